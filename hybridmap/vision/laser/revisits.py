"""Re-proposal: nodes that lie near each other on the optimised map are registered again, finely."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from hybridmap.config.laser import LaserConfig
from hybridmap.geometry import Array, between, invert_relative, wrap_angle
from hybridmap.graph.edges import Search, passed
from hybridmap.streams.laser import Laser
from hybridmap.vision.base import Belief
from hybridmap.vision.laser import checks
from hybridmap.vision.laser.hypotheses import Hypothesis
from hybridmap.vision.laser.likelihood import score_starts, spaced, square
from hybridmap.vision.laser.registration import Prior, align, ambiguity_of
from hybridmap.vision.laser.submap import Atlas, Field
from hybridmap.vision.laser.visibility import violation_both_ways


class Reviser:
    """Rounds of re-proposal."""

    def __init__(self, config: LaserConfig, atlas: Atlas, laser: Laser) -> None:
        self._config = config
        self._atlas = atlas
        self._laser = laser
        self._rounds = 0
        self._done: set[tuple[int, int]] = set()

    def round(self, belief: Belief, since: int = 0) -> list[Hypothesis]:
        """Register every pair that is due; empty once the configured rounds are over.

        Args:
            belief: where the nodes lie.
            since: how the map lies about this node and later ones with that about earlier ones is not known.
        """
        if self._rounds >= self._config.revisits.rounds or len(self._atlas) == 0:
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

    def _grid(self) -> NDArray[np.int64]:
        """Nodes about every so many metres of travel."""
        travel = np.asarray(self._atlas.travel_m)
        wanted = np.arange(0.0, travel[-1] + 1e-9, self._config.revisits.every_m)
        return np.unique(np.searchsorted(travel, wanted).clip(0, len(travel) - 1))

    def _partners(self, node: int, grid: NDArray[np.int64], poses: Array) -> list[int]:
        """Nearest older node of each earlier pass, at most a few."""
        c, travel = self._config.revisits, self._atlas.travel_m
        old = grid[: np.searchsorted(grid, node)]
        distance = np.hypot(*(poses[old, :2] - poses[node, :2]).T)
        near = [int(i) for i in np.argsort(distance, kind="stable") if distance[i] < c.radius_m]
        chosen: list[int] = []
        for i in near:
            other = int(old[i])
            apart = [abs(travel[other] - travel[o]) > c.apart_m for o in chosen]
            if travel[node] - travel[other] > c.apart_m and all(apart):
                chosen.append(other)
        return [o for o in chosen[: c.partners] if (node, o) not in self._done]

    def register(self, node: int, other: int, poses: Array, search: Search = Search.NEAR) -> Hypothesis:
        """Register the scans about a node to those about an older one, from where the poses (N, 3) have them; `search`: why."""
        c, settings = self._config.revisits, self._config.registration
        target, probe = self._atlas.around(other, c.target_half_m), self._atlas.around(node, c.probe_half_m)
        sharp, fine = self._atlas.scoring_field(target, Field.SHARP), self._atlas.fine_field(target)
        expected = between(poses[other], poses[node])
        offsets = square(c.search_m, 0.15)
        headings = expected[2] + np.deg2rad(spaced(c.search_deg, 1.5))
        scores = score_starts(sharp, probe.cloud.thinned(100).points, expected[:2], headings, offsets)
        h, t = np.unravel_index(int(np.argmax(scores)), scores.shape)
        start = np.array([*(expected[:2] + offsets[t]), headings[h]])
        prior = Prior(expected, 1.0, 0.2)
        alignment = align(fine, probe.cloud.thinned(300), start[None], settings, prior)
        covariance = alignment.covariance(0, settings, c.floor_m, np.deg2rad(c.floor_deg))
        pose = alignment.poses[0]
        near, fit, off = float(alignment.near[0]), float(alignment.fit[0]), pose - expected
        ambiguity = ambiguity_of(fine, probe.cloud, alignment)
        if ambiguity > self._config.probes.ambiguity_max:
            weakest = alignment.weakest_direction(0)
            covariance[:2, :2] += c.ambiguous_m**2 * np.outer(weakest, weakest)
        asked, seen = checks.of_fit(near, fit, self._config.probes), 0.0
        fits = passed(asked)
        off_deg = float(np.rad2deg(abs(wrap_angle(off[2]))))
        asked += checks.of_gate(np.hypot(*off[:2]), off_deg, checks.OFF_MAX_M, checks.OFF_MAX_DEG)
        if passed(asked):
            seen = violation_both_ways(probe, target, pose, self._atlas.ranges, self._laser)
            asked += checks.of_free_space(seen, self._config.probes)
        relative = invert_relative(self._atlas.joining(other, pose, covariance, node))
        figures = {"ambiguity": ambiguity}
        return Hypothesis(node, other, relative, near * fit, 0.0, search, asked, figures, fits, 1.0 - fit + seen)
