"""Loop closure by camera: nearby nodes, of these the most similar profiles, verification, and agreement with a second loop."""

from __future__ import annotations

from collections.abc import Callable, Collection, Sequence
from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from hybridmap.config.vision import VisionConfig
from hybridmap.geometry import Array, RelativePose, between, wrap_angle
from hybridmap.graph.edges import Edge, EdgeKind, Lack, Method, Proposer, Search, Status
from hybridmap.metrics import StageClock
from hybridmap.vision.base import Belief, known_nodes
from hybridmap.vision.gating import MIN_AGE_S, Gate, nodes_within
from hybridmap.vision.profile import Profile
from hybridmap.vision.relocalising import ChainState, GlobalMatch, Relocaliser, Whereabouts
from hybridmap.vision.rgbd import checks
from hybridmap.vision.rgbd.global_search import RANKED, GlobalSearch, chain_state
from hybridmap.vision.rgbd.keyframe import Keyframe
from hybridmap.vision.rgbd.pnp import Candidate, Verification, Verifier
from hybridmap.vision.rgbd.revisits import MAP_SIGMA_DEG, MAP_SIGMA_M, Reverification, Revisits
from hybridmap.vision.rgbd.support import MeasuredLoop, Support
from hybridmap.vision.templates import MODERATE_THRESHOLD, Matcher

Indices = NDArray[np.int64]
GATE_PER_M, GATE_GROWTH_M = 0.1, 10.0
"""Growth of the gate per metre since the last closure, and its largest growth, m: wheels drift by less."""
HEADING_DEG, HEADING_DEG_PER_M = 50.0, 0.3
"""Largest difference of headings, degrees, and its growth per metre since the last closure: within a camera's field of view."""
ACCEPT, SEPARATION = 2, 2
"""Most accepted edges of a node, and how many nodes its candidates are apart."""
PENDING_NODES = 40
"""A verified edge without support is rejected after so many nodes."""
SHIFT_SIGMA_M, SHIFT_SIGMA_DEG = 0.7, 6.0
"""Standard deviations of unverified edges, m and degrees: about the distance between views that match."""
REPROPOSE_M, REPROPOSE_PER_NODE, REPROPOSE_ONLINE = 2.0, 2, 1
"""Re-proposal: nodes this near on the map are tried again, m; candidates a node; moved nodes tried with each new node."""
SPAN_M = 0.75
"""Travel that agreeing matches of a lost robot must cover, m: three steps between nodes."""
UNRECOGNISED_NODES, UNCERTAIN_NODES = 16, 40
"""Nodes in a row at known places, none recognised, after which the robot is lost; nodes after which an uncertain link of the
chain is taken to hold."""
KNOWN_M, KNOWN_RAD = 0.7, float(np.deg2rad(20.0))
"""A node this near to an old one, with a similar heading, is at a known place."""
SURE = 4.0
"""While driving, depth alone is trusted where the map's standard deviation is below so many times `MAP_SIGMA_M`."""


