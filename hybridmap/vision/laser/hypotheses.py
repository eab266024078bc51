"""Hypotheses of loop closure: the submap of the last metres is registered to old submaps that may be nearby."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from hybridmap.config.vision import VisionConfig
from hybridmap.geometry import IDENTITY, Array, RelativePose, between, invert_relative, wrap_angle
from hybridmap.graph.edges import Check, Edge, EdgeKind, Lack, Method, Proposer, Search, passed
from hybridmap.streams.laser import Laser
from hybridmap.vision.base import Belief
from hybridmap.vision.laser import checks
from hybridmap.vision.laser.cloud import CELL_M, Cloud
from hybridmap.vision.laser.panorama import Panoramas
from hybridmap.vision.laser.scan_matching import (
    SEPARATE_DEG,
    SEPARATE_M,
    STEP_DEG,
    STEP_M,
    Start,
    align,
    ambiguity_of,
    score_starts,
    sharpened,
    spaced,
    square,
    survivors,
)
from hybridmap.vision.laser.submap import Atlas, Field, Submap, violation_both_ways

LENGTH_M = 10.0
"""Travel that a probe covers, m: long enough to contain a corner or a door."""
TARGET_EVERY_M, TARGET_HALF_M = 4.0, 6.0
"""Travel between the anchors of old submaps, and that a submap covers to either side, m: a probe fits wholly into one."""
POINTS = 120
"""Points of a probe that score the starts."""
GATE_INFLATION = 4.0
"""Factor on the deviations of the gate: the errors of the chain's edges are not independent, as their covariances assume."""
GATE_M, GATE_DEG = 2.5, 4.0
"""Constant part of the gate's width, m and degrees."""
WINDOW_M = 3.5
"""A target is searched this far about its anchor, m; beyond that, other targets are nearer."""
TARGETS = 16
"""Most old submaps that are searched more closely, the best first."""
MODES_PER_TARGET, MODES, MODES_SURE, MODES_ANYWHERE = 2, 6, 3, 8
"""Separated modes that are verified: of a target; of a probe; of one in narrow gates, where one place is in question; of one
on the whole map."""
LEADS = 8
"""Starts by profile that are searched closely, those on which most profiles agree first."""
OLD_WAY_M = 3.0
"""Largest travel from a node by profile to the anchor of its target, m: half of that between two anchors, and a step more."""
ABOUT_M, ABOUT_DEG = 0.9, 6.0
"""Half-widths of the search about a start by profile, m and degrees."""
ABOUT_MIN = 0.4
"""Least likelihood of the best start near it: where it is less, hardly a registration passes."""
SURE_SIGMA_M = 0.8
"""A gate is narrow below this standard deviation, m: rooms are farther apart."""
FLOOR_M, FLOOR_DEG = 0.004, 0.04
"""Least standard deviations of the registration of two submaps, m and degrees: submaps bend."""
PIECE_M = 1.0
"""Side of the squares in which the points of a probe count as one thing, m (more where the cells are larger): a tree, a piece
of a car or of a wall."""
REGISTERED_POINTS = 400
"""Points of a probe that are registered."""
UNKNOWN = 1e8
"""Stands for an infinite standard deviation, m."""
SAME_M, SAME_RAD = 0.3, 0.1
"""Hypotheses of one anchor nearer to each other than this are one, m and rad."""


@dataclass(frozen=True, slots=True)
class Hypothesis:
    """A measured candidate of a loop closure.

    Attributes:
        probe: newer node, whose frame is that of the recent submap.
        anchor: older node, whose frame is that of the old submap.
        relative: pose of the anchor in the frame of the probe.
        quality: share of the points that have a partner, times the share of inliers among those.
        sigma_m: standard deviation of the expected position before the registration, m; 1e8 on the whole map.
        search: why the two submaps were compared.
        checks: checks of the registration, in their order; the loop is rejected if one failed, unless only `by_a_hair`.
        figures: further measured values of the registration, by name.
        fits: whether enough points of the scans fit, whatever the other checks say.
        misfit: share of points that do not fit, plus share of walls in the other's free space.
        pieces: number of separate things that the probe saw; 0 if not counted.
        proposed_by: what proposed the loop first.
    """

    probe: int
    anchor: int
    relative: RelativePose
    quality: float
    sigma_m: float
    search: Search
    checks: tuple[Check, ...]
    figures: dict[str, float]
    fits: bool
    misfit: float
    pieces: int = 0
    proposed_by: Proposer | None = None

    @property
    def passed(self) -> bool:
        """Whether all checks passed."""
        return passed(self.checks)

    @property
    def by_a_hair(self) -> bool:
        """Whether checks failed, but only shares, each by no more than its standard error (see `checks.loosened`)."""
        return not self.passed and self.within_a_hair.passed

    @property
    def within_a_hair(self) -> Hypothesis:
        """The same hypothesis; if checks failed, with the easier limits of `checks.loosened`. It may fail these too."""
        return self if self.passed else replace(self, checks=checks.loosened(self.checks, self.pieces))

    def proposed(self, key: int, lack: Lack | None = None) -> Edge:
        """The hypothesis as an edge, under a key; `lack` says why it is not accepted although all checks passed."""
        return Edge.decided(
            self.probe,
            self.anchor,
            EdgeKind.LOOP,
            self.relative,
            self.checks,
            lack if self.passed else None,
            method=Method.SCANS,
            search=self.search,
            proposed_by=self.proposed_by,
            figures=self.figures,
            key=key,
        )


