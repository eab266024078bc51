"""Graduated non-convexity: truncated least squares on the loops; odometry and registration edges are known inliers.

Yang et al., "Graduated Non-Convexity for Robust Spatial Perception" (2020), with one optimiser step per round, quantised
weights (so that noise models are shared), and without the loops of weight zero.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import Any

import gtsam
import numpy as np
from numpy.typing import NDArray

from hybridmap.backends.base import Outcome, SolveStatus
from hybridmap.backends.driver import Driver, first_line
from hybridmap.backends.gtsam.batch import run
from hybridmap.backends.gtsam.covariance import expected_loops
from hybridmap.backends.gtsam.factors import NoiseModels, factor_graph, factors, noise_models, poses_of, values
from hybridmap.backends.gtsam.initial import best_start, trusted_start
from hybridmap.backends.gtsam.robust import WarmKernel, with_kernel
from hybridmap.backends.judging.clusters import bypassed, lone_loops, rejected_clusters
from hybridmap.backends.objective import (
    SLACK,
    gate_of,
    softened,
    squared_norms,
    truncated_cost,
    truncated_weights,
    unit_variance,
    weak_edges,
)
from hybridmap.config.backends import BackendsConfig
from hybridmap.errors import BackendError, counted
from hybridmap.geometry import Array
from hybridmap.graph.paths import extend
from hybridmap.graph.pose_graph import PoseGraph, prefix

CHUNK_NODES = 500
"""`grow`: nodes a chunk. Odometry drifts little over so many, and a large graph takes few chunks."""
MU_FACTOR = 4.0
"""Growth of the control parameter mu from round to round; Yang et al. have 1.4, and here each round is one step only."""
MAX_ROUNDS = 60
"""Most rounds: mu then has grown by more than any residual needs."""
_STEP = 0.5  # of a quantised weight's logarithm to the base 2
_PATIENT, _NEAR_FIRST = 1e-4, 3e-2  # least weight of a loop that takes part in a round
_ROUGHLY = 10.0  # of the bound, before the first iteration
_QUICK = (2, 12)  # iterations before each look: where loops agree few are needed, where they do not they are of no use
_MOSTLY, _ALMOST_ALL = 0.9, 0.97  # share of loops that least squares must agree with, on the way and in the end

_BENDABLE = ("least squares", "drive")  # attempts whose start false loops may have bent
_LAST_RESORT = "headings of all loops"  # begins with false loops too: only where those from dead reckoning reject most loops
_GIVES_UP = (RuntimeError, BackendError, np.linalg.LinAlgError)  # gtsam raises nothing more specific than the first

Whole = Callable[[PoseGraph, BackendsConfig, Array | None], Outcome]
"""Solves a whole graph; the poses (N, 3), if given, are those that a drive led to."""


@dataclass(frozen=True, slots=True)
class Truncated:
    """Result of a run of graduated non-convexity.

    Attributes:
        poses: (N, 3) poses, m and rad.
        kept: (L,) whether each loop is an inlier, in the graph's order.
        rounds: number of annealing steps and of iterations after them.
        bound: squared residual beyond which a loop was an outlier at the end.
        lack: what could not be done, in words; empty if all was done.
    """

    poses: Array
    kept: NDArray[np.bool_]
    rounds: int
    bound: float
    lack: str = ""


class _Problem:
    """The factors of one graph, made once; each round combines them with the current weights of the loops."""

    def __init__(self, graph: PoseGraph, config: BackendsConfig) -> None:
        self.graph = graph
        self.loops = np.flatnonzero(graph.is_loop)
        self._models = noise_models(config.robust)
        self._known = factor_graph(graph.with_edges(~graph.is_loop), self._models)
        self._loop_factors = factors(graph.with_edges(self.loops), self._models)

    def squared(self, poses: Array) -> Array:
        """Squared residual of each loop."""
        return squared_norms(self.graph, poses)[self.loops]

    def weighted(self, weights: Array, negligible: float = 0.0) -> Any:
        """Factor graph with each loop's information multiplied by its weight; loops below `negligible` are left out."""
        out = gtsam.NonlinearFactorGraph(self._known)
        with np.errstate(divide="ignore"):
            quantised = np.where(weights < negligible, 0.0, 2.0 ** (np.round(np.log2(weights) / _STEP) * _STEP))
        for i, weight in enumerate(quantised.tolist()):
            if weight == 1.0:
                out.push_back(self._loop_factors[i])
            elif weight > 0.0:
                edge = self.loops[i]
                model = self._models(self.graph.information[edge] * weight)
                ends = int(self.graph.sources[edge]), int(self.graph.targets[edge])
                out.push_back(gtsam.BetweenFactorPose2(*ends, gtsam.Pose2(*self.graph.deltas[edge]), model))
        return out


