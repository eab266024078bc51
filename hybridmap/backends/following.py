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
from hybridmap.backends.clusters import rejected_clusters
from hybridmap.backends.objective import chi2, gate_of, squared_norms, total, unit_variance
from hybridmap.backends.weak import hanging_nodes, weak_edges
from hybridmap.config.backends import BackendsConfig
from hybridmap.errors import BackendError
from hybridmap.geometry import Array, between, compose
from hybridmap.graph.connectivity import extend, require_connected
from hybridmap.graph.pose_graph import EdgeKind, PoseGraph

_ROUNDING = 1e-9  # of chi2: a chain without loops has none, and no solver finds less


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
    place = np.searchsorted(new.edge_ids, old.edge_ids)  # both strictly increase
    found = new.edge_ids[np.minimum(place, max(new.n_edges - 1, 0))] == old.edge_ids if new.n_edges else place < 0
    i_old, i_new = np.flatnonzero(found), place[found]
    same = _unchanged(old.with_edges(i_old) if len(i_old) < old.n_edges else old, new.with_edges(i_new))
    kept_old, kept_new = np.zeros(old.n_edges, dtype=bool), np.zeros(new.n_edges, dtype=bool)
    kept_old[i_old[same]], kept_new[i_new[same]] = True, True
    added, removed = np.flatnonzero(~kept_new), np.flatnonzero(~kept_old)
    newest = np.maximum(new.sources[added], new.targets[added])
    closes = bool(len(removed) or np.any(newest < old.n_nodes) or np.any(new.kinds[added] >= EdgeKind.LOOP))
    return Change(added, removed, closes)


def _unchanged(old: PoseGraph, new: PoseGraph) -> NDArray[np.bool_]:
    """Which edges (E,) of two graphs with the same edges have the same measurement."""
    rows = ((old.deltas, new.deltas), (old.information, new.information), (old.kinds, new.kinds))
    same = np.ones(old.n_edges, dtype=bool)
    for before, after in rows:
        if not np.array_equal(before, after):  # nearly always they are: this is the quick way to see it
            same &= (before == after).reshape(old.n_edges, -1).all(axis=1)
    return same


class GraphBackend(ABC):
    """What all back-ends share; a solver supplies `_optimise` and may refine `_solve_whole`."""

    _descends = False  # whether a solution of higher chi2 than its start is a failure
    _softens = False  # whether it puts the configured kernel on edges of motion

    def __init__(self, name: str, config: BackendsConfig) -> None:
        self._name = name
        self._config = config
        self._graph: PoseGraph | None = None
        self._poses: Array = np.zeros((0, 3))
        self._squared: Array = np.zeros(0)
        self._weights: dict[int, float] = {}
        self._rejected: tuple[int, ...] = ()

    @property
    def name(self) -> str:
        """The name by which `create` knows it."""
        return self._name

    def update(self, graph: PoseGraph) -> Solution:
        """See `Backend.update`."""
        started = time.process_time()
        change = difference(self._graph, graph)
        placed = self._admit(graph, change)
        start = self._extend(graph, placed)
        at_start = self._carried(graph, change, start)
        if self._must_work(change):
            outcome = self._guarded(graph, start, change)
        else:
            message = "extended by odometry"
            outcome = Outcome(start, SolveStatus.CONVERGED, message, 0, self._weights, self._rejected)
        squared = at_start if outcome.poses is start else squared_norms(graph, outcome.poses)
        self._graph, self._poses, self._squared = graph, outcome.poses, squared
        self._weights, self._rejected = outcome.weights, outcome.rejected
        return self._solution(graph, outcome, squared, total(at_start), started)

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
        if self._descends and total(squared) > before + _ROUNDING:
            message = f"{outcome.message}; ended worse than it began, kept the start"
            outcome = Outcome(graph.initial, SolveStatus.DIVERGED, message, outcome.iterations)
            squared = squared_norms(graph, graph.initial)
        solution = self._solution(graph, outcome, squared, before, started)
        if not outcome.rejected:
            return solution
        meant = graph if outcome.calibrated is None else outcome.calibrated
        clusters = rejected_clusters(meant, outcome.poses, outcome.rejected, gate_of(self._config))
        return replace(solution, report=replace(solution.report, rejected_clusters=clusters))

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

    def _admit(self, graph: PoseGraph, change: Change) -> Array:
        """Validate what is new; the poses to extend from."""
        old = self._graph
        if old is None:
            graph.validate()
            return graph.initial[:1]
        if graph.n_nodes < old.n_nodes:
            raise BackendError(f"{self._name}: the graph shrank from {old.n_nodes} to {graph.n_nodes} nodes between updates")
        graph.with_edges(change.added).validate()
        if len(change.removed):
            require_connected(graph)
        return self._poses

    def _guarded(self, graph: PoseGraph, start: Array, change: Change) -> Outcome:
        try:
            outcome = self._follow(graph, start, change)
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

    def _carried(self, graph: PoseGraph, change: Change, start: Array) -> Array:
        """Squared residuals (E,) at the start of an update; those of edges that were there before are known."""
        old = self._graph
        if old is None or len(change.removed):
            return squared_norms(graph, start)
        squared = np.empty(graph.n_edges)
        known = np.ones(graph.n_edges, dtype=bool)
        known[change.added] = False
        squared[known] = self._squared
        squared[change.added] = squared_norms(graph.with_edges(change.added), start)
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
