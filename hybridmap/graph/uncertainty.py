"""How uncertain every node is relative to one of them: covariance along the shortest path of the graph."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray
from scipy.sparse import csr_array
from scipy.sparse.csgraph import dijkstra

from hybridmap.errors import GraphError
from hybridmap.geometry import Array, adjoint, compose, inverse
from hybridmap.graph.pose_graph import PoseGraph

_MIN_WEIGHT = 1e-12  # csgraph takes an explicit zero for a missing edge


def relative_covariances(graph: PoseGraph, node: int) -> Array:
    """Covariance of every node relative to `node`, right perturbation in each node's own frame.

    Paths are shortest in the trace of the edges' position covariance; along a path the covariances of the edges, taken as
    independent, are carried to the end by adjoints (as `geometry.compose_relative` does for two).

    Args:
        graph: the measurements.
        node: the reference; its own covariance is zero.

    Returns:
        (N, 3, 3) m^2 and rad^2; infinite on the diagonal for a node that no path reaches.

    Raises:
        GraphError: `node` does not exist.
    """
    n = graph.n_nodes
    if not 0 <= node < n:
        raise GraphError(f"graph: node {node} does not exist, expected one of 0..{n - 1}")
    covariance: Array = np.asarray(np.linalg.inv(graph.information))
    parent, edge = _shortest_tree(graph, covariance[:, 0, 0] + covariance[:, 1, 1], node)
    child = np.flatnonzero(edge >= 0)
    delta, step = np.zeros((n, 3)), np.zeros((n, 3, 3))
    delta[child], step[child] = _away_from_parent(graph, covariance, child, edge[child])
    pose, above = delta, parent.copy()
    while np.any(above != node):
        pose, above = compose(pose[above], pose), above[above]
    carry = adjoint(pose)
    total, above = carry @ step @ carry.transpose(0, 2, 1), parent.copy()
    while np.any(above != node):
        total, above = total + total[above], above[above]
    back = adjoint(inverse(pose))
    out = back @ total @ back.transpose(0, 2, 1)
    unreached = edge < 0
    unreached[node] = False
    out[unreached] = np.diag(np.full(3, np.inf))
    return np.asarray(out)


def _shortest_tree(graph: PoseGraph, weight: Array, node: int) -> tuple[NDArray[np.int64], NDArray[np.int64]]:
    """Parent of each node (`node` for itself and for the unreached) and the edge to it (-1 for those)."""
    n = graph.n_nodes
    low = np.minimum(graph.sources, graph.targets)
    high = np.maximum(graph.sources, graph.targets)
    order = np.lexsort((weight, high, low))
    first = np.ones(len(order), dtype=bool)
    first[1:] = (low[order][1:] != low[order][:-1]) | (high[order][1:] != high[order][:-1])
    best = order[first]
    matrix = csr_array((np.maximum(weight[best], _MIN_WEIGHT), (low[best], high[best])), shape=(n, n))
    _, found = dijkstra(matrix, directed=False, indices=np.array([node]), return_predecessors=True)
    predecessor = found[0]
    reached = predecessor >= 0
    parent = np.where(reached, predecessor, node).astype(np.int64)
    edge = np.full(n, -1, dtype=np.int64)
    child = np.flatnonzero(reached)
    key = np.minimum(child, parent[child]) * n + np.maximum(child, parent[child])
    edge[child] = best[np.searchsorted(low[best] * n + high[best], key)]
    return parent, edge


def _away_from_parent(
    graph: PoseGraph, covariance: Array, child: NDArray[np.int64], edge: NDArray[np.int64]
) -> tuple[Array, Array]:
    """Pose and covariance of each child in its parent's frame; edges that lead the other way are turned round."""
    delta, cov = graph.deltas[edge].copy(), covariance[edge]
    turned = graph.sources[edge] == child
    carry = adjoint(delta[turned])
    cov[turned] = carry @ cov[turned] @ carry.transpose(0, 2, 1)
    delta[turned] = inverse(delta[turned])
    return delta, cov