def graduate(graph: PoseGraph, start: Array, config: BackendsConfig, negligible: float) -> Truncated:
    """Anneal from a nearly convex to the truncated cost, one optimiser step per round; then solve until the inliers are stable.

    Args:
        graph: a graph that odometry and registration edges connect.
        start: (N, 3) initial poses.
        config: settings of the outlier test and the largest number of iterations of each full solve at the end.
        negligible: loops of smaller weight are left out of a round. A small limit uses far loops from the first round; a
            larger one begins with loops that nearly agree. Neither is better on every graph.
    """
    problem = _Problem(graph, config)
    bound, poses = gate_of(config), start
    squared = problem.squared(poses)
    largest = float(squared.max(initial=0.0))
    mu = bound / (2.0 * largest - bound) if largest > bound else np.inf
    rounds, current = 0, values(start)
    while np.isfinite(mu) and rounds < MAX_ROUNDS:
        weights = truncated_weights(squared, mu, bound)
        poses, current = _step(problem.weighted(weights, negligible), poses, current)
        squared = problem.squared(poses)
        rounds += 1
        if mu > 1.0 and np.all((weights < negligible) | (weights > 0.9)):
            break
        mu *= MU_FACTOR
    settled = _settle(problem, poses, bound, config.max_iterations)
    honest = min(1.0, SLACK * _variance(graph, settled, config)) * bound
    if honest < bound:
        settled = _settle(problem, settled.poses, honest, config.max_iterations)
    return replace(settled, rounds=rounds + settled.rounds)


def trusting(graph: PoseGraph, config: BackendsConfig) -> Truncated | None:
    """Least squares with all loops, then with those that are no outliers; None if too many loops are outliers.

    False loops may bend the map so that nearly all loops fit at first. So those that fit in the end are counted as well.
    """
    bound = gate_of(config)
    poses, rounds = best_start(graph, graph.initial), 0
    if _share(squared_norms(graph, poses)[graph.is_loop] <= _ROUGHLY * bound) < _MOSTLY:
        return None
    whole = factor_graph(graph, NoiseModels())
    for limit, least in zip(_QUICK, (_MOSTLY, _ALMOST_ALL), strict=True):
        outcome = run("lm", whole, poses, min(limit, config.max_iterations), rescue=limit == _QUICK[-1])
        poses, rounds = outcome.poses, rounds + outcome.iterations
        kept = squared_norms(graph, poses)[graph.is_loop] <= bound
        if _share(kept) < least:
            return None
    found = Truncated(poses, kept, rounds, bound)
    if kept.all() and config.robust.odometry == "none":
        return found
    settled = _settle(_Problem(graph, config), poses, bound, config.max_iterations)
    return settled if _share(settled.kept) >= _ALMOST_ALL else None


def _share(true: NDArray[np.bool_]) -> float:
    return float(true.mean()) if len(true) else 1.0


def _variance(graph: PoseGraph, result: Truncated, config: BackendsConfig) -> float:
    squared = squared_norms(graph, result.poses)
    return unit_variance(graph, squared, (*_rejected(graph, result), *weak_edges(graph, squared, config.robust)))


