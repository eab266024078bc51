"""Batch optimisers of GTSAM behind one door: Levenberg-Marquardt, Gauss-Newton, Dogleg."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import gtsam
import numpy as np

from hybridmap.backends.base import SolveStatus
from hybridmap.backends.factors import NoiseModels, factor_graph, poses_of, values
from hybridmap.backends.following import GraphBackend, Outcome
from hybridmap.backends.initial import best_start
from hybridmap.backends.objective import chi2
from hybridmap.geometry import Array
from hybridmap.graph.pose_graph import PoseGraph

_MAKE: dict[str, tuple[Callable[[], Any], Callable[..., Any]]] = {
    "lm": (gtsam.LevenbergMarquardtParams, gtsam.LevenbergMarquardtOptimizer),
    "gn": (gtsam.GaussNewtonParams, gtsam.GaussNewtonOptimizer),
    "dogleg": (gtsam.DoglegParams, gtsam.DoglegOptimizer),
}


def run(method: str, factor_graph_: Any, start: Array, max_iterations: int) -> Outcome:
    """One optimiser run; exceptions become the status `failed`, standing still on a slope `stalled`.

    Args:
        method: `lm`, `gn` or `dogleg`.
        factor_graph_: a `gtsam.NonlinearFactorGraph` over keys 0..N-1.
        start: (N, 3) poses.
        max_iterations: the limit.
    """
    make_params, make_optimizer = _MAKE[method]
    params = make_params()
    params.setMaxIterations(max_iterations)
    try:
        optimizer = make_optimizer(factor_graph_, values(start), params)
        poses = poses_of(optimizer.optimize())
    except RuntimeError as error:
        text = str(error).strip().splitlines()
        return Outcome(start, SolveStatus.FAILED, f"{method}: {text[0] if text else type(error).__name__}", 0)
    iterations = int(optimizer.iterations())
    if not np.isfinite(poses).all():
        return Outcome(start, SolveStatus.DIVERGED, f"{method}: poses were not finite", iterations)
    if iterations >= max_iterations:
        return Outcome(poses, SolveStatus.MAX_ITERATIONS, f"{method}: stopped at {iterations} iterations", iterations)
    if method == "lm" and optimizer.lambda_() > 1e4:
        return Outcome(poses, SolveStatus.STALLED, f"lm: no step lowered the cost after {iterations} iterations", iterations)
    return Outcome(poses, SolveStatus.CONVERGED, f"{method}: converged", iterations)


class BatchBackend(GraphBackend):
    """`gtsam-lm` (with a start of its own and Dogleg to fall back on), `gtsam-gn`, `gtsam-dogleg`."""

    def _optimise(self, graph: PoseGraph, start: Array) -> Outcome:
        method = self._name.removeprefix("gtsam-")
        whole = factor_graph(graph, NoiseModels())
        outcome = run(method, whole, start, self._config.max_iterations)
        if method == "lm" and outcome.status is not SolveStatus.CONVERGED:
            other = run("dogleg", whole, outcome.poses, self._config.max_iterations)
            if other.status is SolveStatus.CONVERGED:
                return other
        return outcome

    def _solve_whole(self, graph: PoseGraph) -> Outcome:
        outcome = self._optimise(graph, best_start(graph))
        if chi2(graph, outcome.poses) > chi2(graph, graph.initial):
            return Outcome(graph.initial, SolveStatus.DIVERGED, "ended worse than it began; kept the start", outcome.iterations)
        return outcome
