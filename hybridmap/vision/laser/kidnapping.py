"""Finds from the free space of its scans whether a laser robot was kidnapped (carried), and localises it on the whole map."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace

import numpy as np

from hybridmap.config.vision import VisionConfig
from hybridmap.geometry import IDENTITY, Array, RelativePose, between, compose
from hybridmap.graph.edges import Check, Edge, Lack, passed
from hybridmap.streams.laser import Laser, LaserScan
from hybridmap.vision.base import Belief
from hybridmap.vision.gating import nodes_within
from hybridmap.vision.laser import checks
from hybridmap.vision.laser.cloud import build_field, cloud_of_scan
from hybridmap.vision.laser.hypotheses import (
    GATE_DEG,
    GATE_INFLATION,
    GATE_M,
    LENGTH_M,
    REGISTERED_POINTS,
    TARGET_HALF_M,
    Hypothesis,
    Prober,
)
from hybridmap.vision.laser.scan_matching import Prior, align
from hybridmap.vision.laser.submap import Atlas, alone, violation_both_ways, violation_of_step
from hybridmap.vision.laser.tracking import CONTRADICTION_DEG, CONTRADICTION_M, Step, Tracker
from hybridmap.vision.profile import Profile
from hybridmap.vision.relocalising import ChainState, GlobalMatch, Relocaliser, Settlement, Whereabouts, placed_by
from hybridmap.vision.templates import Matcher

MAP_VIOLATION = 0.4
"""Share of the walls of the map or of the last scans in the other's free space above which they contradict each other."""
SURE_M, RECENT_M = 0.3, 4.0
"""Largest standard deviation of their position on the map at which they can, and travel of the last scans, m."""
OLD_M, OLD_NODES = 4.0, 20
"""The old nodes with which they are compared: largest distance, m, and number of the nearest."""
LOOSE_M, LOOSE_RAD = 0.3, float(np.deg2rad(5.0))
"""Standard deviations of the pose of a single scan that is compared with the map, m and rad."""
HINTS = 4
"""So many nodes after a break whose scans hint that the robot drove on count as one that fits well."""
DECIDED = 3.0
"""Going back from the node where the robot was localised, a sum of so many scans for the chain ends the search."""


@dataclass(frozen=True, slots=True)
class ChainBreak:
    """A break of the chain.

    Attributes:
        node: the first node after it.
        registration: the registration of that node to the one before.
        odometry: (3,) its pose in the frame of the one before, by the wheels, m and rad.
        lost_since: first node after an earlier break from which the robot was not localised yet; None if there is none.
    """

    node: int
    registration: Edge
    odometry: Array
    lost_since: int | None


