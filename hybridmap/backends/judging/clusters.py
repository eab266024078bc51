"""Rejected loops that agree with each other: what a false one seldom does, and a true one that was dropped always does."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray
from scipy.sparse import coo_array
from scipy.sparse.csgraph import connected_components
from scipy.spatial import cKDTree

from hybridmap.geometry import Array, between, compose, inverse, log
from hybridmap.graph.pose_graph import PoseGraph

NEIGHBOURS = 10
"""Loops are neighbours where both of their ends lie within so many nodes of each other."""

_LEAST = 3  # loops of a cluster
_BOTH = 4.0  # of the gate: two loops and the way between them are uncertain


def rejected_clusters(graph: PoseGraph, poses: Array, rejected: tuple[int, ...], gate: float) -> tuple[tuple[int, ...], ...]:
    """Groups of rejected loops that say the same, the largest first; `edge_ids`.

    Two neighbouring loops say the same where one, carried along the map to the ends of the other, agrees with it.

    Args:
        graph: the graph.
        poses: (N, 3) the solution.
        rejected: `edge_ids` of the loops that it holds for false.
        gate: squared Mahalanobis residual up to which a measurement agrees.
    """
    edges = np.flatnonzero(np.isin(graph.edge_ids, rejected))
    pairs = neighbouring_pairs(graph, edges)
    same = pairs[_agree(graph, poses, edges, pairs) <= _BOTH * gate]
    matrix = coo_array((np.ones(len(same)), (same[:, 0], same[:, 1])), shape=(len(edges), len(edges)))
    count, label = connected_components(matrix, directed=False) if len(edges) else (0, np.zeros(0, dtype=np.int64))
    sizes = np.bincount(label, minlength=count)
    chosen = [group for group in np.argsort(-sizes, kind="stable").tolist() if sizes[group] >= _LEAST]
    return tuple(tuple(graph.edge_ids[edges[label == group]].tolist()) for group in chosen)


def neighbouring_pairs(graph: PoseGraph, edges: NDArray[np.int64]) -> NDArray[np.int64]:
    """Pairs (P, 2) of positions in `edges` whose loops are neighbours."""
    if len(edges) < 2:
        return np.zeros((0, 2), dtype=np.int64)
    low, high = _ends(graph, edges)
    tree = cKDTree(np.column_stack([low, high]))
    pairs = tree.query_pairs(NEIGHBOURS, p=np.inf, output_type="ndarray")
    return np.asarray(pairs[np.lexsort((pairs[:, 1], pairs[:, 0]))], dtype=np.int64)


def _ends(graph: PoseGraph, edges: NDArray[np.int64]) -> tuple[NDArray[np.int64], NDArray[np.int64]]:
    """Older and newer node of each."""
    return np.minimum(graph.sources[edges], graph.targets[edges]), np.maximum(graph.sources[edges], graph.targets[edges])


def _agree(graph: PoseGraph, poses: Array, edges: NDArray[np.int64], pairs: NDArray[np.int64]) -> Array:
    """Squared Mahalanobis distance (P,) of the second loop from the first, carried along the map."""
    low, high = _ends(graph, edges)
    turned = graph.sources[edges] != low
    deltas = graph.deltas[edges]
    deltas = np.where(turned[:, None], inverse(deltas), deltas)  # the newer node seen from the older one
    first, second = pairs[:, 0], pairs[:, 1]
    to_first = between(poses[low[second]], poses[low[first]])
    to_second = between(poses[high[first]], poses[high[second]])
    carried = compose(compose(to_first, deltas[first]), to_second)
    r = log(compose(inverse(deltas[second]), carried))
    return np.asarray(np.einsum("ei,eij,ej->e", r, graph.information[edges[second]], r))
