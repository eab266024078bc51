"""Whether a laser robot can have driven where its chain has it, by the free space that its scans see."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from hybridmap.config.vision import VisionConfig
from hybridmap.geometry import IDENTITY, Array, RelativePose, between, compose
from hybridmap.graph.edges import Check, Edge
from hybridmap.streams.laser import Laser, LaserScan
from hybridmap.vision.base import Belief
from hybridmap.vision.gating import nodes_within
from hybridmap.vision.laser import checks
from hybridmap.vision.laser.cloud import Cloud, cloud_of_scan, merged_at
from hybridmap.vision.laser.hypotheses import GATE_DEG, GATE_INFLATION, GATE_M, LENGTH_M, TARGET_HALF_M
from hybridmap.vision.laser.likelihood import build_field
from hybridmap.vision.laser.registration import Prior, align
from hybridmap.vision.laser.submap import Atlas, Submap
from hybridmap.vision.laser.tracking import Step, Tracker
from hybridmap.vision.laser.visibility import violation_both_ways
from hybridmap.vision.relocalising import placed_by

MAP_VIOLATION = 0.4
"""The map contradicts the last scans if more of either's walls than this share lie in the other's free space: another room."""
SURE_M = 0.3
"""It can contradict them only where it is this sure of where they lie (standard deviation of the position), m."""
RECENT_M = 4.0
"""Travel of the last scans that are held against the map."""
SEEN_M, SEEN_NODES = 4.0, 20
"""The old nodes that they are held against: the nearest ones, so near."""
LOOSE_M, LOOSE_RAD = 0.3, float(np.deg2rad(5.0))
"""How well the place of a single scan is known, where it is held against the map."""
DECIDED = 3.0
"""Going back from where the robot was found, so many scans in favour of the chain say that it was carried later."""


class Continuity:
    """Judges the chain of the atlas."""

    def __init__(self, config: VisionConfig, atlas: Atlas, laser: Laser, tracker: Tracker) -> None:
        self._may_be_lost, self._gate_sigmas = config.relocalising.enabled, config.closing.gate_sigmas
        self._atlas = atlas
        self._laser = laser
        self._tracker = tracker

    def broken(
        self, node: int, step: Step, odometry: RelativePose, on_the_way: Sequence[tuple[Array, LaserScan]]
    ) -> tuple[Check, ...]:
        """Checks that say that the robot did not drive to the newest node of the atlas; empty where the chain holds.

        The registration does not fit, or contradicts the odometry far beyond its covariance; the scans of the two nodes look
        through each other's walls; and on the way there is a scan that does not follow on the one before it, as it fits
        nowhere near or looks through its walls. A drop-out of the wheels contradicts the odometry as well, and people and
        doors let a scan look through walls; but then each scan follows on another.

        Args:
            node: the newest node.
            step: how the scans have it that the robot moved to it.
            odometry: how the wheels have it.
            on_the_way: in order, the scans between the two nodes, and where the wheels have them: motion (3,) since the first.
        """
        if not self._may_be_lost:
            return ()
        error = between(odometry.delta, step.relative.delta)
        sigmas = float(np.sqrt(error @ np.linalg.solve(odometry.covariance, error)))
        if step.measured and sigmas <= checks.CONTRADICTION_SIGMAS:
            return ()
        last, here = (_alone(self._atlas.clouds[i], i) for i in (node - 1, node))
        seen = violation_both_ways(here, last, step.relative.delta, self._atlas.ranges, self._laser)
        if seen <= checks.WAY_VIOLATION or self._follow(node, odometry.delta, on_the_way):
            return ()
        return checks.of_way(sigmas if step.measured else None, seen)

    def contradicted(self, node: int, belief: Belief) -> bool:
        """Whether the last scans and the old ones, where a sure map has the robot, look through each other's walls."""
        poses = belief.poses_map_node
        near = nodes_within(poses, node, SEEN_M, np.pi, self._old(node))
        if len(near) == 0 or np.trace(belief.covariance_from(node)[near, :2, :2], axis1=1, axis2=2).min() > SURE_M**2:
            return False
        here = self._atlas.submap(node, self._atlas.along(node, RECENT_M, 0.0))
        there = self._seen_about(poses[node], near, poses)
        return violation_both_ways(here, there, IDENTITY, self._atlas.ranges, self._laser) > MAP_VIOLATION

    def carried_unnoticed(self, sightings: Sequence[Edge], belief: Belief) -> int | None:
        """The node to which the robot was carried without anything that showed it, once sightings say where it is.

        The sightings lie outside the gate: the chain cannot have drifted so far. The scans before that node fit where the
        chain has them better than where the sightings have them, and those since then the other way round; the chain counts
        as `tracking.inliers_min` where there is no old map. None where the chain is better, or has only drifted.

        Args:
            sightings: loops that put the robot elsewhere than the chain.
            belief: the map's, without them.
        """
        found, poses = min(s.source for s in sightings), belief.poses_map_node
        there = placed_by(sightings, found, poses)
        if self._may_have_drifted(found, there, min(s.target for s in sightings), belief):
            return None
        total, best, carried_to = 0.0, 0.0, None
        for node in range(found, 0, -1):
            pose = compose(there, between(poses[found], poses[node]))
            by_chain = max(self._fit(node, poses[node], poses), checks.INLIERS_MIN)
            total += self._fit(node, pose, poses) - by_chain
            if total > best:
                best, carried_to = total, node
            if total < best - DECIDED:
                break
        return carried_to

    def _may_have_drifted(self, node: int, there: Array, target: int, belief: Belief) -> bool:
        """Whether a pose (3,) of a node that was measured from an old one lies inside the gate of a probe."""
        covariance = belief.covariance_from(target)[node]
        off = between(belief.poses_map_node[node], there)
        sigma_m = float(np.sqrt(np.linalg.eigvalsh(covariance[:2, :2])[1]))
        width = self._gate_sigmas * GATE_INFLATION
        near = np.hypot(off[0], off[1]) <= width * sigma_m + GATE_M
        return bool(near and abs(off[2]) <= width * np.sqrt(covariance[2, 2]) + np.deg2rad(GATE_DEG))

    def _old(self, node: int) -> int:
        """The first node that is not old at a node: a probe and half of a target lie between them."""
        return int(self._atlas.along(node, LENGTH_M + TARGET_HALF_M, 0.0)[0])

    def _fit(self, node: int, pose: Array, poses: Array) -> float:
        """Share of a node's scan that fits what old nodes saw about a pose (3,) on the map; 0 where there are none."""
        old = poses[: self._old(node)]
        near = np.flatnonzero(np.hypot(*(old[:, :2] - pose[:2]).T) < SEEN_M)
        if len(near) == 0:
            return 0.0
        walls = self._seen_about(pose, near, poses).cloud
        field = build_field(walls)
        prior = Prior(IDENTITY, LOOSE_M, LOOSE_RAD)
        return float(align(field, self._atlas.clouds[node], IDENTITY[None], prior).inliers[0])

    def _seen_about(self, pose: Array, near: NDArray[np.int64], poses: Array) -> Submap:
        """The nearest of some nodes, as they lie on the map, merged in the frame of a pose (3,)."""
        away = np.hypot(*(poses[near, :2] - pose[:2]).T)
        nearest = np.sort(near[np.argsort(away, kind="stable")[:SEEN_NODES]])
        there = between(pose, poses[nearest])
        cloud = merged_at([self._atlas.clouds[i] for i in nearest.tolist()], there)
        return Submap(int(nearest[0]), nearest, there, cloud)

    def _follow(self, node: int, odometry: Array, on_the_way: Sequence[tuple[Array, LaserScan]]) -> bool:
        """Whether each scan from the last node to the newest fits the one before it, and neither looks through the other."""
        atlas = self._atlas
        clouds = [cloud_of_scan(scan.ranges_m, self._laser) for _, scan in on_the_way]
        clouds = [atlas.clouds[node - 1], *clouds, atlas.clouds[node]]
        ranges = [atlas.ranges[node - 1], *(scan.ranges_m for _, scan in on_the_way), atlas.ranges[node]]
        wheels = [IDENTITY, *(motion for motion, _ in on_the_way), odometry]
        for i in range(len(clouds) - 1):
            found = self._tracker.pair(clouds[i], clouds[i + 1], between(wheels[i], wheels[i + 1]))
            here, there = _alone(clouds[i + 1], i + 1), _alone(clouds[i], i)
            seen = violation_both_ways(here, there, found.poses[0], ranges, self._laser)
            if found.inliers[0] < checks.INLIERS_WEAK or seen > checks.WAY_VIOLATION:
                return False
        return True


def _alone(cloud: Cloud, number: int) -> Submap:
    """A submap of one scan."""
    return Submap(number, np.array([number]), IDENTITY[None], cloud)
