"""Build a graph step by step with a back-end: for users with their own front-end."""

from __future__ import annotations

from copy import deepcopy
from dataclasses import dataclass, field, replace
from typing import Any, Literal

import numpy as np
from numpy.typing import ArrayLike

from hybridmap.backends.base import Backend, Solution, SolveStatus
from hybridmap.backends.gtsam.covariance import Covariances
from hybridmap.backends.registry import LEAST_SQUARES, create
from hybridmap.config.backends import BackendsConfig
from hybridmap.errors import BackendError, GraphError
from hybridmap.geometry import IDENTITY, Array, RelativePose, between, compose, compose_relative, invert_relative
from hybridmap.graph.edges import EdgeKind
from hybridmap.graph.paths import extend, require_connected
from hybridmap.graph.pose_graph import PoseGraph

_EMPTY = PoseGraph(
    initial=np.zeros((0, 3)),
    sources=np.zeros(0, dtype=np.int64),
    targets=np.zeros(0, dtype=np.int64),
    deltas=np.zeros((0, 3)),
    information=np.zeros((0, 3, 3)),
    kinds=np.zeros(0, dtype=np.int8),
    edge_ids=np.zeros(0, dtype=np.int64),
)


@dataclass(frozen=True, slots=True)
class Snapshot:
    """The state of a `GraphSession`, to which it can return; its arrays are never changed.

    Attributes:
        rows: node -> its row in `graph`, in the order in which they were added.
        graph: the graph; its `initial` (N, 3) holds the latest poses, m and rad; NaN for a node without a pose.
        fixed: the node that is held fixed; None if there are no nodes.
        next_edge: least number that a new edge may have.
        solution: the latest solution; None before the first.
    """

    rows: dict[int, int] = field(default_factory=dict)
    graph: PoseGraph = field(default=_EMPTY, repr=False)
    fixed: int | None = None
    next_edge: int = 0
    solution: Solution | None = field(default=None, repr=False)


