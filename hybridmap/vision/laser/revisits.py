"""Nodes near each other on the optimised map are registered again, for more and more precise loops."""

from __future__ import annotations

from collections.abc import Collection

import numpy as np
from numpy.typing import NDArray

from hybridmap.config.vision import VisionConfig
from hybridmap.geometry import Array, between, invert_relative, wrap_angle
from hybridmap.graph.edges import Search, passed
from hybridmap.streams.laser import Laser
from hybridmap.vision.base import Belief
from hybridmap.vision.laser import checks
from hybridmap.vision.laser.hypotheses import Hypothesis
from hybridmap.vision.laser.scan_matching import Prior, align, ambiguity_of, score_starts, spaced, square
from hybridmap.vision.laser.submap import Atlas, Field, violation_both_ways

RADIUS_M = 2.5
"""Largest distance of nodes that are registered again, m: they see the same room."""
EVERY_M = 1.0
"""Travel between two nodes that take part, m."""
APART_M, PARTNERS = 12.0, 3
"""Travel between two passes, m, and most earlier passes that a node is registered to."""
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

    def __init__(self, config: VisionConfig, atlas: Atlas, laser: Laser) -> None:
        self._most_rounds, self._fit_min = config.closing.revisit_rounds, config.laser.probes.fit_min
        self._atlas = atlas
        self._laser = laser
        self._rounds = 0
        self._done: set[tuple[int, int]] = set()

    def round(self, belief: Belief, since: int = 0) -> list[Hypothesis]:
        """Register nodes, one a metre of travel, to the nearest of up to three earlier passes; failed ones are returned too.

        Pairs of earlier rounds are left out. The list is empty after the configured number of rounds.

        Args:
            belief: the map, which gives the poses of the nodes.
            since: nodes from this one on are not paired with earlier ones.
        """
        if self._rounds >= self._most_rounds or len(self._atlas) == 0:
            return []
        self._rounds += 1
        grid = self._grid()
        found = []
        for node in grid:
            beside = grid[(grid < since) == (node < since)]
            for other in self._partners(int(node), beside, belief.poses_map_node):
                self._done.add((int(node), other))
                found.append(self.register(int(node), other, belief.poses_map_node))
        return found

    def restart(self, carried_to: int, retracted: Collection[tuple[int, int]]) -> None:
        """Begin the rounds anew with pairs across a carry, to the node `carried_to`, and those whose loops were retracted."""
        across = {(node, other) for node, other in self._done if other < carried_to <= node}
        self._rounds, self._done = 0, self._done - across - set(retracted)

    def _grid(self) -> NDArray[np.int64]:
        """Nodes about every so many metres of travel."""
        travel = np.asarray(self._atlas.travel_m)
        wanted = np.arange(0.0, travel[-1] + 1e-9, EVERY_M)
        return np.unique(np.searchsorted(travel, wanted).clip(0, len(travel) - 1))

    def _partners(self, node: int, grid: NDArray[np.int64], poses: Array) -> list[int]:
        """Nearest older node of each earlier pass, at most a few."""
        travel = self._atlas.travel_m
        old = grid[: np.searchsorted(grid, node)]
        distance = np.hypot(*(poses[old, :2] - poses[node, :2]).T)
        near = [int(i) for i in np.argsort(distance, kind="stable") if distance[i] < RADIUS_M]
        chosen: list[int] = []
        for i in near:
            other = int(old[i])
            apart = [abs(travel[other] - travel[o]) > APART_M for o in chosen]
            if travel[node] - travel[other] > APART_M and all(apart):
                chosen.append(other)
        return [o for o in chosen[:PARTNERS] if (node, o) not in self._done]

    def register(self, node: int, other: int, poses: Array, search: Search = Search.NEAR) -> Hypothesis:
        """Register the scans around a node to those around an older one (`other`), starting from the map's poses (N, 3).

        `search` is the reason that the hypothesis records. The hypothesis may have failed its checks.
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
        return Hypothesis(node, other, relative, near * fit, 0.0, search, asked, figures, fits, 1.0 - fit + seen)
