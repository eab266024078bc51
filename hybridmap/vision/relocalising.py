"""Whether a robot is lost, and where it is once several of its sightings on the whole map say the same."""

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
"""Nodes whose closures must put the robot at one and the same place: rooms that look alike seldom do so four times."""
MISMATCH_MAX = 0.15
"""Mean mismatch, of sightings that say how badly they fit, at which no travel is enough; half of it doubles the travel."""
MISMATCH_SCALE = 0.03
"""Of one node's sightings at different places, one that fits worse by this counts for a factor e less."""
WAIT_M = 32.0
"""Travel after which a sighting that no others agreed with is given up, m."""
REHUNG_M, REHUNG_RAD = 0.5, float(np.deg2rad(10.0))
"""Standard deviations of the edge in the place of the broken one: it holds the chain together, the closures place it."""
WHERE_IT_WAS = 2.0
"""A robot that is found within so many of these deviations of where the chain has it was not carried."""
BELOW_HALF = float(np.nextafter(0.5, 0.0))
"""The sightings that contradict those that agree must count for less than half as much."""
KEPT_STEPS = 1000
"""The newest registrations, which are taken back where they reach across a break."""


class Chain(Enum):
    """How a new node hangs on the nodes before it, by what it sees."""

    HOLDS = "holds"
    DOUBTFUL = "doubtful"
    BROKEN = "broken"


class Whereabouts:
    """Keeps the evidence.

    The chain is broken at a node whose view fits none of the nodes before it: the robot may have been carried there, or have
    looked at a bare wall. It is doubtful at a node whose view fits, but slides: one wall fits any other. And a robot that is
    where its map has it recognises what it drives past. In all three cases it is lost until a closure tells where it is;
    only a doubt is forgotten in the end, as most bare walls are just that.

    Args:
        unrecognised: times in a row that the robot must fail to recognise what it should know to be lost; 0: it never is.
        doubt_nodes: nodes after which a doubt is forgotten.
    """

    def __init__(self, unrecognised: int, doubt_nodes: int = 1) -> None:
        self._wanted = unrecognised
        self._doubt_nodes = doubt_nodes
        self._breaks: dict[int, Chain] = {}
        self._unrecognised = 0

    @property
    def lost(self) -> bool:
        """The map's own pose is not to be trusted."""
        return bool(self._breaks) or (self._wanted > 0 and self._unrecognised >= self._wanted)

    @property
    def first_break(self) -> int | None:
        """The first node since the last closure before which the chain broke or may have broken; None where it holds."""
        return min(self._breaks, default=None)

    @property
    def lost_since(self) -> int | None:
        """The first node since the last closure before which the chain certainly broke; None where it did not."""
        return min((at for at, how in self._breaks.items() if how is Chain.BROKEN), default=None)

    def break_before(self, node: int) -> int | None:
        """Where the chain broke, if the robot is elsewhere at a node: the last break up to it, else the last doubt."""
        before = [at for at in self._breaks if at <= node]
        certain = [at for at in before if self._breaks[at] is Chain.BROKEN]
        return max(certain or before, default=None)

    def tracked(self, node: int, chain: Chain) -> None:
        """The view of a new node was compared with those before it."""
        doubts = [at for at, how in self._breaks.items() if how is Chain.DOUBTFUL]
        for at in doubts:
            if node - at > self._doubt_nodes:
                del self._breaks[at]
        if chain is not Chain.HOLDS:
            self._breaks[node] = chain

    def recognised(self) -> None:
        """A closure says where the robot is."""
        self._breaks.clear()
        self._unrecognised = 0

    def unrecognised(self) -> None:
        """Here the robot should have seen a place that it knows, and did not recognise it."""
        self._unrecognised += 1


@dataclass(frozen=True, slots=True)
class Sighting:
    """A pair of views that was compared while the robot was lost, and how badly it fits: 0 for perfectly."""

    edge: Edge
    mismatch: float = 0.0


@dataclass(frozen=True, slots=True)
class Settlement:
    """What came of the sightings.

    Attributes:
        proposals: those that changed, and what happens to the chain.
        friends: the sightings that entered the map; empty while the robot is not found.
        carried_to: the node to which the robot was carried; None where it is not found, or was not carried.
    """

    proposals: list[Edge]
    friends: tuple[Edge, ...] = ()
    carried_to: int | None = None