class GraphSession:
    """A graph that is edited step by step, and a back-end that follows it.

    The caller numbers nodes and edges: nodes by any integers, edges by increasing ones. If a call raises, the session stays
    exactly as it was.
    """

    def __init__(self, backend: str | Backend = LEAST_SQUARES, config: BackendsConfig | None = None) -> None:
        """An empty session with a back-end, given by name or in a fresh state; of the latter, copies are used.

        Raises:
            BackendError: no such back-end.
        """
        self._given, self._config = backend, config
        self._backend = self._fresh()
        self._state = Snapshot()

    def add_node(self, node: int, pose: ArrayLike | None = None) -> None:
        """Add a node.

        Args:
            node: its number.
            pose: (3,) m and rad. The first node stays there (None: at the origin) until `fix` is called. Of a later one it is
                only a start for `solve`; None: its edges place it.

        Raises:
            BackendError: the node exists already.
            GraphError: the pose is not three finite numbers.
        """
        state = self._state
        if node in state.rows:
            raise BackendError(f"node {node} exists already; choose another number")
        given = _numbers(IDENTITY if pose is None else pose, (3,), f"pose of node {node}")
        if not np.isfinite(given).all():
            raise GraphError(f"pose of node {node}: found NaN or Inf, expected finite numbers")
        if pose is None and state.rows:
            given = np.full(3, np.nan)
        initial = np.concatenate([state.graph.initial, given[None]])
        self._state = replace(
            state,
            rows={**state.rows, node: len(state.rows)},
            graph=replace(state.graph, initial=initial),
            fixed=node if state.fixed is None else state.fixed,
        )

    def add_edge(
        self, edge: int, source: int, target: int, delta: ArrayLike, information: ArrayLike, kind: EdgeKind = EdgeKind.LOOP
    ) -> None:
        """Add an edge between two nodes that were added.

        Args:
            edge: its number, above all earlier ones.
            source, target: numbers of the nodes.
            delta: (3,) measured pose of the target in the frame of the source, m and rad.
            information: (3, 3) inverse covariance of x, y and yaw in the frame of the target.
            kind: give edges of the chain as `ODOMETRY` or `REGISTRATION`. A robust back-end may reject a `LOOP`.

        Raises:
            BackendError: the number `edge` is not above all earlier ones.
            GraphError: an unknown node, both nodes the same, or an invalid measurement.
        """
        state = self._state
        if edge < state.next_edge:
            raise BackendError(f"edge {edge}: numbers must increase, expected {state.next_edge} or more")
        unknown = [node for node in (source, target) if node not in state.rows]
        if unknown:
            raise GraphError(f"edge {edge} ({source} -> {target}): found node {unknown[0]}, expected nodes that were added")
        new = _one_edge(edge, source, target, delta, information, kind)
        replace(new, sources=np.array([0]), targets=np.array([int(target != source)]), initial=np.zeros((2, 3))).validate()
        rows = replace(new, sources=np.array([state.rows[source]]), targets=np.array([state.rows[target]]))
        self._state = replace(state, graph=_joined(state.graph, rows), next_edge=edge + 1)

    def remove_edge(self, edge: int) -> None:
        """Remove an edge.

        Raises:
            BackendError: there is no such edge.
            GraphError: a node would be left without a path to the fixed node.
        """
        graph = self._state.graph
        kept = graph.edge_ids != edge
        if kept.all():
            raise BackendError(f"edge {edge}: is not in the graph; expected one of its {graph.n_edges} edges")
        require_connected(graph.with_edges(kept))
        self._state = replace(self._state, graph=graph.with_edges(kept))

    def remove_node(self, node: int, mode: Literal["drop", "bridge"] = "drop") -> None:
        """Remove a node and its edges; the back-end then starts anew from the present poses.

        Args:
            node: the node.
            mode: `drop`; or `bridge`: join the nodes added just before and after it by one odometry edge, composed of the
                odometry or registration edges that join it to them.

        Raises:
            BackendError: there is no such node, it is the fixed one, or, for `bridge`, it is at an end of the chain or such
                an edge is missing.
            GraphError: another node would be left without a path to the fixed node.
        """
        state = self._state
        if node not in state.rows or node == state.fixed:
            found = "is the fixed one" if node in state.rows else "is not in the graph"
            raise BackendError(f"node {node}: {found}; expected a node that was added and is not fixed")
        row, graph = state.rows[node], state.graph
        if mode == "bridge":
            graph = _joined(graph, _bridge(state, node))
        graph = graph.with_edges((graph.sources != row) & (graph.targets != row))
        graph = replace(
            graph,
            initial=np.delete(graph.initial, row, axis=0),
            sources=graph.sources - (graph.sources > row),
            targets=graph.targets - (graph.targets > row),
        )
        require_connected(graph)
        rows = {other: i for i, other in enumerate(other for other in state.rows if other != node)}
        self._state = replace(state, rows=rows, graph=graph, next_edge=state.next_edge + (mode == "bridge"))
        self._backend = self._fresh()

    def fix(self, node: int) -> None:
        """Hold this node fixed from now on, instead of the one that was fixed before.

        It stays at its latest pose: that of the last solution, or as given to `add_node`.

        Raises:
            BackendError: there is no such node, or it has no pose yet.
        """
        state = self._state
        if node not in state.rows or not np.isfinite(state.graph.initial[state.rows[node]]).all():
            found = "has no pose yet" if node in state.rows else "is not in the graph"
            raise BackendError(f"node {node}: {found}; expected a node with a pose; `step` gives it one")
        self._state = replace(self._state, fixed=node)

    def step(self, budget: int = 1) -> Solution:
        """Solve the changed graph by up to `budget` updates of the back-end, fewer if it converges; returns the last solution.

        Raises:
            GraphError: the graph is malformed.
            BackendError: the budget is below 1, or the graph cannot be solved.
        """
        if budget < 1:
            raise BackendError(f"step: found a budget of {budget}, expected 1 or more")
        graph = _graph(self._state)
        for _ in range(budget):
            solution = self._backend.update(graph)
            if solution.report.status in (SolveStatus.CONVERGED, SolveStatus.WAITING):
                break
        return self._adopt(solution)

    def solve(self) -> Solution:
        """Solve the whole graph by `Backend.solve`, from the latest poses.

        Raises:
            GraphError: the graph is malformed.
            BackendError: the session has no node, or the solver failed.
        """
        return self._adopt(self._backend.solve(_graph(self._state)))

    def poses(self) -> Array:
        """Latest poses (N, 3), m and rad, in the order in which nodes were added; edges place those after the last solution.

        Raises:
            BackendError: the session has no node.
            GraphError: a node without a pose is not connected.
        """
        return _graph(self._state).initial.copy()

    def edge_weights(self) -> dict[int, float]:
        """Loop edge id -> its final weight in the latest solution; empty without one or without a robust kernel."""
        solution = self._state.solution
        return {} if solution is None else dict(solution.report.weights)

    def marginal(self, node: int) -> Array:
        """Covariance (3, 3) of a node relative to the fixed one, in the node's own frame, at the latest poses; m^2 and rad^2.

        It follows from the information of all edges, rejected loops too.

        Raises:
            BackendError: there is no such node, or the graph is singular.
        """
        rows = self._state.rows
        if node not in rows:
            raise BackendError(f"node {node}: is not in the graph; expected one of its {len(rows)} nodes")
        graph, fixed = _graph(self._state), rows[_fixed(self._state)]
        covariances = Covariances(graph, graph.initial)
        return np.asarray(covariances.relative(np.array([fixed]), np.array([rows[node]]))[0])

    def snapshot(self) -> Snapshot:
        """The present state, for `restore`."""
        return self._state

    def restore(self, snapshot: Snapshot) -> None:
        """Return to a state: nodes, edges and poses are exactly those of the snapshot, and the back-end starts from them."""
        self._state = snapshot
        self._backend = self._fresh()

    def _fresh(self) -> Backend:
        """The back-end in its initial state."""
        return create(self._given, self._config) if isinstance(self._given, str) else deepcopy(self._given)

    def _adopt(self, solution: Solution) -> Solution:
        """Move the fixed node back to its pose, and keep the poses."""
        state = self._state
        row, poses = state.rows[_fixed(state)], solution.poses.copy()
        where = state.graph.initial[row]
        if not np.array_equal(poses[row], where):
            poses = compose(where, between(poses[row], poses))
            poses[row] = where
        solution = replace(solution, poses=poses)
        self._state = replace(state, graph=replace(state.graph, initial=poses.copy()), solution=solution)
        return solution


