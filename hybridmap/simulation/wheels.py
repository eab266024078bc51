"""Wheel odometry with the errors that real wheels have: wrong scale, a pull to one side, noise and slip."""

from __future__ import annotations

import numpy as np

from hybridmap.config.inputs import WheelErrorConfig
from hybridmap.geometry import Array, between, quaternion_from_yaw, wrap_angle, yaw_from_quaternion

TRANSLATION_M_PER_SQRT_M = 0.006
"""White noise of the distance, m per sqrt(m)."""
ROTATION_DEG_PER_SQRT_M = 0.6
"""White noise of the heading, degrees per sqrt(m) driven."""
ROTATION_PER_TURN = 0.012
"""White noise of the heading, radians per sqrt(radian) turned."""
SLIPS_PER_M = 0.02
"""Slips a metre driven, on average. With the noise above: a differential drive with rubber wheels on a smooth floor."""
SLIP_M, SLIP_DEG = 0.02, 1.0
"""Standard deviations of the distance and of the heading that a slip loses, m and degrees."""


def wheel_odometry(true_poses: Array, errors: WheelErrorConfig, rng: np.random.Generator) -> Array:
    """Poses (N, 3) of `base_link` in `odom` that the wheels report; the first is the identity.

    Args:
        true_poses: (N, 3) m and rad, of the world.
        errors: figures of the wheels.
        rng: of this robot's wheels.
    """
    steps = between(true_poses[:-1], true_poses[1:])
    ahead, turn = steps[:, 0] * 1.0, steps[:, 2] * 1.0
    metres, turned = np.abs(ahead), np.abs(turn)
    factor, noise = errors.noise, rng.standard_normal((3, len(steps)))
    ahead = ahead * (1.0 + errors.scale_bias) + factor * TRANSLATION_M_PER_SQRT_M * np.sqrt(metres) * noise[0]
    turn = turn * (1.0 + errors.turn_bias) + np.deg2rad(errors.heading_bias_deg_per_m) * metres
    turn += (
        np.deg2rad(factor * ROTATION_DEG_PER_SQRT_M) * np.sqrt(metres) * noise[1]
        + factor * ROTATION_PER_TURN * np.sqrt(turned) * noise[2]
    )
    slipping = rng.random(len(steps)) < factor * SLIPS_PER_M * metres
    ahead -= slipping * np.abs(rng.normal(0.0, factor * SLIP_M, len(steps)))
    turn += slipping * np.deg2rad(rng.normal(0.0, factor * SLIP_DEG, len(steps)))
    yaw = np.concatenate([[0.0], np.cumsum(turn)])
    middle = yaw[:-1] + 0.5 * turn
    position = np.cumsum(np.column_stack([ahead * np.cos(middle), ahead * np.sin(middle)]), axis=0)
    return np.column_stack([np.vstack([np.zeros(2), position]), as_transmitted(yaw)])


def as_transmitted(yaw_rad: Array) -> Array:
    """Headings (N,) as they come back from the quaternions in which messages and files carry them."""
    return yaw_from_quaternion(*quaternion_from_yaw(wrap_angle(yaw_rad)).T)
