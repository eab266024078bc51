"""`Driver` makes a back-end of a solver: it follows a growing graph.

A solver is a function from (graph, initial poses) to an outcome.
"""

from __future__ import annotations

import time
from collections.abc import Callable, Iterator
from dataclasses import replace
from enum import Enum
from typing import Any

import numpy as np

from hybridmap.backends.base import (
    Backend,
    Outcome,
    Remembering,
    Solution,
    Solver,
    SolveReport,
    SolveStatus,
    SupportsPoseGraph,
)
from hybridmap.backends.judging.clusters import rejected_clusters
from hybridmap.backends.objective import chi2, gate_of, hanging_nodes, squared_norms, total, unit_variance, weak_edges
from hybridmap.backends.registry import unfiltered
from hybridmap.config.backends import BackendsConfig
from hybridmap.errors import BackendError, counted
from hybridmap.geometry import Array, between, compose
from hybridmap.graph.order import in_driving_order
from hybridmap.graph.paths import extend, require_connected
from hybridmap.graph.pose_graph import Change, PoseGraph, difference, prefix

_ROUNDING = 1e-9  # of chi2: a chain without loops has none, and no solver finds less

Extend = Callable[[PoseGraph, Array], Array]
"""Poses (N, 3) of a graph whose first (M, 3) are given."""


class Works(Enum):
    """When `Driver.update` calls the solver: if the graph closes a loop (`Change.closes`), whenever it grows, or never."""

    ON_CLOSURES = "on closures"
    ON_GROWTH = "on growth"
    NEVER = "never"