def _fixed(state: Snapshot) -> int:
    if state.fixed is None:
        raise BackendError("the session has no node; add one with add_node")
    return state.fixed


def _graph(state: Snapshot) -> PoseGraph:
    """The state's graph; from the first node without a pose on, edges place the nodes."""
    _fixed(state)
    unplaced = np.isnan(state.graph.initial).any(axis=1)
    if not unplaced.any():
        return state.graph
    return replace(state.graph, initial=extend(state.graph, state.graph.initial[: int(unplaced.argmax())]))


def _one_edge(edge: int, source: int, target: int, delta: ArrayLike, information: ArrayLike, kind: EdgeKind) -> PoseGraph:
    """A graph of one edge, without its nodes."""
    return PoseGraph(
        initial=np.zeros((0, 3)),
        sources=np.array([source]),
        targets=np.array([target]),
        deltas=_numbers(delta, (3,), f"measurement of edge {edge}")[None],
        information=_numbers(information, (3, 3), f"information of edge {edge}")[None],
        kinds=np.array([kind], dtype=np.int8),
        edge_ids=np.array([edge]),
    )


def _numbers(given: ArrayLike, shape: tuple[int, ...], what: str) -> Array:
    """A copy as floats of a known shape."""
    try:
        numbers = np.array(given, dtype=np.float64)
    except (TypeError, ValueError):
        raise GraphError(f"{what}: expected numbers, found {str(given)[:60]}") from None
    if numbers.shape != shape:
        raise GraphError(f"{what}: expected the shape {shape}, found {numbers.shape}")
    return numbers


def _joined(graph: PoseGraph, more: PoseGraph) -> PoseGraph:
    """The nodes of the first with the edges of both."""
    names = ("sources", "targets", "deltas", "information", "kinds", "edge_ids")
    both: dict[str, Any] = {name: np.concatenate([getattr(graph, name), getattr(more, name)]) for name in names}
    return PoseGraph(initial=graph.initial, **both)


def _bridge(state: Snapshot, node: int) -> PoseGraph:
    """One edge between the neighbours of a node in the chain, by rows."""
    row = state.rows[node]
    if not 0 < row < len(state.rows) - 1:
        raise BackendError(f"node {node}: is at an end of the chain; expected a node between two others")
    whole = compose_relative(_relative(state, row - 1, row), _relative(state, row, row + 1))
    information = np.linalg.inv(whole.covariance)
    information = 0.5 * (information + information.T)
    return _one_edge(state.next_edge, row - 1, row + 1, whole.delta, information, EdgeKind.ODOMETRY)


def _relative(state: Snapshot, source: int, target: int) -> RelativePose:
    """The first chain edge between two nodes (rows), directed from the first to the second."""
    graph = state.graph
    forward = (graph.sources == source) & (graph.targets == target)
    backward = (graph.sources == target) & (graph.targets == source)
    found = np.flatnonzero((forward | backward) & (graph.kinds < EdgeKind.LOOP))
    if len(found) == 0:
        names = list(state.rows)
        raise BackendError(
            f"nodes {names[source]} and {names[target]}: no chain edge joins them; expected consecutive nodes of the chain"
        )
    edge = int(found[0])
    covariance = np.asarray(np.linalg.inv(graph.information[edge]), dtype=np.float64)
    relative = RelativePose(graph.deltas[edge], covariance)
    return relative if forward[edge] else invert_relative(relative)
