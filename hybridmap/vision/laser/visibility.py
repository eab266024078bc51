"""Free space: a wall of one submap must not stand where the beams of the other went through."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from hybridmap.geometry import Array, compose, inverse, transform_points
from hybridmap.streams.base import Laser
from hybridmap.vision.laser.submap import Submap

MARGIN_M = 0.25
VIEWPOINTS = 6
POINTS = 250


def violation(
    walls: Submap, seers: Submap, pose_seers_walls: Array, ranges: Sequence[NDArray[np.float32]], laser: Laser
) -> float:
    """Share of one submap's visible points that lie in the free space of another.

    Args:
        walls: whose points are asked about.
        seers: whose scans look at them.
        pose_seers_walls: (3,) frame of `walls` in that of `seers`.
        ranges: (B,) ranges of every node's scan, by node.
        laser: bearings and mounting.
    """
    points = transform_points(pose_seers_walls, walls.cloud.thinned(POINTS).points)
    seen = through = 0
    for i in seers.viewpoints(VIEWPOINTS):
        pose = compose(seers.poses[i], laser.pose_base_laser)
        free, hit = _look(transform_points(inverse(pose), points), ranges[int(seers.nodes[i])], laser)
        seen, through = seen + int(hit.sum()) + int(free.sum()), through + int(free.sum())
    return through / max(seen, 1)


def _look(points: Array, ranges_m: NDArray[np.float32], laser: Laser) -> tuple[NDArray[np.bool_], NDArray[np.bool_]]:
    """Which points (P, 2) in the laser's frame a scan looks through, and which it sees as walls."""
    bearings = laser.bearings_rad
    increment = float(bearings[-1] - bearings[0]) / max(len(bearings) - 1, 1)
    distance = np.hypot(points[:, 0], points[:, 1])
    turn = (np.arctan2(points[:, 1], points[:, 0]) - float(bearings[0])) * np.sign(increment) % (2.0 * np.pi)
    beam = np.round(turn / abs(increment)).astype(np.int64)
    inside = (beam >= 1) & (beam < len(bearings) - 1)
    beam = beam.clip(1, len(bearings) - 2)
    three = np.stack([ranges_m[beam - 1], ranges_m[beam], ranges_m[beam + 1]])
    usable = inside & np.isfinite(three).all(axis=0)
    margin = MARGIN_M + 0.03 * distance
    free = usable & (distance < np.nan_to_num(three).min(axis=0) - margin)
    hit = usable & ~free & (distance < np.nan_to_num(three).max(axis=0) + margin)
    return free, hit
