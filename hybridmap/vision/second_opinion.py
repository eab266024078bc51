"""At the end of the drive: was the robot carried to a place that looks like the one where the wheels have it?

A room may look nearly the same from its other end. A robot that was carried there fits the map where the wheels have it: its
chain does not break, and its loops agree. But they fit worse than those from before, and the other place fits better.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from typing import Protocol, runtime_checkable

import numpy as np
from numpy.typing import NDArray

from hybridmap.geometry import Array, between
from hybridmap.graph.contradictions import contradictions
from hybridmap.graph.edges import Edge, EdgeKind, Lack, Status
from hybridmap.vision.base import Belief, FrontEnd
from hybridmap.vision.relocalising import SUPPORT, GlobalMatch, Relocaliser, Whereabouts, placed_by

ASKED = 12
"""Most nodes from which the whole map is searched: enough for `SUPPORT` of them where some see too little."""
DISPUTED, FAR_M = 0.1, 5.0
"""Share of the loops without weight from which on loops and chain dispute, and a distance, m: a carry over less explains the
dispute by itself, and where it was the second look finds."""
MOST = 4
"""Most searches of one drive; each of them may find a carry."""


class Witness(Protocol):
    """What a front-end knows of how well its views fit."""

    @property
    def worse(self) -> float:
        """Loops that fit worse than others by so much, on average, make a search worth its time."""

    @property
    def span_m(self) -> float:
        """Travel that agreeing matches must cover, m."""

    @property
    def reach_m(self) -> float:
        """Travel from a node within which the views of others take part in its loops, m."""

    def new_key(self) -> int:
        """A key for a new edge."""

    def misfit(self, edge: Edge) -> float:
        """How badly the views of an accepted loop or registration fit: 0 is perfect, NaN if it was not measured by views."""

    def matches(self, node: int, since: int) -> list[GlobalMatch]:
        """Pending matches of a node with any node well before the node `since`, whatever the map says of their poses."""

    def carried_to(self, matches: Sequence[Edge], since: int, belief: Belief) -> range:
        """Nodes of which one is the first after the carry, by matches that agree; empty if the odometry only drifted."""

    def corrected(self, edges: Sequence[Edge]) -> None:
        """Note that the map was corrected by new and changed edges: loops are to be looked for anew."""


@runtime_checkable
class LocalisingFrontEnd(FrontEnd, Protocol):
    """A front-end that can tell where on the whole map its views fit.

    Attributes:
        witness: what it knows of that; None if the robot is taken never to be lost.
    """

    witness: Witness | None


class SecondOpinion:
    """Compares the place that the loops gave the robot with the rest of the map, where they fit worse than those before."""

    def __init__(self, witness: Witness) -> None:
        """Ask a witness."""
        self._witness = witness
        self._left = MOST

    def ask(self, edges: Sequence[Edge], rejected: Sequence[int], belief: Belief) -> list[Edge]:
        """Search the whole map where loops fit worse than those before; if the robot was carried there, correct the map.

        Args:
            edges: of the map.
            rejected: numbers of the loops to which the back-end gives no weight; if they are many, a near place is not taken.
            belief: the map.

        Returns:
            The matches with the better place, the loops and registrations that they contradict, now rejected, and an edge by
            way of the matches across the carry; empty if the robot was not carried.
        """
        accepted = [e for e in edges if e.status is Status.ACCEPTED and e.key >= 0 and e.kidnapped_m is None]
        loops = [edge for edge in accepted if edge.kind is EdgeKind.LOOP and np.isfinite(self._witness.misfit(edge))]
        steps = [edge for edge in accepted if edge.kind is EdgeKind.REGISTRATION]
        since = worse_since(loops, steps, self._witness) if self._left > 0 else None
        if since is None:
            return []
        self._left -= 1
        relocaliser = Relocaliser(Whereabouts(0), self._witness.new_key, self._witness.span_m)
        matches = relocaliser.settle(self._better(loops, since, belief), belief).accepted
        places = self._witness.carried_to(matches, since, belief) if matches else range(0)
        if not places:
            return []
        sigmas = contradictions(edges).sigmas
        carried_to = max(places, key=lambda node: sigmas.get(node, 0.0))
        wrong = _contradicted(accepted, carried_to, belief.travel_m, self._witness.reach_m)
        across = relocaliser.reattach(carried_to, matches, belief)
        near = any(edge.kidnapped_m is not None and edge.kidnapped_m < FAR_M for edge in across)
        if near and len(rejected) > DISPUTED * len(loops):
            return []
        corrected = [*wrong, *matches, *across]
        self._witness.corrected(corrected)
        return corrected

    def _better(self, loops: Sequence[Edge], since: int, belief: Belief) -> list[GlobalMatch]:
        """Matches elsewhere on the map, of nodes with loops across `since` that fit clearly worse where the map has them.

        There are none if as many of these nodes fit clearly better where the map has them.
        """
        nodes = np.unique([loop.source for loop in loops if loop.source >= since > loop.target])
        asked = nodes[np.unique(np.linspace(0, len(nodes) - 1, ASKED).round().astype(np.int64))]
        out: list[GlobalMatch] = []
        better, clearly, dissent = 0, 0.5 * self._witness.worse, 0
        for node in asked.tolist():
            found = self._witness.matches(node, since)
            is_here = [
                is_about(placed_by([match.edge], node, belief.poses_map_node), belief.poses_map_node[node]) for match in found
            ]
            there = [match for match, yes in zip(found, is_here, strict=True) if not yes]
            here = [match.mismatch for match, yes in zip(found, is_here, strict=True) if yes]
            here += [self._witness.misfit(loop) for loop in loops if loop.source == node and loop.target < since]
            best_there, best_here = min((match.mismatch for match in there), default=np.inf), min(here)
            dissent += best_here + clearly <= best_there
            if best_there + clearly <= best_here:
                better, out = better + 1, out + there
        return out if better > dissent else []


def _contradicted(edges: Sequence[Edge], carried_to: int, travel_m: Array, reach_m: float) -> list[Edge]:
    """Take back the edges across a carry, and the loops that were measured by views from both sides of it."""
    out = []
    for edge in edges:
        across = min(edge.source, edge.target) < carried_to <= max(edge.source, edge.target)
        blurred = min(abs(travel_m[end] - travel_m[carried_to]) for end in (edge.source, edge.target)) < reach_m
        if across or (blurred and edge.kind is EdgeKind.LOOP):
            out.append(replace(edge.settled(lack=Lack.KIDNAPPED), contradicts_odometry=False))
    return out


def worse_since(loops: Sequence[Edge], registrations: Sequence[Edge], witness: Witness) -> int | None:
    """Find the node across which the loops fit worst in comparison to all others.

    Args:
        loops: accepted ones, from newer nodes to older ones.
        registrations: accepted ones; the loops are compared with these if there are less than `SUPPORT` other loops.
        witness: tells how badly an edge fits.

    Returns:
        The node: newer nodes fit older ones worse than any fit each other, by more than `Witness.worse` on average. None if
        there is no such node, with loops from at least `SUPPORT` nodes across it.
    """
    seen = [(loop.source, loop.target, witness.misfit(loop)) for loop in loops]
    sources, targets, misfits = np.array([one for one in seen if np.isfinite(one[2])]).reshape(-1, 3).T
    steps = np.array([witness.misfit(edge) for edge in registrations])
    usual = float(steps[np.isfinite(steps)].mean()) if np.isfinite(steps).any() else 0.0
    worst, since = witness.worse, None
    for node in np.unique(sources).astype(np.int64).tolist():
        across: NDArray[np.bool_] = (sources >= node) & (targets < node)
        if len(np.unique(sources[across])) < SUPPORT:
            continue
        others = float(misfits[~across].mean()) if np.count_nonzero(~across) >= SUPPORT else usual
        worse = float(misfits[across].mean()) - others
        if worse > worst:
            worst, since = worse, node
    return since


SAME_M, SAME_RAD = 2.5, float(np.deg2rad(20.0))
"""Poses nearer than this are one place, m and rad: rooms that look alike are farther apart, or turned."""


def is_about(placed: Array, pose: Array) -> bool:
    """Whether any of the poses (n, 3) is about the same place as a pose (3,)."""
    off = between(pose, placed)
    near = np.hypot(off[..., 0], off[..., 1]) <= SAME_M
    return bool(np.any(near & (np.abs(off[..., 2]) <= SAME_RAD)))
