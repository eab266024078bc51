"""Solve one graph with several back-ends; the results for the tables and pages of a comparison."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from enum import StrEnum
from functools import partial
from itertools import product

import numpy as np

from hybridmap.backends.base import ODOMETRY, Backend, Solution, SolveStatus
from hybridmap.backends.driver import replay
from hybridmap.backends.judging.certificate import Certificate, certify
from hybridmap.backends.objective import chi2
from hybridmap.backends.registry import create, is_sequential
from hybridmap.config.backends import BackendsConfig, ConsistencyConfig
from hybridmap.errors import BackendError, counted
from hybridmap.geometry import Array
from hybridmap.graph.pose_graph import PoseGraph
from hybridmap.metrics import FIGURES, Metric, figure

Progress = Callable[[int, int], None]


class Way(StrEnum):
    """How a back-end gets the graph: `batch`, the whole graph at once; `incremental`, node by node, as in a drive."""

    BATCH = "batch"
    INCREMENTAL = "incremental"


@dataclass(frozen=True, slots=True)
class Row:
    """Result of one back-end on the graph.

    Attributes:
        backend: name of the back-end.
        solution: its solution; None if the back-end failed.
        failure: message of the error; empty string if the back-end did not fail.
        certificate: what was proved about the solution on the inlier edges; None if no proof was asked for.
        way: how the back-end got the graph.
        title: unique name of the row: that of the back-end, with the way if the back-end has two rows.
        curve: (K, 2) convergence; None if not asked for. Batch: iterations (or sweeps) and chi2 over the edges that were
            inliers at the end. Incremental: number of nodes, and unit variance of the inliers at that time.
    """

    backend: str
    solution: Solution | None
    failure: str = ""
    certificate: Certificate | None = None
    way: Way = Way.BATCH
    title: str = ""
    curve: Array | None = None

    @property
    def status(self) -> str:
        """Status of the solver in one word, for people."""
        return str(SolveStatus.FAILED if self.solution is None else self.solution.report.status)

    @property
    def has_map(self) -> bool:
        """Whether the back-end computed poses of its own, beyond the initial ones."""
        return self.solution is not None and self.solution.report.status.has_map

    @property
    def message(self) -> str:
        """Message of the solver or of the error, in one line."""
        return self.failure if self.solution is None else self.solution.report.summary

    @property
    def remark(self) -> str:
        """Message of the solver, and why the solution is not certified, if that was asked for."""
        doubt = "" if self.certificate is None or self.certificate.certified else self.certificate.message
        return "; ".join(filter(None, (self.message, doubt)))


def compare(
    graph: PoseGraph,
    backends: Sequence[str | Backend],
    config: BackendsConfig | None = None,
    *,
    ways: Sequence[Way] = (Way.BATCH,),
    certified: bool = False,
    traced: bool = False,
    progress: Progress | None = None,
) -> list[Row]:
    """Solve one frozen graph with each back-end in each way. A back-end that fails gets a row with the error.

    The rows are in the order of the back-ends, and for each in the order of the ways.

    Args:
        graph: the graph.
        backends: names, or back-ends that have solved nothing yet.
        config: settings of the back-ends given by name.
        ways: ways of giving the graph to each; dead reckoning is the same in every way and gets only the first.
        certified: prove how far each solution is from the best map (`backends.judging.certificate`).
        traced: compute convergence curves, which makes batch solvers about three times slower.
        progress: called with the number of finished parts of the work and their total.

    Raises:
        GraphError: the graph is malformed.
        BackendError: an unknown name, or a name that is given twice.
    """
    config = config or BackendsConfig()
    names = [backend if isinstance(backend, str) else backend.name for backend in backends]
    twice = next((name for name in names if names.count(name) > 1), None)
    if twice is not None:
        raise BackendError(f"back-end {twice!r} is named twice; name each back-end once")
    graph.validate()
    plan = [(create(one, config), way) for one, way in product(backends, ways) if one != ODOMETRY or way is ways[0]]
    steps = [graph.n_nodes if way is Way.INCREMENTAL else 1 for _, way in plan]
    rows = []
    for number, (backend, way) in enumerate(plan):
        step = partial(_count, progress, sum(steps[:number]), sum(steps))
        row = _solved(graph, backend, way, alone=len(ways) == 1, report=step)
        if row.solution is not None and certified:
            row = replace(row, certificate=certify(graph, row.solution.poses, row.solution.report.rejected_edge_ids))
        if row.solution is not None and traced and way is Way.BATCH:
            row = replace(row, curve=convergence(graph, backend.name, config, row.solution))
        rows.append(row)
        step(steps[number])
    return rows


def convergence(graph: PoseGraph, name: str, config: BackendsConfig, final: Solution) -> Array:
    """Convergence (K, 2) of a back-end: number of iterations, and chi2 then over the edges that `final` does not reject.

    Each point is a separate run with that limit, at Fibonacci numbers of iterations or sweeps; together they take about two
    and a half times as long as one run. Back-ends that do not iterate on one objective get only the first and last point.

    Args:
        graph: the graph that was solved.
        name, config: name and settings of the back-end.
        final: its solution of the whole graph.
    """
    kept = graph.with_edges(~np.isin(graph.edge_ids, final.report.rejected_edge_ids))
    given = graph.with_edges(~np.isin(graph.edge_ids, final.report.inconsistent_edge_ids))
    points = [(0.0, chi2(kept, graph.initial))]
    limit, following = 1, 2
    while limit < final.report.iterations and is_sequential(name):
        solution = create(name, _limited(config, limit)).solve(given)
        points.append((float(limit), chi2(kept, solution.poses)))
        limit, following = following, limit + following
    points.append((float(final.report.iterations), chi2(kept, final.poses)))
    return np.array(points)


def _limited(config: BackendsConfig, most: int) -> BackendsConfig:
    """The settings with at most this many iterations or sweeps, and without the pre-filter."""
    relaxation = config.relaxation.model_copy(update={"solve_sweeps": min(most, config.relaxation.solve_sweeps)})
    limited = {"max_iterations": min(most, config.max_iterations), "relaxation": relaxation}
    return config.model_copy(update={**limited, "consistency": ConsistencyConfig()})


def _count(progress: Progress | None, before: int, total: int, done: int) -> None:
    if progress is not None:
        progress(before + done, total)


def _solved(graph: PoseGraph, backend: Backend, way: Way, *, alone: bool, report: Callable[[int], None]) -> Row:
    """The row of one back-end in one way, without a proof; `alone`: each back-end has this one row."""
    title = backend.name if alone or way is Way.BATCH else f"{backend.name}/{way}"
    row = Row(backend.name, None, way=way, title=title)
    try:
        return _driven(row, backend, graph, report) if way is Way.INCREMENTAL else replace(row, solution=backend.solve(graph))
    except BackendError as error:
        return replace(row, failure=str(error))


def _driven(row: Row, backend: Backend, graph: PoseGraph, report: Callable[[int], None]) -> Row:
    """The row of an incremental run: node by node, then `finish`. The report has the cost of all updates."""
    cpu_s, iterations, curve = 0.0, 0, []
    for done, solution in enumerate(replay(backend, graph), start=1):
        cpu_s += solution.report.cpu_s
        iterations += solution.report.iterations
        curve.append((done, solution.report.unit_variance))
        report(done)
    final = backend.finish(graph)
    iterations += final.report.iterations
    total = replace(
        final.report,
        message=f"{counted(iterations, 'iteration')} over {counted(graph.n_nodes, 'node')}; at the end: {final.report.message}",
        cpu_s=cpu_s + final.report.cpu_s,
        iterations=iterations,
        chi2_initial=chi2(graph, graph.initial),
    )
    curve.append((graph.n_nodes, final.report.unit_variance))
    return replace(row, solution=Solution(final.poses, total), curve=np.array(curve, dtype=np.float64))


def _own_figure(measure: str, title: str, value: float) -> Metric:
    """A figure that only the solver knows; back-ends of other packages may have some that our list does not describe."""
    name = f"{measure}/{title}"
    return figure(name, value) if f"{measure}/" in FIGURES else Metric(name, float(value), "1", f"{measure} by the solver")


def _proved_figures(proof: Certificate) -> dict[str, float | None]:
    bounded, certified = proof.chi2_gap < 1.0, np.isfinite(proof.gap)
    return {
        "chi2_bound": proof.chi2_bound if bounded else None,
        "chi2_gap": proof.chi2_gap if bounded else None,
        "certificate_gap": proof.gap if certified else None,
    }


def metrics_of(rows: Sequence[Row]) -> list[Metric]:
    """Metrics of the rows with a solution, named `<measure>/<title of the row>`."""
    metrics = []
    for row in rows:
        if row.solution is None:
            continue
        report = row.solution.report
        figures: dict[str, float | None] = {
            "chi2_initial": report.chi2_initial,
            "chi2": report.chi2,
            "iterations": report.iterations,
            "cpu_s": report.cpu_s,
            "rejected_loops": len(report.rejected_edge_ids),
            "rejected_together": sum(map(len, report.rejected_clusters)) if report.rejected_clusters else None,
            "chi2_odometry": report.chi2_odometry,
            "unit_variance": report.unit_variance,
            "weak_edges": len(report.weak_edges) or None,
            "hanging_nodes": report.hanging_nodes if report.weak_edges else None,
        }
        if row.certificate is not None:
            figures |= _proved_figures(row.certificate)
        known = {measure: value for measure, value in figures.items() if value is not None}
        title = row.title or row.backend
        metrics += [figure(f"{measure}/{title}", value, what="the solution") for measure, value in known.items()]
        metrics += [_own_figure(measure, title, value) for measure, value in report.figures.items()]
    return metrics
