"""One cell of a study: disturb one graph, solve it with one back-end, and compute the errors."""

from __future__ import annotations

import math
import time
from dataclasses import dataclass, field, replace

import numpy as np
from numpy.typing import NDArray

from hybridmap import provenance
from hybridmap.backends.base import ODOMETRY, Solution, SolveStatus
from hybridmap.backends.driver import Driver, replay
from hybridmap.backends.gtsam.initial import angular_start
from hybridmap.backends.objective import chi2
from hybridmap.backends.odometry import dead_reckoning
from hybridmap.backends.registry import create
from hybridmap.backends.relaxation.linear import convergence
from hybridmap.errors import BackendError, HybridMapError, counted
from hybridmap.geometry import Array, align, between, compose
from hybridmap.graph.paths import chain
from hybridmap.graph.pose_graph import PoseGraph
from hybridmap.study.false_loops import Kind, with_drift, with_false_loops
from hybridmap.study.frozen import Frozen
from hybridmap.study.measures import KEPT, NEAR_M, OF_ODOMETRY
from hybridmap.study.model import BackendVariant, DriftConfig, backend_settings
from hybridmap.verdict import Facts, reasons_of, verdict_of

UNMAPPED, MAPPED = "unmapped", "mapped"
"""Status of a cell whose source gave no graph, and of one that is judged as its drive was mapped."""


@dataclass(frozen=True, slots=True)
class CellTask:
    """The input of a cell; it may be sent to another machine.

    Attributes:
        key: digest of everything that determines the figures of the cell.
        frozen: the clean graph with its reference poses, as bytes of `Frozen.pack`.
        drift: errors to add to the odometry edges.
        kind: kind of the false loop closures to add.
        rate: share of false loops among all loops of the disturbed graph, 0 <= rate < 1.
        seed: seed of random drift and of the false loops; the graph in `frozen` is made already.
        variant: the back-end, its settings, and how it gets the graph.
    """

    key: str
    frozen: bytes
    drift: DriftConfig
    kind: Kind
    rate: float
    seed: int
    variant: BackendVariant


@dataclass(frozen=True, slots=True)
class CellResult:
    """The result of a cell.

    Attributes:
        key: key of the task.
        status: status of the back-end (`SolveStatus`); `failed` also for an error of hybridmap, `unmapped` if the source gave
            no graph, `mapped` if the map of the drive itself was judged, `crashed` for any other exception.
        message: one line for people: the solver's words, or what failed; may be empty.
        figures: name -> value, for the figures of `measures` and counts of the graph; a figure that could not be computed is
            None or not there.
        timings: name -> value, for the names in `measures.TIMINGS`; stored apart from the figures, as they differ between runs.
        code: digest of the code that computed the result.
    """

    key: str
    status: str
    message: str
    figures: dict[str, float | None] = field(default_factory=dict)
    timings: dict[str, float] = field(default_factory=dict)
    code: str = field(default_factory=lambda: provenance.solving())

    @property
    def lost(self) -> bool:
        """Whether the back-end had a graph and no map of it: the figures `measures.OF_ODOMETRY` are those of odometry."""
        without_map = self.status in (SolveStatus.FAILED, SolveStatus.DIVERGED, SolveStatus.SINGULAR)
        return without_map and any(name in self.figures for name in OF_ODOMETRY)

    def figure(self, name: str) -> float | None:
        """Value of the figure or timing of this name; None if missing."""
        return self.figures.get(name, self.timings.get(name))


def key_of(source_key: str, drift: DriftConfig, false_loops: tuple[str, float, int], variant: BackendVariant) -> str:
    """Digest of everything that determines the figures of a cell, code and libraries included.

    The seed counts only for what is random: drift with noise or drop-outs, and false loops at a rate above 0. Names and titles
    do not count.

    Args:
        source_key: key of the clean graph.
        drift: errors to add to its odometry edges.
        false_loops: kind, rate and seed of the false loops.
        variant: the back-end, its settings, and how it gets the graph.
    """
    kind, rate, seed = false_loops
    return provenance.digest(
        {
            "code": provenance.solving(),
            "source": source_key,
            "drift": None if drift.idle else drift.model_dump(),
            "drift_seed": seed if drift.by_chance else None,
            "false_loops": [kind, rate, seed] if rate > 0.0 else None,
            "backend": [variant.backend, variant.start, variant.way],
            "settings": backend_settings(variant).model_dump(mode="json", exclude={"names"}),
        }
    )


