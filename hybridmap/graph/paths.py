"""Paths through a graph: connectivity, poses along the chain, and covariances along chain and shortest paths."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from functools import cache, cached_property
from heapq import heapify, heappop, heappush

import numpy as np
from numpy.typing import NDArray
from scipy.sparse import csr_array
from scipy.sparse.csgraph import connected_components, dijkstra

from hybridmap.config.mapping import EdgesConfig
from hybridmap.errors import GraphError
from hybridmap.geometry import Array, RelativePose, adjoint, between, compose, exp, inverse, log
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


Indices = NDArray[np.int64]
_MIN_WEIGHT = 1e-12  # csgraph takes an explicit zero for a missing edge


@dataclass(frozen=True)
class _Links:
    """Pairs of nodes that edges join, the lower number first.

    Attributes:
        low, high: (L,) nodes.
        delta: (L, 3) pose of the high one in the frame of the low one.
        covariance: (L, 3, 3) of that, in the frame of the high one.
        n_nodes: number N of nodes of the graph.
    """

    low: Indices
    high: Indices
    delta: Array
    covariance: Array
    n_nodes: int

    @cached_property
    def keys(self) -> Indices:
        """One number (L,) for each pair of nodes, ascending."""
        return self.low * self.n_nodes + self.high

    @cached_property
    def lengths(self) -> csr_array:
        """The trace of the position covariance of each link, m^2, as a symmetric matrix (N, N)."""
        weight = np.maximum(self.covariance[:, 0, 0] + self.covariance[:, 1, 1], _MIN_WEIGHT)
        ends = np.concatenate([self.low, self.high]), np.concatenate([self.high, self.low])
        return csr_array((np.concatenate([weight, weight]), ends), shape=(self.n_nodes, self.n_nodes))

    @cached_property
    def steps(self) -> tuple[Array, Array]:
        """Adjoint and covariance (2, L, 3, 3) with which a covariance is propagated along each link: up, then down."""
        up, down = adjoint(inverse(self.delta)), adjoint(self.delta)
        return np.stack([up, down]), np.stack([self.covariance, down @ self.covariance @ down.transpose(0, 2, 1)])


@dataclass(frozen=True, slots=True)
class Chain:
    """The poses of consecutive nodes, with their covariance by dead reckoning and registrations.

    Attributes:
        poses: (N, 3) m and rad.
        covariance: (N, 3, 3) of each pose relative to node 0, in the common frame of the poses; the difference of two entries
            is the covariance of the motion between the two nodes.
        breaks: (B,) nodes without an edge of motion from the node before; across them the covariance is unknown. A kidnapping
            that was found is no break: the edge that leads over it counts as one of motion.
    """

    poses: Array
    covariance: Array
    breaks: Indices

    def ways(self, first: Indices, second: Indices) -> RelativePose:
        """The poses of nodes `second` (P,) in the frames of nodes `first` (P,), or of one (1,), with covariances.

        The covariances are infinite across a break.
        """
        back = adjoint(inverse(self.poses[second]))
        sign = np.where(second >= first, 1.0, -1.0)[:, None, None]
        covariance = back @ (sign * (self.covariance[second] - self.covariance[first])) @ back.transpose(0, 2, 1)
        covariance[np.searchsorted(self.breaks, first, "right") != np.searchsorted(self.breaks, second, "right")] = np.inf
        return RelativePose(between(self.poses[first], self.poses[second]), covariance)


def chain_of(graph: PoseGraph, poses: Array | None = None) -> Chain:
    """Compose the poses of consecutive nodes from their edges of motion.

    Of several edges of two nodes the motion is the mean, weighted by their information, which adds up. Across a break the
    composed pose stays the same.

    Args:
        graph: the measurements.
        poses: (N, 3) poses to be used instead of the composed ones; None: compose them, with node 0 at the origin.
    """
    motion = graph.with_edges(graph.is_motion)
    links = _links(motion)
    steps = np.flatnonzero(links.high == links.low + 1)
    covariances = np.zeros((graph.n_nodes, 3, 3))
    covariances[links.high[steps]] = links.covariance[steps]
    if poses is None:
        poses, deltas = np.zeros((graph.n_nodes, 3)), np.zeros((graph.n_nodes, 3))
        deltas[links.high[steps]] = _means(motion, links)[steps]
        for node in range(1, graph.n_nodes):
            poses[node] = compose(poses[node - 1], deltas[node])
    carry = adjoint(poses)
    grown = np.cumsum(carry @ covariances @ carry.transpose(0, 2, 1), axis=0)
    return Chain(poses, grown, np.setdiff1d(np.arange(1, graph.n_nodes), links.high[steps]))


def covariances_from(graph: PoseGraph) -> Callable[[int], Array]:
    """Return a function from a node to the covariances of all nodes relative to it. Its results are cached.

    The information of edges of the same two nodes adds up. Paths are shortest in the trace of the position covariance; along a
    path covariances, taken as independent, are propagated by adjoints (as `geometry.compose_relative`).

    Returns:
        From a node to (N, 3, 3) m^2 and rad^2, right perturbation in each node's own frame: zero for the node itself, infinite
        on the diagonal for a node that no path reaches. It raises GraphError if the node does not exist.
    """
    links = cache(lambda: _links(graph))

    def from_node(node: int) -> Array:
        if not 0 <= node < graph.n_nodes:
            raise GraphError(f"graph: node {node} does not exist, expected one of 0..{graph.n_nodes - 1}")
        return _relative_covariances(links(), node)

    return cache(from_node)


def _relative_covariances(links: _Links, node: int) -> Array:
    parent, edge = _shortest_tree(links, node)
    child = np.flatnonzero(edge >= 0)
    down = np.zeros(links.n_nodes, dtype=np.int64)
    down[child] = links.low[edge[child]] == child
    out = np.zeros((links.n_nodes, 3, 3))
    _along_tree()(parent, edge, down, *links.steps, out)
    unreached = edge < 0
    unreached[node] = False
    out[unreached] = np.diag(np.full(3, np.inf))
    return out


@cache
def _along_tree() -> Callable[..., None]:
    """The compiled loop; compiled on first use, as few commands need it."""
    from hybridmap.compiled import compiled

    tree = "int64[::1], int64[::1], int64[::1]"
    return compiled(f"void({tree}, float64[:, :, :, ::1], float64[:, :, :, ::1], float64[:, :, ::1])")(_propagate)


def _propagate(parent: Indices, edge: Indices, down: Indices, carry: Array, step: Array, out: Array) -> None:
    """Covariances (N, 3, 3) of the nodes of a tree; `out` holds that of the root. `edge` is -1 where a node has no parent."""
    done = edge < 0
    waiting = np.empty(len(parent), dtype=np.int64)
    for first in range(len(parent)):
        node, count = first, 0
        while not done[node]:
            waiting[count] = node
            node, count = parent[node], count + 1
        for position in range(count - 1, -1, -1):
            node = waiting[position]
            above, by, added = out[parent[node]], carry[down[node], edge[node]], step[down[node], edge[node]]
            for i in range(3):
                for j in range(3):
                    total = added[i, j]
                    for k in range(3):
                        for m in range(3):
                            total += by[i, k] * above[k, m] * by[j, m]
                    out[node, i, j] = total
            done[node] = True


def _means(graph: PoseGraph, links: _Links) -> Array:
    """Poses (L, 3) of the higher nodes of links in the frames of the lower ones: the weighted means of all edges of a pair."""
    delta, information, key = _upwards(graph)
    link = np.searchsorted(links.keys, key)
    pull = np.zeros((len(links.low), 3))
    np.add.at(pull, link, np.einsum("eij,ej->ei", information, log(between(links.delta[link], delta))))
    return compose(links.delta, exp(np.einsum("lij,lj->li", links.covariance, pull)))


def _upwards(graph: PoseGraph) -> tuple[Array, Array, Indices]:
    """Every edge from its lower to its higher node: delta (E, 3), information (E, 3, 3), and one number (E,) for each pair."""
    turned = graph.sources > graph.targets
    delta, information = graph.deltas.copy(), graph.information.copy()
    delta[turned] = inverse(graph.deltas[turned])
    back = adjoint(delta[turned])
    information[turned] = back.transpose(0, 2, 1) @ information[turned] @ back
    return (
        delta,
        information,
        np.minimum(graph.sources, graph.targets) * graph.n_nodes + np.maximum(graph.sources, graph.targets),
    )


def _links(graph: PoseGraph) -> _Links:
    """All edges from the lower to the higher node, those of one pair fused: their information adds up."""
    delta, information, key = _upwards(graph)
    order = np.lexsort((-information[:, 0, 0] - information[:, 1, 1], key))
    first = np.flatnonzero(np.diff(key[order], prepend=-1))
    total = np.add.reduceat(information[order], first, axis=0) if len(first) else information
    pairs = key[order[first]]
    covariance: Array = np.asarray(np.linalg.inv(total))
    return _Links(pairs // graph.n_nodes, pairs % graph.n_nodes, delta[order[first]], covariance, graph.n_nodes)


def _shortest_tree(links: _Links, node: int) -> tuple[Indices, Indices]:
    """Parent of each node (`node` for itself and for the unreached) and the link to it (-1 for those)."""
    _, found = dijkstra(links.lengths, indices=np.array([node]), return_predecessors=True)
    predecessor = found[0]
    reached = predecessor >= 0
    parent = np.where(reached, predecessor, node).astype(np.int64)
    edge = np.full(links.n_nodes, -1, dtype=np.int64)
    child = np.flatnonzero(reached)
    key = np.minimum(child, parent[child]) * links.n_nodes + np.maximum(child, parent[child])
    edge[child] = np.searchsorted(links.keys, key)
    return parent, edge


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
    """Poses (N, 3) of all nodes, m and rad: `placed` (M, 3) for the first M, the others by their best edge to one with a pose.

    Registrations are better than odometry, and odometry is better than loops; among edges of one kind, the earlier node nearest
    in number is best, then the newest edge. A node without an edge to an earlier one waits for the later ones.

    Raises:
        GraphError: a node has no path to those that have a pose.
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
    if len(best) < n - done:
        return _spread(graph, poses, done)
    for node in range(done, n):
        poses[node] = _by_edge(graph, poses, best[node], node)
    return poses


