"""A back-end to build a graph with: for those who bring their own front-end."""

from __future__ import annotations

from dataclasses import dataclass, field, replace
from typing import Literal

import numpy as np
from numpy.typing import ArrayLike

from hybridmap.backends.base import Solution, SolveStatus
from hybridmap.backends.covariance import Covariances
from hybridmap.backends.registry import create
from hybridmap.config.backends import BackendsConfig
from hybridmap.errors import BackendError, GraphError
from hybridmap.geometry import IDENTITY, Array, RelativePose, between, compose, compose_relative, invert_relative
from hybridmap.graph.connectivity import extend, require_connected
from hybridmap.graph.pose_graph import EdgeKind, PoseGraph


@dataclass(frozen=True, slots=True)
class _Edge:
    source: int
    target: int
    delta: Array
    information: Array
    kind: EdgeKind


@dataclass(frozen=True, slots=True)
class Snapshot:
    """A state to return to; arrays in it are never written to."""

    nodes: tuple[int, ...]
    edges: dict[int, _Edge]
    poses: dict[int, Array]
    fixed: int | None
    next_edge: int
    solution: Solution | None = field(repr=False)


class GraphSession:
    """Nodes and edges that come and go, and a back-end that follows them.

    Node and edge numbers are the caller's own: nodes any whole numbers, edges increasing ones. Whatever raises leaves the
    session as it was, bit for bit.
    """

    def __init__(self, backend: str = "gtsam-lm", config: BackendsConfig | None = None) -> None:
        """An empty session.

        Raises:
            BackendError: no such back-end.
        """
        self._name, self._config = backend, config
        self._backend = create(backend, config)
        self._state = Snapshot((), {}, {}, None, 0, None)

    def add_node(self, node: int, pose: ArrayLike | None = None) -> None:
        """Add a node; the first one stays at its `pose` (3,), m and rad (default: the origin), others are placed by edges.

        Raises:
            BackendError: the node is there already.
        """
        state = self._state
        if node in state.nodes:
            raise BackendError(f"node {node} is there already")
        poses = dict(state.poses)
        if pose is not None or not state.nodes:
            poses[node] = np.array(IDENTITY if pose is None else pose, dtype=np.float64)
        self._state = replace(
            state, nodes=(*state.nodes, node), poses=poses, fixed=node if state.fixed is None else state.fixed
        )

    def add_edge(
        self, edge: int, source: int, target: int, delta: ArrayLike, information: ArrayLike, kind: EdgeKind = EdgeKind.LOOP
    ) -> None:
        """Add a measured pose (3,) of the target in the frame of the source, with its information (3, 3).

        Raises:
            BackendError: the number is not above all earlier ones.
            GraphError: an unknown node, or a measurement that no solver could take.
        """
        state = self._state
        if edge < state.next_edge:
            raise BackendError(f"edge {edge}: numbers must increase, expected {state.next_edge} or more")
        new = _Edge(source, target, np.array(delta, dtype=np.float64), np.array(information, dtype=np.float64), kind)
        unknown = [node for node in (source, target) if node not in state.nodes]
        if unknown:
            raise GraphError(f"edge {edge} ({source} -> {target}): there is no node {unknown[0]}")
        _arrays(np.zeros((2, 3)), {edge: new}, [0], [int(target != source)]).validate()
        self._state = replace(state, edges={**state.edges, edge: new}, next_edge=edge + 1)

    def remove_edge(self, edge: int) -> None:
        """Take an edge out again.

        Raises:
            BackendError: there is no such edge.
            GraphError: a node would hang on nothing.
        """
        if edge not in self._state.edges:
            raise BackendError(f"there is no edge {edge}")
        candidate = replace(self._state, edges={e: one for e, one in self._state.edges.items() if e != edge})
        require_connected(_graph(candidate))
        self._state = candidate

    def remove_node(self, node: int, mode: Literal["drop", "bridge"] = "drop") -> None:
        """Take a node and its edges out; `bridge` joins its neighbours in the chain by the composition of their edges.

        Raises:
            BackendError: there is no such node, it is the fixed one, or it is not between two others of the chain.
            GraphError: another node would hang on nothing.
        """
        state = self._state
        if node not in state.nodes or node == state.fixed:
            raise BackendError(f"node {node}: {'is the fixed one' if node in state.nodes else 'there is no such node'}")
        edges = {e: one for e, one in state.edges.items() if node not in (one.source, one.target)}
        poses = {other: pose for other, pose in state.poses.items() if other != node}
        candidate = replace(state, nodes=tuple(n for n in state.nodes if n != node), edges=edges, poses=poses)
        if mode == "bridge":
            edges[state.next_edge] = _bridge(state, node)
            candidate = replace(candidate, next_edge=state.next_edge + 1)
        require_connected(_graph(candidate))
        self._state = candidate
        self._backend = create(self._name, self._config)

    def fix(self, node: int) -> None:
        """Make another node the one that stays where it is.

        Raises:
            BackendError: there is no such node, or it has no pose yet.
        """
        if node not in self._state.poses:
            raise BackendError(f"node {node}: has no pose to be fixed at")
        self._state = replace(self._state, fixed=node)

    def step(self, budget: int = 1) -> Solution:
        """Follow what has changed: at most so many updates of the back-end, fewer where it has converged.

        Raises:
            GraphError, BackendError: as `Backend.update`.
        """
        if budget < 1:
            raise BackendError(f"step: found a budget of {budget}, expected 1 or more")
        graph = _graph(self._state)
        for _ in range(budget):
            solution = self._backend.update(graph)
            if solution.report.status is SolveStatus.CONVERGED:
                break
        return self._adopt(solution)

    def solve(self) -> Solution:
        """Solve the whole graph anew.

        Raises:
            GraphError, BackendError: as `Backend.solve`.
        """
        return self._adopt(self._backend.solve(_graph(self._state)))

    def poses(self) -> Array:
        """(N, 3) latest poses in the order of the nodes; nodes newer than the last solution are placed by their edges."""
        graph = _graph(self._state)
        return graph.initial

    def edge_weights(self) -> dict[int, float]:
        """Final weight of each loop in the latest solution; empty without a robust kernel."""
        solution = self._state.solution
        return {} if solution is None else dict(solution.report.weights)

    def marginal(self, node: int) -> Array:
        """Covariance (3, 3) of a node relative to the fixed one, in its own frame, at the latest poses.

        Raises:
            BackendError: there is no such node, or the graph is singular.
        """
        nodes = self._state.nodes
        if node not in nodes:
            raise BackendError(f"there is no node {node}")
        graph, fixed = _graph(self._state), nodes.index(_fixed(self._state))
        covariances = Covariances(graph, graph.initial)
        return np.asarray(covariances.relative(np.array([fixed]), np.array([nodes.index(node)]))[0])

    def snapshot(self) -> Snapshot:
        """The state as it is."""
        return self._state

    def restore(self, snapshot: Snapshot) -> None:
        """Return to a state: nodes, edges and poses are exactly what they were; the back-end starts from them."""
        self._state = snapshot
        self._backend = create(self._name, self._config)

    def _adopt(self, solution: Solution) -> Solution:
        """Bring the fixed node back to where it is, and keep the poses."""
        state = self._state
        fixed = state.nodes.index(_fixed(state))
        poses = solution.poses
        if not np.array_equal(poses[fixed], state.poses[_fixed(state)]):
            poses = compose(state.poses[_fixed(state)], between(poses[fixed], poses))
            poses[fixed] = state.poses[_fixed(state)]
        solution = replace(solution, poses=poses)
        by_node = {node: pose.copy() for node, pose in zip(state.nodes, poses, strict=True)}
        self._state = replace(state, poses=by_node, solution=solution)
        return solution


