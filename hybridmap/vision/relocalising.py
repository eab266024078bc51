"""Global localisation: whether a robot is lost, and where it is once several matches on the whole map agree."""

from __future__ import annotations

from collections import deque
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from enum import Enum

import numpy as np
from numpy.typing import NDArray

from hybridmap.geometry import Array, RelativePose, between, compose, inverse
from hybridmap.graph.agreement import Loops, agreement, largest_consistent_set
from hybridmap.graph.edges import Check, Edge, EdgeKind, Lack, Method, Search, Status, at_least, at_most, passed
from hybridmap.vision.base import Belief

Indices = NDArray[np.int64]

SUPPORT = 4
"""Least number of nodes with matches that agree: similar rooms seldom agree four times."""
MISMATCH_MAX = 0.15
"""Mean mismatch of agreeing matches at which no travel is enough; half of it doubles the travel that is needed."""
MISMATCH_SCALE = 0.03
"""Excess of mismatch over the best match of the same node that divides the weight of a match by e."""
WAIT_M = 32.0
"""Travel after which a match without support is rejected, m."""
REATTACHED_M, REATTACHED_RAD = 0.5, float(np.deg2rad(10.0))
"""Standard deviations of the edge that replaces a broken one, m and rad: loose, as the closures place the node."""
SAME_PLACE_SIGMA = 2.0
"""A robot found within so many of these deviations of its pose by the chain, and the drift of the chain, was not kidnapped."""
BENDING = 4.0
"""Factor on the standard deviation of the chain, as for the gate of loops: it bends more than independent edges would."""
BELOW_HALF = float(np.nextafter(0.5, 0.0))
"""Contradicting matches must weigh less than half of the agreeing ones."""
KEPT_STEPS = 1000
"""Number of the newest registrations that are kept; those across a break are retracted."""


class ChainState(Enum):
    """How certain the motion to a new node is.

    It holds; or it is uncertain: the view fits those before, but may slide along a wall; or it is broken: the view fits none.
    """

    HOLDS = "holds"
    UNCERTAIN = "uncertain"
    BROKEN = "broken"


class Whereabouts:
    """Keeps the evidence of whether a robot is lost, i.e. whether its pose on the map may be wrong.

    A robot is lost from each of these events on until the next loop closure: the view of a node fits none before it (the motion
    is broken); the view fits, but the motion is uncertain along a wall; or the robot fails to recognise known places several
    times. Uncertain motion is forgotten after some nodes, a break when `mended` is called.

    Args:
        unrecognised: failures in a row to recognise a known place after which the robot is lost; 0: they do not count.
        uncertain_nodes: nodes after which uncertain motion is forgotten.
    """

    def __init__(self, unrecognised: int, uncertain_nodes: int = 1) -> None:
        self._wanted = unrecognised
        self._uncertain_nodes = uncertain_nodes
        self._breaks: dict[int, ChainState] = {}
        self._unrecognised = 0

    @property
    def lost(self) -> bool:
        """Whether the robot is lost: its pose on the map may be wrong."""
        return bool(self._breaks) or (self._wanted > 0 and self._unrecognised >= self._wanted)

    @property
    def first_break(self) -> int | None:
        """First node after broken or uncertain motion since the last loop closure; None if there is none.

        Uncertain motion that is forgotten and breaks that were mended do not count.
        """
        return min(self._breaks, default=None)

    @property
    def lost_since(self) -> int | None:
        """First node after broken motion (not uncertain motion) since the last loop closure; None if there is none."""
        return min((at for at, how in self._breaks.items() if how is ChainState.BROKEN), default=None)

    def break_before(self, node: int) -> int | None:
        """Node at which the last broken motion since the last loop closure ends, `node` included.

        If none is broken, the node at which the last uncertain motion ends that is not forgotten; else None.
        """
        before = [at for at in self._breaks if at <= node]
        certain = [at for at in before if self._breaks[at] is ChainState.BROKEN]
        return max(certain or before, default=None)

    def tracked(self, node: int, chain: ChainState) -> None:
        """Note how certain the motion to a new node is, and forget uncertain motion that is too old."""
        uncertain = [at for at, how in self._breaks.items() if how is ChainState.UNCERTAIN]
        for at in uncertain:
            if node - at > self._uncertain_nodes:
                del self._breaks[at]
        if chain is not ChainState.HOLDS:
            self._breaks[node] = chain

    def recognised(self) -> None:
        """Record that a loop closure has localised the robot: it no longer counts as lost, and all evidence is cleared."""
        self._breaks.clear()
        self._unrecognised = 0

    def mended(self, node: int) -> None:
        """Forget the break before a node: the robot drove there after all."""
        self._breaks.pop(node, None)

    def unrecognised(self) -> None:
        """Record that the robot failed to recognise a known place; several times without `recognised` make it count as lost."""
        self._unrecognised += 1


