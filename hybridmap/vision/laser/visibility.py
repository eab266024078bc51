"""Free space: a wall of one submap must not stand where the beams of the other went through."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from hybridmap.geometry import Array, compose, inverse
from hybridmap.streams.laser import Laser
from hybridmap.vision.laser.cloud import Cloud
from hybridmap.vision.laser.submap import Submap

Marks = NDArray[np.bool_]

MARGIN_M, MARGIN_PER_M = 0.25, 0.03
"""A point is in free space where the laser saw farther by so much, m, and by this share of its distance."""
VIEWPOINTS, POINTS = 6, 250
"""Scans of one submap that look at points of the other, and these points, at most."""
GRAZING = 0.3
"""Least cosine between a wall's normal and the ray at which the wall is judged."""


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
    chosen = seers.viewpoints(VIEWPOINTS)
    poses = compose(seers.poses[chosen], laser.pose_base_laser)
    free, hit = _look(cloud, inverse(poses), np.array([ranges[i] for i in seers.nodes[chosen].tolist()]), laser)
    through, seen = free.sum(axis=0), (free | hit).sum(axis=0)
    judged = seen > 0
    return float((2.0 * through > seen)[judged].mean()) if judged.any() else 0.0


def violation_both_ways(
    here: Submap, there: Submap, pose_there_here: Array, ranges: Sequence[NDArray[np.float32]], laser: Laser
) -> float:
    """The larger share of the two, each submap looking at the walls of the other."""
    forth = violation(here, there, pose_there_here, ranges, laser)
    return max(forth, violation(there, here, inverse(pose_there_here), ranges, laser))


def _look(cloud: Cloud, poses_laser_cloud: Array, ranges_m: NDArray[np.float32], laser: Laser) -> tuple[Marks, Marks]:
    """Which points of a cloud each of some scans looks through, and which it sees as walls; (V, P) each.

    Walls that the beams graze are left out: there a small error of the heading is a large one of the range.

    Args:
        cloud: P points.
        poses_laser_cloud: (V, 3) the cloud's frame seen from the laser at each scan.
        ranges_m: (V, B) of the scans.
        laser: bearings.
    """
    x, y = _turned(cloud.points, poses_laser_cloud)
    x, y = x + poses_laser_cloud[:, :1], y + poses_laser_cloud[:, 1:2]
    normal_x, normal_y = _turned(cloud.normals, poses_laser_cloud)
    bearings = laser.bearings_rad
    increment = float(bearings[-1] - bearings[0]) / max(len(bearings) - 1, 1)
    distance = np.hypot(x, y)
    turn = (np.arctan2(y, x) - float(bearings[0])) * np.sign(increment) % (2.0 * np.pi)
    beam = np.round(turn / abs(increment)).astype(np.int64)
    inside = (beam >= 1) & (beam < len(bearings) - 1)
    nearest, farthest = _about(ranges_m)
    beam = beam.clip(1, len(bearings) - 2) - 1
    low, high = np.take_along_axis(nearest, beam, axis=1), np.take_along_axis(farthest, beam, axis=1)
    usable = inside & (np.abs(normal_x * x + normal_y * y) > GRAZING * distance) & np.isfinite(low)
    margin = MARGIN_M + MARGIN_PER_M * distance
    free = usable & (distance < low - margin)
    return free, usable & ~free & (distance < high + margin)


def _turned(vectors: Array, poses: Array) -> tuple[Array, Array]:
    """Components (V, P) each of vectors (P, 2) turned by the headings of V poses."""
    cos, sin = np.cos(poses[:, 2:]), np.sin(poses[:, 2:])
    return cos * vectors[:, 0] - sin * vectors[:, 1], sin * vectors[:, 0] + cos * vectors[:, 1]


def _about(ranges_m: NDArray[np.float32]) -> tuple[NDArray[np.float32], NDArray[np.float32]]:
    """Least and largest (V, B - 2) of each beam and its two neighbours; NaN where one of them has no return."""
    before, at, after = ranges_m[:, :-2], ranges_m[:, 1:-1], ranges_m[:, 2:]
    return np.minimum(np.minimum(before, at), after), np.maximum(np.maximum(before, at), after)
