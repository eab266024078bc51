"""The dense trajectory: every scan between nodes is registered to the final map."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from hybridmap.geometry import Array, between, compose, interpolate, wrap_angle
from hybridmap.streams.laser import Laser, LaserScan
from hybridmap.trajectory import Anchors, anchors_on
from hybridmap.vision.laser.cloud import Cloud, build_field, clouds_of_scans, merged_at
from hybridmap.vision.laser.scan_matching import Prior, align
from hybridmap.vision.laser.submap import Atlas

BLOCK_NODES = 8
"""Consecutive nodes whose scans share one local map, as their views overlap."""
RADIUS_M, MAP_NODES = 6.0, 60
"""Nodes of a local map: largest distance to its middle, m, and number of the nearest; enough walls in little time."""
PRIOR_M, PRIOR_DEG = 0.02, 6.0
"""Standard deviations of odometry between two nodes, m and degrees: it drifts in heading, hardly in distance."""
INLIERS_MIN = 0.6
"""Least share of inliers of an accepted scan: as of a good registration of a node."""
OFF_MAX_M, OFF_MAX_DEG = 0.3, 17.0
"""Largest accepted correction, m and degrees: half a step between nodes."""
TURN_AS_TRAVEL_M = 0.3
"""A turn by a radian counts as so much travel, m."""
NOWHERE_M = 1e6
"""Coordinate of points that only fill an array, m."""


@dataclass(frozen=True, slots=True)
class ObservedScan:
    """A scan, the node from which the robot was seen (-1 before the first), and its pose (3,) in that node's frame by odometry.

    That is the last node before the scan, or an older one on which the robot was followed.
    """

    scan: LaserScan
    node: int
    motion: Array
    followed: bool = False


class DenseTrajectory:
    """Registers the scans between nodes to the final map, a block of consecutive nodes at a time."""

    def __init__(self, atlas: Atlas, laser: Laser) -> None:
        self._atlas = atlas
        self._laser = laser

    def dense_trajectory(self, scans: Sequence[ObservedScan], steps: Array, poses: Array) -> Anchors:
        """Poses of the robot at the scans, those of the nodes among them, tied to the nodes before and after.

        Scans that do not fit the map are left out, and those around a kidnapping: odometry does not show on which side of it
        they were taken.

        Args:
            scans: every scan since the first node, in order of time; the scan of a node itself has zero motion.
            steps: (N - 1, 3) pose of the next node in the frame of each, by the path integrator, m and rad; NaN where the robot
                was followed on older nodes in between.
            poses: (N, 3) of the nodes in the final map, m and rad.
        """
        nodes = np.array([s.node for s in scans], dtype=np.int64)
        motions = np.array([s.motion for s in scans]).reshape(-1, 3)
        onward = ~np.array([s.followed for s in scans], dtype=bool)
        expected, jumped = _expected(nodes, motions, steps.reshape(-1, 3), poses, onward)
        found, fits = expected[0].copy(), np.zeros(len(scans))
        for first, stop in self._blocks():
            block = np.flatnonzero((nodes >= first) & (nodes < stop))
            for start in expected:
                if len(block):
                    clouds = self._clouds([scans[i].scan for i in block.tolist()])
                    pose, fit = self._register(clouds, start[block], poses[first:stop], poses)
                    better = fit > fits[block]
                    found[block[better]], fits[block[better]] = pose[better], fit[better]
                block = block[jumped[block]]
        good = fits >= INLIERS_MIN
        for piece in self._atlas.pieces[1:]:
            if piece.start in self._atlas.resumed:
                continue
            good[(nodes == piece.start - 1) & (_way(motions) > 0.0)] = False
        stamps = np.array([s.scan.stamp_ns for s in scans], dtype=np.int64)
        return anchors_on(poses, stamps[good], nodes[good], between(poses[nodes[good]], found[good]))

    def _blocks(self) -> list[tuple[int, int]]:
        """First and one past the last node of each block, within one piece of the chain."""
        size = BLOCK_NODES
        return [(first, min(first + size, p.stop)) for p in self._atlas.pieces for first in range(p.start, p.stop, size)]

    def _clouds(self, scans: list[LaserScan]) -> list[Cloud]:
        return clouds_of_scans([scan.ranges_m for scan in scans], self._laser, self._atlas.scene.scale)

    def _register(self, clouds: list[Cloud], expected: Array, block: Array, poses: Array) -> tuple[Array, Array]:
        """Poses (K, 3) of a block's scans, and the share (K,) of each that fits; 0 where it is too far from `expected`."""
        distance = np.hypot(*(poses[:, :2] - block[:, :2].mean(axis=0)).T)
        near = np.argsort(distance, kind="stable")[:MAP_NODES]
        near = np.union1d(near[distance[near] < RADIUS_M], np.argsort(distance, kind="stable")[:1])
        local = merged_at([self._atlas.clouds[i] for i in near.tolist()], poses[near])
        field = build_field(local)
        stack, counts = _stacked(clouds)
        prior = Prior(expected, PRIOR_M, float(np.deg2rad(PRIOR_DEG)))
        alignment = align(field, stack, expected, prior)
        inliers = alignment.inliers * stack.points.shape[1] / np.maximum(counts, 1)
        off = between(expected, alignment.poses)
        close = (np.hypot(off[:, 0], off[:, 1]) < OFF_MAX_M) & (np.abs(off[:, 2]) < np.deg2rad(OFF_MAX_DEG))
        return alignment.poses, np.where(close, inliers, 0.0)


