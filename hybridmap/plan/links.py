"""The experience graph as a robot can drive it: nodes, and the straight ways between them that have room for it."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from enum import StrEnum
from functools import cached_property

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import cKDTree

from hybridmap.geometry import Array
from hybridmap.graph.gaps import Kidnapping, kidnapping_edges
from hybridmap.graph.pose_graph import PoseGraph
from hybridmap.plan.free_space import FreeSpace
from hybridmap.trajectory import NS_PER_S

SIGHT_M = 2.0
"""Nodes so near each other are linked if the robot can drive straight between them, whether or not an edge joins them."""
_USUAL_SPEED_M_S = 0.5
"""Where the drive does not tell how fast the robot is."""


class Cost(StrEnum):
    """What routes are the least of."""

    LENGTH = "length"
    TIME = "time"


@dataclass(frozen=True)
class Links:
    """Ways between nodes, which can be driven in both directions.

    Attributes:
        n_nodes: number N of nodes.
        ends: (L, 2) nodes that each link joins, the lower first; no pair twice.
        costs: (L,) of each link, positive: m, or s.
    """

    n_nodes: int
    ends: NDArray[np.int64]
    costs: Array

    @cached_property
    def around(self) -> list[list[tuple[int, float, int]]]:
        """For each node its neighbours: (node, cost of the link, number of the link)."""
        found: list[list[tuple[int, float, int]]] = [[] for _ in range(self.n_nodes)]
        for number, ((a, b), cost) in enumerate(zip(self.ends.tolist(), self.costs.tolist(), strict=True)):
            found[a].append((b, cost, number))
            found[b].append((a, cost, number))
        return found


def links_of(
    graph: PoseGraph,
    poses: Array,
    stamps_ns: NDArray[np.int64],
    space: FreeSpace,
    *,
    kidnapped: Sequence[Kidnapping] = (),
    cost: Cost = Cost.LENGTH,
) -> Links:
    """The links of a graph: its edges, and the lines of sight between near nodes, where the free space has room.

    By time, a link between consecutive nodes costs what it took to drive, and any other what it takes at the median speed.

    Args:
        graph: the accepted edges.
        poses: (N, 3) of the nodes in `map`, m and rad.
        stamps_ns: (N,) of the nodes.
        space: where the robot can be.
        kidnapped: stretches that nobody drove.
        cost: length or time.
    """
    edges = graph.with_edges(~kidnapping_edges(graph, kidnapped))
    near = cKDTree(poses[:, :2]).query_pairs(SIGHT_M, output_type="ndarray").reshape(-1, 2)
    ends = np.concatenate([np.stack([edges.sources, edges.targets], axis=1), near.astype(np.int64)])
    ends = np.unique(np.sort(ends, axis=1), axis=0)
    ends = ends[space.sees(poses[ends[:, 0], :2], poses[ends[:, 1], :2])]
    off = poses[ends[:, 1], :2] - poses[ends[:, 0], :2]
    lengths = np.maximum(np.hypot(off[:, 0], off[:, 1]), 1e-6)
    if cost is Cost.LENGTH:
        return Links(len(poses), ends, lengths)
    carried = {(one.before, one.after) for one in kidnapped}
    took_s = (stamps_ns[ends[:, 1]] - stamps_ns[ends[:, 0]]) / NS_PER_S
    drove = (ends[:, 1] == ends[:, 0] + 1) & (took_s > 0.0)
    drove &= np.array([tuple(pair) not in carried for pair in ends.tolist()], dtype=np.bool_)
    speed_m_s = float(np.median(lengths[drove] / took_s[drove])) if drove.any() else _USUAL_SPEED_M_S
    return Links(len(poses), ends, np.where(drove, took_s, lengths / max(speed_m_s, 1e-3)))