class Relocaliser:
    """Keeps the sightings of a lost robot. The newer node is the source of an edge.

    Sightings wait until `SUPPORT` of them, of distinct nodes over `span_m` of travel, put the robot at one and the same pose,
    and those that contradict them count for less than half as much. Then all of them enter the map together, and the odometry
    edge at which the chain broke gives way to one that leads to where they have it; registrations across the break are taken
    back. The worse those that agree best fit, the more travel is needed, and of one node's sightings the worse count less.
    """

    def __init__(self, whereabouts: Whereabouts, new_key: Callable[[], int], span_m: float) -> None:
        """Start without a sighting; those that agree must cover `span_m` of travel."""
        self.whereabouts = whereabouts
        self._span_m = span_m
        self._new_key = new_key
        self._waiting: list[Sighting] = []
        self._agree: NDArray[np.bool_] = np.zeros((0, 0), dtype=bool)
        self._steps: deque[Edge] = deque(maxlen=KEPT_STEPS)

    def tracked(self, node: int, chain: Chain, steps: list[Edge]) -> None:
        """Take notice of how a new node was registered to the ones before it."""
        self.whereabouts.tracked(node, chain)
        self._steps += [step for step in steps if step.status is Status.ACCEPTED]

    def settle(self, found: Sequence[Sighting], belief: Belief) -> Settlement:
        """Let new sightings wait; accept the largest set of them that agree through the chain, if it is good enough.

        Args:
            found: what was looked at, in any state; those that are pending are sightings.
            belief: the map's; poses on either side of the break are right among themselves.
        """
        out = [sighting.edge for sighting in found] + self._expired(belief)
        self._waiting += [s for s in found if s.edge.status is Status.PENDING]
        if not self._waiting:
            return Settlement(out)
        edges = [sighting.edge for sighting in self._waiting]
        loops = Loops.measured([(e.source, e.target, e.relative) for e in edges if e.relative is not None])
        self._agree = agreement(loops, belief.ways, known=self._agree)
        weights = self._weights()
        chosen = np.flatnonzero(largest_consistent_set(self._agree, weights))
        asked = self._asked(chosen, weights, belief)
        if not passed(asked):
            return Settlement(out)
        friends = tuple(edges[i].settled(*asked) for i in chosen.tolist())
        self._waiting = [s for i, s in enumerate(self._waiting) if i not in set(chosen.tolist())]
        out += [*friends, *self.dismiss(Lack.CONTRADICTED)]
        broken_at = self.whereabouts.break_before(min(s.source for s in friends))
        self.whereabouts.recognised()
        carried_to = broken_at if broken_at is not None and self._carried(broken_at, friends, belief) else None
        return Settlement(
            out + (self.rehang(carried_to, friends, belief) if carried_to is not None else []), friends, carried_to
        )

    def dismiss(self, lack: Lack = Lack.UNSUPPORTED) -> list[Edge]:
        """Refuse all sightings that wait."""
        out = [s.edge.settled(lack=lack) for s in self._waiting]
        self._waiting, self._agree = [], self._agree[:0, :0]
        return out

    def rehang(self, broken_at: int, friends: tuple[Edge, ...], belief: Belief) -> list[Edge]:
        """Take back what was registered across a break, and hang the node behind it where its sightings have it.

        Args:
            broken_at: the first node behind the break.
            friends: sightings that agree; their sources lie behind the break, their targets before it.
            belief: poses on either side of the break are right among themselves.

        Returns:
            The registrations taken back, and the edge from the node before the break to the one behind it.
        """
        crossing = [step for step in self._steps if step.source < broken_at <= step.target]
        return [
            *(replace(step.settled(lack=Lack.KIDNAPPED), contradicts_odometry=False) for step in crossing),
            self._rehung(broken_at, friends, belief),
        ]

    def _expired(self, belief: Belief) -> list[Edge]:
        """Refuse sightings that have waited too long."""
        old_nodes = belief.travel_m < belief.travel_m[-1] - WAIT_M
        old = [s.edge for s in self._waiting if old_nodes[s.edge.source]]
        kept = [i for i, s in enumerate(self._waiting) if not old_nodes[s.edge.source]]
        self._waiting, self._agree = [self._waiting[i] for i in kept], self._agree[np.ix_(kept, kept)]
        return [s.settled(lack=Lack.UNSUPPORTED) for s in old]

    def _weights(self) -> Array:
        """(n,) 1 for each node's best sighting, less for those of the same node that fit worse."""
        sources, mismatch = self._sources(), self._mismatch()
        best = np.array([mismatch[sources == source].min() for source in sources])
        return np.asarray(np.exp((best - mismatch) / MISMATCH_SCALE))

    def _asked(self, chosen: Indices, weights: Array, belief: Belief) -> tuple[Check, ...]:
        """What sightings that agree are held against: nodes, travel (less where they fit badly), and the weight of the rest.

        The travel is that of the best fitting of them, of as many as make the most of it.
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

    def _carried(self, broken_at: int, friends: tuple[Edge, ...], belief: Belief) -> bool:
        off = between(belief.poses_map_node[broken_at], placed_by(friends, broken_at, belief.poses_map_node))
        return bool(np.hypot(off[0], off[1]) > WHERE_IT_WAS * REHUNG_M or abs(off[2]) > WHERE_IT_WAS * REHUNG_RAD)

    def _rehung(self, broken_at: int, friends: tuple[Edge, ...], belief: Belief) -> Edge:
        """The edge into the node at which the chain broke, by way of the closures; it contradicts the odometry beside it."""
        poses = belief.poses_map_node
        middle = placed_by(friends, broken_at, poses)
        relative = RelativePose(between(poses[broken_at - 1], middle), np.diag([REHUNG_M, REHUNG_M, REHUNG_RAD]) ** 2)
        moved_m = float(np.hypot(*(middle - poses[broken_at])[:2]))
        return Edge.decided(
            broken_at - 1,
            broken_at,
            EdgeKind.REGISTRATION,
            relative,
            method=Method.LOOPS,
            search=Search.WHOLE_MAP,
            figures={"agreeing": float(len(friends))},
            carried_m=moved_m,
            key=self._new_key(),
            contradicts_odometry=True,
        )

    def _sources(self) -> Indices:
        return np.array([s.edge.source for s in self._waiting], dtype=np.int64)

    def _mismatch(self) -> Array:
        return np.array([s.mismatch for s in self._waiting])


def placed_by(sightings: Sequence[Edge], at: int, poses: Array) -> Array:
    """Pose (3,) on the map of a node, by the sighting that lies most amid the others."""
    placed = np.array([_placed(s, at, poses) for s in sightings])
    return np.asarray(placed[int(np.argmin(np.abs(placed[:, None, :2] - placed[None, :, :2]).sum(axis=(1, 2))))])


def _placed(sighting: Edge, at: int, poses: Array) -> Array:
    """Pose (3,) on the map of a node of the new piece of chain, as one sighting has it."""
    assert sighting.relative is not None
    seen = compose(poses[sighting.target], inverse(sighting.relative.delta))
    return compose(seen, between(poses[sighting.source], poses[at]))