def _stacked(clouds: list[Cloud]) -> tuple[Cloud, NDArray[np.int64]]:
    """One cloud with arrays (K, P, 2), short ones filled with points far from every wall; and how many points are real."""
    counts = np.array([len(c) for c in clouds], dtype=np.int64)
    points = np.full((len(clouds), max(int(counts.max()), 1), 2), NOWHERE_M)
    normals = np.zeros_like(points)
    for k, cloud in enumerate(clouds):
        points[k, : counts[k]], normals[k, : counts[k]] = cloud.points, cloud.normals
    return Cloud(points, normals), counts


def _expected(
    nodes: NDArray[np.int64], motions: Array, steps: Array, poses: Array, onward: NDArray[np.bool_]
) -> tuple[list[Array], NDArray[np.bool_]]:
    """Poses on the map by odometry, (S, 3) each, from which scans are registered, and where (S,) the latter two are wanted.

    The first are propagated from the node before, and blended with those propagated back from the node after. Where these two
    differ by more than a scan may be off, the robot slid or was carried at one moment, and each of them is right on one side
    of it. `onward` (S,) are the scans after which the next node was made; the others are only propagated from the node before.
    """
    forward = compose(poses[nodes], motions)
    blended, backward, jumped = forward.copy(), forward.copy(), np.zeros(len(nodes), dtype=bool)
    inside = np.flatnonzero(onward & (nodes < len(poses) - 1))
    inside = inside[np.isfinite(steps[nodes[inside], 0])]
    if len(inside) == 0:
        return [blended], jumped
    node, motion = nodes[inside], motions[inside]
    backward[inside] = compose(poses[node + 1], between(steps[node], motion))
    share = (_way(motion) / np.maximum(_way(steps[node]), 1e-6)).clip(0.0, 1.0)
    blended[inside] = interpolate(forward[inside], backward[inside], share)
    off = between(forward, backward)
    jumped = np.hypot(off[:, 0], off[:, 1]) > OFF_MAX_M
    return [blended, forward, backward], np.asarray(jumped)


def _way(motion: Array) -> Array:
    return np.asarray(np.hypot(motion[:, 0], motion[:, 1]) + TURN_AS_TRAVEL_M * np.abs(wrap_angle(motion[:, 2])))