def _rejected(graph: PoseGraph, result: Truncated) -> tuple[int, ...]:
    return tuple(graph.edge_ids[graph.is_loop][~result.kept].tolist())


def on_probation(graph: PoseGraph, result: Truncated, config: BackendsConfig) -> Truncated:
    """Remove accepted loops without an accepted neighbour; then re-admit those consistent with the map made without them.

    If a graph overstates its noise, false loops may happen to be consistent. Each removed loop is tested by its innovation
    under the covariance of loop and map, scaled by the unit variance of the map without the loop. Loops without which the
    map would fall into parts stay.

    Raises:
        BackendError: the map is singular without the loops.
    """
    loops = np.flatnonzero(graph.is_loop)
    used = np.setdiff1d(np.arange(graph.n_edges), loops[~result.kept])
    lone = used[lone_loops(graph.with_edges(used))]
    if len(lone) == 0:
        return result
    without = result.kept & ~np.isin(loops, lone)
    problem = _Problem(graph, config)
    outcome = run("lm", problem.weighted(without.astype(np.float64)), result.poses, config.max_iterations)
    bare = replace(result, poses=outcome.poses, kept=without, rounds=result.rounds + outcome.iterations)
    variance = _variance(graph, bare, config)
    others = softened(graph.with_edges(used), bare.poses, config.robust)
    expected = expected_loops(others, bare.poses, np.flatnonzero(np.isin(others.edge_ids, graph.edge_ids[lone])), variance)
    kept = without | np.isin(loops, lone[expected])
    if not np.any(kept != without):
        return bare
    outcome = run("lm", problem.weighted(kept.astype(np.float64)), bare.poses, config.max_iterations)
    return replace(bare, poses=outcome.poses, kept=kept, rounds=bare.rounds + outcome.iterations)


def _from_kernels(graph: PoseGraph, config: BackendsConfig) -> Truncated:
    """Start from the map of Cauchy's kernel on loops and the configured one on odometry; solve until the inliers are stable."""
    bound = gate_of(config)
    outcome = with_kernel("cauchy", graph, trusted_start(graph, graph.initial, bound), config)
    settled = _settle(_Problem(graph, config), outcome.poses, bound, config.max_iterations)
    return replace(settled, rounds=outcome.iterations + settled.rounds)


def _softened_last(graph: PoseGraph, config: BackendsConfig) -> Truncated:
    """Choose the loops on odometry without a kernel, which false loops cannot tear; then solve with the kernel."""
    stiff = config.model_copy(update={"robust": config.robust.model_copy(update={"odometry": "none"})})
    result = grow(graph, stiff, _PATIENT)
    settled = _settle(_Problem(graph, config), result.poses, result.bound, config.max_iterations)
    return replace(settled, rounds=result.rounds + settled.rounds)


def _settle(problem: _Problem, poses: Array, bound: float, max_iterations: int) -> Truncated:
    """Solve with the inliers a few times, until the set of inliers is stable."""
    keep: NDArray[np.bool_] = problem.squared(poses) <= bound
    rounds = 0
    for _ in range(8):
        outcome = run("lm", problem.weighted(keep.astype(np.float64)), poses, max_iterations)
        poses, rounds = outcome.poses, rounds + outcome.iterations
        again = problem.squared(poses) <= bound
        if np.array_equal(again, keep):
            break
        keep = again
    return Truncated(poses, keep, rounds, bound)


def _step(factor_graph: Any, poses: Array, current: Any) -> tuple[Array, Any]:
    """One damped step from given poses, in both forms; returns both forms of the new poses."""
    optimizer = gtsam.LevenbergMarquardtOptimizer(factor_graph, current, gtsam.LevenbergMarquardtParams())
    optimizer.iterate()
    moved = poses_of(optimizer.values())
    return (moved, optimizer.values()) if np.isfinite(moved).all() else (poses, current)


