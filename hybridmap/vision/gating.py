"""Where in the map a robot may be, which nodes are worth comparing, and whether the robot still knows where it is."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import astuple, dataclass
from enum import Enum
from functools import cache

import numpy as np
from numpy.typing import NDArray

from hybridmap.geometry import Array, wrap_angle

Indices = NDArray[np.int64]


@dataclass(frozen=True, slots=True)
class Gate:
    """Which older nodes a new one was compared with.

    Attributes:
        radius_m, heading_deg: its widths.
        older: how many nodes were old enough.
        inside: how many of those lay in it.
        whole_map: the others were searched as well, because the robot was not sure where it was.
    """

    radius_m: float
    heading_deg: float
    older: int
    inside: int
    whole_map: bool = False

    def to_array(self) -> Array:
        """(5,) as a map file keeps it."""
        return np.array(astuple(self), dtype=np.float64)

    @classmethod
    def of_array(cls, kept: Array) -> Gate:
        """The gate that `to_array` gave."""
        radius_m, heading_deg, older, inside, whole_map = kept.tolist()
        return cls(radius_m, heading_deg, int(older), int(inside), bool(whole_map))


def nodes_within(poses: Array, node: int, radius_m: float | Array, turn_rad: float, before: int | None = None) -> Indices:
    """Nodes before one of them that lie near it and look nearly the same way.

    Every frame asks for it and looks at every node: the one loop over them is compiled.

    Args:
        poses: (N, 3) of all nodes, m and rad.
        node: the one in question.
        radius_m: largest distance, m; one for all, or (before,) one for each.
        turn_rad: largest difference of the headings, rad.
        before: only nodes of lower numbers count; default: `node`.

    Returns:
        (n,) node numbers, ascending.
    """
    old = np.ascontiguousarray(poses[: node if before is None else before], dtype=np.float64)
    x, y, yaw = (float(number) for number in poses[node])
    found = np.empty(len(old), dtype=np.int64)
    count = _scan()(old, x, y, np.atleast_1d(np.asarray(radius_m, dtype=np.float64)), found)
    near = found[:count]
    return near[np.abs(wrap_angle(old[near, 2] - yaw)) <= turn_rad]


@cache
def _scan() -> Callable[[Array, float, float, Array, Indices], int]:
    """Writes the numbers of the nodes that lie near a point; compiled when it is first asked for, as few commands do."""
    from hybridmap.compiled import compiled

    return compiled("int64(float64[:, ::1], float64, float64, float64[::1], int64[::1])")(_near)


def _near(poses: Array, x: float, y: float, radius_m: Array, found: Indices) -> int:
    count = 0
    for node in range(len(poses)):
        across, along = poses[node, 0] - x, poses[node, 1] - y
        radius = radius_m[node] if len(radius_m) > 1 else radius_m[0]
        if across * across + along * along <= radius * radius:
            found[count] = node
            count += 1
    return count


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
