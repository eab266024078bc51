"""Whether frames show the same things, for the second opinion at the end of the drive."""

from __future__ import annotations

from collections.abc import Callable, Sequence

import numpy as np

from hybridmap.geometry import between, compose
from hybridmap.graph.edges import Edge, EdgeKind, Method, Status
from hybridmap.vision.base import Belief
from hybridmap.vision.relocalising import GlobalMatch, placed_by
from hybridmap.vision.rgbd.closing import SPAN_M, LoopCloser
from hybridmap.vision.second_opinion import is_about

UNPLACED_NODES = 8
"""The search for the carry goes back over so many nodes in a row that no features place; old nodes are older by so many."""


class FeatureWitness:
    """Compares the features of a node with the whole map; implements `vision.second_opinion.Witness`.

    Where a room looks the same from its other end, its surfaces fit there, and its features never do.
    """

    worse = 0.5
    span_m = SPAN_M
    reach_m = 0.0

    def __init__(self, closer: LoopCloser, new_key: Callable[[], int]) -> None:
        """Search with a closer; `new_key` returns the key of a new edge."""
        self._closer = closer
        self.new_key = new_key

    def misfit(self, edge: Edge) -> float:
        """1 for a loop by depth alone, else 0."""
        return float(edge.kind is EdgeKind.LOOP and edge.method is Method.DEPTH)

    def matches(self, node: int, since: int) -> list[GlobalMatch]:
        """Nodes well before `since` whose features fit those of a node, at any pose."""
        old = np.arange(max(min(node, since) - UNPLACED_NODES, 0), dtype=np.int64)
        return [GlobalMatch(edge) for edge in self._closer.anywhere(node, old) if edge.status is Status.PENDING]

    def carried_to(self, matches: Sequence[Edge], since: int, belief: Belief) -> range:
        """From the first node that features place by the matches back to the last one that they place where the map has it."""
        poses, found = belief.poses_map_node, min(match.source for match in matches)
        there = placed_by(matches, found, poses)
        first = found
        for node in range(found - 1, 0, -1):
            placed = np.array([placed_by([match.edge], node, poses) for match in self.matches(node, since)]).reshape(-1, 3)
            if is_about(placed, compose(there, between(poses[found], poses[node]))):
                first = node
            elif is_about(placed, poses[node]) or first - node > UNPLACED_NODES:
                return range(node + 1, first + 1)
        return range(1, first + 1)

    def corrected(self, edges: Sequence[Edge]) -> None:
        """Nodes near each other on the corrected map are compared anew."""
        self._closer.restart(edges)