def _fixed(state: Snapshot) -> int:
    if state.fixed is None:
        raise BackendError("the session has no node")
    return state.fixed


def _graph(state: Snapshot) -> PoseGraph:
    """The state as arrays; nodes without a pose are placed by their edges."""
    _fixed(state)
    index = {node: i for i, node in enumerate(state.nodes)}
    placed = 0
    while placed < len(state.nodes) and state.nodes[placed] in state.poses:
        placed += 1
    known = np.array([state.poses[node] for node in state.nodes[:placed]]).reshape(-1, 3)
    initial = np.concatenate([known, np.zeros((len(state.nodes) - placed, 3))])
    edges = state.edges.values()
    graph = _arrays(initial, state.edges, [index[edge.source] for edge in edges], [index[edge.target] for edge in edges])
    return graph if placed == len(state.nodes) else replace(graph, initial=extend(graph, known))


def _arrays(initial: Array, edges: dict[int, _Edge], sources: list[int], targets: list[int]) -> PoseGraph:
    return PoseGraph(
        initial=initial,
        sources=np.array(sources, dtype=np.int64),
        targets=np.array(targets, dtype=np.int64),
        deltas=np.array([edge.delta for edge in edges.values()], dtype=np.float64).reshape(-1, 3),
        information=np.array([edge.information for edge in edges.values()], dtype=np.float64).reshape(-1, 3, 3),
        kinds=np.array([edge.kind for edge in edges.values()], dtype=np.int8),
        edge_ids=np.array(list(edges), dtype=np.int64),
    )


def _bridge(state: Snapshot, node: int) -> _Edge:
    """One edge between the neighbours of a node in the chain."""
    place = state.nodes.index(node)
    if not 0 < place < len(state.nodes) - 1:
        raise BackendError(f"node {node}: is at an end of the chain, there is nothing to bridge")
    before, after = state.nodes[place - 1], state.nodes[place + 1]
    whole = compose_relative(_relative(state, before, node), _relative(state, node, after))
    information = np.linalg.inv(whole.covariance)
    return _Edge(before, after, whole.delta, 0.5 * (information + information.T), EdgeKind.ODOMETRY)


def _relative(state: Snapshot, source: int, target: int) -> RelativePose:
    """The first chain edge between two nodes, from the one to the other."""
    for edge in state.edges.values():
        if edge.kind < EdgeKind.LOOP and {edge.source, edge.target} == {source, target}:
            relative = RelativePose(edge.delta, np.asarray(np.linalg.inv(edge.information), dtype=np.float64))
            return relative if edge.source == source else invert_relative(relative)
    raise BackendError(f"nodes {source} and {target}: no chain edge joins them, there is nothing to bridge")
