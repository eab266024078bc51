"""Whether the robot still knows where on its map it is: it does not once it has been carried away."""

from __future__ import annotations

from enum import Enum


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
