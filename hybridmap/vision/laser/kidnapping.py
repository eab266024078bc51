"""Whether a laser robot was kidnapped, by the free space that its scans see; and the search for it on the whole map."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from hybridmap.config.vision import VisionConfig
from hybridmap.geometry import IDENTITY, Array, RelativePose, between, compose
from hybridmap.graph.edges import Check, Edge, Lack
from hybridmap.streams.laser import Laser, LaserScan
from hybridmap.vision.base import Belief
from hybridmap.vision.gating import nodes_within
from hybridmap.vision.laser import checks
from hybridmap.vision.laser.cloud import Cloud, build_field, cloud_of_scan, merged_at
from hybridmap.vision.laser.hypotheses import GATE_DEG, GATE_INFLATION, GATE_M, LENGTH_M, TARGET_HALF_M, Hypothesis, Prober
from hybridmap.vision.laser.scan_matching import Prior, align
from hybridmap.vision.laser.submap import Atlas, Submap, violation_both_ways
from hybridmap.vision.laser.tracking import Step, Tracker
from hybridmap.vision.profile import Profile
from hybridmap.vision.relocalising import Chain, Relocaliser, Settlement, Sighting, Whereabouts, placed_by
from hybridmap.vision.templates import Matcher

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


UNRECOGNISED_PROBES = 2
"""Probes that recognise nothing while the map contradicts what is seen, with none that does between them, after which the
robot is lost too."""
SPAN_M = 1.5
"""Travel that sightings must cover, m: submaps that overlap less than they say something new."""
FROM_M, OFTEN_M = 0.9, 6.0
"""Travel since the break from which on the scans since then are held against the whole map, and up to which that is done at
each node, m; then as often as loops are looked for."""
SUBMAPS = 100
"""Old submaps that are searched, at most; where there are more, those whose views are likest."""
MISFIT = 0.015
"""Where the scans of the drive fit one another better than so (the share that does not), a sighting that fits as badly as
elsewhere is a worse one: its mismatch counts for more, in proportion."""
MISFIT_STEPS = 10
"""Steps for which the usual misfit of scans is taken before any was seen."""
ALIKE = (0.5, 0.5)
"""Weights of intensity and depth where views are ranked: a laser's profile has the one band, and they do not matter."""


