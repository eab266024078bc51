"""Free space: a wall of one submap must not stand where the beams of the other went through."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from hybridmap.geometry import Array, compose, inverse
from hybridmap.streams.base import Laser
from hybridmap.vision.laser.cloud import Cloud
from hybridmap.vision.laser.submap import Submap

MARGIN_M = 0.25
VIEWPOINTS = 6
GRAZING = 0.3
POINTS = 250


def violation(
    walls: Submap, seers: Submap, pose_seers_walls: Array, ranges: Sequence[NDArray[np.float32]], laser: Laser
) -> float:
    """Share of one submap's visible points that most of another's scans which could see them look through.

    Args:
        walls: whose points are asked about.
        seers: whose scans look at them.
        pose_seers_walls: (3,) frame of `walls` in that of `seers`.
        ranges: (B,) ranges of every node's scan, by node.
        laser: bearings and mounting.
    """
    cloud = walls.cloud.thinned(POINTS).moved(pose_seers_walls)
    seen, through = np.zeros(len(cloud)), np.zeros(len(cloud))
    for i in seers.viewpoints(VIEWPOINTS):
        pose = compose(seers.poses[i], laser.pose_base_laser)
        free, hit = _look(cloud.moved(inverse(pose)), ranges[int(seers.nodes[i])], laser)
        seen, through = seen + (free | hit), through + free
    judged = seen > 0
    return float((2.0 * through > seen)[judged].mean()) if judged.any() else 0.0


def _look(cloud: Cloud, ranges_m: NDArray[np.float32], laser: Laser) -> tuple[NDArray[np.bool_], NDArray[np.bool_]]:
    """Which points of a cloud in the laser's frame a scan looks through, and which it sees as walls.

    Walls that the beams graze are left out: there a small error of the heading is a large one of the range.
    """
    points = cloud.points
    bearings = laser.bearings_rad
    increment = float(bearings[-1] - bearings[0]) / max(len(bearings) - 1, 1)
    distance = np.hypot(points[:, 0], points[:, 1])
    turn = (np.arctan2(points[:, 1], points[:, 0]) - float(bearings[0])) * np.sign(increment) % (2.0 * np.pi)
    beam = np.round(turn / abs(increment)).astype(np.int64)
    inside = (beam >= 1) & (beam < len(bearings) - 1)
    beam = beam.clip(1, len(bearings) - 2)
    three = np.stack([ranges_m[beam - 1], ranges_m[beam], ranges_m[beam + 1]])
    steep = np.abs((cloud.normals * points).sum(axis=1)) > GRAZING * distance
    usable = inside & steep & np.isfinite(three).all(axis=0)
    margin = MARGIN_M + 0.03 * distance
    free = usable & (distance < np.nan_to_num(three).min(axis=0) - margin)
    hit = usable & ~free & (distance < np.nan_to_num(three).max(axis=0) + margin)
    return free, hit