@dataclass(frozen=True, slots=True)
class GlobalMatch:
    """Two nodes that were compared while the robot was lost: their edge, and how badly they match (`mismatch`).

    The edge is pending if the views match, else rejected. The mismatch grows with the share of the views that does not fit: 0
    for a perfect fit.
    """

    edge: Edge
    mismatch: float = 0.0


@dataclass(frozen=True, slots=True)
class Settlement:
    """What the matches of a lost robot led to.

    Attributes:
        proposals: every edge that the map must add or replace: accepted, pending and rejected ones.
        accepted: the matches among the proposals that now enter the map; empty while the robot is not localised.
        kidnapped_to: the first node after the kidnapping; None while the robot is not localised, or if it was not kidnapped.
    """

    proposals: list[Edge]
    accepted: tuple[Edge, ...] = ()
    kidnapped_to: int | None = None


class Relocaliser:
    """Keeps the matches of a lost robot with older nodes. The newer node is the source of an edge.

    Matches are pending until those of `SUPPORT` distinct nodes over `span_m` of travel agree with each other and with the
    motion between them, and those that contradict them weigh less than half. Then all of them enter the map together. After
    a kidnapping an edge derived from them replaces the odometry edge across it, and registrations across it are retracted.
    Matches with larger mismatch need more travel, and weigh less than a better match of the same node.

    The first node of a session comes after a break too (`arrived`). Nothing tells where it is, so there the break never proves
    to be a bad registration, and its edge comes from a node that was matched.

    Attributes:
        leading: the pending matches that agree best with each other, if they are of `SUPPORT` distinct nodes; else none.
    """

    def __init__(self, whereabouts: Whereabouts, new_key: Callable[[], int], span_m: float) -> None:
        """Start without matches; matches that agree must cover `span_m` of travel. `new_key` returns the key of a new edge."""
        self.whereabouts = whereabouts
        self._span_m = span_m
        self._new_key = new_key
        self._waiting: list[GlobalMatch] = []
        self._agree: NDArray[np.bool_] = np.zeros((0, 0), dtype=bool)
        self._steps: deque[Edge] = deque(maxlen=KEPT_STEPS)
        self._arrivals: set[int] = set()
        self.leading: tuple[Edge, ...] = ()

    def arrived(self, node: int) -> None:
        """Note that a session begins at a node, of which nothing is known but that its place may be on the map."""
        self._arrivals.add(node)
        self.whereabouts.tracked(node, ChainState.BROKEN)

    def tracked(self, node: int, chain: ChainState, steps: list[Edge]) -> None:
        """Note the registrations (`steps`) of a new node to the ones before it, and how certain the motion is (`chain`)."""
        self.whereabouts.tracked(node, chain)
        self._steps += [step for step in steps if step.status is Status.ACCEPTED]

    def settle(self, found: Sequence[GlobalMatch], belief: Belief) -> Settlement:
        """Add matches; accept the largest set that agrees with each other and with the motion between, if it is good enough.

        Then the robot counts as localised, and all other matches are rejected. Those that waited too long are rejected anyway.

        Args:
            found: nodes that were compared; those with pending edges are matches.
            belief: the map; poses on either side of a kidnapping are right relative to each other.
        """
        out, self.leading = [match.edge for match in found] + self._expired(belief), ()
        self._waiting += [s for s in found if s.edge.status is Status.PENDING]
        if not self._waiting:
            return Settlement(out)
        edges = [match.edge for match in self._waiting]
        loops = Loops.measured([(e.source, e.target, e.relative) for e in edges if e.relative is not None])
        self._agree = agreement(loops, belief.ways, known=self._agree)
        weights = self._weights()
        chosen = np.flatnonzero(largest_consistent_set(self._agree, weights))
        asked = self._asked(chosen, weights, belief)
        if not passed(asked):
            if passed(asked[:1]):
                self.leading = tuple(edges[i] for i in chosen.tolist())
            return Settlement(out)
        accepted = tuple(edges[i].settled(*asked) for i in chosen.tolist())
        self._waiting = [s for i, s in enumerate(self._waiting) if i not in set(chosen.tolist())]
        out += [*accepted, *self.dismiss(Lack.CONTRADICTED)]
        broken_at = self.whereabouts.break_before(min(s.source for s in accepted))
        self.whereabouts.recognised()
        kidnapped_to = broken_at if broken_at is not None and self._is_elsewhere(broken_at, accepted, belief) else None
        return Settlement(
            out + (self.reattach(kidnapped_to, accepted, belief) if kidnapped_to is not None else []), accepted, kidnapped_to
        )

    def dismiss(self, lack: Lack = Lack.UNSUPPORTED) -> list[Edge]:
        """Reject all pending matches for the reason `lack`; returns their edges."""
        out = [s.edge.settled(lack=lack) for s in self._waiting]
        self._waiting, self._agree, self.leading = [], self._agree[:0, :0], ()
        return out

    def reattach(self, broken_at: int, accepted: tuple[Edge, ...], belief: Belief) -> list[Edge]:
        """Retract registrations across a kidnapping, and place the node after it where its matches say; keeps no state.

        Args:
            broken_at: the first node after the kidnapping.
            accepted: matches that agree, from nodes after the kidnapping to nodes before it.
            belief: the map; poses on either side of the kidnapping are right relative to each other.

        Returns:
            The retracted registrations, and an edge from the node before the kidnapping to the one after it.
        """
        crossing = [step for step in self._steps if step.source < broken_at <= step.target]
        return [
            *(replace(step.settled(lack=Lack.KIDNAPPED), contradicts_odometry=False) for step in crossing),
            self._reattached(broken_at, accepted, belief),
        ]

    def _expired(self, belief: Belief) -> list[Edge]:
        """Reject matches that have been pending too long."""
        old_nodes = belief.travel_m < belief.travel_m[-1] - WAIT_M
        old = [s.edge for s in self._waiting if old_nodes[s.edge.source]]
        kept = [i for i, s in enumerate(self._waiting) if not old_nodes[s.edge.source]]
        self._waiting, self._agree = [self._waiting[i] for i in kept], self._agree[np.ix_(kept, kept)]
        return [s.settled(lack=Lack.UNSUPPORTED) for s in old]

    def _weights(self) -> Array:
        """(n,) 1 for the best match of each node, less for its others."""
        sources, mismatch = self._sources(), self._mismatch()
        best = np.array([mismatch[sources == source].min() for source in sources])
        return np.asarray(np.exp((best - mismatch) / MISMATCH_SCALE))

    def _asked(self, chosen: Indices, weights: Array, belief: Belief) -> tuple[Check, ...]:
        """Checks of matches that agree: number of nodes, travel, and the weight of the others.

        The travel is reduced by the mean mismatch, and is that of the subset of the best matches for which it is largest.
        """
        mismatch = self._mismatch()[chosen]
        order = np.argsort(mismatch, kind="stable")
        sources, span_m = self._sources()[chosen[order]], -1.0
        for count in range(SUPPORT, len(chosen) + 1):
            fits = 1.0 - float(mismatch[order[:count]].mean()) / MISMATCH_MAX
            seen = np.unique(sources[:count])
            if fits > 0.0 and len(seen) >= SUPPORT:
                span_m = max(span_m, float(belief.travel_m[seen[-1]] - belief.travel_m[seen[0]]) * fits)
        own = weights[chosen].sum()
        return (
            at_least("agreeing", len(np.unique(sources)), SUPPORT),
            at_least("span_m", span_m, self._span_m),
            at_most("rival", (weights.sum() - own) / own, BELOW_HALF),
        )

    def _is_elsewhere(self, broken_at: int, accepted: tuple[Edge, ...], belief: Belief) -> bool:
        """Whether matches put the node after a break elsewhere than the chain can have drifted on the way to the first of them.

        A break in a sparse scene may be a bad registration. Found again after a long way, the robot is off by the drift.
        """
        if broken_at in self._arrivals:
            return True
        poses, first = belief.poses_map_node, min(accepted, key=lambda match: match.source)
        drift = BENDING**2 * belief.covariance_from(first.target)[first.source]
        drift = np.where(np.isfinite(drift), drift, 0.0)  # no motion joins them: the chain says nothing of where it is
        drift_m2 = float(np.linalg.eigvalsh(drift[:2, :2])[1])
        off = between(poses[broken_at], placed_by(accepted, broken_at, poses))
        by_place = np.hypot(off[0], off[1]) / np.sqrt(REATTACHED_M**2 + drift_m2)
        by_heading = abs(off[2]) / np.sqrt(REATTACHED_RAD**2 + drift[2, 2])
        return bool(max(by_place, by_heading) > SAME_PLACE_SIGMA)

    def _reattached(self, broken_at: int, accepted: tuple[Edge, ...], belief: Belief) -> Edge:
        """The edge to the first node after the break, by way of the matches; it replaces the odometry."""
        poses = belief.poses_map_node
        middle, arrival = placed_by(accepted, broken_at, poses), broken_at in self._arrivals
        before = accepted[0].target if arrival else broken_at - 1
        relative = RelativePose(between(poses[before], middle), np.diag([REATTACHED_M, REATTACHED_M, REATTACHED_RAD]) ** 2)
        moved_m = float(np.hypot(*(middle - poses[broken_at])[:2]))
        return Edge.decided(
            before,
            broken_at,
            EdgeKind.REGISTRATION,
            relative,
            method=Method.LOOPS,
            search=Search.WHOLE_MAP,
            figures={"agreeing": float(len(accepted))},
            kidnapped_m=None if arrival else moved_m,
            key=self._new_key(),
            contradicts_odometry=not arrival,
        )

    def _sources(self) -> Indices:
        return np.array([s.edge.source for s in self._waiting], dtype=np.int64)

    def _mismatch(self) -> Array:
        return np.array([s.mismatch for s in self._waiting])


def placed_by(matches: Sequence[Edge], at: int, poses: Array) -> Array:
    """Pose (3,) on the map of the node `at`: each match gives one, and the medoid (nearest to all others) is returned.

    Args:
        matches: measured edges from nodes joined to `at` by motion (sources) to nodes of the map (targets).
        at: the node.
        poses: (N, 3) of all nodes, m and rad. Only the way from the sources to `at`, and the targets, are used.
    """
    placed = np.array([_placed(s, at, poses) for s in matches])
    return np.asarray(placed[int(np.argmin(np.abs(placed[:, None, :2] - placed[None, :, :2]).sum(axis=(1, 2))))])


def _placed(match: Edge, at: int, poses: Array) -> Array:
    """Pose (3,) of a node after the break on the map, by one match."""
    assert match.relative is not None
    seen = compose(poses[match.target], inverse(match.relative.delta))
    return compose(seen, between(poses[match.source], poses[at]))