def grow(graph: PoseGraph, config: BackendsConfig, negligible: float) -> Truncated:
    """Solve the first part of the drive, then ever longer parts up to the whole graph, by truncated least squares.

    The new nodes of a part begin where odometry leads from the last solution. Rejected loops are considered again in every
    part. Loops of a weight below `negligible` are left out of an annealing round.
    """
    poses, rounds = graph.initial[:1], 0
    for end in range(CHUNK_NODES, graph.n_nodes, CHUNK_NODES):
        part = prefix(graph, end)
        result = graduate(part, extend(part, poses), config, negligible)
        poses, rounds = result.poses, rounds + result.rounds
    last = graduate(graph, extend(graph, poses), config, negligible)
    return replace(last, rounds=rounds + last.rounds)


def create(name: str, config: BackendsConfig, whole: Whole | None = None) -> Driver:
    """A back-end with Cauchy's kernel on loops while driving, and the solver `whole` (None: `best`) for a whole graph."""
    solve = whole or best

    def anew(graph: PoseGraph, initial: Array) -> Outcome:
        del initial  # every attempt has a start of its own
        return solve(graph, config, None)

    def onward(graph: PoseGraph, driven: Array) -> Outcome:
        return solve(graph, config, driven)

    def given(graph: PoseGraph, start: Array) -> Outcome:
        found = graduate(graph, start, config, _PATIENT)
        found = _without_lone(graph, found, config) if found.kept.all() else _tested(graph, found, config)
        return _cheapest(graph, {"given": found}, config)

    warm = WarmKernel("cauchy", config)
    return Driver(name, config, anew, follow=warm, onward=onward, given=given, softens=True, remembers=warm)


def best(graph: PoseGraph, config: BackendsConfig, driven: Array | None) -> Outcome:
    """Run the configured attempts until a result convinces; if none does, take the one with the lowest truncated cost.

    A result convinces if no rejected loops agree with each other, or if two different attempts lead to it and it keeps more
    than half of the loops: two attempts from dead reckoning may both be lost. With a kernel on odometry, which false loops may
    tear, every loop must fit as well. Least squares with all loops, and the map of the drive `driven` (N, 3), may be bent by
    false loops: if a run from either rejects loops, it only competes with the next convincing result. An attempt that fails is
    left out; if all fail, the result is that of least squares with all loops, and the status says so.
    """
    results, unconfirmed = dict[str, Truncated](), dict[str, Truncated]()
    failures: list[str] = []
    tearable = config.robust.odometry != "none"
    for name, attempt in attempts(graph, config, driven).items():
        if name == _LAST_RESORT and any(_share(result.kept) > 0.5 for result in results.values()):
            continue
        try:
            found = attempt()
        except _GIVES_UP as error:
            failures.append(f"{name}: {first_line(error)}")
            continue
        if found is None or (name == _LAST_RESORT and _variance(graph, found, config) > 1.0):  # it tears the chain
            continue
        found = _without_lone(graph, found, config) if found.kept.all() else _tested(graph, found, config)
        sides = results.values() if name == "grown" and _share(found.kept) > 0.5 else ()
        agreed = any(np.array_equal(found.kept, other.kept) for other in sides)
        if tearable:
            convincing = found.kept.all() and unit_variance(graph, squared_norms(graph, found.poses)) <= SLACK
        else:
            convincing = agreed or not rejected_clusters(graph, found.poses, _rejected(graph, found), found.bound)
        if convincing and name in _BENDABLE and not found.kept.all():
            unconfirmed[name] = found
        elif convincing:
            return _cheapest(graph, {**unconfirmed, name: found}, config)
        results[name] = found
    return _cheapest(graph, results, config) if results else _least_squares(graph, config, "; ".join(failures))


def _tested(graph: PoseGraph, found: Truncated, config: BackendsConfig) -> Truncated:
    """The result after `on_probation`, or as it was where that cannot go on."""
    try:
        return on_probation(graph, found, config)
    except _GIVES_UP as error:
        return replace(found, lack=f"lone loops were not tested ({first_line(error)})")


