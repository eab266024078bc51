"""The order of the drive: nodes numbered so that each one hangs on an earlier one, and edges of motion told from loops.

Chains, growing solvers and the judges of loops need that order. `in_driving_order` is the one place that finds it, for
graph files and for graphs that a caller made. Its result does not depend on how the nodes were numbered, unless their
numbers are themselves a whole chain.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray
from scipy.sparse import csr_array
from scipy.sparse.csgraph import connected_components

from hybridmap.geometry import Array, between, log
from hybridmap.graph.edges import EdgeKind
from hybridmap.graph.pose_graph import PoseGraph

Indices = NDArray[np.int64]
Mask = NDArray[np.bool_]

_PRINTED = 1e-3  # m and rad: files print poses with six digits, so an edge that initial poses were composed of fits that well


@dataclass(frozen=True, slots=True)
class Arranged:
    """A graph in the order of the drive.

    Attributes:
        graph: the same edges, with the same `edge_ids`; nodes may have other numbers.
        nodes: (N,) node k of `graph` had the number `nodes[k]` before; None if the numbers are the same.
    """

    graph: PoseGraph
    nodes: Indices | None = None

    def given(self, poses: Array) -> Array:
        """Poses (N, 3) of the nodes of `graph`, in the order that the nodes had before."""
        if self.nodes is None:
            return poses
        out = np.empty_like(poses)
        out[self.nodes] = poses
        return out


def in_driving_order(graph: PoseGraph) -> Arranged:
    """Number the nodes in the order of the drive, and find the edges of motion if no edge is known to be one.

    The graph is not changed if every node but the first has an edge of motion to an earlier one, or if it is not connected.
    If no edge is one of motion, those between consecutive nodes are, provided that they join all of them. Otherwise the
    order is that of a walk along the edges (`_walk`), which prefers edges of motion, and edges that came first. If no edge
    was one of motion, the edges of the walk become odometry. There the walk prefers the edges that the initial poses were
    composed of, if these are a chain (`_composed`), and only they become odometry.

    Args:
        graph: a valid graph (`PoseGraph.validate`), whose edges came in about the order of the drive.
    """
    motion = graph.is_motion
    known = bool(motion.any())
    if _hangs_on_earlier(graph, motion if known else np.abs(graph.sources - graph.targets) == 1):
        return Arranged(graph if known else _with_motion(graph, np.abs(graph.sources - graph.targets) == 1))
    if not _connected(graph):
        return Arranged(graph)
    composed = None if known else _composed(graph)
    nodes, tree = _walk(graph, motion if composed is None else composed)
    arranged = _renumbered(graph, nodes)
    if known:
        return Arranged(arranged, nodes)
    return Arranged(_with_motion(arranged, _alongside(graph, tree) if composed is None else composed), nodes)


def _hangs_on_earlier(graph: PoseGraph, edges: Mask) -> bool:
    """Whether each node but the first has one of these edges to an earlier node."""
    hangs = np.zeros(graph.n_nodes, dtype=np.bool_)
    hangs[:1] = True
    hangs[np.maximum(graph.sources[edges], graph.targets[edges])] = True
    return bool(hangs.all())


def _with_motion(graph: PoseGraph, edges: Mask) -> PoseGraph:
    return replace(graph, kinds=np.where(edges, np.int8(EdgeKind.ODOMETRY), graph.kinds))


def _connected(graph: PoseGraph) -> bool:
    ends = (graph.sources, graph.targets)
    joined = csr_array((np.ones(graph.n_edges, dtype=np.int8), ends), shape=(graph.n_nodes, graph.n_nodes))
    count, _ = connected_components(joined, directed=False)
    return bool(count == 1)


def _composed(graph: PoseGraph) -> Mask | None:
    """Which edges (E,) the initial poses were composed of, if these are chains of half of the nodes or more; else None.

    Poses that were composed along a tree of edges, loops among them, branch; those of the odometry do not.
    """
    with np.errstate(over="ignore", invalid="ignore"):
        error = log(between(graph.deltas, between(graph.initial[graph.sources], graph.initial[graph.targets])))
        composed = np.asarray(np.abs(error).max(axis=1) <= _PRINTED)
    ends = np.unique(np.sort(np.stack([graph.sources, graph.targets], axis=1)[composed], axis=1), axis=0)
    branches = np.bincount(ends.ravel(), minlength=graph.n_nodes) > 2
    return composed if 2 * len(ends) >= graph.n_nodes - 1 and not branches.any() else None


def _alongside(graph: PoseGraph, edges: Indices) -> Mask:
    """Which edges (E,) join the same two nodes as one of `edges`."""
    key = np.minimum(graph.sources, graph.targets) * graph.n_nodes + np.maximum(graph.sources, graph.targets)
    return np.isin(key, key[edges])


def _renumbered(graph: PoseGraph, nodes: Indices) -> PoseGraph:
    """The graph with node `nodes[k]` as node k."""
    number = np.empty(graph.n_nodes, dtype=np.int64)
    number[nodes] = np.arange(graph.n_nodes)
    file = graph.file
    if file is not None:
        file = replace(file, vertices=file.vertices[nodes], held=None if file.held is None else int(number[file.held]))
    return replace(
        graph,
        initial=graph.initial[nodes],
        sources=number[graph.sources],
        targets=number[graph.targets],
        entered=None if graph.entered is None else np.maximum(number[graph.sources], number[graph.targets]),
        file=file,
    )


def _walk(graph: PoseGraph, preferred: Mask) -> tuple[Indices, Indices]:
    """Visit all nodes of a connected graph; returns the nodes in order, and the edge by which each one but the first came.

    The walk goes on from the node visited last that still has an edge to a new node, by the first such edge; edges that are
    not preferred count only where no visited node has a preferred one. It begins where preferred edges leave and none arrives,
    or else at the source of the first edge.
    """
    n, ends = graph.n_nodes, np.concatenate([graph.sources, graph.targets])
    edges = np.tile(np.arange(graph.n_edges), 2)
    by_node = np.lexsort((edges, ends))
    first = np.searchsorted(ends[by_node], np.arange(n + 1)).tolist()
    around, other = edges[by_node].tolist(), np.concatenate([graph.targets, graph.sources])[by_node].tolist()
    liked = preferred[edges[by_node]].tolist()
    visited, nodes, tree = [False] * n, list[int](), list[int]()
    start = _start(graph, preferred)
    stacks: tuple[list[tuple[int, int]], list[tuple[int, int]]] = ([], [(start, -1)])
    while stacks[0] or stacks[1]:
        node, edge = (stacks[0] or stacks[1]).pop()
        if visited[node]:
            continue
        visited[node] = True
        nodes.append(node)
        tree.append(edge)
        for k in range(first[node + 1] - 1, first[node] - 1, -1):  # the first edge ends on top
            if not visited[other[k]]:
                stacks[0 if liked[k] else 1].append((other[k], around[k]))
    return np.array(nodes, dtype=np.int64), np.array(tree[1:], dtype=np.int64)


def _start(graph: PoseGraph, preferred: Mask) -> int:
    """The node at which a walk begins."""
    leaving = np.flatnonzero(preferred & ~np.isin(graph.sources, graph.targets[preferred]))
    return int(graph.sources[leaving[0] if len(leaving) else 0]) if graph.n_edges else 0
