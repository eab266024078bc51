"""One scan as points with normals in `base_link`, and the merging of many into one cloud."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from hybridmap.config.laser import ScanConfig
from hybridmap.geometry import Array
from hybridmap.streams.base import Laser

NEIGHBOURS = 3


@dataclass(frozen=True, slots=True)
class Cloud:
    """Points of walls, with normals that point to the robot which saw them.

    Attributes:
        points: (P, 2) m.
        normals: (P, 2) unit vectors; (0, 0) where the neighbours of a point are no line.
    """

    points: Array
    normals: Array

    def __len__(self) -> int:
        return len(self.points)

    def moved(self, pose_a_b: Array) -> Cloud:
        """The same cloud in frame a, given in frame b."""
        cos, sin = np.cos(pose_a_b[2]), np.sin(pose_a_b[2])
        turn = np.array([[cos, sin], [-sin, cos]])
        return Cloud(self.points @ turn + pose_a_b[:2], self.normals @ turn)

    def thinned(self, count: int) -> Cloud:
        """At most `count` points, evenly picked in their order."""
        if len(self) <= count:
            return self
        pick = (np.arange(count) * (len(self) / count)).astype(np.int64)
        return Cloud(self.points[pick], self.normals[pick])


EMPTY = Cloud(np.zeros((0, 2)), np.zeros((0, 2)))


def cloud_of_scan(ranges_m: NDArray[np.float32], laser: Laser, config: ScanConfig) -> Cloud:
    """Points of one scan in `base_link`, merged by cell.

    Args:
        ranges_m: (B,) ranges, NaN where invalid.
        laser: bearings and mounting.
        config: range limit and cell size.
    """
    ranges = ranges_m.astype(np.float64)
    valid = (ranges >= laser.range_min_m) & (ranges <= min(laser.range_max_m, config.range_max_m))
    ranges, bearings = ranges[valid], laser.bearings_rad[valid]
    if len(ranges) < 2 * NEIGHBOURS + 1:
        return EMPTY
    points = np.stack([ranges * np.cos(bearings), ranges * np.sin(bearings)], axis=1)
    step = abs(float(laser.bearings_rad[-1] - laser.bearings_rad[0])) / max(len(laser.bearings_rad) - 1, 1)
    normals = _normals(points, np.minimum(1.0, 0.1 + 8.0 * step * ranges))
    return merged([Cloud(points, normals).moved(laser.pose_base_laser)], config.cell_m)


def merged(clouds: Iterable[Cloud], cell_m: float) -> Cloud:
    """All points, those of one cell averaged; the order follows the cells, so it depends on the points alone."""
    parts = [c for c in clouds if len(c)]
    if not parts:
        return EMPTY
    points = np.concatenate([c.points for c in parts])
    normals = np.concatenate([c.normals for c in parts])
    low = points.min(axis=0)
    cells = ((points - low) / cell_m).astype(np.int64)
    key = cells[:, 0] * (int(cells[:, 1].max()) + 1) + cells[:, 1]
    _, group, count = np.unique(key, return_inverse=True, return_counts=True)
    n = len(count)
    mean: Array = np.stack([np.bincount(group, points[:, i], n) / count for i in (0, 1)], axis=1)
    normal: Array = np.stack([np.bincount(group, normals[:, i], n) for i in (0, 1)], axis=1)
    length = np.sqrt((normal**2).sum(axis=1))
    normal = np.where((length > 0.3)[:, None], normal / np.maximum(length, 1e-9)[:, None], 0.0)
    return Cloud(mean, normal)


def _normals(points: Array, reach_m: Array) -> Array:
    """Normal of the line through each point's neighbours in beam order, towards the laser at the origin; (P, 2)."""
    n = len(points)
    window = np.arange(n)[:, None] + np.arange(-NEIGHBOURS, NEIGHBOURS + 1)[None]
    inside = (window >= 0) & (window < n)
    offset = points[np.clip(window, 0, n - 1)] - points[:, None]
    dx, dy = offset[..., 0], offset[..., 1]
    w = (inside & (dx * dx + dy * dy <= (reach_m**2)[:, None])).astype(np.float64)
    total = w.sum(axis=1)
    mx, my = (w * dx).sum(axis=1) / total, (w * dy).sum(axis=1) / total
    xx = (w * dx * dx).sum(axis=1) / total - mx * mx
    yy = (w * dy * dy).sum(axis=1) / total - my * my
    xy = (w * dx * dy).sum(axis=1) / total - mx * my
    along = 0.5 * np.arctan2(2.0 * xy, xx - yy)
    normal = np.stack([-np.sin(along), np.cos(along)], axis=1)
    spread = np.sqrt((xx - yy) ** 2 + 4.0 * xy * xy)
    is_line = (total >= 3.0) & ((xx + yy - spread) <= 0.1 * (xx + yy + spread))
    normal *= np.where((normal * points).sum(axis=1) > 0.0, -1.0, 1.0)[:, None]
    return np.where(is_line[:, None], normal, 0.0)
