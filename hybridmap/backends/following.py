"""Following a growing graph: what is new, what is gone, and when a solver has to work at all."""

from __future__ import annotations

import time
from abc import ABC, abstractmethod
from collections.abc import Callable
from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from hybridmap.backends.base import Solution, SolveReport, SolveStatus, SupportsPoseGraph
from hybridmap.backends.judging.clusters import rejected_clusters
from hybridmap.backends.judging.weak import hanging_nodes, weak_edges
from hybridmap.backends.objective import chi2, gate_of, squared_norms, total, unit_variance
from hybridmap.config.backends import BackendsConfig
from hybridmap.errors import BackendError
from hybridmap.geometry import Array, between, compose
from hybridmap.graph.connectivity import extend, require_connected
from hybridmap.graph.edges import EdgeKind
from hybridmap.graph.pose_graph import PoseGraph

_ROUNDING = 1e-9  # of chi2: a chain without loops has none, and no solver finds less

_Rows = slice | NDArray[np.int64]


@dataclass(frozen=True, slots=True)
class Outcome:
    """What a solver says.

    Attributes:
        poses: (N, 3).
        status, message, iterations: why it stopped, and when.
        weights: loop edge id -> final weight.
        rejected: loops held for false.
        values: the poses in the solver's own form, to start from again.
        calibrated: the graph under the odometry calibration that the solver found.
    """

    poses: Array
    status: SolveStatus
    message: str
    iterations: int
    weights: dict[int, float] = field(default_factory=dict)
    rejected: tuple[int, ...] = ()
    values: Any = None
    calibrated: PoseGraph | None = None


@dataclass(frozen=True, slots=True)
class Change:
    """Difference of two states of one graph; a measurement that changed counts as removed and added.

    Attributes:
        added: (A,) indices into the new graph's edges.
        removed: (R,) indices into the old graph's edges.
        closes: a loop came, an edge went, or one came between nodes that were there before: solved poses may move. Further
            chain edges of a new node (to the last but one, say) do not count: they wait for the next closure.
    """

    added: NDArray[np.int64]
    removed: NDArray[np.int64]
    closes: bool


def prefix(graph: PoseGraph, nodes: int) -> PoseGraph:
    """The graph as it was when it had `nodes` nodes.

    Chain edges are there as soon as both of their ends are; loops that were committed late come late.
    """
    both = np.maximum(graph.sources, graph.targets)
    entry = np.where(graph.kinds < EdgeKind.LOOP, both, np.maximum(both, graph.entry_nodes))
    return replace(graph.with_edges(entry < nodes), initial=graph.initial[:nodes])


def difference(old: PoseGraph | None, new: PoseGraph) -> Change:
    """What happened between two states of one graph."""
    if old is None:
        return Change(np.arange(new.n_edges), np.arange(0), closes=True)
    head = _common_head(old.edge_ids, new.edge_ids)
    came, went = np.ones(new.n_edges, dtype=bool), np.ones(old.n_edges, dtype=bool)
    came[:head] = went[:head] = ~_unchanged(old, slice(head), new, slice(head))
    if head < old.n_edges:
        i_old, i_new = _pairs(old.edge_ids, new.edge_ids, head)
        came[i_new] = went[i_old] = ~_unchanged(old, i_old, new, i_new)
    added, removed = np.flatnonzero(came), np.flatnonzero(went)
    newest = np.maximum(new.sources[added], new.targets[added])
    closes = bool(len(removed) or np.any(newest < old.n_nodes) or np.any(new.kinds[added] >= EdgeKind.LOOP))
    return Change(added, removed, closes)


def _common_head(old: NDArray[np.int64], new: NDArray[np.int64]) -> int:
    """How many numbers two lists have in common before they first differ."""
    both = min(len(old), len(new))
    differ = old[:both] != new[:both]
    return int(differ.argmax()) if differ.any() else both


def _pairs(old: NDArray[np.int64], new: NDArray[np.int64], head: int) -> tuple[_Rows, _Rows]:
    """Rows of the numbers from `head` on that are in both of two increasing lists."""
    in_old = np.flatnonzero(np.isin(old[head:], new[head:], assume_unique=True))
    in_new = np.flatnonzero(np.isin(new[head:], old[head:], assume_unique=True))
    return _sliced(head + in_old), _sliced(head + in_new)


