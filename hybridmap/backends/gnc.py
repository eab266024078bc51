"""Graduated non-convexity on the loop edges: truncated least squares, odometry and registration edges known inliers.

Yang et al., "Graduated Non-Convexity for Robust Spatial Perception" (2020), with one optimiser step a round, weights
quantised so that noise models are shared, and loops of weight zero left out of the graph.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import gtsam
import numpy as np
from numpy.typing import NDArray
from scipy.stats import chi2 as chi2_law

from hybridmap.backends.base import Solution, SolveStatus
from hybridmap.backends.batch import run
from hybridmap.backends.factors import NoiseModels, anchor, factors, poses_of, values
from hybridmap.backends.following import GraphBackend, Outcome, prefix
from hybridmap.backends.objective import squared_norms
from hybridmap.backends.robust import cauchy
from hybridmap.config.backends import GncConfig
from hybridmap.geometry import Array
from hybridmap.graph.connectivity import extend
from hybridmap.graph.pose_graph import PoseGraph

_LEVELS = 16  # of a quantised weight


@dataclass(frozen=True, slots=True)
class _Result:
    """Poses, weight of each loop (L,), rounds, and the truncated cost that the method minimises."""

    poses: Array
    weights: Array
    rounds: int
    cost: float


class _Problem:
    """One graph's factors, made once; a round puts them together with the loops' current weights."""

    def __init__(self, graph: PoseGraph, bound: float) -> None:
        self.graph, self.bound = graph, bound
        self.loops = np.flatnonzero(graph.is_loop)
        whole = factors(graph, NoiseModels())
        self._known = gtsam.NonlinearFactorGraph()
        for edge in np.flatnonzero(~graph.is_loop).tolist():
            self._known.push_back(whole[edge])
        self._known.push_back(anchor(graph.initial[0]))
        self._loop_factors = [whole[edge] for edge in self.loops.tolist()]
        self._models = NoiseModels()

    def squared(self, poses: Array) -> Array:
        """Squared residual of each loop."""
        return squared_norms(self.graph, poses)[self.loops]

    def cost(self, poses: Array) -> float:
        """Quadratic on known inliers, truncated at the bound on loops."""
        every = squared_norms(self.graph, poses)
        every[self.loops] = np.minimum(every[self.loops], self.bound)
        return float(every.sum())

    def weighted(self, weights: Array) -> Any:
        """Factor graph in which each loop's information is multiplied by its weight."""
        out = gtsam.NonlinearFactorGraph(self._known)
        levels = np.round(weights * _LEVELS).astype(int)
        for i, level in enumerate(levels.tolist()):
            if level == _LEVELS:
                out.push_back(self._loop_factors[i])
            elif level > 0:
                edge = self.loops[i]
                model = self._models(self.graph.information[edge] * (level / _LEVELS), loop=False)
                ends = int(self.graph.sources[edge]), int(self.graph.targets[edge])
                out.push_back(gtsam.BetweenFactorPose2(*ends, gtsam.Pose2(*self.graph.deltas[edge]), model))
        return out


def truncated_weights(squared: Array, mu: float, bound: float) -> Array:
    """Weights of the truncated-least-squares surrogate at control parameter mu (Yang et al., eq. 14)."""
    between_ = np.sqrt(bound * mu * (mu + 1.0) / np.maximum(squared, 1e-300)) - mu
    inside, outside = squared <= bound * mu / (mu + 1.0), squared >= bound * (mu + 1.0) / mu
    return np.asarray(np.where(inside, 1.0, np.where(outside, 0.0, np.clip(between_, 0.0, 1.0))))


def graduate(graph: PoseGraph, start: Array, config: GncConfig, max_iterations: int) -> _Result:
    """Anneal from nearly convex to truncated, one optimiser step a round; then settle on the binary set."""
    problem = _Problem(graph, float(chi2_law.ppf(config.quantile, df=3)))
    bound, poses = problem.bound, start
    squared = problem.squared(poses)
    largest = float(squared.max(initial=0.0))
    mu = bound / (2.0 * largest - bound) if 2.0 * largest > 2.0 * bound else np.inf
    rounds = 0
    while np.isfinite(mu) and rounds < config.max_rounds:
        weights = truncated_weights(squared, mu, bound)
        poses = _step(problem.weighted(weights), poses)
        squared = problem.squared(poses)
        rounds += 1
        if mu > 1e3 or np.all((weights < 0.5 / _LEVELS) | (weights > 1.0 - 0.5 / _LEVELS)):
            break
        mu *= config.mu_factor
    return _settle(problem, poses, rounds, max_iterations)