class LoopCloser:
    """Finds loop closures for one camera. The newer node is the source of an edge.

    Args:
        keyframes: of all nodes, by number; it grows as nodes are made.
        config: settings of the visual side.
        verifier: measures the relative pose of two keyframes.
        yaw_of_shift: shift of a profile in columns -> yaw of the older view in the newer one, rad.
        new_key: returns the key of a new edge.
        clock: measures the time of the search for candidates (stage `search`).

    Attributes:
        support: the measured loops, and which of them agree with each other.
    """

    def __init__(
        self,
        keyframes: Sequence[Keyframe],
        config: VisionConfig,
        verifier: Verifier,
        yaw_of_shift: Callable[[int], float],
        new_key: Callable[[], int],
        clock: StageClock,
    ) -> None:
        self._keyframes = keyframes
        rgbd, matching = config.rgbd, config.matching
        self._closing, self._unverified = rgbd.closing, rgbd.verify == "none"
        self._gate_sigmas = config.closing.gate_sigmas
        self._may_be_lost = config.relocalising.enabled
        self._verifier = verifier
        self._yaw_of_shift = yaw_of_shift
        self._new_key = new_key
        self._clock = clock
        self._by_profile = config.closing.by != "proximity"
        self._matcher = Matcher(
            rgbd.matching, matching.mu_r, matching.mu_d, config.profile.max_shift, matching.g_bar, matching.sequence
        )
        whereabouts = Whereabouts(UNRECOGNISED_NODES if self._may_be_lost else 0, UNCERTAIN_NODES)
        self._relocaliser = Relocaliser(whereabouts, new_key, SPAN_M)
        self._global_search = GlobalSearch(keyframes, self._matcher, verifier, new_key)
        self._c_t = matching.c_t if matching.c_t is not None or not self._unverified else MODERATE_THRESHOLD[rgbd.matching]
        self.support = Support()
        self._revisits = Revisits()
        self._tried: set[tuple[int, int]] = set()
        self._travel_at_closure = 0.0
        self._noted, self._gate_of_newest, self._ranking = -1, Gate(0.0, 0.0, 0, 0), np.zeros((0, 3))
        self._map_covariance = np.diag([MAP_SIGMA_M, MAP_SIGMA_M, np.deg2rad(MAP_SIGMA_DEG)]) ** 2
        self._reverification = Reverification(keyframes, verifier, self._map_covariance)
        self._most_rounds = self._rounds_left = config.closing.revisit_rounds

    def add_node(self, profile: Profile) -> None:
        """Store the profile (bands, width) of the next node."""
        self._matcher.add(profile)

    def close(self, node: int, belief: Belief) -> list[Edge]:
        """Look for loops of the newest node, and decide pending ones; returns new (also rejected) and changed edges."""
        since_m = self._travel_at_closure
        gated = self._gate(node, belief)
        changed = self._try_candidates(node, self._ranked(node, gated, belief), belief) if len(gated) else []
        if not self._unverified:
            broken = self._relocaliser.whereabouts.first_break is not None
            if not broken and not any(p.status is Status.ACCEPTED for p in changed):
                near = self._nearest(node, 1, belief)
                changed += self._try_again(node, near, belief, {j for j in near if self._is_sure(node, j, belief)})
            changed += self._relocalise(node, gated, changed, belief)
            if not broken:
                changed += self._catch_up(belief)
        if self._travel_at_closure > since_m:
            self._revisits.closed(node, since_m, belief)
        return [*changed, *self.support.give_up(before=node - PENDING_NODES)]

    def _catch_up(self, belief: Belief) -> list[Edge]:
        """Try a few nodes again that a closure has moved."""
        out: list[Edge] = []
        for _ in range(REPROPOSE_ONLINE):
            node = self._revisits.next_moved(belief)
            if node is None:
                break
            if self.support.accepted(node) < ACCEPT:
                near = self._nearest(node, REPROPOSE_PER_NODE, belief)
                out += self._try_again(node, near, belief, {j for j in near if self._is_sure(node, j, belief)})
        return out

    def tracked(self, node: int, steps: list[Edge]) -> None:
        """Note the registrations (`steps`) of a new node to the ones before it: they tell whether its motion is certain.

        Without `vision.relocalising.enabled` it counts as certain.
        """
        self._relocaliser.tracked(node, chain_state(steps) if self._may_be_lost else ChainState.HOLDS, steps)

    @property
    def lost_since(self) -> int | None:
        """First node since the last loop closure whose view fits none of those before it (broken motion); None if all fit."""
        return self._relocaliser.whereabouts.lost_since

    def note(self, node: int) -> dict[str, Array]:
        """What the map file keeps of the search for loops of a node: the last one that was searched for; else empty.

        Keys: `gate` (5,), see `Gate.to_array`; `ranked` (n, 3), the candidates by profile, the best first: node, score G
        (eq. 13), shift in columns.
        """
        if node != self._noted:
            return {}
        return {"gate": self._gate_of_newest.to_array(), "ranked": self._ranking}

    def _relocalise(self, node: int, gated: Indices, changed: list[Edge], belief: Belief) -> list[Edge]:
        """Note whether the node was recognised; search the whole map while the robot is lost."""
        whereabouts = self._relocaliser.whereabouts
        if any(p.status is Status.ACCEPTED for p in changed):
            whereabouts.recognised()
            return self._relocaliser.dismiss(Lack.NOT_LOST)
        if len(np.intersect1d(nodes_within(belief.poses_map_node, node, KNOWN_M, KNOWN_RAD), gated)):
            whereabouts.unrecognised()
        if not whereabouts.lost:
            return []
        self._gate_of_newest = replace(self._gate_of_newest, whole_map=True)
        old = np.flatnonzero(belief.stamps_s[node] - belief.stamps_s[:node] >= MIN_AGE_S)
        seen = self._global_search.search(node, np.setdiff1d(old, gated).astype(np.int64))
        found = self._relocaliser.settle([GlobalMatch(edge) for edge in seen], belief)
        if found.accepted:
            for edge in found.accepted:
                self.support.join(edge.source, edge.target)
            self._travel_at_closure = float(belief.travel_m[node])
        return found.proposals

    def finish(self, belief: Belief) -> list[Edge]:
        """At the end of the drive, compare nodes near each other on the optimised map; then decide all pending loops.

        After the configured number of calls nothing is compared any more. Returns new and changed edges.
        """
        out: list[Edge] = []
        if self._rounds_left > 0 and not self._unverified:
            self._rounds_left -= 1
            first_break = self._relocaliser.whereabouts.first_break
            for node in range(len(self._keyframes)):
                if self.support.accepted(node) < ACCEPT:
                    near = self._nearest(node, REPROPOSE_PER_NODE, belief)
                    placed = first_break is None or node < first_break
                    out += self._try_again(node, near, belief, near if placed else ())
        out += self._relocaliser.dismiss()
        return [*out, *self.support.give_up(before=len(self._keyframes))]

    def beside(self, node: int, before: int, belief: Belief) -> list[Edge]:
        """Compare a node with the nodes before `before` that are near it on the map, and give up what waited too long.

        Returns new and changed edges; none where two of its loops were accepted already.
        """
        out = self.support.give_up(before=node - PENDING_NODES)
        if self._unverified or self.support.accepted(node) >= ACCEPT:
            return out
        near = self._nearest(node, REPROPOSE_PER_NODE, belief, before)
        return out + self._try_again(node, near, belief, {j for j in near if self._is_sure(node, j, belief)})

    def anywhere(self, node: int, targets: Indices) -> list[Edge]:
        """Compare a node with nodes `targets` (n,), ascending, at any pose; see `GlobalSearch.search`. Nothing is kept."""
        return self._global_search.search(node, targets)

    def restart(self, changed: Sequence[Edge]) -> None:
        """Begin the rounds of `finish` anew, as the map was corrected by new and changed loops."""
        self._rounds_left = self._most_rounds
        for edge in changed:
            if edge.kind is EdgeKind.LOOP and edge.status is Status.ACCEPTED:
                self.support.join(edge.source, edge.target)
            elif edge.kind is EdgeKind.LOOP:
                self.support.replace(edge)

    def verify(self, outliers: Sequence[Edge], belief: Belief) -> list[Edge]:
        """Measure outlier loops again; `belief` is the map without them.

        Returns all of them under their keys, rejected where they do not fit; none where loops are not verified.
        """
        if self._unverified:
            return []
        out = []
        for edge in outliers:
            found = self._reverification.measure(edge, belief)
            out.append(found.proposed(edge.source, edge.target, edge.key, Candidate(Search.AGAIN, edge.proposed_by)))
            self.support.replace(out[-1])
        return out

    def _is_sure(self, node: int, target: int, belief: Belief) -> bool:
        """Whether the map knows a relative pose well enough to start a registration of depth alone."""
        sigma = np.sqrt(np.diag(belief.covariance_from(node)[target]))
        return bool(np.all(sigma <= SURE * np.sqrt(np.diag(self._map_covariance))))

    def _gate(self, node: int, belief: Belief) -> Indices:
        """Nodes that are old enough, within the drift since the last closure, and of similar heading."""
        since = float(belief.travel_m[node]) - self._travel_at_closure
        growth = GATE_PER_M * since
        radius = self._closing.gate_m + min(growth, GATE_GROWTH_M)
        radii: Array = np.full(node, radius)
        if growth > GATE_GROWTH_M:
            spread = np.trace(belief.covariance_from(node)[:node, :2, :2], axis1=1, axis2=2)
            radii = np.maximum(radii, self._closing.gate_m + self._gate_sigmas * np.sqrt(spread))
        heading = np.deg2rad(HEADING_DEG + HEADING_DEG_PER_M * since)
        poses = belief.poses_map_node
        offset = poses[:node, :2] - poses[node, :2]
        turned = np.abs(wrap_angle(poses[:node, 2] - poses[node, 2]))
        old = belief.stamps_s[node] - belief.stamps_s[:node] >= MIN_AGE_S
        inside = old & (np.hypot(offset[:, 0], offset[:, 1]) <= radii) & (turned <= heading)
        widths = float(radii.max(initial=radius)), float(np.rad2deg(min(heading, np.pi)))
        self._noted, self._ranking = node, np.zeros((0, 3))
        self._gate_of_newest = Gate(*widths, int(old.sum()), int(inside.sum()))
        return np.flatnonzero(inside).astype(np.int64)

    def _ranked(self, node: int, gated: Indices, belief: Belief) -> dict[int, Candidate]:
        """The best candidates by profile, or those nearest on the map where profiles do not rank; some nodes apart.

        Profiles proposed them if there are more nodes in the gate than are verified; else each would be verified anyway.
        """
        if not self._by_profile:
            gap = np.hypot(*(belief.poses_map_node[gated, :2] - belief.poses_map_node[node, :2]).T)
            nearest = np.argsort(gap, kind="stable")
            return _first_apart(gated[nearest], gap[nearest], self._closing.candidates, Search.GATE)
        ranked = RANKED * self._closing.candidates
        with self._clock.stage("search"):
            match = self._matcher.best(self._keyframes[node].profile, ranked, gated, ending_at=node)
        self._ranking = np.column_stack([match.indices, match.score, match.shift])
        proposer = Proposer.PROFILE if len(gated) > self._closing.candidates else Proposer.PROXIMITY
        chosen: dict[int, Candidate] = {}
        for i, target in enumerate(match.indices.tolist()):
            if self._c_t is not None and match.score[i] >= self._c_t:
                break
            if all(abs(target - other) >= SEPARATION for other in chosen):
                profile = {"profile_G": float(match.score[i])}
                chosen[target] = Candidate(Search.GATE, proposer, int(match.shift[i]), profile)
            if len(chosen) == self._closing.candidates:
                break
        return chosen

    def _try_candidates(self, node: int, ranked: dict[int, Candidate], belief: Belief) -> list[Edge]:
        """Verify each candidate, the best first, until enough are accepted."""
        if self._unverified:
            return self._accept_unverified(node, ranked, belief)
        out: list[Edge] = []
        entered = 0
        for target, candidate in ranked.items():
            if entered == ACCEPT:
                break
            self._tried.add((node, target))
            found = self._verifier.verify(self._keyframes[node], self._keyframes[target])
            changed = self._file(node, target, candidate, found, belief)
            entered += changed[0].status is Status.ACCEPTED
            out += changed
        return out

    def _try_again(self, node: int, near: dict[int, Candidate], belief: Belief, by_depth: Collection[int]) -> list[Edge]:
        """Verify pairs that are near each other on the map: by features once; else, where allowed, by depth."""
        out: list[Edge] = []
        for target, candidate in near.items():
            found: Verification | None = None
            if (node, target) not in self._tried:
                self._tried.add((node, target))
                found = self._verifier.verify(self._keyframes[node], self._keyframes[target])
            if (found is None or found.relative is None) and target in by_depth:
                guess = RelativePose(between(belief.poses_map_node[node], belief.poses_map_node[target]), self._map_covariance)
                found = self._verifier.verify_on_map(self._keyframes[node], self._keyframes[target], guess)
            if found is not None:
                out += self._file(node, target, candidate, found, belief)
        return out

    def _file(self, node: int, target: int, candidate: Candidate, found: Verification, belief: Belief) -> list[Edge]:
        """Turn a verification into edges: its own first, then those that it supports."""
        waiting = found.proposed(node, target, self._new_key(), candidate, Lack.WAITING)
        if found.relative is None:
            return [waiting]
        changed = self.support.file(MeasuredLoop(waiting, found.relative), belief)
        if changed[0].status is Status.ACCEPTED:
            self._travel_at_closure = max(self._travel_at_closure, float(belief.travel_m[node]))
        return changed

    def _nearest(self, node: int, most: int, belief: Belief, before: int | None = None) -> dict[int, Candidate]:
        """Nodes before this one, or before `before`, of nearly the same pose without an edge to this one, nearest first."""
        earlier = slice(node if before is None else before)
        poses = belief.poses_map_node
        gap = np.hypot(*(poses[earlier, :2] - poses[node, :2]).T)
        turned = np.abs(wrap_angle(poses[earlier, 2] - poses[node, 2]))
        old = belief.stamps_s[node] - belief.stamps_s[earlier] >= MIN_AGE_S
        near = old & (gap <= REPROPOSE_M) & (turned <= np.deg2rad(HEADING_DEG))
        near &= True if before is None else known_nodes(before, node, belief)[earlier]
        cost = gap + turned
        order = np.argsort(np.where(near, cost, np.inf), kind="stable")[: int(near.sum())]
        left = np.array([target for target in order.tolist() if not self.support.has(node, target)], dtype=np.int64)
        return _first_apart(left, gap[left], most, Search.NEAR)

    def _accept_unverified(self, node: int, ranked: dict[int, Candidate], belief: Belief) -> list[Edge]:
        """As in the paper: the best match is a closure; its shift gives the yaw, the translation is 0."""
        for target, candidate in ranked.items():
            delta = np.array([0.0, 0.0, self._yaw_of_shift(candidate.shift)])
            sigma = np.array([SHIFT_SIGMA_M] * 2 + [np.deg2rad(SHIFT_SIGMA_DEG)])
            relative = RelativePose(delta, np.diag(sigma**2))
            self._travel_at_closure = float(belief.travel_m[node])
            asked = () if self._c_t is None else checks.of_profile(candidate.figures["profile_G"], self._c_t)
            edge = Edge.decided(
                node,
                target,
                EdgeKind.LOOP,
                relative,
                asked,
                method=Method.PROFILE,
                search=candidate.search,
                proposed_by=candidate.proposed_by,
                shift=candidate.shift,
                figures=candidate.figures,
                key=self._new_key(),
            )
            return [edge]
        return []


def _first_apart(targets: Indices, gap_m: Array, most: int, search: Search) -> dict[int, Candidate]:
    """The first of older nodes (n,), at distances (n,), m, on the map, that lie some nodes apart."""
    chosen: dict[int, Candidate] = {}
    for target, gap in zip(targets.tolist(), gap_m.tolist(), strict=True):
        if all(abs(target - other) >= SEPARATION for other in chosen):
            chosen[target] = Candidate(search, Proposer.PROXIMITY, figures={"map_distance_m": gap})
        if len(chosen) == most:
            break
    return chosen
