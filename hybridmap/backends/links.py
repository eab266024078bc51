"""The links of a graph in the order in which a sweep visits them, and one sweep.

A sweep visits every link once, in place: each moves its two ends towards each other. Links that share no node do not see
each other, so they may be visited at once; the order is chosen such that there are few such levels (`link_levels`), and
a sweep is exactly the loop over links in that order.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Self

import numpy as np
from numpy.typing import NDArray

from hybridmap.geometry import Array, wrap_angle
from hybridmap.graph.pose_graph import PoseGraph

Complex = NDArray[np.complex128]
Weigh = Callable[[slice, Complex, Array], Array]

_TURN = 2.0 * np.pi


@dataclass(frozen=True, slots=True)
class Planar:
    """Poses with complex positions, as the sweeps use them.

    Attributes:
        position: (N,) complex, x + iy in m.
        yaw: (N,) rad, not wrapped.
    """

    position: Complex
    yaw: Array

    @classmethod
    def of(cls, poses: Array) -> Self:
        """From (N, 3)."""
        return cls(poses[:, 0] + 1j * poses[:, 1], poses[:, 2].copy())

    def to_array(self) -> Array:
        """(N, 3), yaw wrapped."""
        return np.column_stack([self.position.real, self.position.imag, wrap_angle(self.yaw)])

    def largest_move(self, before: Planar) -> float:
        """Largest change of a coordinate since `before`, m or rad."""
        step = self.position - before.position
        return float(max(np.abs(step.real).max(), np.abs(step.imag).max(), np.abs(self.yaw - before.yaw).max()))


def link_levels(graph: PoseGraph) -> NDArray[np.int64]:
    """The level (E,) of each link: no two links of one level share a node.

    Levels 0 and 1 are the chain: the first link between nodes k and k + 1 is at level k mod 2. Every other link, in order
    of the log, takes the lowest level from 2 on that is free at both of its ends. A link's level never depends on later
    links, so that a graph that grows keeps its order.
    """
    low = np.minimum(graph.sources, graph.targets)
    levels = np.full(graph.n_edges, -1, dtype=np.int64)
    beside = np.flatnonzero(np.abs(graph.sources - graph.targets) == 1)
    _, first = np.unique(low[beside], return_index=True)
    levels[beside[first]] = low[beside[first]] % 2
    taken = [0b11] * graph.n_nodes  # a bit for each level that is in use at a node
    others = np.flatnonzero(levels < 0)
    found = []
    for source, target in zip(graph.sources[others].tolist(), graph.targets[others].tolist(), strict=True):
        used = taken[source] | taken[target]
        free = ~used & (used + 1)
        taken[source] |= free
        taken[target] |= free
        found.append(free.bit_length() - 1)
    levels[others] = found
    return levels


@dataclass(frozen=True, slots=True)
class Links:
    """Links in the order of a sweep: by level, within a level by age.

    Attributes:
        order: (E,) index of each in the graph.
        sources, targets: (E,) nodes.
        steps: (E,) complex, where the target is in the frame of the source, m.
        turns: (E,) rad.
        levels: begin and end of each level.
    """

    order: NDArray[np.int64]
    sources: NDArray[np.int64]
    targets: NDArray[np.int64]
    steps: Complex
    turns: Array
    levels: tuple[slice, ...]

    @classmethod
    def of(cls, graph: PoseGraph) -> Self:
        """Sort the links of a graph."""
        level = link_levels(graph)
        order = np.lexsort((graph.edge_ids, level))
        ends = np.flatnonzero(np.diff(level[order], append=-1)) + 1
        deltas = graph.deltas[order]
        return cls(
            order,
            graph.sources[order],
            graph.targets[order],
            deltas[:, 0] + 1j * deltas[:, 1],
            deltas[:, 2],
            tuple(slice(int(a), int(b)) for a, b in zip([0, *ends[:-1]], ends, strict=True)),
        )

    def sweep(self, poses: Planar, theta: float, weigh: Weigh | None = None) -> Planar:
        """Visit every link once: both ends move towards each other by theta times the link's error.

        Args:
            poses: before.
            theta: share of the error that each end takes.
            weigh: from a level and the errors (complex m, rad) of its links at their visit to factors on theta.
        """
        now = Planar(poses.position.copy(), poses.yaw.copy())
        for level in self.levels:
            source, target = self.sources[level], self.targets[level]
            apart, turn = self.errors(now, level)
            rate = theta if weigh is None else theta * weigh(level, apart, turn)
            apart, turn = rate * apart, rate * turn
            now.position[source] += apart
            now.position[target] -= apart
            now.yaw[source] += turn
            now.yaw[target] -= turn
        return now

    def errors(self, poses: Planar, which: slice) -> tuple[Complex, Array]:
        """How far targets are from where their links have them: complex m in the world frame, and rad within +-pi."""
        source, target = self.sources[which], self.targets[which]
        heading = poses.yaw[source]
        turn = poses.yaw[target] - heading - self.turns[which]
        turn -= _TURN * np.rint(turn * (1.0 / _TURN))
        step = (np.cos(heading) + 1j * np.sin(heading)) * self.steps[which]
        return poses.position[target] - poses.position[source] - step, turn
