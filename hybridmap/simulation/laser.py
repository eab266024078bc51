"""The simulated planar laser."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from hybridmap.config.inputs import LaserScannerConfig
from hybridmap.geometry import Array
from hybridmap.simulation.scene import Scene
from hybridmap.streams.laser import Laser, LaserScan

FORWARD_M = 0.15
"""The laser stands this far in front of `base_link`, m."""
HEIGHT_M = 0.3
"""Height of the scanning plane, m: it meets the legs of tables and the fronts of cupboards."""
RANGE_MIN_M = 0.05
"""No return nearer than this, m."""
NOISE_M = 0.01
"""Standard deviation of a range, m: that of the small scanners of indoor robots."""
DROP_FRACTION = 0.002
"""Share of beams without a return."""


def laser_of(config: LaserScannerConfig) -> Laser:
    """Bearings and mounting; bearings are those that a LaserScan message with its 32-bit angles gives."""
    field = np.deg2rad(config.field_of_view_deg)
    steps = config.beams if config.field_of_view_deg >= 360.0 else config.beams - 1
    first, step = float(np.float32(-0.5 * field)), float(np.float32(field / steps))
    bearings = first + np.arange(config.beams, dtype=np.float64) * step
    low, high = (float(np.float32(value)) for value in (RANGE_MIN_M, config.range_max_m))
    return Laser(bearings, low, high, np.array([FORWARD_M, 0.0, 0.0]))


class LaserModel:
    """Scans one scene in a plane parallel to the floor."""

    def __init__(self, scene: Scene, config: LaserScannerConfig, noise: float = 1.0) -> None:
        self._scene = scene
        self._noise = noise
        self.laser = laser_of(config)

    def scan(self, stamp_ns: int, pose_world_base: Array, rng: np.random.Generator) -> LaserScan:
        """What the laser measures from a pose (3,), m and rad, with the noise of `rng`."""
        x, y, yaw = pose_world_base
        angle = self.laser.bearings_rad + yaw
        rays = np.column_stack([np.cos(angle), np.sin(angle), np.zeros(len(angle))]).astype(np.float32)
        origin = np.array([x + FORWARD_M * np.cos(yaw), y + FORWARD_M * np.sin(yaw), HEIGHT_M])
        hits = self._scene.cast(origin, rays)
        ranges = np.where(hits.hit, hits.length, np.inf).astype(np.float64)
        ranges = ranges + self._noise * NOISE_M * rng.standard_normal(len(ranges))
        dropped = rng.random(len(ranges)) < self._noise * DROP_FRACTION
        return LaserScan(stamp_ns, self._valid(ranges.astype(np.float32), dropped))

    def _valid(self, ranges: NDArray[np.float32], dropped: NDArray[np.bool_]) -> NDArray[np.float32]:
        inside = (ranges >= np.float32(self.laser.range_min_m)) & (ranges < np.float32(self.laser.range_max_m))
        return np.where(inside & ~dropped, ranges, np.float32(np.nan))