class Continuity:
    """Tests whether the robot can have driven along the registered poses of the nodes, or was carried away (kidnapped)."""

    def __init__(self, config: VisionConfig, atlas: Atlas, laser: Laser, tracker: Tracker) -> None:
        self._may_be_lost, self._gate_sigmas = config.relocalising.enabled, config.closing.gate_sigmas
        self._atlas = atlas
        self._laser = laser
        self._tracker = tracker
        self._hinted_at, self._hints = -1, 0

    def broken(
        self, node: int, step: Step, odometry: RelativePose, on_the_way: Sequence[tuple[Array, LaserScan]]
    ) -> tuple[Check, ...]:
        """Test the way to the newest node; returns the failed checks, none if the robot can have driven it.

        The robot counts as kidnapped where three things hold: the registration does not fit, or contradicts the odometry;
        the walls of the two scans lie in each other's free space; and a scan between the nodes does not fit the one before.
        Wheel slip, people and doors cause the first two, but not the third. Without `vision.relocalising.enabled` none fails.

        Args:
            node: the newest node of the atlas.
            step: the motion to it from the node before, by scan matching.
            odometry: the same motion by the wheels.
            on_the_way: the scans between these two in order, each with the robot's pose (3,) in the frame of the node before.
        """
        if not self._may_be_lost:
            return ()
        error = between(odometry.delta, step.relative.delta)
        sigmas = float(np.sqrt(error @ np.linalg.solve(odometry.covariance, error)))
        if step.measured and sigmas <= checks.CONTRADICTION_SIGMAS:
            return ()
        seen = violation_of_step(node, step.relative.delta, self._atlas, self._laser)
        if seen <= checks.WAY_VIOLATION or self._follow(node, odometry.delta, on_the_way):
            return ()
        return checks.of_way(sigmas if step.measured else None, seen)

    def drove_on(self, breaks: Sequence[ChainBreak], node: int) -> bool | None:
        """Whether a scan after a break of the chain shows that the robot drove on: a bad scan or a crowd broke the chain.

        The scans since the break are registered to the submap before it, and expected where the wheels have them. Call it once
        for each new node: faint fits are counted.

        Args:
            breaks: the breaks in a row, the first one first; nodes between them are joined by registrations.
            node: the newest node, after the last of them.

        Returns:
            True if it drove on, False if it is elsewhere; None if the scans do not fit well enough to tell.
        """
        last = breaks[0].registration.source
        self._hints = self._hints if self._hinted_at == breaks[-1].node else 0
        self._hinted_at = breaks[-1].node
        by_wheels, expected = {b.node: b.odometry for b in breaks}, IDENTITY
        for i in range(breaks[0].node, node + 1):
            chain = self._atlas.chain
            expected = compose(expected, by_wheels[i] if i in by_wheels else between(chain[i - 1], chain[i]))
        here = self._atlas.submap(node, range(breaks[-1].node, node + 1))
        found = self._tracker.resume(last, here.cloud.thinned(REGISTERED_POINTS), expected)
        loosest = np.linalg.eigvalsh(found.covariance(0, 0.0, 0.0)[:2, :2])[1] ** 0.5
        there = self._atlas.submap(last, self._atlas.along(last, RECENT_M, 0.0))
        seen = violation_both_ways(here, there, found.poses[0], self._atlas.ranges, self._laser)
        off, wider = between(expected, found.poses[0]), np.sqrt(node - last)
        near = np.hypot(off[0], off[1]) <= CONTRADICTION_M * wider and abs(off[2]) <= np.deg2rad(CONTRADICTION_DEG) * wider
        inliers = float(found.inliers[0])
        if near and passed(checks.of_resumption(inliers, checks.INLIERS_HINT, float(loosest), seen)):
            self._hints += 1
        if not passed(checks.of_resumption(inliers, checks.INLIERS_MIN, float(loosest), seen)):
            return True if self._hints >= HINTS else None
        return bool(near)

    def contradicted(self, node: int, belief: Belief) -> bool:
        """Whether the last scans contradict the old scans around the robot's pose on the map, where that pose is certain."""
        poses = belief.poses_map_node
        near = nodes_within(poses, node, OLD_M, np.pi, self._old(node))
        if len(near) == 0 or np.trace(belief.covariance_from(node)[near, :2, :2], axis1=1, axis2=2).min() > SURE_M**2:
            return False
        here = self._atlas.submap(node, self._atlas.along(node, RECENT_M, 0.0))
        there = self._atlas.about(poses[node], near, poses, OLD_NODES)
        return violation_both_ways(here, there, IDENTITY, self._atlas.ranges, self._laser) > MAP_VIOLATION

    def kidnapped_unnoticed(self, matches: Sequence[Edge], belief: Belief, known: int | None = None) -> int | None:
        """Find the first node after a kidnapping that was not noticed; None if the odometry only drifted.

        Scans before that node fit the map better at the poses by dead reckoning; later scans, at those by the loops. If there
        are no old scans to compare with, the pose by dead reckoning counts as a fair fit (`checks.INLIERS_MIN`).

        Args:
            matches: loops that localised the robot and contradict dead reckoning.
            belief: the map without these loops.
            known: scans of nodes before this one are the old scans; None: those well before each node.
        """
        found, poses = min(s.source for s in matches), belief.poses_map_node
        there = placed_by(matches, found, poses)
        if self._may_have_drifted(found, there, min(s.target for s in matches), belief):
            return None
        total, best, kidnapped_to = 0.0, 0.0, None
        for node in range(found, 0, -1):
            pose = compose(there, between(poses[found], poses[node]))
            by_chain = max(self._fit(node, poses[node], poses, known), checks.INLIERS_MIN)
            total += self._fit(node, pose, poses, known) - by_chain
            if total > best:
                best, kidnapped_to = total, node
            if total < best - DECIDED:
                break
        return kidnapped_to

    def _may_have_drifted(self, node: int, there: Array, target: int, belief: Belief) -> bool:
        """Whether a measured pose (3,) of a node lies within the drift since `target`, as the gate of a probe has it."""
        covariance = belief.covariance_from(target)[node]
        off = between(belief.poses_map_node[node], there)
        sigma_m = float(np.sqrt(np.linalg.eigvalsh(covariance[:2, :2])[1]))
        width = self._gate_sigmas * GATE_INFLATION
        near = np.hypot(off[0], off[1]) <= width * sigma_m + GATE_M
        return bool(near and abs(off[2]) <= width * np.sqrt(covariance[2, 2]) + np.deg2rad(GATE_DEG))

    def _old(self, node: int) -> int:
        """First node too new to be compared with a node: nearer than a probe and half a target."""
        return int(self._atlas.along(node, LENGTH_M + TARGET_HALF_M, 0.0)[0])

    def _fit(self, node: int, pose: Array, poses: Array, known: int | None) -> float:
        """Share of a node's scan that fits the old scans about a pose (3,) on the map; 0 where there are none."""
        old = poses[: self._old(node) if known is None else known]
        near = np.flatnonzero(np.hypot(*(old[:, :2] - pose[:2]).T) < OLD_M)
        if len(near) == 0:
            return 0.0
        field = build_field(self._atlas.about(pose, near, poses, OLD_NODES).cloud)
        return float(align(field, self._atlas.clouds[node], IDENTITY[None], Prior(IDENTITY, LOOSE_M, LOOSE_RAD)).inliers[0])

    def _follow(self, node: int, odometry: Array, on_the_way: Sequence[tuple[Array, LaserScan]]) -> bool:
        """Whether each scan from the last node to the newest fits the one before it."""
        atlas = self._atlas
        clouds = [cloud_of_scan(scan.ranges_m, self._laser, atlas.scene.scale) for _, scan in on_the_way]
        last = atlas.before(node)
        clouds = [atlas.clouds[last], *clouds, atlas.clouds[node]]
        ranges = [atlas.ranges[last], *(scan.ranges_m for _, scan in on_the_way), atlas.ranges[node]]
        wheels = [IDENTITY, *(motion for motion, _ in on_the_way), odometry]
        for i in range(len(clouds) - 1):
            found = self._tracker.pair(clouds[i], clouds[i + 1], between(wheels[i], wheels[i + 1]))
            here, there = alone(clouds[i + 1], i + 1), alone(clouds[i], i)
            seen = violation_both_ways(here, there, found.poses[0], ranges, self._laser)
            if found.inliers[0] < checks.INLIERS_WEAK or seen > checks.WAY_VIOLATION:
                return False
        return True


