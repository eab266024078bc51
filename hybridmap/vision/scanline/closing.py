"""Which stretches of the way are the same place: threshold, gate, rivals, and agreement with earlier matches."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from hybridmap.geometry import Array, RelativePose, between, compose, inverse, wrap_angle
from hybridmap.graph.edges import Check, Edge, EdgeKind, Lack, Method, Proposer, Search, Status, at_most, passed
from hybridmap.vision.base import Belief
from hybridmap.vision.gating import MIN_AGE_S
from hybridmap.vision.scanline.sequences import Sequences

Indices = NDArray[np.int64]
DIFFERENT_M, WITHIN_M, PAIRS, QUANTILE = 2.0, 20.0, 400, 0.01
"""Nodes this far apart by self-motion, within so much travel, are at different places for certain. Least number of such pairs
that the threshold is found from, and the share of them that scores below it."""
RENEW = 1.02
"""The threshold is found anew when the number of pairs has grown by this factor: its cost stays linear in the drive."""
GATE_M, GATE_PER_M = 1.0, 0.25
"""Radius of the gate, m, and its growth per metre of the way between the two nodes: wheels err by less than a quarter of it."""
HEADING_DEG, HEADING_DEG_PER_M = 25.0, 1.5
"""Largest difference of headings, degrees, and its growth per metre: views must overlap by half, wheels veer by less."""
AWAY_M = 3.0
"""A node with less travel between is no revisit, m."""
RIVAL_M, UNLIKE = 1.5, 0.8
"""Distance from which a node is another place, m; a match scores at most so many times the best of these."""
TURNING_DEG = 6.0
"""A step with a larger turn sweeps the view: its profile matches by chance."""
WINDOW_NODES, SUPPORT = 10, 4
"""Matches of so many last nodes are asked whether they agree, and how many must, with the newest."""
AGREE_M, AGREE_PER_M, AGREE_DEG, AGREE_DEG_PER_M = 0.3, 0.03, 3.0, 0.5
"""Two matches agree where the way between them, by self-motion, closes within so much, plus so much a metre of it."""
SIGMA_M, SIGMA_ACROSS_M, SIGMA_DEG = 0.1, 0.2, 2.0
"""Standard deviations of a loop along and across the way and of its heading: a profile does not see the lateral offset."""


@dataclass(frozen=True, slots=True)
class Measured:
    """Where an older view was taken, seen from a newer one.

    Attributes:
        delta: (3,) m and rad.
        by_depth: whether the way along comes from the depth ahead, rather than from the scores of the nodes around.
    """

    delta: Array
    by_depth: bool


class DifferentPlaces:
    """The threshold of the score, found from pairs of nodes that are known to lie apart, without any truth.

    Attributes:
        threshold: the quantile `QUANTILE` of their scores so far; -inf before there are enough.
    """

    def __init__(self) -> None:
        self.threshold = -np.inf
        self._scores: list[Array] = []
        self._pairs, self._due = 0, float(PAIRS)

    def learn(self, scores: Array, distance_m: Array, travel_m: Array) -> None:
        """Add the newest node: its scores, distances by self-motion and travel to all nodes before it, each (N,)."""
        apart = (distance_m > DIFFERENT_M) & (travel_m < WITHIN_M) & np.isfinite(scores)
        self._scores.append(scores[apart])
        self._pairs += int(np.count_nonzero(apart))
        if self._pairs >= self._due:
            self._scores = [np.concatenate(self._scores)]
            self.threshold = float(np.quantile(self._scores[0], QUANTILE))
            self._due = RENEW * self._pairs


class ScanlineCloser:
    """Finds the loops of the newest node. The newer node is the source of an edge.

    Args:
        sequences: scores of all nodes against the newest.
        measure: (newer node, older node) -> pose of the older seen from the newer.
        c_t: threshold of the score; None: it is found from the drive.
    """

    def __init__(self, sequences: Sequences, measure: Callable[[int, int], Measured], c_t: float | None) -> None:
        self._sequences = sequences
        self._measure = measure
        self._c_t = c_t
        self._different = DifferentPlaces()
        self._chain: list[Array] = []
        self._turning: list[bool] = []
        self._travel_at_closure = 0.0
        self._waiting: list[Edge] = []
        self._matched: list[Edge] = []
        self._keys = 0

    def add_node(self, motion: Array) -> None:
        """Add the newest node with the motion (3,) to it from the node before, m and rad; that of the first is not used."""
        self._chain.append(compose(self._chain[-1], motion) if self._chain else motion)
        self._turning.append(bool(abs(motion[2]) > np.deg2rad(TURNING_DEG)))

    def way(self, first: int, second: int) -> Array:
        """Pose (3,) of a node seen from another by self-motion alone, m and rad."""
        return between(self._chain[first], self._chain[second])

    def rescale(self, factor: float) -> None:
        """Multiply all ways by self-motion: the gain of the wheels was corrected."""
        self._chain = [pose * np.array([factor, factor, 1.0]) for pose in self._chain]

    def close(self, node: int, belief: Belief) -> list[Edge]:
        """Look for a loop of the newest node; returns new edges, rejected ones too, and earlier ones that changed."""
        chain, scores = np.array(self._chain), self._sequences.scores
        travel_m = belief.travel_m[node] - belief.travel_m[:node]
        self._different.learn(scores[:node], np.hypot(*(chain[:node, :2] - chain[node, :2]).T), travel_m)
        changed = self.give_up(node - WINDOW_NODES)
        older = self._candidates(node, belief)
        if not np.isfinite(self._threshold) or len(older) == 0:
            return changed
        best = int(older[np.argmin(scores[older])])
        match = self._compared(node, best, belief)
        if match.status is Status.REJECTED:
            return [*changed, match]
        recent = [edge for edge in self._matched if node - edge.source < WINDOW_NODES]
        agreeing = [edge for edge in recent if self._agree(edge, match, belief)]
        self._matched = [*recent, match]
        if len(agreeing) + 1 < SUPPORT:
            self._waiting.append(match)
            return [*changed, match]
        self._travel_at_closure = float(belief.travel_m[node])
        joined = {edge.key for edge in agreeing}
        accepted = [edge.settled() for edge in self._waiting if edge.key in joined]
        self._waiting = [edge for edge in self._waiting if edge.key not in joined]
        return [*changed, *accepted, match.settled()]

    def give_up(self, before: int) -> list[Edge]:
        """Reject what still waits of the nodes up to `before`: no others agreed with it."""
        late = [edge.settled(lack=Lack.UNSUPPORTED) for edge in self._waiting if edge.source <= before]
        self._waiting = [edge for edge in self._waiting if edge.source > before]
        return late

    @property
    def _threshold(self) -> float:
        return self._different.threshold if self._c_t is None else self._c_t

    def _candidates(self, node: int, belief: Belief) -> Indices:
        if self._turning[node]:
            return np.zeros(0, dtype=np.int64)
        travel_m, poses = belief.travel_m, belief.poses_map_node
        way_m = np.minimum(travel_m[node] - self._travel_at_closure, travel_m[node] - travel_m[:node])
        near = np.hypot(*(poses[:node, :2] - poses[node, :2]).T) <= GATE_M + GATE_PER_M * way_m
        turn = np.abs(wrap_angle(poses[:node, 2] - poses[node, 2])) <= np.deg2rad(HEADING_DEG + HEADING_DEG_PER_M * way_m)
        usable = (
            self._revisit(node, belief)
            & ~np.array(self._turning[:node], dtype=bool)
            & np.isfinite(self._sequences.scores[:node])
        )
        return np.flatnonzero(near & turn & usable)

    @staticmethod
    def _revisit(node: int, belief: Belief) -> NDArray[np.bool_]:
        """(node,) which earlier nodes would be seen again, not still."""
        old = belief.stamps_s[node] - belief.stamps_s[:node] > MIN_AGE_S
        return np.asarray(old & (belief.travel_m[node] - belief.travel_m[:node] > AWAY_M))

    def _compared(self, node: int, older: int, belief: Belief) -> Edge:
        scores, poses = self._sequences.scores, belief.poses_map_node
        elsewhere = self._revisit(node, belief) & (np.hypot(*(poses[:node, :2] - poses[older, :2]).T) > RIVAL_M)
        rival = float(np.min(scores[:node][elsewhere], initial=np.inf))
        score = float(scores[older])
        checks: tuple[Check, ...] = (
            at_most("G over the last views", score, self._threshold, None if self._c_t is None else "vision.matching.c_t"),
            at_most("its share of the best G elsewhere", score / max(rival, 1e-9), UNLIKE),
        )
        measured = self._measure(node, older)
        covariance = np.diag([SIGMA_M, SIGMA_ACROSS_M, np.deg2rad(SIGMA_DEG)]) ** 2
        self._keys += 1
        return Edge.decided(
            node,
            older,
            EdgeKind.LOOP,
            RelativePose(measured.delta, covariance),
            checks,
            Lack.WAITING if passed(checks) else None,
            method=Method.SEQUENCE,
            search=Search.GATE,
            proposed_by=Proposer.PROFILE,
            shift=round(float(self._sequences.shifts[older])),
            figures={"threshold": self._threshold, "by depth": float(measured.by_depth)},
            key=self._keys - 1,
        )

    def _agree(self, one: Edge, other: Edge, belief: Belief) -> bool:
        """Whether the ways between the ends of two matches, by self-motion, form a closed ring with them."""
        assert one.relative is not None
        assert other.relative is not None
        newer, older = (self.way(a, b) for a, b in _ends(one, other))
        gap = between(compose(one.relative.delta, older), compose(newer, other.relative.delta))
        way_m = sum(abs(float(belief.travel_m[b] - belief.travel_m[a])) for a, b in _ends(one, other))
        near = float(np.hypot(gap[0], gap[1])) <= AGREE_M + AGREE_PER_M * way_m
        return near and abs(float(wrap_angle(gap[2]))) <= np.deg2rad(AGREE_DEG + AGREE_DEG_PER_M * way_m)


def _ends(one: Edge, other: Edge) -> Sequence[tuple[int, int]]:
    return (one.source, other.source), (one.target, other.target)


def seen_from_newer(ahead_m: float, yaw_rad: float) -> Array:
    """Pose (3,) of an older view seen from a newer one that is `ahead_m` ahead of it; `yaw_rad` is the older one's heading."""
    return inverse(np.array([ahead_m, 0.0, -yaw_rad]))