def _sliced(rows: NDArray[np.int64]) -> _Rows:
    """Increasing row numbers, without gaps as a slice: that takes a view where numbers take a copy."""
    gapless = len(rows) and rows[-1] - rows[0] == len(rows) - 1
    return slice(int(rows[0]), int(rows[-1]) + 1) if gapless else rows


def _unchanged(old: PoseGraph, i_old: _Rows, new: PoseGraph, i_new: _Rows) -> NDArray[np.bool_]:
    """Which of some edges of one graph are the same as those of another: ends, kind and measurement."""
    same = np.asarray(old.kinds[i_old] == new.kinds[i_new])
    for name in ("sources", "targets", "deltas", "information"):
        equal = getattr(old, name)[i_old] == getattr(new, name)[i_new]
        if not equal.all():  # nearly always they are: this is the quick way to see it
            same &= equal.reshape(len(same), -1).all(axis=1)
    return same


Work = Callable[[PoseGraph, Array, Change], Outcome]


class GraphBackend(ABC):
    """What all back-ends share; a solver supplies `_optimise` and may refine `_solve_whole`."""

    _rise = np.inf  # relative, of chi2 over that of the start, from which a solution is none
    _softens = False  # whether it puts the configured kernel on edges of motion

    def __init__(self, name: str, config: BackendsConfig) -> None:
        self._name = name
        self._config = config
        self._graph: PoseGraph | None = None
        self._poses: Array = np.zeros((0, 3))
        self._squared: Array = np.zeros(0)
        self._weights: dict[int, float] = {}
        self._rejected: tuple[int, ...] = ()
        self._waiting = 0  # measurements beside the chain that no solver has seen

    @property
    def name(self) -> str:
        """The name by which `create` knows it."""
        return self._name

    def update(self, graph: PoseGraph) -> Solution:
        """See `Backend.update`."""
        return self._advance(graph, None)

    def _advance(self, graph: PoseGraph, always: Work | None) -> Solution:
        """Follow the graph: by `always` if given, else by `_follow` where the graph asks for work."""
        started = time.process_time()
        change = difference(self._graph, graph)
        new = graph.with_edges(change.added)
        placed = self._admit(graph, new, change)
        start = self._extend(new, placed)
        at_start = self._carried(new, change, start)
        if always is not None or self._must_work(change):
            outcome, waiting = self._guarded(graph, start, change, always or self._follow), 0
        else:
            waiting = self._waiting + new.n_edges - (len(start) - len(placed))
            outcome = self._extended(start, waiting)
        squared = at_start if outcome.poses is start else squared_norms(graph, outcome.poses)
        before = total(at_start)
        if self._rose(before, total(squared)):
            message = f"{outcome.message}; chi2 rose, the next updates go on from there"
            outcome = replace(outcome, status=SolveStatus.STALLED, message=message)
        self._graph, self._poses, self._squared = graph, outcome.poses, squared
        self._weights, self._rejected, self._waiting = outcome.weights, outcome.rejected, waiting
        return self._solution(graph, outcome, squared, before, started)

    def _extended(self, start: Array, waiting: int) -> Outcome:
        """What an update without work comes to."""
        status, message = SolveStatus.CONVERGED, "extended by odometry"
        if waiting:
            status, message = SolveStatus.WAITING, f"{message}; {waiting} measurements beside the chain wait for a closure"
        return Outcome(start, status, message, 0, self._weights, self._rejected)

    def finish(self, graph: PoseGraph) -> Solution:
        """See `Backend.finish`: a fresh solve; back-ends whose state is their merit go on from it instead."""
        return self.solve(graph)

    def solve(self, graph: PoseGraph | SupportsPoseGraph) -> Solution:
        """See `Backend.solve`."""
        frozen = graph if isinstance(graph, PoseGraph) else graph.pose_graph()
        return self._timed(frozen, lambda: self._solve_whole(frozen))

    def _timed(self, graph: PoseGraph, work: Callable[[], Outcome]) -> Solution:
        """Check a whole graph, run a solver on it, check what comes out."""
        started = time.process_time()
        graph.validate()
        require_connected(graph)
        try:
            outcome = work()
        except RuntimeError as error:  # gtsam raises nothing more specific
            raise BackendError(f"{self._name}: the solver gave up: {_first_line(error)}") from error
        outcome = self._checked(graph, graph.initial, outcome)
        squared = squared_norms(graph, outcome.poses)
        before = total(squared) if outcome.poses is graph.initial else chi2(graph, graph.initial)
        if self._rose(before, total(squared)):
            message = f"{outcome.message}; ended worse than it began, kept the start"
            outcome = Outcome(graph.initial, SolveStatus.DIVERGED, message, outcome.iterations)
            squared = squared_norms(graph, graph.initial)
        solution = self._solution(graph, outcome, squared, before, started)
        if not outcome.rejected:
            return solution
        meant = graph if outcome.calibrated is None else outcome.calibrated
        clusters = rejected_clusters(meant, outcome.poses, outcome.rejected, gate_of(self._config))
        return replace(solution, report=replace(solution.report, rejected_clusters=clusters))

    def _rose(self, before: float, after: float) -> bool:
        """Whether chi2 after is above that before by more than what an optimum leaves open."""
        return np.isfinite(self._rise) and after > before * (1.0 + self._rise) + _ROUNDING

    @abstractmethod
    def _optimise(self, graph: PoseGraph, start: Array) -> Outcome:
        """Work on a whole graph from given poses, knowing nothing of earlier calls."""

    def _solve_whole(self, graph: PoseGraph) -> Outcome:
        """What `solve` does."""
        return self._optimise(graph, graph.initial)

    def _follow(self, graph: PoseGraph, start: Array, change: Change) -> Outcome:
        """What `update` does when the graph asks for work."""
        del change
        return self._optimise(graph, start)

    def _extend(self, graph: PoseGraph, placed: Array) -> Array:
        return extend(graph, placed)

    def _must_work(self, change: Change) -> bool:
        return change.closes

    def _admit(self, graph: PoseGraph, new: PoseGraph, change: Change) -> Array:
        """Validate what is new, i.e. the edges of `new`; the poses to extend from."""
        new.validate()
        old = self._graph
        if old is None:
            return graph.initial[:1]
        if graph.n_nodes < old.n_nodes:
            raise BackendError(f"{self._name}: the graph shrank from {old.n_nodes} to {graph.n_nodes} nodes between updates")
        if len(change.removed):
            require_connected(graph)
        return self._poses

    def _guarded(self, graph: PoseGraph, start: Array, change: Change, work: Work) -> Outcome:
        try:
            outcome = work(graph, start, change)
        except RuntimeError as error:
            raise BackendError(f"{self._name}: the solver gave up: {_first_line(error)}") from error
        return self._checked(graph, start, outcome)

    def _checked(self, graph: PoseGraph, start: Array, outcome: Outcome) -> Outcome:
        """Refuse what is not finite, and bring node 0 back to where it is fixed."""
        if not np.isfinite(outcome.poses).all():
            message = "poses were not finite; kept those before"
            return Outcome(start, SolveStatus.DIVERGED, message, outcome.iterations)
        if np.array_equal(outcome.poses[0], graph.initial[0]):
            return outcome
        poses = compose(graph.initial[0], between(outcome.poses[0], outcome.poses))
        poses[0] = graph.initial[0]
        return replace(outcome, poses=poses)

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
        """The outcome with the referee's figures: squared residuals (E,) at its poses, chi2 before."""
        meant = graph if outcome.calibrated is None else outcome.calibrated
        strain = squared if outcome.calibrated is None else squared_norms(meant, outcome.poses)
        weak = weak_edges(meant, strain, self._config.robust) if self._softens else {}
        without = (*outcome.rejected, *weak)
        hanging = hanging_nodes(graph, without) if weak else 0
        note = f"; {len(weak)} edges of motion of little weight, {hanging} nodes hang on them alone" if weak else ""
        report = SolveReport(
            backend=self._name,
            status=outcome.status,
            message=outcome.message + note,
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
        )
        return Solution(outcome.poses, report)


def _first_line(error: BaseException) -> str:
    text = str(error).strip()
    return text.splitlines()[0] if text else type(error).__name__