def _by_edge(graph: PoseGraph, poses: Array, edge: int, node: int) -> Array:
    """Pose (3,) of one end of an edge, from that of the other end."""
    if graph.targets[edge] == node:
        return compose(poses[graph.sources[edge]], graph.deltas[edge])
    return compose(poses[graph.targets[edge]], inverse(graph.deltas[edge]))


def _spread(graph: PoseGraph, poses: Array, done: int) -> Array:
    """Place the nodes from `done` on outwards from those before, whatever their order; best edges first, as for `extend`."""
    ends = np.stack([graph.sources, graph.targets])
    around: list[list[int]] = [[] for _ in range(graph.n_nodes)]
    for edge, both in enumerate(ends.T.tolist()):
        for node in both:
            around[node].append(edge)
    trust, total = _TRUST[graph.kinds].tolist(), ends.sum(axis=0).tolist()
    out, placed = poses.copy(), [node < done for node in range(graph.n_nodes)]
    rim = [(-trust[edge], total[edge] - node, -edge, node) for node in range(done) for edge in around[node]]
    heapify(rim)
    while rim:
        _, node, edge, _ = heappop(rim)
        if placed[node]:
            continue
        out[node], placed[node] = _by_edge(graph, out, -edge, node), True
        for onward in around[node]:
            heappush(rim, (-trust[onward], total[onward] - node, -onward, node))
    if not all(placed):
        node = placed.index(False)
        raise GraphError(f"{graph.where}: {graph.node_name(node)} is not connected to {graph.node_name(0)}")
    return out


def own_odometry(graph: PoseGraph) -> Indices:
    """Indices, ascending, of the odometry edges that lead from a node to the next."""
    return np.flatnonzero((graph.kinds == EdgeKind.ODOMETRY) & (graph.targets == graph.sources + 1))


def chain(graph: PoseGraph) -> PoseGraph:
    """The graph with initial poses that are composed along its best edges, loops too if need be (`extend`), from node 0 on.

    Raises:
        GraphError: a node has no path to node 0.
    """
    return replace(graph, initial=extend(graph, graph.initial[:1]))
