"""How sure an odometry edge is."""

from __future__ import annotations

import numpy as np

from hybridmap.config.mapping import EdgesConfig
from hybridmap.geometry import Array


def odometry_covariance(config: EdgesConfig, travel_m: float, turn_rad: float) -> Array:
    """Covariance (3, 3) of a stretch of dead reckoning, in the frame of its end (m^2, rad^2).

    Both standard deviations grow with the root of the way, as a random walk does; a heading that wanders along a
    straight way of length s moves the end sideways by s / sqrt(3) times its own deviation, with correlation -sqrt(3)/2
    as seen from the end.

    Args:
        config: growth rates and floors.
        travel_m: path length of the stretch.
        turn_rad: absolute angle turned on it.
    """
    position = config.translation_floor_m**2 + config.translation_per_sqrt_m**2 * travel_m
    walk = np.deg2rad(config.rotation_deg_per_sqrt_m) ** 2 * travel_m
    heading = np.deg2rad(config.rotation_floor_deg) ** 2 + walk + config.rotation_per_turn**2 * turn_rad
    sideways = position + walk * travel_m**2 / 3.0
    cross = -walk * travel_m / 2.0
    return np.array([[position, 0.0, 0.0], [0.0, sideways, cross], [0.0, cross, heading]])
