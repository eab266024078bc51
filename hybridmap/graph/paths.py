"""Paths through a graph: connectivity, poses along the chain, and covariances along chain and shortest paths."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from functools import cache

import numpy as np
from numpy.typing import NDArray
from scipy.sparse import csr_array
from scipy.sparse.csgraph import connected_components, dijkstra

from hybridmap.config.mapping import EdgesConfig
from hybridmap.errors import GraphError
from hybridmap.geometry import Array, RelativePose, adjoint, between, compose, inverse
from hybridmap.graph.edges import EdgeKind
from hybridmap.graph.pose_graph import PoseGraph


def odometry_covariance(config: EdgesConfig, travel_m: float, turn_rad: float) -> Array:
    """Covariance (3, 3) of a stretch of dead reckoning, in the frame of its end (m^2, rad^2).

    Both standard deviations grow with the root of the way, as a random walk does; a heading that wanders along a
    straight way of length s moves the end sideways by s / sqrt(3) times its own deviation, with correlation -sqrt(3)/2
    as seen from the end.

    Args:
        config: growth rates and floors.
        travel_m: path length of the stretch.
        turn_rad: absolute angle turned on it.
    """
    position = config.translation_floor_m**2 + config.translation_per_sqrt_m**2 * travel_m
    walk = np.deg2rad(config.rotation_deg_per_sqrt_m) ** 2 * travel_m
    heading = np.deg2rad(config.rotation_floor_deg) ** 2 + walk + config.rotation_per_turn**2 * turn_rad
    sideways = position + walk * travel_m**2 / 3.0
    cross = -walk * travel_m / 2.0
    return np.array([[position, 0.0, 0.0], [0.0, sideways, cross], [0.0, cross, heading]])


_MIN_WEIGHT = 1e-12  # csgraph takes an explicit zero for a missing edge


@dataclass(frozen=True, slots=True)
class _Links:
    """Pairs of nodes that edges join, the lower number first.

    Attributes:
        low, high: (L,) nodes.
        delta: (L, 3) pose of the high one in the frame of the low one.
        covariance: (L, 3, 3) of that, in the frame of the high one.
    """

    low: NDArray[np.int64]
    high: NDArray[np.int64]
    delta: Array
    covariance: Array


@dataclass(frozen=True, slots=True)
class Chain:
    """The poses of consecutive nodes, with their covariance by dead reckoning and registrations.

    Attributes:
        poses: (N, 3) m and rad.
        covariance: (N, 3, 3) of each pose relative to node 0, in the common frame of the poses; the difference of two entries
            is the covariance of the motion between the two nodes.
        breaks: (B,) nodes without an edge of motion from the node before; across them the covariance is unknown.
    """

    poses: Array
    covariance: Array
    breaks: NDArray[np.int64]

    def ways(self, first: NDArray[np.int64], second: NDArray[np.int64]) -> RelativePose:
        """The poses of nodes `second` (P,) in the frames of nodes `first` (P,), with covariances."""
        back = adjoint(inverse(self.poses[second]))
        sign = np.where(second >= first, 1.0, -1.0)[:, None, None]
        covariance = back @ (sign * (self.covariance[second] - self.covariance[first])) @ back.transpose(0, 2, 1)
        covariance[np.searchsorted(self.breaks, first, "right") != np.searchsorted(self.breaks, second, "right")] = np.inf
        return RelativePose(between(self.poses[first], self.poses[second]), covariance)


def chain_of(graph: PoseGraph, poses: Array | None = None) -> Chain:
    """Compose the poses of consecutive nodes from their edges of motion; several edges of two nodes are fused as independent.

    Args:
        graph: the measurements.
        poses: (N, 3) poses to be used instead of the composed ones; None: compose them, with node 0 at the origin.
    """
    links = _links(graph.with_edges(graph.is_motion))
    steps = np.flatnonzero(links.high == links.low + 1)
    deltas, covariances = np.zeros((graph.n_nodes, 3)), np.zeros((graph.n_nodes, 3, 3))
    deltas[links.high[steps]], covariances[links.high[steps]] = links.delta[steps], links.covariance[steps]
    if poses is None:
        poses = np.zeros((graph.n_nodes, 3))
        for node in range(1, graph.n_nodes):
            poses[node] = compose(poses[node - 1], deltas[node])
    carry = adjoint(poses)
    grown = np.cumsum(carry @ covariances @ carry.transpose(0, 2, 1), axis=0)
    return Chain(poses, grown, np.setdiff1d(np.arange(1, graph.n_nodes), links.high[steps]))


def covariances_from(graph: PoseGraph) -> Callable[[int], Array]:
    """Return a function from a node to the covariances of all nodes relative to it. Its results are cached.

    Edges of the same two nodes are fused. Paths are shortest in the trace of the position covariance; along a path covariances,
    taken as independent, are propagated by adjoints (as `geometry.compose_relative`).

    Returns:
        From a node to (N, 3, 3) m^2 and rad^2, right perturbation in each node's own frame: zero for the node itself, infinite
        on the diagonal for a node that no path reaches. It raises GraphError if the node does not exist.
    """
    links = cache(lambda: _links(graph))

    def from_node(node: int) -> Array:
        if not 0 <= node < graph.n_nodes:
            raise GraphError(f"graph: node {node} does not exist, expected one of 0..{graph.n_nodes - 1}")
        return _relative_covariances(links(), graph.n_nodes, node)

    return cache(from_node)


def _relative_covariances(links: _Links, n: int, node: int) -> Array:
    parent, edge = _shortest_tree(links, n, node)
    child = np.flatnonzero(edge >= 0)
    delta, step = np.zeros((n, 3)), np.zeros((n, 3, 3))
    delta[child], step[child] = _away_from_parent(links, child, edge[child])
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


def _links(graph: PoseGraph) -> _Links:
    """All edges from the lower to the higher node, those of one pair fused: their information adds up."""
    turned = graph.sources > graph.targets
    delta, information = graph.deltas.copy(), graph.information.copy()
    delta[turned] = inverse(graph.deltas[turned])
    back = adjoint(delta[turned])
    information[turned] = back.transpose(0, 2, 1) @ information[turned] @ back
    key = np.minimum(graph.sources, graph.targets) * graph.n_nodes + np.maximum(graph.sources, graph.targets)
    order = np.lexsort((-information[:, 0, 0] - information[:, 1, 1], key))
    first = np.flatnonzero(np.diff(key[order], prepend=-1))
    total = np.add.reduceat(information[order], first, axis=0) if len(first) else information
    pairs = key[order[first]]
    covariance: Array = np.asarray(np.linalg.inv(total))
    return _Links(pairs // graph.n_nodes, pairs % graph.n_nodes, delta[order[first]], covariance)


def _shortest_tree(links: _Links, n: int, node: int) -> tuple[NDArray[np.int64], NDArray[np.int64]]:
    """Parent of each node (`node` for itself and for the unreached) and the link to it (-1 for those)."""
    weight = np.maximum(links.covariance[:, 0, 0] + links.covariance[:, 1, 1], _MIN_WEIGHT)
    matrix = csr_array((weight, (links.low, links.high)), shape=(n, n))
    _, found = dijkstra(matrix, directed=False, indices=np.array([node]), return_predecessors=True)
    predecessor = found[0]
    reached = predecessor >= 0
    parent = np.where(reached, predecessor, node).astype(np.int64)
    edge = np.full(n, -1, dtype=np.int64)
    child = np.flatnonzero(reached)
    key = np.minimum(child, parent[child]) * n + np.maximum(child, parent[child])
    edge[child] = np.searchsorted(links.low * n + links.high, key)
    return parent, edge


def _away_from_parent(links: _Links, child: NDArray[np.int64], edge: NDArray[np.int64]) -> tuple[Array, Array]:
    """Pose and covariance of each child in its parent's frame; links of the other direction are inverted."""
    delta, covariance = links.delta[edge].copy(), links.covariance[edge]
    turned = links.low[edge] == child
    carry = adjoint(delta[turned])
    covariance[turned] = carry @ covariance[turned] @ carry.transpose(0, 2, 1)
    delta[turned] = inverse(delta[turned])
    return delta, covariance


_TRUST = np.zeros(len(EdgeKind), dtype=np.int64)  # of a kind of edge, when a new node is placed
_TRUST[EdgeKind.LOOP], _TRUST[EdgeKind.MANUAL], _TRUST[EdgeKind.ODOMETRY], _TRUST[EdgeKind.REGISTRATION] = 0, 0, 1, 2


def require_connected(graph: PoseGraph) -> None:
    """Refuse a graph in which a node is not connected to node 0.

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
    """Add poses for the nodes beyond `placed` (M, 3), each by its best edge to an earlier node; returns (N, 3).

    Registrations are better than odometry, and odometry is better than loops; among edges of one kind, the earlier node nearest
    in number is best, then the newest edge.

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
    """Indices of the odometry edges that lead from a node to the next."""
    return np.flatnonzero((graph.kinds == EdgeKind.ODOMETRY) & (graph.targets == graph.sources + 1))


def chain(graph: PoseGraph) -> PoseGraph:
    """The graph with initial poses that are composed along its edges, from the pose of node 0 on."""
    return replace(graph, initial=extend(graph, graph.initial[:1]))