def run(task: CellTask) -> CellResult:
    """Disturb the graph, solve it and compute the errors; with `way: mapped` only the figures of the drive are looked up.

    A `HybridMapError` becomes a result with the status `failed`; other exceptions are raised. A back-end without a map gets the
    errors of odometry, as a robot has that: a method that is left out where it fails looks better than it is.
    """
    frozen = Frozen.unpack(task.frozen)
    if frozen.graph is None:
        return CellResult(task.key, UNMAPPED, frozen.failure)
    if task.variant.way == "mapped":
        return _as_mapped(task, frozen)
    started = time.process_time()
    try:
        drifted = with_drift(frozen.graph, task.drift, task.seed)
        graph = with_false_loops(drifted, task.kind, task.rate, task.seed)
    except HybridMapError as error:
        return _failed(task, error, {}, started)
    counts, started = _counts(drifted, graph), time.process_time()
    try:
        solution = _solve(task, graph, frozen.reference)
    except HybridMapError as error:
        return _failed(task, error, counts | _of_odometry(drifted, graph, frozen.reference), started)
    spent, report = {"cpu_s": time.process_time() - started}, solution.report
    figures = counts | {"iterations": float(report.iterations), "chi2_initial": _finite(report.chi2_initial)}
    figures["verdict"] = float(verdict_of(reasons_of(Facts.of_graph(graph, solution))).grade)
    if report.status.has_map:
        figures |= judge(drifted, graph, solution, frozen.reference)
    else:
        figures |= _of_odometry(drifted, graph, frozen.reference)
    return CellResult(task.key, str(report.status), report.message, figures | _convergence(task.variant, graph), spent)


def _convergence(variant: BackendVariant, graph: PoseGraph) -> dict[str, float | None]:
    """What theory says of a relaxation rule on this graph, and what its sweeps do; empty for other back-ends."""
    found = convergence(variant.backend, graph, backend_settings(variant).relaxation.theta)
    return {name: _finite(value) for name, value in found.items()}


def _failed(task: CellTask, error: HybridMapError, figures: dict[str, float | None], started: float) -> CellResult:
    message = " ".join(str(error).split())
    return CellResult(task.key, str(SolveStatus.FAILED), message, figures, {"cpu_s": time.process_time() - started})


def _of_odometry(own: PoseGraph, graph: PoseGraph, reference: Array) -> dict[str, float | None]:
    """The errors of odometry, which count for a back-end without a map; none if the graph itself cannot be used."""
    try:
        figures = judge(own, graph, create(ODOMETRY).solve(graph), reference)
    except HybridMapError:
        return {}
    return {name: figures[name] for name in OF_ODOMETRY if name in figures}


def _as_mapped(task: CellTask, frozen: Frozen) -> CellResult:
    """The result of the drive itself; the time of mapping is assigned to the primary back-end.

    A back-end that ended the drive without a map gets its own status and the errors of odometry, as in `run`.
    """
    assert frozen.mapped is not None
    name = frozen.mapped.primary if task.variant.backend == "primary" else task.variant.backend
    if name not in frozen.mapped.figures:
        known = ", ".join(frozen.mapped.figures)
        message = f"{name}: did not follow the drive; there are {known} (`backends.names` of its configuration)"
        return CellResult(task.key, str(SolveStatus.FAILED), message)
    timings = dict(frozen.mapped.timings) if name == frozen.mapped.primary else {}
    figures = dict(frozen.mapped.figures[name])
    if name in frozen.mapped.lost:
        odometry = frozen.mapped.figures[ODOMETRY]
        figures |= {figure: odometry[figure] for figure in OF_ODOMETRY if figure in odometry}
    status, message = frozen.mapped.lost.get(name, (MAPPED, ""))
    return CellResult(task.key, status, message, figures, timings)


def judge(own: PoseGraph, graph: PoseGraph, solution: Solution, reference: Array) -> dict[str, float | None]:
    """Compute the figures of a solution of `graph`.

    Args:
        own: the graph without false loops.
        graph: the same graph with false loops appended behind its edges.
        solution: a back-end's solution of `graph`.
        reference: (N, 3) reference poses of the nodes in any frame, m and rad; NaN where unknown.

    Returns:
        Name -> value, for the figures of `measures.MEASURES` that depend on the poses; None for one that is not finite.
    """
    false = np.arange(graph.n_edges) >= own.n_edges
    kept, rejected = _fates(graph, solution)
    ate_m, yaw_deg = errors(solution.poses, reference)
    lost, own_loops = int(np.count_nonzero(~false & rejected)), int(np.count_nonzero(own.is_loop))
    return {
        "ate_m": _finite(ate_m),
        "within_5_cm": float(ate_m <= NEAR_M) if math.isfinite(ate_m) else None,
        "yaw_deg": _finite(yaw_deg),
        "chi2": _finite(solution.report.chi2),
        "chi2_own": _finite(chi2(own, solution.poses)),
        "chi2_odometry": _finite(solution.report.chi2_odometry),
        "unit_variance": _finite(solution.report.unit_variance),
        "false_kept": float(np.count_nonzero(false & kept)),
        "own_lost": float(lost),
        "own_lost_percent": 100.0 * lost / own_loops if own_loops else None,
    }