class WholeMap:
    """Whether a laser robot is lost, and the search for it. The newer node is the source of an edge.

    Where the chain breaks a new piece of the atlas begins. Its scans are held against all submaps of before, and what fits
    is a sighting, until enough of them agree (`Relocaliser`).
    """

    def __init__(
        self,
        config: VisionConfig,
        atlas: Atlas,
        prober: Prober,
        continuity: Continuity,
        profiles: Sequence[Profile],
        new_key: Callable[[], int],
    ) -> None:
        self._every_m = config.laser.probes.every_m
        self._atlas = atlas
        self._prober = prober
        self._profiles = profiles
        self._new_key = new_key
        self._continuity = continuity
        self._whereabouts = Whereabouts(UNRECOGNISED_PROBES if config.relocalising.enabled else 0)
        self._relocaliser = Relocaliser(self._whereabouts, new_key, SPAN_M)
        self._views = Matcher("plain", *ALIKE, max_shift=config.profile.max_shift)
        self._misfits, self._steps = MISFIT_STEPS * MISFIT, MISFIT_STEPS
        self._broken_at: int | None = None
        self._lost_m, self._searched_m = 0.0, -np.inf

    @property
    def lost_since(self) -> int | None:
        """The node at which the chain broke, while the robot is not found."""
        return self._broken_at

    @property
    def since(self) -> int:
        """The first node of the piece of map that the robot surely is on: 0, or where the chain broke."""
        return self._broken_at or 0

    def tracked(self, registration: Edge, broken_by: tuple[Check, ...]) -> Edge:
        """Take notice of how the newest node of the atlas was registered; a new piece begins with it if the chain broke.

        Args:
            registration: of the newest node to those before it.
            broken_by: the checks that say that the robot did not drive there; empty where the chain holds.

        Returns:
            The registration with these checks.
        """
        node = registration.target
        if broken_by:
            self._atlas.part(node)
            self._broken_at = node
            self._lost_m, self._searched_m = self._atlas.travel_m[node], -np.inf
            registration = replace(registration, broken_by=broken_by)
        else:
            self._misfits, self._steps = self._misfits + 1.0 - registration.figures["fit"], self._steps + 1
        self._relocaliser.tracked(node, Chain.BROKEN if broken_by else Chain.HOLDS, [registration])
        return registration

    def probed(self, node: int, hypotheses: Sequence[Hypothesis], belief: Belief) -> None:
        """Keep account of whether the robot recognises what it should, by what a probe inside the gate found.

        A bare corridor fits, if anywhere along itself: that says neither.
        """
        if self._broken_at is not None:
            return
        if any(h.passed for h in hypotheses):
            self._whereabouts.recognised()
        elif any(h.fits for h in hypotheses):
            return
        elif self._continuity.contradicted(node, belief):
            if not self._whereabouts.lost:
                self._lost_m = self._atlas.travel_m[node] - FROM_M
            self._whereabouts.unrecognised()

    def closed(self) -> list[Edge]:
        """Loops inside the gate have entered the map: the robot is where the map has it, if it is on that piece of it."""
        if self._broken_at is not None:
            return []
        self._whereabouts.recognised()
        return self._relocaliser.dismiss(Lack.NOT_LOST)

    def finish(self) -> list[Edge]:
        """The drive is over: sightings that still wait are refused."""
        return self._relocaliser.dismiss()

    def search(self, node: int, belief: Belief) -> Settlement:
        """While the robot is lost, hold its last metres against the whole map; now and then, once that has been in vain."""
        if not self._whereabouts.lost or not self._due(node):
            return Settlement([])
        self._searched_m = self._atlas.travel_m[node]
        broken = self._broken_at is not None
        recent = self._atlas.along(node, LENGTH_M if broken else RECENT_M, 0.0)
        anchors = self._prober.anchors_before(self.since if broken else int(recent[0]))
        found = self._prober.probe_anywhere(self._atlas.submap(node, recent), self.likeliest(node, anchors))
        settlement = self._relocaliser.settle([self._sighting(h) for h in found], belief)
        return self._found(settlement, belief) if settlement.friends else settlement

    def _due(self, node: int) -> bool:
        """Whether the whole map is to be searched: at each node soon after it got lost, then as often as it is probed."""
        travel_m = self._atlas.travel_m[node]
        if travel_m - self._lost_m <= OFTEN_M:
            return travel_m - self._lost_m >= FROM_M
        return travel_m - self._searched_m >= self._every_m

    def likeliest(self, node: int, anchors: list[int]) -> list[int]:
        """All anchors if they are few; else those about the nodes whose views are most like the robot's."""
        most = SUBMAPS
        if len(anchors) <= most:
            return anchors
        for profile in self._profiles[len(self._views.store) :]:
            self._views.add(profile)
        stop = anchors[-1] + 1
        ranked = self._views.best(self._profiles[node], stop, np.arange(stop)).indices
        following = np.searchsorted(np.array(anchors), ranked)
        likeliest = list(dict.fromkeys(following.tolist()))[:most]
        return [anchors[i] for i in sorted(likeliest)]

    def _sighting(self, h: Hypothesis) -> Sighting:
        """What fits is a sighting; it fits the worse, the better the scans of this drive fit one another."""
        edge = h.proposed(self._new_key(), Lack.WAITING)
        if not h.passed:
            return Sighting(edge)
        mismatch = max(1.0, MISFIT / (self._misfits / self._steps)) * h.misfit
        return Sighting(replace(edge, figures={**h.figures, "mismatch": mismatch}), mismatch)

    def _found(self, settlement: Settlement, belief: Belief) -> Settlement:
        """The robot knows where it is; where nothing had shown when it was carried, find that out."""
        broken_at, self._broken_at = self._broken_at, None
        if broken_at is not None:
            if settlement.carried_to is None:
                self._atlas.join(broken_at)
            return settlement
        carried_to = self._continuity.carried_unnoticed(settlement.friends, belief)
        if carried_to is None:
            return settlement
        self._atlas.part(carried_to)
        rehung = self._relocaliser.rehang(carried_to, settlement.friends, belief)
        return Settlement(settlement.proposals + rehung, settlement.friends, carried_to)
