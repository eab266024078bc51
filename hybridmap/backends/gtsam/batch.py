"""Batch optimisers of GTSAM: Levenberg-Marquardt, Gauss-Newton, Dogleg."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from typing import Any

import gtsam
import numpy as np

from hybridmap.backends.base import Outcome, SolveStatus
from hybridmap.backends.driver import Driver
from hybridmap.backends.gtsam.factors import (
    NoiseModels,
    anchor,
    collected,
    exact_poses,
    exact_values,
    factor_graph,
    factors,
    poses_of,
    values,
)
from hybridmap.backends.gtsam.initial import best_start
from hybridmap.config.backends import BackendsConfig
from hybridmap.errors import counted
from hybridmap.geometry import Array
from hybridmap.graph.pose_graph import PoseGraph, difference

_MAKE: dict[str, tuple[Callable[[], Any], Callable[..., Any]]] = {
    "lm": (gtsam.LevenbergMarquardtParams, gtsam.LevenbergMarquardtOptimizer),
    "gn": (gtsam.GaussNewtonParams, gtsam.GaussNewtonOptimizer),
    "dogleg": (gtsam.DoglegParams, gtsam.DoglegOptimizer),
    "dogleg-qr": (gtsam.DoglegParams, gtsam.DoglegOptimizer),
}

_ON_THE_WAY = 1e-3  # relative tolerance while the graph grows: the next closure comes soon
_STUCK = 1e4  # Levenberg-Marquardt's lambda where it gave up rather than arrived


def create(name: str, config: BackendsConfig, method: str) -> Driver:
    """A least-squares back-end.

    Args:
        name: name of the back-end.
        config: its settings.
        method: `lm` (which computes initial poses of its own, and falls back on Dogleg), `gn` or `dogleg`.
    """

    def given(graph: PoseGraph, start: Array) -> Outcome:
        return run(method, factor_graph(graph, NoiseModels()), start, config.max_iterations)

    def solve(graph: PoseGraph, initial: Array) -> Outcome:
        start = best_start(graph, initial)
        outcome = given(graph, start)
        return outcome if start is initial else replace(outcome, message=f"{outcome.message} (start: rotation averaging)")

    warm = WarmStart(method, NoiseModels(), config.max_iterations)
    return Driver(name, config, solve, follow=warm, given=given, most_rise=1e-9, remembers=warm)


def run(
    method: str,
    graph: Any,
    start: Array,
    max_iterations: int,
    *,
    initial: Any = None,
    tolerance: float = 1e-5,
    rescue: bool = True,
) -> Outcome:
    """Run an optimiser once. Exceptions become the status `singular` or `failed`; no progress far from an optimum, `stalled`.

    Levenberg-Marquardt solves normal equations, which square the condition number. If it fails or stalls, Dogleg follows
    with an orthogonal factorisation, which does not.

    Args:
        method: `lm`, `gn` or `dogleg`.
        graph: a `gtsam.NonlinearFactorGraph` over keys 0..N-1.
        start: (N, 3) initial poses.
        max_iterations: largest number of iterations.
        initial: the same poses as `gtsam.Values`, if they exist already.
        tolerance: relative decrease of the cost at which an optimiser has converged.
        rescue: whether Dogleg may follow.
    """
    initial = values(start) if initial is None else initial
    outcome = _attempt(method, graph, start, initial, max_iterations, tolerance)
    if not rescue or method != "lm" or outcome.status in (SolveStatus.CONVERGED, SolveStatus.MAX_ITERATIONS):
        return outcome
    onward = initial if outcome.values is None else outcome.values
    other = _attempt("dogleg-qr", graph, outcome.poses, onward, max_iterations, tolerance)
    message = f"{outcome.message}; {other.message}"
    return replace(other, message=message) if other.status is SolveStatus.CONVERGED else replace(outcome, message=message)


def _attempt(method: str, graph: Any, start: Array, initial: Any, max_iterations: int, tolerance: float) -> Outcome:
    make_params, make_optimizer = _MAKE[method]
    params = make_params()
    params.setMaxIterations(max_iterations)
    params.setRelativeErrorTol(tolerance)
    params.setAbsoluteErrorTol(0.0)  # GTSAM's own takes a graph of little information for solved before the first step
    if method.endswith("-qr"):
        params.setLinearSolverType("MULTIFRONTAL_QR")
    try:
        optimizer = make_optimizer(graph, initial, params)
        result = optimizer.optimize()
    except RuntimeError as error:
        text = str(error).strip().splitlines()
        status = SolveStatus.SINGULAR if "ndetermina" in str(error) else SolveStatus.FAILED  # GTSAM's word for singular
        return Outcome(start, status, f"{method}: {text[0] if text else type(error).__name__}", 0)
    poses, iterations = poses_of(result), int(optimizer.iterations())
    if not np.isfinite(poses).all():
        return Outcome(start, SolveStatus.DIVERGED, f"{method}: poses were not finite", iterations)
    if method == "gn" and graph.error(result) > graph.error(initial):
        return Outcome(start, SolveStatus.DIVERGED, "gn: the cost rose, kept the start", iterations)
    status, message = SolveStatus.CONVERGED, f"{method}: converged"
    if iterations >= max_iterations:
        status, message = SolveStatus.MAX_ITERATIONS, f"{method}: stopped at {counted(iterations, 'iteration')}"
    elif method == "lm" and optimizer.lambda_() > _STUCK:
        status, message = SolveStatus.STALLED, f"lm: no step lowered the cost after {counted(iterations, 'iteration')}"
    return Outcome(poses, status, message, iterations, values=result)


class WarmStart:
    """A solver that keeps factors and poses between updates, so that only new ones are converted."""

    def __init__(self, method: str, models: NoiseModels, max_iterations: int) -> None:
        self._method, self._models, self._max_iterations = method, models, max_iterations
        self._graph: PoseGraph | None = None
        self._factors: dict[int, Any] = {}
        self._values: Any = None

    def memory(self) -> tuple[PoseGraph | None, Array | None]:
        """The graph, and each pose as (N, 4): x, y, cosine and sine; see `Remembering`."""
        if self._graph is None:
            return None, None
        return self._graph, exact_poses(self._values, self._graph.n_nodes)

    def remember(self, memory: tuple[PoseGraph | None, Array | None]) -> None:
        """Take over what `memory` returned."""
        self._graph, exact = memory
        if self._graph is not None and exact is not None:
            made = factors(self._graph, self._models)
            self._factors = dict(zip(self._graph.edge_ids.tolist(), made, strict=True))
            self._values = exact_values(exact)

    def __call__(self, graph: PoseGraph, start: Array) -> Outcome:
        """Run the optimiser once; for a graph seen before, `start` (N, 3) must continue the last outcome.

        The optimiser takes only the poses of new nodes from `start`.
        """
        added = difference(self._graph, graph).added
        known = self._graph.n_nodes if self._graph is not None else 0
        new = graph.with_edges(added)
        self._factors |= zip(new.edge_ids.tolist(), factors(new, self._models), strict=True)
        initial = values(start[known:], known)
        if self._values is not None:
            initial.insert(self._values)
        whole = collected([*(self._factors[edge] for edge in graph.edge_ids.tolist()), anchor(graph.initial[0])])
        outcome = run(self._method, whole, start, self._max_iterations, initial=initial, tolerance=_ON_THE_WAY)
        self._graph, self._values = graph, initial if outcome.values is None else outcome.values
        return outcome