def _settle(problem: _Problem, poses: Array, rounds: int, max_iterations: int) -> _Result:
    """A few full solves with the set of inliers, until it no longer changes."""
    keep: NDArray[np.bool_] = problem.squared(poses) <= problem.bound
    for _ in range(8):
        outcome = run("lm", problem.weighted(keep.astype(np.float64)), poses, max_iterations)
        poses, rounds = outcome.poses, rounds + outcome.iterations
        again = problem.squared(poses) <= problem.bound
        if np.array_equal(again, keep):
            break
        keep = again
    return _Result(poses, keep.astype(np.float64), rounds, problem.cost(poses))


def _step(factor_graph: Any, poses: Array) -> Array:
    """One damped step from given poses."""
    params = gtsam.LevenbergMarquardtParams()
    optimizer = gtsam.LevenbergMarquardtOptimizer(factor_graph, values(poses), params)
    optimizer.iterate()
    moved = poses_of(optimizer.values())
    return moved if np.isfinite(moved).all() else poses


def grow(graph: PoseGraph, config: GncConfig, max_iterations: int) -> _Result:
    """Solve the graph chunk by chunk, extending by odometry; loops rejected before compete again in every chunk."""
    poses = graph.initial[:1]
    result = None
    rounds = 0
    for end in [*range(config.chunk_nodes, graph.n_nodes, config.chunk_nodes), graph.n_nodes]:
        part = prefix(graph, end)
        result = graduate(part, extend(part, poses), config, max_iterations)
        poses, rounds = result.poses, rounds + result.rounds
    assert result is not None
    return _Result(result.poses, result.weights, rounds, result.cost)


class GncBackend(GraphBackend):
    """`gtsam-gnc`: Cauchy on the loops while driving, graduated non-convexity on the whole graph at the end."""

    def _optimise(self, graph: PoseGraph, start: Array) -> Outcome:
        return cauchy(graph, start, self._config)

    def finish(self, graph: PoseGraph) -> Solution:
        """See `Backend.finish`: as `solve`, with the map at the end of the drive as one more start."""
        self.update(graph)
        return self._timed(graph, lambda: self._best(graph, self._poses))

    def _solve_whole(self, graph: PoseGraph) -> Outcome:
        return self._best(graph, None)

    def _best(self, graph: PoseGraph, driven: Array | None) -> Outcome:
        """Run the configured starts; the lowest truncated cost wins, and one that keeps every loop ends the search."""
        config, limit = self._config.gnc, self._config.max_iterations
        starts: dict[str, Callable[[], _Result]] = {}
        if driven is not None:
            starts["driven"] = lambda: graduate(graph, driven, config, limit)
        starts["cauchy"] = lambda: graduate(graph, cauchy(graph, graph.initial, self._config).poses, config, limit)
        starts["batch"] = lambda: graduate(graph, graph.initial, config, limit)
        starts["grow"] = lambda: grow(graph, config, limit)
        wanted = starts if config.start == "auto" else {config.start: starts[config.start]}
        best, best_name = None, ""
        for name, attempt in wanted.items():
            result = attempt()
            if best is None or result.cost < best.cost:
                best, best_name = result, name
            if np.all(best.weights > 0.5):
                break
        assert best is not None
        loops = graph.edge_ids[graph.is_loop].tolist()
        weights = dict(zip(loops, best.weights.tolist(), strict=True))
        lost = int(np.sum(best.weights < 0.5))
        message = f"gnc: {lost} of {len(loops)} loops rejected (start: {best_name})"
        return Outcome(best.poses, SolveStatus.CONVERGED, message, best.rounds, weights)