class Driver:
    """A back-end made of a solver: follows a growing graph, solves a whole one, and reports on both.

    Between two loop closures the cost of an update grows with the new part of the graph only. If a call raises, the state
    is as before the call.
    """

    def __init__(
        self,
        name: str,
        config: BackendsConfig,
        solve: Solver,
        *,
        follow: Solver | None = None,
        last: Solver | None = None,
        onward: Solver | None = None,
        given: Solver | None = None,
        works: Works = Works.ON_CLOSURES,
        place: Extend = extend,
        most_rise: float = np.inf,
        softens: bool = False,
        remembers: Remembering | None = None,
    ) -> None:
        """Make a back-end.

        Args:
            name: of the back-end.
            config: settings with the gate of loops and the kernel on odometry and registration edges.
            solve: solves a whole graph from its `initial`, independently of earlier calls.
            follow: runs an update that calls the solver, from the last outcome. Default: `solve`.
            last: if given, the end of the drive is one more update by this function. Default: a whole solution.
            onward: if given, the end of the drive is a whole solution by this function, from the poses reached so far.
                Default: by `solve`, from the graph's `initial`.
            given: solves a whole graph from its `initial` and no other poses, for comparisons. Default: `solve`.
            works: when an update calls the solver.
            place: places new nodes.
            most_rise: relative rise of chi2 above that of the start beyond which a solution is refused, and an update is
                called `stalled`.
            softens: the solver puts the configured kernel on odometry and registration edges; outliers are reported.
            remembers: what keeps the state of `follow` between updates; None: it keeps none.
        """
        self._name, self._config = name, config
        self._solve, self._follow, self._last, self._onward = solve, follow or solve, last, onward
        self._given = given or solve
        self._works, self._place, self._most_rise, self._softens = works, place, most_rise, softens
        self._graph: PoseGraph | None = None
        self._poses: Array = np.zeros((0, 3))
        self._squared: Array = np.zeros(0)
        self._weights: dict[int, float] = {}
        self._rejected: tuple[int, ...] = ()
        self._waiting = 0  # loops and registrations that no solver has seen
        self._remembers = remembers

    def __reduce__(self) -> tuple[Any, ...]:
        """How to make this back-end again: by its name and settings, and with the state that it has reached."""
        memory = None if self._remembers is None else self._remembers.memory()
        state = self._graph, self._poses, self._squared, self._weights, self._rejected, self._waiting, memory
        return restored, (self._name, self._config), state

    def __setstate__(self, state: tuple[Any, ...]) -> None:
        self._graph, self._poses, self._squared, self._weights, self._rejected, self._waiting, memory = state
        if self._remembers is not None:
            self._remembers.remember(memory)

    @property
    def name(self) -> str:
        """The name from which `registry.create` makes this back-end."""
        return self._name

    def update(self, graph: PoseGraph) -> Solution:
        """Follow the graph as it has grown (or lost edges) since the last call.

        Raises:
            GraphError: a new edge is malformed, or a node is not connected.
            BackendError: the graph cannot be solved, or has fewer nodes than before.
        """
        return self._advance(graph, None)

    def finish(self, graph: PoseGraph) -> Solution:
        """Compute the final solution at the end of a drive.

        Raises:
            GraphError: the graph is malformed or not connected.
            BackendError: the graph cannot be solved.
        """
        if self._last is not None:
            return self._advance(graph, self._last)
        if self._onward is not None:
            return self._whole(graph, self._onward, self.update(graph).poses)
        return self.solve(graph)

    def solve(self, graph: PoseGraph | SupportsPoseGraph) -> Solution:
        """Solve a whole graph, independently of earlier calls.

        Raises:
            GraphError: the graph is malformed or not connected.
            BackendError: the solver failed.
        """
        frozen = graph if isinstance(graph, PoseGraph) else graph.pose_graph()
        return self._whole(frozen, self._solve, frozen.initial)

    def solve_as_given(self, graph: PoseGraph) -> Solution:
        """As `solve`, but from the graph's `initial` and no other poses, also where the back-end would look for better ones.

        Raises:
            GraphError: the graph is malformed or not connected.
            BackendError: the solver failed.
        """
        return self._whole(graph, self._given, graph.initial)

    def _advance(self, graph: PoseGraph, always: Solver | None) -> Solution:
        """Follow the graph: by `always` if given, else by `follow` when the graph calls for the solver."""
        started = time.process_time()
        change = difference(self._graph, graph)
        new = graph.with_edges(change.added)
        placed = self._admit(graph, new, change)
        start = self._place(new, placed)
        at_start = self._carried(new, change, start)
        if always is not None or self._works is Works.ON_GROWTH or (self._works is Works.ON_CLOSURES and change.closes):
            outcome, waiting = self._checked(graph, start, self._asked(always or self._follow, graph, start)), 0
        else:
            waiting = 0 if self._works is Works.NEVER else self._waiting + new.n_edges - (len(start) - len(placed))
            outcome = self._extended(start, waiting)
        squared = at_start if outcome.poses is start else squared_norms(graph, outcome.poses)
        before = total(at_start)
        if self._rose(before, total(squared)):
            message = f"{outcome.message}; chi2 rose; the next update continues from here"
            outcome = replace(outcome, status=SolveStatus.STALLED, message=message)
        self._graph, self._poses, self._squared = graph, outcome.poses, squared
        self._weights, self._rejected, self._waiting = outcome.weights, outcome.rejected, waiting
        return self._solution(graph, outcome, squared, before, started)

    def _whole(self, graph: PoseGraph, solver: Solver, start: Array) -> Solution:
        """Check a whole graph, and solve it with its nodes in the order of the drive, whatever theirs is."""
        graph.validate()
        require_connected(graph)
        arranged = in_driving_order(graph)
        if arranged.nodes is None:
            return self._in_order(arranged.graph, solver, start)
        solution = self._in_order(arranged.graph, solver, start[arranged.nodes])
        return replace(solution, poses=_anchored(arranged.given(solution.poses), graph.initial[0]))

    def _in_order(self, graph: PoseGraph, solver: Solver, start: Array) -> Solution:
        """Run a solver on a whole graph and check the result."""
        started = time.process_time()
        outcome = self._checked(graph, graph.initial, self._asked(solver, graph, start))
        squared = squared_norms(graph, outcome.poses)
        before = total(squared) if outcome.poses is graph.initial else chi2(graph, graph.initial)
        if self._rose(before, total(squared)):
            message = f"{outcome.message}; chi2 did not fall; the initial poses are kept"
            outcome = Outcome(graph.initial, SolveStatus.DIVERGED, message, outcome.iterations)
            squared = squared_norms(graph, graph.initial)
        solution = self._solution(graph, outcome, squared, before, started)
        if not outcome.rejected:
            return solution
        meant = graph if outcome.calibrated is None else outcome.calibrated
        clusters = rejected_clusters(meant, outcome.poses, outcome.rejected, gate_of(self._config))
        return replace(solution, report=replace(solution.report, rejected_clusters=clusters))

    def _admit(self, graph: PoseGraph, new: PoseGraph, change: Change) -> Array:
        """Validate the new edges, those of `new`; returns the poses to extend from."""
        new.validate()
        old = self._graph
        if old is None:
            return graph.initial[:1]
        if graph.n_nodes < old.n_nodes:
            raise BackendError(
                f"{self._name}: the graph shrank from {old.n_nodes} to {counted(graph.n_nodes, 'node')} between updates"
            )
        if len(change.removed):
            require_connected(graph)
        return self._poses

    def _asked(self, solver: Solver, graph: PoseGraph, start: Array) -> Outcome:
        try:
            return solver(graph, start)
        except RuntimeError as error:  # gtsam raises nothing more specific
            raise BackendError(f"{self._name}: the solver gave up: {first_line(error)}") from error

    def _extended(self, start: Array, waiting: int) -> Outcome:
        """The outcome of an update without the solver."""
        status, message = SolveStatus.CONVERGED, "extended by odometry"
        if waiting:
            status, message = SolveStatus.WAITING, f"{message}; {counted(waiting, 'edge')} waiting for a loop closure"
        return Outcome(start, status, message, 0, self._weights, self._rejected)

    def _rose(self, before: float, after: float) -> bool:
        """Whether chi2 after is above that before by more than the tolerance of an optimum."""
        return np.isfinite(self._most_rise) and after > before * (1.0 + self._most_rise) + _ROUNDING

    def _checked(self, graph: PoseGraph, start: Array, outcome: Outcome) -> Outcome:
        """Refuse poses that are not finite, and move node 0 back to its fixed pose."""
        if not np.isfinite(outcome.poses).all():
            message = "the poses were not finite; the previous ones are kept"
            return Outcome(start, SolveStatus.DIVERGED, message, outcome.iterations)
        poses = _anchored(outcome.poses, graph.initial[0])
        return outcome if poses is outcome.poses else replace(outcome, poses=poses)

    def _carried(self, new: PoseGraph, change: Change, start: Array) -> Array:
        """Squared residuals (E,) at the start of an update: those of the edges of `new`; the others are known."""
        kept = np.delete(self._squared, change.removed) if len(change.removed) else self._squared
        squared = np.empty(len(kept) + new.n_edges)
        known = np.ones(len(squared), dtype=bool)
        known[change.added] = False
        squared[known] = kept
        squared[change.added] = squared_norms(new, start)
        return squared

    def _solution(self, graph: PoseGraph, outcome: Outcome, squared: Array, before: float, started: float) -> Solution:
        """The solution with the common figures: squared residuals (E,) at its poses, chi2 before."""
        meant = graph if outcome.calibrated is None else outcome.calibrated
        strain = squared if outcome.calibrated is None else squared_norms(meant, outcome.poses)
        weak = weak_edges(meant, strain, self._config.robust) if self._softens else {}
        without = (*outcome.rejected, *weak)
        hanging = hanging_nodes(graph, without) if weak else 0
        softened = f"; {counted(len(weak), 'edge')} of motion down-weighted, {counted(hanging, 'node')} joined by them alone"
        report = SolveReport(
            backend=self._name,
            status=outcome.status,
            message=outcome.message + (softened if weak else ""),
            iterations=outcome.iterations,
            chi2_initial=before,
            chi2=total(squared),
            cpu_s=time.process_time() - started,
            rejected_edge_ids=outcome.rejected,
            weights=outcome.weights,
            chi2_odometry=total(strain[~graph.is_loop]),
            unit_variance=unit_variance(meant, strain, without),
            weak_edges=weak,
            hanging_nodes=hanging,
            figures=outcome.figures,
        )
        return Solution(outcome.poses, report, outcome.calibrated)


