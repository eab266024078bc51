"""Nodes near each other on the optimised map are registered again, for more and more precise loops."""

from __future__ import annotations

from collections.abc import Collection

import numpy as np
from numpy.typing import NDArray

from hybridmap.config.vision import VisionConfig
from hybridmap.geometry import Array, between, invert_relative, wrap_angle
from hybridmap.graph.edges import Proposer, Search, passed
from hybridmap.streams.laser import Laser
from hybridmap.vision.base import Belief
from hybridmap.vision.laser import checks
from hybridmap.vision.laser.hypotheses import Hypothesis
from hybridmap.vision.laser.panorama import APART_M, Panoramas
from hybridmap.vision.laser.scan_matching import Prior, align, ambiguity_of, score_starts, spaced, square
from hybridmap.vision.laser.submap import Atlas, Field, violation_both_ways

Indices = NDArray[np.int64]

RADIUS_M = 2.5
"""Largest distance of nodes that are registered again, m: they see the same room."""
PARTNERS = 3
"""Most earlier passes that a node is registered to."""
PROBE_HALF_M, TARGET_HALF_M = 1.5, 4.0
"""Half-lengths of the submaps about a node and about its partner, m: short, so that neither bends."""
SEARCH_M, SEARCH_DEG = 0.45, 4.5
"""Half-widths of the grid of starts, m and degrees: the error of an optimised map."""
GRID_M, GRID_DEG = 0.15, 1.5
"""Steps of that grid, m and degrees."""
SCORED_POINTS, REGISTERED_POINTS = 100, 300
"""Points that score the starts, and that are registered."""
PRIOR_M, PRIOR_RAD = 1.0, 0.2
"""Standard deviations of the map as prior, m and rad: loose, for directions that the walls leave free."""
AMBIGUOUS_M = 1.5
"""Standard deviation along a direction in which a registration is ambiguous, m."""
FLOOR_M, FLOOR_DEG = 0.002, 0.025
"""Standard deviations of such a registration at least, m and degrees."""


class Reviser:
    """Registers nodes that are near each other on the optimised map, in rounds."""

    def __init__(self, config: VisionConfig, atlas: Atlas, laser: Laser, panoramas: Panoramas) -> None:
        self._most_rounds, self._fit_min = config.closing.revisit_rounds, config.laser.probes.fit_min
        self._atlas = atlas
        self._laser = laser
        self._panoramas = panoramas
        self._rounds = 0
        self._done: set[tuple[int, int]] = set()

    def round(self, belief: Belief, since: int = 0, *, known: NDArray[np.bool_] | None = None) -> list[Hypothesis]:
        """Register nodes with a panorama to one of each of up to three earlier passes; failed ones are returned too.

        Partners are what the panoramas propose out of the whole map, if that is near on this map; then, of passes without any,
        the nearest. Pairs of earlier rounds are left out. The list is empty after the configured number of rounds.

        Args:
            belief: the map, which gives the poses of the nodes.
            since: nodes from this one on are not paired with earlier ones.
            known: (N,) nodes before `since` with which those from it on are paired instead; the others are with none.
        """
        if self._rounds >= self._most_rounds or len(self._atlas) == 0:
            return []
        self._rounds += 1
        grid = np.array(self._panoramas.nodes)
        found = []
        for number, node in enumerate(grid.tolist()):
            beside = (grid < since) == (node < since) if known is None else known[grid] & (node >= since)
            for other, proposed_by in self._partners(number, grid, beside, belief.poses_map_node):
                self._done.add((node, other))
                found.append(self.register(node, other, belief.poses_map_node, proposed_by))
        return found

    def restart(self, carried_to: int, retracted: Collection[tuple[int, int]]) -> None:
        """Begin the rounds anew with pairs across a carry, to the node `carried_to`, and those whose loops were retracted."""
        across = {(node, other) for node, other in self._done if other < carried_to <= node}
        self._rounds, self._done = 0, self._done - across - set(retracted)

    def _partners(self, number: int, grid: Indices, beside: NDArray[np.bool_], poses: Array) -> list[tuple[int, Proposer]]:
        """Older nodes near a node, at most one of each earlier pass: by profile, the most similar first; then the nearest."""
        travel, node = self._atlas.travel_m, int(grid[number])
        distance = np.hypot(*(poses[grid[:number], :2] - poses[node, :2]).T)
        near = (distance < RADIUS_M) & beside[:number]
        proposed = [(i, Proposer.PROFILE) for i in self._panoramas.alike(number).numbers.tolist() if near[i]]
        proposed += [(i, Proposer.PROXIMITY) for i in np.argsort(distance, kind="stable").tolist() if near[i]]
        chosen: list[tuple[int, Proposer]] = []
        for i, proposed_by in proposed:
            other = int(grid[i])
            apart = [abs(travel[other] - travel[o]) > APART_M for o, _ in chosen]
            if travel[node] - travel[other] > APART_M and all(apart):
                chosen.append((other, proposed_by))
        return [pair for pair in chosen[:PARTNERS] if (node, pair[0]) not in self._done]

    def register(
        self, node: int, other: int, poses: Array, proposed_by: Proposer | None, search: Search = Search.NEAR
    ) -> Hypothesis:
        """Register the scans around a node to those around an older one (`other`), starting from the map's poses (N, 3).

        `proposed_by` and `search` are what the hypothesis records. The hypothesis may have failed its checks.
        """
        target, probe = self._atlas.around(other, TARGET_HALF_M), self._atlas.around(node, PROBE_HALF_M)
        sharp, fine = self._atlas.scoring_field(target, Field.SHARP), self._atlas.fine_field(target)
        expected = between(poses[other], poses[node])
        offsets = square(SEARCH_M, GRID_M)
        headings = expected[2] + np.deg2rad(spaced(SEARCH_DEG, GRID_DEG))
        scores = score_starts(sharp, probe.cloud.thinned(SCORED_POINTS).points, expected[:2], headings, offsets)
        h, t = np.unravel_index(int(np.argmax(scores)), scores.shape)
        start = np.array([*(expected[:2] + offsets[t]), headings[h]])
        prior = Prior(expected, PRIOR_M, PRIOR_RAD)
        alignment = align(fine, probe.cloud.thinned(REGISTERED_POINTS), start[None], prior)
        covariance = alignment.covariance(0, FLOOR_M, np.deg2rad(FLOOR_DEG))
        pose = alignment.poses[0]
        near, fit, off = float(alignment.near[0]), float(alignment.fit[0]), pose - expected
        ambiguity = ambiguity_of(fine, probe.cloud, alignment)
        if ambiguity > checks.AMBIGUITY_MAX:
            weakest = alignment.weakest_direction(0)
            covariance[:2, :2] += AMBIGUOUS_M**2 * np.outer(weakest, weakest)
        asked, seen = checks.of_fit(near, fit, self._fit_min), 0.0
        fits = passed(asked)
        off_deg = float(np.rad2deg(abs(wrap_angle(off[2]))))
        asked += checks.of_gate(np.hypot(*off[:2]), off_deg, checks.OFF_MAX_M, checks.OFF_MAX_DEG)
        if passed(asked):
            seen = violation_both_ways(probe, target, pose, self._atlas.ranges, self._laser)
            asked += checks.of_free_space(seen)
        relative = invert_relative(self._atlas.joining(other, pose, covariance, node))
        figures = {"ambiguity": ambiguity}
        misfit = 1.0 - fit + seen
        return Hypothesis(node, other, relative, near * fit, 0.0, search, asked, figures, fits, misfit, proposed_by=proposed_by)
