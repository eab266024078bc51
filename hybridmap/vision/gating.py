"""Gating: where on the map a robot may be by its uncertainty, and which nodes are therefore compared."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import astuple, dataclass
from functools import cache

import numpy as np
from numpy.typing import NDArray

from hybridmap.geometry import Array, wrap_angle

Indices = NDArray[np.int64]
MIN_AGE_S = 10.0
"""A node that is younger than this is no revisit, s: the robot has not left its place."""


@dataclass(frozen=True, slots=True)
class Gate:
    """Which older nodes a new node was compared with.

    Attributes:
        radius_m, heading_deg: largest difference of position and heading from the new node; the largest radius, if each older
            node has its own.
        older: number of nodes that were old enough to be compared.
        inside: number of those that lay within the radius and heading.
        whole_map: whether nodes outside were compared too, because the robot was lost.
    """

    radius_m: float
    heading_deg: float
    older: int
    inside: int
    whole_map: bool = False

    def to_array(self) -> Array:
        """The five attributes in their order as an array (5,), as a map file stores them."""
        return np.array(astuple(self), dtype=np.float64)

    @classmethod
    def of_array(cls, kept: Array) -> Gate:
        """Make a gate from the array (5,) that `to_array` returned."""
        radius_m, heading_deg, older, inside, whole_map = kept.tolist()
        return cls(radius_m, heading_deg, int(older), int(inside), bool(whole_map))


def nodes_within(poses: Array, node: int, radius_m: float | Array, turn_rad: float, before: int | None = None) -> Indices:
    """Find earlier nodes near a node and of nearly the same heading, in time linear in the number of nodes.

    Args:
        poses: (N, 3) of all nodes, m and rad.
        node: number of the node whose neighbours are sought.
        radius_m: largest distance, m; one for all, or (before,) one for each earlier node.
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
    """The compiled loop; compiled on first use, as few commands need it."""
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