@dataclass(frozen=True, slots=True)
class _Gate:
    """Where the anchor of a target may be: expected pose (3,) of the probe in its frame, radius m, heading rad, sigma m."""

    anchor: int
    expected: Array
    radius_m: float
    heading_rad: float
    sigma_m: float


@dataclass(frozen=True, slots=True)
class _Candidate:
    """A target inside the gate with its best starts, the best first."""

    gate: _Gate
    target: Submap
    starts: list[Start]


@dataclass(frozen=True, slots=True)
class _Mode:
    """A promising start: pose (3,) of the probe in the target's frame, its score, and what proposed it."""

    gate: _Gate
    target: Submap
    pose: Array
    score: float
    proposed_by: Proposer

    def is_near(self, other: _Mode) -> bool:
        """Whether a registration from one start would find that of the other: both are on one target and not separated."""
        off = between(self.pose, other.pose)
        near = np.hypot(off[0], off[1]) < SEPARATE_M and abs(off[2]) < np.deg2rad(SEPARATE_DEG)
        return self.gate.anchor == other.gate.anchor and bool(near)


class Prober:
    """Registers the submap of the last metres (the probe) to old submaps, to find loop closures."""

    def __init__(self, config: VisionConfig, atlas: Atlas, laser: Laser, panoramas: Panoramas) -> None:
        self._panoramas = panoramas
        self._gate_sigmas, self._fit_min = config.closing.gate_sigmas, config.laser.probes.fit_min
        self._atlas = atlas
        self._laser = laser
        self._anchors: list[int] = []

    def probe(self, node: int, belief: Belief, since: int = 0, known: NDArray[np.bool_] | None = None) -> list[Hypothesis]:
        """Register the last metres before a node to the old submaps that may be nearby.

        The starts that profiles propose come first. Only if none of these passes all checks, the whole gate is searched.

        Args:
            node: the newest node of the probe.
            belief: the map, which tells what may be nearby.
            since: old submaps around earlier nodes than this one are left out.
            known: (N,) around which nodes old submaps may lie instead.

        Returns:
            The most promising few, failed ones too, those whose start was likeliest first.
        """
        atlas = self._atlas
        recent = atlas.along(node, LENGTH_M, 0.0)
        recent = recent[recent <= node]
        middle = 0.5 * (atlas.travel_m[int(recent[0])] + atlas.travel_m[node])
        probe = atlas.submap(int(recent[np.searchsorted(np.asarray(atlas.travel_m)[recent], middle)]), recent)
        gates = self._gates(probe.anchor, int(recent[0]), np.arange(node) >= since if known is None else known, belief)
        by_profile = self._by_profile(gates, probe)
        found = self._verified(by_profile, probe)
        if not any(h.passed for h in found):
            modes = self._search(gates, probe, Proposer.PROXIMITY)
            tried = by_profile[: len(found)]
            found += self._verified([m for m in modes if not any(m.is_near(t) for t in tried)], probe)
        return _distinct(found)

    def probe_anywhere(self, probe: Submap, anchors: Sequence[int]) -> list[Hypothesis]:
        """Register a submap to the old submaps around the nodes `anchors`, without an expected pose; returns as `probe`."""
        gates = [_Gate(anchor, IDENTITY, UNKNOWN, np.pi, UNKNOWN) for anchor in anchors]
        modes = self._search(gates, probe, Proposer.GLOBAL)[:MODES_ANYWHERE]
        return _distinct([self._verify(mode, probe, Search.WHOLE_MAP) for mode in modes])

    def probe_at(self, probe: Submap, anchor: int, expected: Array) -> list[Hypothesis]:
        """Register a submap to the old one around the node `anchor`, near an expected pose (3,) in its frame, m and rad.

        Returns:
            One hypothesis, failed or not; none where hardly anything fits.
        """
        gate = _Gate(anchor, expected, UNKNOWN, np.pi, UNKNOWN)
        modes = self._about(gate, expected, probe, Proposer.PROXIMITY)
        return [self._verify(mode, probe, Search.WHOLE_MAP) for mode in modes]

    def anchors_before(self, node: int) -> list[int]:
        """Nodes, ascending and some metres apart, around which there are submaps that lie wholly before a node."""
        self._extend_anchors()
        atlas, half_m = self._atlas, TARGET_HALF_M
        limit = atlas.travel_m[node] - half_m
        first = atlas.piece(node).start
        return [a for a in self._anchors if a < first or (a < node and atlas.travel_m[a] < limit)]

    def _verified(self, modes: list[_Mode], probe: Submap) -> list[Hypothesis]:
        """The most promising starts inside the gate, registered."""
        sure = all(mode.gate.sigma_m < SURE_SIGMA_M for mode in modes)
        return [self._verify(mode, probe, Search.GATE) for mode in modes[: MODES_SURE if sure else MODES]]

    def _by_profile(self, gates: list[_Gate], probe: Submap) -> list[_Mode]:
        """Starts inside the gate where the profiles of the probe put it, the best first."""
        if not gates:
            return []
        leads = self._panoramas.leads(probe.anchor, probe.nodes)
        chain, travel = self._atlas.chain, self._atlas.travel_m
        if len(leads.old) == 0:
            return []
        ways_m = (np.array([travel[i] for i in nodes]) for nodes in (leads.old.tolist(), [gate.anchor for gate in gates]))
        away_m = np.abs(np.subtract.outer(*ways_m))
        of = away_m.argmin(axis=1)
        expected, anchors = (np.array(rows)[of] for rows in zip(*((g.expected, chain[g.anchor]) for g in gates), strict=True))
        radius, heading = np.array([(gate.radius_m, gate.heading_rad) for gate in gates])[of].T
        off = between(anchors, leads.poses) - expected
        inside = (away_m.min(axis=1) <= OLD_WAY_M) & (np.hypot(off[:, 0], off[:, 1]) <= radius + ABOUT_M)
        inside &= np.abs(wrap_angle(off[:, 2])) <= heading + np.deg2rad(ABOUT_DEG)
        modes: list[_Mode] = []
        for old, pose in leads.where(inside).agreed()[:LEADS]:
            gate = min(gates, key=lambda g: abs(travel[old] - travel[g.anchor]))
            modes += self._about(gate, between(chain[gate.anchor], pose), probe, Proposer.PROFILE)
        return sorted(modes, key=lambda m: -m.score)

    def _about(self, gate: _Gate, start: Array, probe: Submap, proposed_by: Proposer) -> list[_Mode]:
        """The likeliest start near a pose (3,) of the probe in a target's frame; none where nothing fits."""
        if np.hypot(start[0], start[1]) > WINDOW_M:
            return []
        target = self._atlas.around(gate.anchor, TARGET_HALF_M)
        sharp = self._atlas.scoring_field(target, Field.SHARP)
        headings = start[2] + np.deg2rad(spaced(ABOUT_DEG, STEP_DEG))
        offsets = square(ABOUT_M, STEP_M)
        scores = score_starts(sharp, probe.cloud.thinned(POINTS).points, start[:2], headings, offsets)
        h, t = np.unravel_index(int(np.argmax(scores)), scores.shape)
        if scores[h, t] < ABOUT_MIN:
            return []
        pose = np.array([*(start[:2] + offsets[t]), headings[h]])
        return [_Mode(gate, target, pose, float(scores[h, t]), proposed_by)]

    def _search(self, gates: list[_Gate], probe: Submap, proposed_by: Proposer) -> list[_Mode]:
        """Promising starts on the likeliest targets, the best first."""
        candidates = [self._candidate(gate, probe) for gate in gates]
        candidates = sorted((k for k in candidates if k.starts), key=lambda k: -k.starts[0].score)
        chosen = candidates[:TARGETS]
        return sorted((mode for k in chosen for mode in self._modes(k, probe, proposed_by)), key=lambda m: -m.score)

    def _extend_anchors(self) -> None:
        travel = self._atlas.travel_m
        while True:
            wanted = travel[self._anchors[-1]] + TARGET_EVERY_M if self._anchors else 0.0
            after = int(np.searchsorted(travel, wanted))
            if after >= len(travel):
                return
            self._anchors.append(after)

    def _gates(self, center: int, oldest: int, among: NDArray[np.bool_], belief: Belief) -> list[_Gate]:
        """Targets around some nodes, wholly before the probe, inside the gate, which follows the covariance without a cap."""
        anchors = [a for a in self.anchors_before(oldest) if among[a]]
        if not anchors:
            return []
        covariance = GATE_INFLATION**2 * np.nan_to_num(belief.covariance_from(center)[anchors], posinf=UNKNOWN)
        sigma_m = np.sqrt(np.linalg.eigvalsh(covariance[:, :2, :2])[:, 1])
        radius = self._gate_sigmas * sigma_m + GATE_M
        heading = self._gate_sigmas * np.sqrt(covariance[:, 2, 2]) + np.deg2rad(GATE_DEG)
        expected = between(belief.poses_map_node[anchors], belief.poses_map_node[center])
        inside = np.hypot(expected[:, 0], expected[:, 1]) <= radius + WINDOW_M
        return [
            _Gate(anchors[i], expected[i], float(radius[i]), float(min(heading[i], np.pi)), float(sigma_m[i]))
            for i in np.flatnonzero(inside)
        ]

    def _candidate(self, gate: _Gate, probe: Submap) -> _Candidate:
        """The best starts in the part of the gate about one target."""
        target = self._atlas.around(gate.anchor, TARGET_HALF_M)
        offsets = square(WINDOW_M, 2.0 * STEP_M)
        inside = (np.hypot(offsets[:, 0], offsets[:, 1]) <= WINDOW_M) & (
            np.hypot(*(offsets - gate.expected[:2]).T) <= gate.radius_m
        )
        if not inside.any():
            return _Candidate(gate, target, [])
        headings = gate.expected[2] + np.deg2rad(spaced(np.rad2deg(gate.heading_rad), 2.0 * STEP_DEG))
        points = probe.cloud.thinned(POINTS // 2).points
        wide = self._atlas.scoring_field(target, Field.WIDE)
        return _Candidate(gate, target, survivors(wide, points, offsets[inside], headings))

    def _modes(self, candidate: _Candidate, probe: Submap, proposed_by: Proposer) -> list[_Mode]:
        """Separated maxima of the likelihood on one target."""
        sharp = self._atlas.scoring_field(candidate.target, Field.SHARP)
        starts = sharpened(sharp, probe.cloud.thinned(POINTS).points, candidate.starts, MODES_PER_TARGET)
        return [_Mode(candidate.gate, candidate.target, start.pose, start.score, proposed_by) for start in starts]

    def _verify(self, mode: _Mode, probe: Submap, search: Search) -> Hypothesis:
        gate = mode.gate
        cloud, field = probe.cloud.thinned(REGISTERED_POINTS), self._atlas.fine_field(mode.target)
        alignment = align(field, cloud, mode.pose[None])
        pose, near, fit = alignment.poses[0], float(alignment.near[0]), float(alignment.fit[0])
        covariance = alignment.covariance(0, FLOOR_M, np.deg2rad(FLOOR_DEG))
        loosest_m = float(np.sqrt(np.linalg.eigvalsh(covariance[:2, :2])[1]))
        figures = {"start": mode.score, "inliers": float(alignment.inliers[0]), "rms_m": float(alignment.rms_m[0])}
        asked, seen = checks.of_fit(near, fit, self._fit_min), 0.0
        fits = passed(asked)
        if search is Search.GATE:
            figures["gate_sigma_m"] = gate.sigma_m
            off_m = float(np.hypot(*(pose - gate.expected)[:2]))
            off_deg = float(np.rad2deg(abs(wrap_angle(pose[2] - gate.expected[2]))))
            asked += checks.of_gate(off_m, off_deg, gate.radius_m, np.rad2deg(gate.heading_rad))
        asked += checks.of_place(loosest_m, ambiguity_of(field, cloud, alignment))
        pieces = _pieces(cloud) if search is Search.GATE else 0
        if passed(checks.loosened(asked, pieces)):
            seen = violation_both_ways(probe, mode.target, pose, self._atlas.ranges, self._laser)
            asked += checks.of_free_space(seen)
        relative = invert_relative(self._atlas.joining(gate.anchor, pose, covariance, probe.anchor))
        return Hypothesis(
            probe.anchor,
            gate.anchor,
            relative,
            near * fit,
            gate.sigma_m,
            search,
            asked,
            figures,
            fits,
            1.0 - fit + seen,
            pieces,
            mode.proposed_by,
        )


def _pieces(cloud: Cloud) -> int:
    """Number of separate things in a cloud: of squares in which it has points."""
    x, y = np.floor(cloud.points / (PIECE_M * cloud.cell_m / CELL_M)).astype(np.int64).T
    return len(np.unique((x << 32) + y))


def _distinct(found: list[Hypothesis]) -> list[Hypothesis]:
    """The first of hypotheses of one anchor at the same pose."""
    out: list[Hypothesis] = []
    for h in found:
        same = [o for o in out if o.anchor == h.anchor]
        gaps = [between(o.relative.delta, h.relative.delta) for o in same]
        if not any(np.hypot(g[0], g[1]) < SAME_M and abs(g[2]) < SAME_RAD for g in gaps):
            out.append(h)
    return out
