"""Small streams for the tests of the mapper and of the parts behind it."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, field

import numpy as np

from hybridmap.geometry import compose
from hybridmap.streams.base import Rig, Sample, SelfMotion, StreamReport
from hybridmap.streams.laser import Laser, LaserScan
from hybridmap.trajectory import NS_PER_S, Trajectory

BEARINGS = np.deg2rad(np.arange(-135.0, 135.1, 1.5))
WALLS = np.array(  # x0, y0, x1, y1; a niche, a pillar and a slanted wall make all places look different
    [
        [-3, -2, 5, -2], [5, -2, 5, 3], [5, 3, 1.5, 3], [1.5, 3, 1.5, 4], [1.5, 4, 0.5, 4], [0.5, 4, 0.5, 3],
        [0.5, 3, -2, 3], [-2, 3, -3, 1.5], [-3, 1.5, -3, -2], [3.2, 0.2, 3.8, 0.2], [3.8, 0.2, 3.8, 0.8], [3.8, 0.8, 3.2, 0.8],
        [3.2, 0.8, 3.2, 0.2],
    ],
    dtype=float,
)  # fmt: skip


def scan(pose: np.ndarray, walls: np.ndarray = WALLS) -> np.ndarray:
    """Return the ranges (B,) that a laser measures from a pose in the room, or between other walls."""
    angle = pose[2] + BEARINGS
    direction = np.stack([np.cos(angle), np.sin(angle)], axis=1)[:, None]
    start, along = walls[:, :2] - pose[:2], walls[:, 2:] - walls[:, :2]
    cross = direction[..., 0] * along[:, 1] - direction[..., 1] * along[:, 0]
    cross = np.where(cross == 0, 1e-12, cross)
    t = (start[:, 0] * along[:, 1] - start[:, 1] * along[:, 0]) / cross
    u = (start[:, 0] * direction[..., 1] - start[:, 1] * direction[..., 0]) / cross
    nearest: np.ndarray = np.where((t > 0) & (u >= 0) & (u <= 1), t, np.inf).min(axis=1)
    return nearest.astype(np.float32)


@dataclass
class RoomDrive:
    """A stream of laps on a circle in the room. Scans come at 5 Hz, odometry with a heading bias at 10 Hz."""

    laps: float = 3.0
    bias_rad_per_m: float = 0.03
    with_scans: bool = True
    nan_at: int | None = None
    name: str = "room"
    report: StreamReport = field(default_factory=StreamReport)

    @property
    def rig(self) -> Rig:
        return Rig(laser=Laser(BEARINGS, 0.05, 30.0, np.array([0.1, 0.0, 0.0]))) if self.with_scans else Rig()

    @property
    def expected_observations(self) -> int | None:
        return None

    @property
    def groundtruth(self) -> Trajectory:
        poses = self._true_poses()
        return Trajectory(np.arange(len(poses)) * NS_PER_S // 10, poses)

    def _true_poses(self) -> np.ndarray:
        angle = np.arange(0.0, 2 * np.pi * self.laps, 0.05)
        return np.stack([1.2 * np.sin(angle), -1.2 * np.cos(angle), angle], axis=1)

    def __iter__(self) -> Iterator[Sample]:
        rng = np.random.default_rng(1)
        odom = np.zeros(3)
        step = np.array([0.06, 0.0, 0.05])
        for i, pose in enumerate(self._true_poses()):
            stamp_ns = i * NS_PER_S // 10
            value = np.full(3, np.nan) if i == self.nan_at else odom
            yield SelfMotion(stamp_ns, value)
            if self.with_scans and i % 2 == 0:
                laser = compose(pose, np.array([0.1, 0.0, 0.0]))
                yield LaserScan(stamp_ns, scan(laser) + rng.normal(0, 0.01, len(BEARINGS)).astype(np.float32))
            noisy = step + np.array([0.0, 0.0, self.bias_rad_per_m * 0.06]) + rng.normal(0, [0.001, 0.0, 0.002])
            odom = compose(odom, noisy)