def errors(poses: Array, reference: Array) -> tuple[float, float]:
    """Root mean square errors of position (m) and heading (deg) of poses (N, 3) against a reference, after SE(2) alignment.

    Only nodes with a known reference pose count (a row without NaN); both errors are NaN if there are fewer than three.
    """
    known = np.isfinite(reference).all(axis=1)
    if np.count_nonzero(known) < 3:
        return math.nan, math.nan
    apart = between(reference[known], compose(align(reference[known], poses[known]), poses[known]))
    position = np.hypot(apart[:, 0], apart[:, 1])
    return float(np.sqrt(np.mean(position**2))), float(np.degrees(np.sqrt(np.mean(apart[:, 2] ** 2))))


def _solve(task: CellTask, graph: PoseGraph, reference: Array) -> Solution:
    """Solve in batch, incrementally, or incrementally with `finish`; the report covers everything."""
    variant = task.variant
    backend = create(variant.backend, backend_settings(variant))
    if variant.way == "solve" and variant.start == "own":
        return backend.solve(graph)
    if variant.way == "solve" and not isinstance(backend, Driver):
        raise BackendError(f"{backend.name}: chooses its start itself; found `start: {variant.start}`, expected own")
    iterations, initial = 0, graph
    if variant.way != "solve" or variant.start == "replay":
        for last in replay(backend, graph):
            iterations += last.report.iterations
    if variant.way == "drive":
        last = backend.finish(graph)
        iterations += last.report.iterations
    if variant.way == "solve":
        assert isinstance(backend, Driver)
        initial = replace(graph, initial=last.poses) if variant.start == "replay" else _begun(graph, variant.start, reference)
        last = backend.solve_as_given(initial)
        iterations += last.report.iterations
    return replace(last, report=replace(last.report, iterations=iterations, chi2_initial=chi2(graph, initial.initial)))


def _begun(graph: PoseGraph, start: str | None, reference: Array) -> PoseGraph:
    """The graph with its initial poses; node 0 keeps its pose.

    Raises:
        BackendError: this graph has no such start.
    """
    if start == "odometry":
        return replace(graph, initial=dead_reckoning(graph, graph.initial[:1]))
    if start == "chain":
        return chain(graph)
    if start == "angular":
        poses = angular_start(graph)
        if poses is None:
            raise BackendError("start: angular: the linear equations are singular; choose another start")
        return replace(graph, initial=poses)
    if start == "reference":
        unknown = int(np.count_nonzero(~np.isfinite(reference).all(axis=1)))
        if unknown:
            raise BackendError(
                f"start: reference: found {unknown} of {counted(len(reference), 'node')} without a reference pose, "
                f"expected none; choose another start"
            )
        return replace(graph, initial=compose(graph.initial[0], between(reference[0], reference)))
    return graph


def _fates(graph: PoseGraph, solution: Solution) -> tuple[NDArray[np.bool_], NDArray[np.bool_]]:
    """(E,) which edges were kept and (E,) which were rejected; dead reckoning uses no loop at all.

    Both may be false: a kernel weighs an edge below one half long before its residual is beyond the gate.
    """
    report = solution.report
    if report.backend == ODOMETRY:
        return ~graph.is_loop, graph.is_loop
    rejected = np.isin(graph.edge_ids, np.array(report.rejected_edge_ids, dtype=np.int64))
    weights = np.array([report.weights.get(edge, 1.0) for edge in graph.edge_ids.tolist()])
    return (weights > KEPT) & ~rejected, rejected


def _counts(own: PoseGraph, graph: PoseGraph) -> dict[str, float | None]:
    return {
        "nodes": float(graph.n_nodes),
        "edges": float(graph.n_edges),
        "own_loops": float(np.count_nonzero(own.is_loop)),
        "false_loops": float(graph.n_edges - own.n_edges),
    }


def _finite(value: float | None) -> float | None:
    return value if value is not None and math.isfinite(value) else None