def _without_lone(graph: PoseGraph, found: Truncated, config: BackendsConfig) -> Truncated:
    """A result that keeps all loops, or the one without lone loops that bend it, if that is cheaper and other loops contradict.

    Where a file overstates its noise, one false loop bends the map until all fit: the costs are compared at an honest bound.
    """
    rival = _tested(graph, found, config)
    if rival.kept.all() or not bypassed(graph, np.flatnonzero(graph.is_loop)[~rival.kept]).all():
        return found
    bound = found.bound * min(1.0, SLACK * _variance(graph, rival, config))
    bent, straight = (truncated_cost(graph, one.poses, bound, config.robust) for one in (found, rival))
    return replace(rival, bound=bound) if straight < bent else found


def _least_squares(graph: PoseGraph, config: BackendsConfig, why: str) -> Outcome:
    """Least squares with all loops, where no attempt came to an end."""
    start = best_start(graph, graph.initial)
    outcome = run("lm", factor_graph(graph, NoiseModels()), start, config.max_iterations)
    message = f"gnc could not go on ({why}); least squares with all loops instead; {outcome.message}"
    weights = dict.fromkeys(graph.edge_ids[graph.is_loop].tolist(), 1.0)
    status = SolveStatus.FELL_BACK if outcome.status.has_map else outcome.status
    return replace(outcome, status=status, message=message, weights=weights)


def attempts(graph: PoseGraph, config: BackendsConfig, driven: Array | None) -> dict[str, Callable[[], Truncated | None]]:
    """Name -> function that makes the attempt, or returns None if it gives up, in the order in which they are tried.

    Args:
        graph: the graph.
        config: settings of the back-end.
        driven: (N, 3) poses reached while driving; None if there are none.
    """

    def whole(negligible: float) -> Truncated:
        return graduate(graph, trusted_start(graph, graph.initial, gate_of(config)), config, negligible)

    ways: dict[str, Callable[[], Truncated | None]] = {}
    if config.gnc.start == "batch":
        return {"batch": lambda: whole(_PATIENT)}
    if config.gnc.start == "auto":
        ways["least squares"] = lambda: trusting(graph, config)
    if driven is not None:
        ways["drive"] = lambda: graduate(graph, driven, config, _PATIENT)
    if config.gnc.start == "auto":
        ways["batch, near loops first"] = lambda: whole(_NEAR_FIRST)
    ways["grown"] = lambda: grow(graph, config, _PATIENT)
    if config.gnc.start == "auto":
        ways["grown, near loops first"] = lambda: grow(graph, config, _NEAR_FIRST)
        ways[_LAST_RESORT] = lambda: graduate(graph, best_start(graph, graph.initial), config, _PATIENT)
    if config.gnc.start == "auto" and config.robust.odometry != "none":
        ways["kernels"] = lambda: _from_kernels(graph, config)
        ways["grown on stiff odometry"] = lambda: _softened_last(graph, config)
    return ways


def _cheapest(graph: PoseGraph, results: dict[str, Truncated], config: BackendsConfig) -> Outcome:
    """The result with the lowest truncated cost, at the tightest final bound of all results.

    With a wider bound, graphs that overstate their noise would prefer a false loop that happens to be consistent.
    """
    bound = min(result.bound for result in results.values())
    costs = {name: truncated_cost(graph, result.poses, bound, config.robust) for name, result in results.items()}
    start = min(costs, key=costs.__getitem__)
    result = results[start]
    loops = graph.edge_ids[graph.is_loop].tolist()
    weights = dict(zip(loops, result.kept.astype(np.float64).tolist(), strict=True))
    rejected = tuple(edge for edge, weight in weights.items() if weight == 0.0)
    variance = _variance(graph, result, config)
    message = f"gnc: {len(rejected)} of {counted(len(loops), 'loop')} rejected (start: {start}; unit variance {variance:.3g})"
    if result.lack:
        return Outcome(result.poses, SolveStatus.FELL_BACK, f"{message}; {result.lack}", result.rounds, weights, rejected)
    return Outcome(result.poses, SolveStatus.CONVERGED, message, result.rounds, weights, rejected)
