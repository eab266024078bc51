"""What hangs together: the connected part of a graph, and poses along its chain."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from numpy.typing import NDArray
from scipy.sparse import csr_array
from scipy.sparse.csgraph import connected_components

from hybridmap.errors import GraphError
from hybridmap.geometry import Array, compose, inverse
from hybridmap.graph.edges import EdgeKind
from hybridmap.graph.pose_graph import PoseGraph

_TRUST = np.zeros(len(EdgeKind), dtype=np.int64)  # of a kind of edge, when a new node is placed
_TRUST[EdgeKind.LOOP], _TRUST[EdgeKind.MANUAL], _TRUST[EdgeKind.ODOMETRY], _TRUST[EdgeKind.REGISTRATION] = 0, 0, 1, 2


def require_connected(graph: PoseGraph) -> None:
    """Refuse a graph in which some node cannot be placed relative to node 0.

    Raises:
        GraphError: names the first such node.
    """
    ones = np.ones(graph.n_edges, dtype=np.int8)
    n = graph.n_nodes
    matrix = csr_array((ones, (graph.sources, graph.targets)), shape=(n, n))
    _, label = connected_components(matrix, directed=False)
    apart = np.flatnonzero(label != label[0])
    if len(apart):
        first, node = graph.node_name(0), graph.node_name(int(apart[0]))
        raise GraphError(f"{graph.where}: {node} is not connected to {first} ({len(apart)} of {n} nodes are not)")


def extend(graph: PoseGraph, placed: Array) -> Array:
    """Place the nodes beyond `placed` (M, 3) by the best edge that joins each to an earlier one; (N, 3).

    Registration goes before odometry before loops; of equal kinds the nearest neighbour in order, then the newest edge.

    Raises:
        GraphError: a node has no edge to an earlier one.
    """
    done, n = len(placed), graph.n_nodes
    poses = np.concatenate([placed, np.zeros((n - done, 3))])
    if done == n:
        return poses
    later, earlier = np.maximum(graph.sources, graph.targets), np.minimum(graph.sources, graph.targets)
    candidates = np.flatnonzero(later >= done)
    rank = _TRUST[graph.kinds[candidates]]
    order = np.lexsort((candidates, earlier[candidates], rank))
    best = dict(zip(later[candidates][order].tolist(), candidates[order].tolist(), strict=True))  # the last one wins
    for node in range(done, n):
        if node not in best:
            raise GraphError(f"{graph.where}: {graph.node_name(node)} is not connected to an earlier node")
        edge = best[node]
        if graph.targets[edge] == node:
            poses[node] = compose(poses[graph.sources[edge]], graph.deltas[edge])
        else:
            poses[node] = compose(poses[graph.targets[edge]], inverse(graph.deltas[edge]))
    return poses


def own_odometry(graph: PoseGraph) -> NDArray[np.int64]:
    """Indices of the odometry edges from a node to the next."""
    return np.flatnonzero((graph.kinds == EdgeKind.ODOMETRY) & (graph.targets == graph.sources + 1))


def chain(graph: PoseGraph) -> PoseGraph:
    """The graph with `initial` replaced by the chain of its edges from node 0's pose on."""
    return replace(graph, initial=extend(graph, graph.initial[:1]))
