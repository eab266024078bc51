"""Clusters of rejected loops that agree with each other. True loops always form them, false ones seldom."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray
from scipy.sparse import coo_array
from scipy.sparse.csgraph import connected_components, dijkstra
from scipy.spatial import cKDTree

from hybridmap.backends.objective import parts
from hybridmap.geometry import Array, RelativePose
from hybridmap.graph.agreement import Loops, ring
from hybridmap.graph.paths import chain_of
from hybridmap.graph.pose_graph import PoseGraph

NEIGHBOURS = 10
"""Loops are neighbours where both of their ends lie within so many nodes of each other."""

_LEAST = 3  # loops of a cluster


def rejected_clusters(graph: PoseGraph, poses: Array, rejected: tuple[int, ...], gate: float) -> tuple[tuple[int, ...], ...]:
    """Groups of three or more rejected loops in which neighbours agree: tuples of edge ids, the largest group first.

    Args:
        graph: the graph.
        poses: (N, 3) poses of the solution, which carry one loop along the chain to the next; m and rad.
        rejected: edge ids of the loops that the solution rejects.
        gate: squared Mahalanobis distance up to which two loops agree.
    """
    edges = np.flatnonzero(np.isin(graph.edge_ids, rejected))
    pairs, loops = neighbouring_pairs(graph, edges), loops_of(graph, edges)
    same = pairs[ring(loops[pairs[:, 0]], loops[pairs[:, 1]], chain_of(graph, poses).ways).distance <= gate]
    matrix = coo_array((np.ones(len(same)), (same[:, 0], same[:, 1])), shape=(len(edges), len(edges)))
    count, label = connected_components(matrix, directed=False) if len(edges) else (0, np.zeros(0, dtype=np.int64))
    sizes = np.bincount(label, minlength=count)
    chosen = [group for group in np.argsort(-sizes, kind="stable").tolist() if sizes[group] >= _LEAST]
    return tuple(tuple(graph.edge_ids[edges[label == group]].tolist()) for group in chosen)


def lone_loops(graph: PoseGraph) -> NDArray[np.int64]:
    """Indices of the loops of a graph that have no neighbour and without which the graph would not fall into parts."""
    loops = np.flatnonzero(graph.is_loop)
    lone = np.delete(loops, np.unique(neighbouring_pairs(graph, loops)))
    part = parts(graph, tuple(graph.edge_ids[lone].tolist()))
    return np.asarray(lone[part[graph.sources[lone]] == part[graph.targets[lone]]])


def bypassed(graph: PoseGraph, loops: NDArray[np.int64]) -> NDArray[np.bool_]:
    """Which (L,) of some loops other loops speak for or against: not only dead reckoning says where their ends are.

    The other edges join the ends of such a loop by a way that is at most half as long as that of motion alone.
    """
    if not len(loops):
        return np.zeros(0, dtype=bool)
    rest = graph.with_edges(np.setdiff1d(np.arange(graph.n_edges), loops))
    first, ends = np.unique(graph.sources[loops], return_inverse=True)
    ways = [_lengths(one, first)[ends, graph.targets[loops]] for one in (rest, rest.with_edges(rest.is_motion))]
    return np.asarray(np.isfinite(ways[0]) & (ways[0] <= 0.5 * ways[1]))


def _lengths(graph: PoseGraph, nodes: NDArray[np.int64]) -> Array:
    """(n, N) length of the shortest way from some nodes (n,) to each node along the edges, m; infinite where there is none."""
    length = np.hypot(*graph.deltas[:, :2].T) + 1e-9  # an edge of no length is one all the same
    ends = np.sort(np.stack([graph.sources, graph.targets]), axis=0)
    order = np.lexsort((length, *ends))
    ends, length = ends[:, order], length[order]
    shortest = np.any(np.diff(ends, axis=1, prepend=-1) != 0, axis=0)
    matrix = coo_array((length[shortest], tuple(ends[:, shortest])), shape=(graph.n_nodes, graph.n_nodes))
    return np.asarray(dijkstra(matrix.tocsr(), directed=False, indices=nodes))


def loops_of(graph: PoseGraph, edges: NDArray[np.int64]) -> Loops:
    """The edges of a graph with indices `edges` (L,), as loops with covariance, in this order.

    Each is turned to lead from its older to its newer node. Whether they are loops is not checked.
    """
    covariance: Array = np.asarray(np.linalg.inv(graph.information[edges]))
    return Loops.of(graph.sources[edges], graph.targets[edges], RelativePose(graph.deltas[edges], covariance))


def neighbouring_pairs(graph: PoseGraph, edges: NDArray[np.int64]) -> NDArray[np.int64]:
    """Pairs (P, 2) of loops that are neighbours: both ends of one are few nodes from those of the other.

    The result holds positions in `edges` (L,), which are indices of loops among the graph's edges.
    """
    if len(edges) < 2:
        return np.zeros((0, 2), dtype=np.int64)
    ends = np.sort(np.column_stack([graph.sources[edges], graph.targets[edges]]), axis=1)
    pairs = cKDTree(ends).query_pairs(NEIGHBOURS, p=np.inf, output_type="ndarray")
    return np.asarray(pairs[np.lexsort((pairs[:, 1], pairs[:, 0]))], dtype=np.int64)
