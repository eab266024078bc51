"""Where a session of a camera lies among earlier ones, and the loops between them."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np

from hybridmap.graph.edges import Edge
from hybridmap.vision.base import Belief
from hybridmap.vision.relocalising import GlobalMatch, Relocaliser, Whereabouts
from hybridmap.vision.rgbd.closing import SPAN_M, LoopCloser


class FeatureMeeting:
    """Compares the nodes of a session with all nodes of earlier ones until it is found, then with those near on the map."""

    def __init__(self, closer: LoopCloser, new_key: Callable[[], int], rounds: int) -> None:
        """Search with a closer; at the end, nodes near each other are compared in so many rounds."""
        self._closer = closer
        self._new_key = new_key
        self._most_rounds = rounds
        self.arrive(0)

    def arrive(self, first: int) -> None:
        """Look for the place of the nodes from `first` on; those before it are the map."""
        self._first, self._found, self._rounds_left = first, False, self._most_rounds
        self._relocaliser = Relocaliser(Whereabouts(0), self._new_key, SPAN_M)
        self._relocaliser.arrived(first)

    def meet(self, node: int, belief: Belief) -> list[Edge]:
        """Look for loops of a node to the nodes before the session; see `MeetingFrontEnd.meet`."""
        if self._found:
            return self._closer.beside(node, self._first, belief)
        seen = self._closer.anywhere(node, np.arange(self._first, dtype=np.int64))
        settlement = self._relocaliser.settle([GlobalMatch(edge) for edge in seen], belief)
        self._found = bool(settlement.accepted)
        for edge in settlement.accepted:
            self._closer.support.join(edge.source, edge.target)
        return settlement.proposals

    def meet_again(self, belief: Belief) -> list[Edge]:
        """Compare nodes near each other on the map, and decide what is pending; see `MeetingFrontEnd.meet_again`."""
        if not self._found:
            return self._relocaliser.dismiss()
        out: list[Edge] = []
        nodes = range(self._first, len(belief.travel_m)) if self._rounds_left > 0 else range(0)
        self._rounds_left -= 1
        for node in nodes:
            out += self._closer.beside(node, self._first, belief)
        return [*out, *self._closer.support.give_up(before=len(belief.travel_m))]
