"""One graph through several back-ends: what the tables and pages of a comparison are made of."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from functools import partial

import numpy as np

from hybridmap.backends.base import Backend, Solution, SolveStatus
from hybridmap.backends.certificate import Certificate, certify
from hybridmap.backends.objective import chi2
from hybridmap.backends.registry import create
from hybridmap.backends.replay import replay
from hybridmap.config.backends import BackendsConfig
from hybridmap.errors import BackendError
from hybridmap.graph.pose_graph import PoseGraph
from hybridmap.metrics import Metric

Progress = Callable[[int, int], None]


@dataclass(frozen=True, slots=True)
class Row:
    """One back-end on the graph.

    Attributes:
        backend: its name.
        solution: None where the back-end failed.
        failure: why; empty where it did not.
        certificate: what could be proved about its solution on the edges that it kept; None where nobody asked.
    """

    backend: str
    solution: Solution | None
    failure: str = ""
    certificate: Certificate | None = None

    @property
    def status(self) -> str:
        """Status in one word."""
        return str(SolveStatus.FAILED if self.solution is None else self.solution.report.status)

    @property
    def message(self) -> str:
        """One line for people."""
        return self.failure if self.solution is None else self.solution.report.message


def compare(
    graph: PoseGraph,
    names: Sequence[str],
    config: BackendsConfig | None = None,
    *,
    incremental: bool = False,
    certified: bool = False,
    progress: Progress | None = None,
) -> list[Row]:
    """Give one frozen graph to each back-end; one that fails is a row that says so.

    Args:
        graph: the graph.
        names: back-ends, in the order of the rows.
        config: their settings.
        incremental: replay the graph node by node (as while driving) instead of solving it whole.
        certified: try to prove each solution optimal (`backends.certificate`).
        progress: called with the units done and their total.

    Raises:
        GraphError: the graph is malformed: no back-end could take it.
        BackendError: a name that there is not.
    """
    graph.validate()
    backends = [create(name, config) for name in names]
    steps = graph.n_nodes if incremental else 1
    rows = []
    for before, backend in enumerate(backends):
        step = partial(_count, progress, before * steps, len(backends) * steps)
        try:
            solution = _replayed(backend, graph, step) if incremental else backend.solve(graph)
            proof = certify(graph, solution.poses, solution.report.rejected_edge_ids) if certified else None
            rows.append(Row(backend.name, solution, certificate=proof))
        except BackendError as error:
            rows.append(Row(backend.name, None, str(error)))
        step(steps)
    return rows


def _count(progress: Progress | None, before: int, total: int, done: int) -> None:
    if progress is not None:
        progress(before + done, total)


def _replayed(backend: Backend, graph: PoseGraph, report: Callable[[int], None]) -> Solution:
    """The last solution of a replay, with the cost of all updates."""
    cpu_s, iterations, last = 0.0, 0, None
    for done, solution in enumerate(replay(backend, graph), start=1):
        cpu_s += solution.report.cpu_s
        iterations += solution.report.iterations
        last = solution
        report(done)
    assert last is not None
    started = chi2(graph, graph.initial)
    return Solution(last.poses, replace(last.report, cpu_s=cpu_s, iterations=iterations, chi2_initial=started))


def metrics_of(rows: Sequence[Row]) -> list[Metric]:
    """Figures `<measure>/<back-end>` of the rows that have a solution."""
    metrics = []
    for row in rows:
        if row.solution is None:
            continue
        report = row.solution.report
        figures: tuple[tuple[str, float, str, str], ...] = (
            ("chi2_initial", report.chi2_initial, "1", "sum of squared Mahalanobis residuals before"),
            ("chi2", report.chi2, "1", "sum of squared Mahalanobis residuals after, over all edges"),
            ("iterations", float(report.iterations), "1", "iterations, sweeps or updates"),
            ("cpu_s", report.cpu_s, "s", "process time"),
            ("rejected_loops", float(len(report.rejected_edge_ids)), "1", "loop edges that the back-end holds for false"),
        )
        if row.certificate is not None and np.isfinite(row.certificate.gap):
            what = "relative gap of the isotropised objective to its lower bound, over the edges kept"
            figures = (*figures, ("certificate_gap", row.certificate.gap, "1", what))
        metrics += [Metric(f"{measure}/{row.backend}", value, unit, text) for measure, value, unit, text in figures]
    return metrics