def restored(name: str, config: BackendsConfig) -> Driver:
    """The back-end of a name, as `Driver.__reduce__` asks for it.

    Raises:
        BackendError: no such name, or what it names is no `Driver`.
    """
    made = unfiltered(name, config)
    if not isinstance(made, Driver):
        raise BackendError(f"back-end {name!r}: cannot be restored; expected one of ours")
    return made


def replay(backend: Backend, graph: PoseGraph) -> Iterator[Solution]:
    """Give a graph to `Backend.update` node by node, as the robot made it; yields the solution after every node.

    The back-end must be in its initial state. A loop enters when it entered the graph (`PoseGraph.entered`), any other edge
    once both of its nodes exist.

    Raises:
        GraphError: the graph is malformed, or a node is joined to later ones only.
        BackendError: the solver failed.
    """
    for nodes in range(1, graph.n_nodes + 1):
        yield backend.update(prefix(graph, nodes))


def _anchored(poses: Array, first: Array) -> Array:
    """Poses (N, 3) moved rigidly, so that the first one is `first` (3,); the same array if it is already."""
    if np.array_equal(poses[0], first):
        return poses
    moved = compose(first, between(poses[0], poses))
    moved[0] = first
    return moved


def first_line(error: BaseException) -> str:
    """The first line of an error's text, or the name of its class if it has none."""
    text = str(error).strip()
    return text.splitlines()[0] if text else type(error).__name__