UNRECOGNISED_PROBES = 2
"""Probes in a row that recognise nothing where the map contradicts the scans, after which the robot is lost."""
SPAN_M = 1.5
"""Travel that agreeing matches must cover, m: their submaps then overlap only in part."""
FROM_M, OFTEN_M = 0.9, 6.0
"""The whole map is searched at each node between these travels since the break, m; later, as often as loops are looked for."""
RESUMED_M = 10.0
"""Travel after a break within which a scan may show that the robot drove on, m: the scans before it are still in sight."""
BAD_SIGHT = 3
"""So many breaks in a row within that travel come from bad scans (a slope, a crowd): nobody is kidnapped so often."""
SUBMAPS = 100
"""Most old submaps that are searched: those with the most similar profiles."""
MISFIT = 0.015
"""Usual share of a scan that does not fit the one before. Where it is less, mismatches are scaled up in proportion."""
MISFIT_STEPS = 10
"""Number of steps for which that share counts before any was measured."""
ALIKE = (0.5, 0.5)
"""Weights of intensity and depth where profiles are ranked; of no effect, as the profile of a laser has one band."""


class GlobalLocalisation:
    """Whether a laser robot is lost, and the search for it. The newer node is the source of an edge.

    After a kidnapping the nodes form a new piece of the atlas. Its scans are registered to all submaps before it; registrations
    that fit are pending matches, until enough of them agree (see `Relocaliser`).
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
        self._breaks: list[ChainBreak] = []
        self._lost_m, self._searched_m = 0.0, -np.inf

    @property
    def lost_since(self) -> int | None:
        """Node before which the robot was kidnapped last, if it has not been found on the map since; else None."""
        return self._broken_at

    @property
    def doubts(self) -> bool:
        """Whether the robot's pose relative to the newest nodes may be wrong: nothing says since when."""
        return self._whereabouts.lost and self._broken_at is None

    @property
    def since(self) -> int:
        """First node whose place relative to the newest one is known: `lost_since`, or 0 if that is None."""
        return self._broken_at or 0

    def tracked(self, registration: Edge, broken_by: tuple[Check, ...], odometry: Array) -> list[Edge]:
        """Note how the newest node was registered; after a kidnapping it begins a new piece of the atlas.

        Args:
            registration: edge from the node before to the newest node.
            broken_by: failed checks of `Continuity.broken`; empty if the robot was not kidnapped.
            odometry: (3,) the same motion by the wheels, m and rad.

        Returns:
            The registration with these checks, and the edges that changed as this node has mended earlier breaks.
        """
        node = registration.target
        if broken_by:
            self._atlas.part(node)
            lost_since, self._broken_at = self._broken_at, node
            self._lost_m, self._searched_m = self._atlas.travel_m[node], -np.inf
            registration = replace(registration, broken_by=broken_by)
            self._breaks.append(ChainBreak(node, registration, odometry, lost_since))
        else:
            self._misfits, self._steps = self._misfits + 1.0 - registration.figures["fit"], self._steps + 1
        self._relocaliser.tracked(node, ChainState.BROKEN if broken_by else ChainState.HOLDS, [registration])
        return [registration, *([] if broken_by else self._mended(node))]

    def _mended(self, node: int) -> list[Edge]:
        """If the newest scan shows that the robot drove on over the last breaks, join the chain; returns the changed edges."""
        if not self._breaks:
            return []
        breaks, drove_on = self._breaks, self._continuity.drove_on(self._breaks, node)
        if drove_on is None and len(breaks) >= BAD_SIGHT:
            drove_on = True
        if drove_on is not None or self._atlas.travel_m[node] - self._atlas.travel_m[breaks[0].node] > RESUMED_M:
            self._breaks = []
        if not drove_on:
            return []
        for b in breaks:
            self._atlas.join(b.node)
            self._whereabouts.mended(b.node)
        self._broken_at = breaks[0].lost_since
        dismissed = [] if self._whereabouts.lost else self._relocaliser.dismiss(Lack.NOT_LOST)
        return [*(replace(b.registration, broken_by=()) for b in breaks), *dismissed]

    def probed(self, node: int, hypotheses: Sequence[Hypothesis], belief: Belief) -> None:
        """Note whether a node recognised its place, from its loop hypotheses; after a break nothing is noted.

        Yes if one passed. No if none fits and its scans contradict the map at `belief`. Otherwise nothing is noted.
        """
        if self._broken_at is not None:
            return
        if any(h.passed for h in hypotheses):
            self._whereabouts.recognised()
        elif not any(h.fits for h in hypotheses) and self._continuity.contradicted(node, belief):
            if not self._whereabouts.lost:
                self._lost_m = self._atlas.travel_m[node] - FROM_M
            self._whereabouts.unrecognised()

    def closed(self) -> list[Edge]:
        """Note that loops were accepted: the robot is localised, unless it was kidnapped. Returns the matches now rejected."""
        if self._broken_at is not None:
            return []
        self._whereabouts.recognised()
        return self._relocaliser.dismiss(Lack.NOT_LOST)

    def finish(self) -> list[Edge]:
        """At the end of the drive, reject all pending matches; returns their edges."""
        return self._relocaliser.dismiss()

    def search(self, node: int, belief: Belief) -> Settlement:
        """While the robot is lost, register its last metres to the whole map, and accept the matches that agree.

        Call it at each node: some are skipped, later more. The settlement is empty then, and if the robot is not lost.
        """
        if not self._whereabouts.lost or not self._due(node):
            return Settlement([])
        self._searched_m = self._atlas.travel_m[node]
        broken = self._broken_at is not None
        recent = self._atlas.along(node, LENGTH_M if broken else RECENT_M, 0.0)
        anchors = self._prober.anchors_before(self.since if broken else int(recent[0]))
        found = self._prober.probe_anywhere(self._atlas.submap(node, recent), self.most_similar(node, anchors))
        settlement = self._relocaliser.settle(self.matches(found), belief)
        return self._found(settlement, belief) if settlement.accepted else settlement

    def _due(self, node: int) -> bool:
        """Whether the whole map is to be searched: at each node at first, then as often as loops are looked for."""
        travel_m = self._atlas.travel_m[node]
        if travel_m - self._lost_m <= OFTEN_M:
            return travel_m - self._lost_m >= FROM_M
        return travel_m - self._searched_m >= self._every_m

    def most_similar(self, node: int, anchors: list[int]) -> list[int]:
        """Of the nodes `anchors`, ascending, the 100 with the views most similar to that of `node`, ascending; or all."""
        if len(anchors) <= SUBMAPS:
            return anchors
        for profile in self._profiles[len(self._views.store) :]:
            self._views.add(profile)
        stop = anchors[-1] + 1
        ranked = self._views.best(self._profiles[node], stop, np.arange(stop)).indices
        following = np.searchsorted(np.array(anchors), ranked)
        most_similar = list(dict.fromkeys(following.tolist()))[:SUBMAPS]
        return [anchors[i] for i in sorted(most_similar)]

    def matches(self, found: Sequence[Hypothesis]) -> list[GlobalMatch]:
        """Hypotheses as matches, pending if they passed; the mismatch is relative to that of consecutive scans."""
        scale, out = max(1.0, MISFIT / (self._misfits / self._steps)), []
        for h in found:
            mismatch = {"mismatch": scale * h.misfit} if h.passed else {}
            edge = replace(h.proposed(self._new_key(), Lack.WAITING), figures={**h.figures, **mismatch})
            out.append(GlobalMatch(edge, **mismatch))
        return out

    def _found(self, settlement: Settlement, belief: Belief) -> Settlement:
        """The robot is localised. Without a break of the chain, find the node of the kidnapping."""
        broken_at, self._broken_at, self._breaks = self._broken_at, None, []
        if broken_at is not None:
            if settlement.kidnapped_to is None:
                self._atlas.join(broken_at)
            return settlement
        kidnapped_to = self._continuity.kidnapped_unnoticed(settlement.accepted, belief)
        if kidnapped_to is None:
            return settlement
        self._atlas.part(kidnapped_to)
        reattached = self._relocaliser.reattach(kidnapped_to, settlement.accepted, belief)
        return Settlement(settlement.proposals + reattached, settlement.accepted, kidnapped_to)
