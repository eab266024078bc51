"""Relaxation link by link, in place, with headings: RatSLAM's rule, plain, robust, and as a start for least squares.

Relaxation needs no good start, but thousands of sweeps to converge fully. Least squares needs a good start and a few
iterations. `relaxation-gtsam-lm` combines them: relaxation while driving, least squares from its map at the end.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from functools import partial

import numpy as np
from numpy.typing import NDArray

from hybridmap.backends.base import Outcome, Solver, SolveStatus
from hybridmap.backends.driver import Driver, Works
from hybridmap.backends.gtsam.initial import best_start
from hybridmap.backends.objective import chi2, gate_of, truncated_cost
from hybridmap.compiled import compiled
from hybridmap.config.backends import BackendsConfig, RelaxationConfig
from hybridmap.errors import counted
from hybridmap.geometry import Array, between, compose, wrap_angle
from hybridmap.graph.edges import EdgeKind
from hybridmap.graph.pose_graph import PoseGraph

TOLERANCE_M = 1e-6
"""A sweep that moves no node by more (m; 1 rad counts as 1 m) ends the relaxation: far below the noise of any edge."""
ROBUST_SCALE_M, ROBUST_SCALE_RAD = 0.3, 0.1
"""`relaxation-robust`: errors of position and heading at which a loop's correction is a quarter of the plain one. A
false loop that is off by a metre then pulls with less than a hundredth."""
ROBUST_START = 8.0
"""Factor on both scales at the first sweep of a call, from which they shrink to themselves: loops of 2 m still pull."""

_LINKS = "int64[::1], int64[::1], float64[:, ::1], float64[:, ::1], boolean[::1]"
_RULE = "float64, float64, int64, float64, float64, float64, float64"
_SIGNATURE = f"Tuple((int64, boolean))(float64[:, ::1], float64[:, ::1], {_LINKS}, {_RULE})"

_TURN = 2.0 * np.pi
_PER_RAD = 1.0 / _TURN


@dataclass(frozen=True, slots=True)
class Relaxed:
    """Result of a run of sweeps.

    Attributes:
        poses: (N, 3) poses, m and rad, yaw wrapped; not finite if the run grew without bound.
        sweeps: number of sweeps.
        settled: whether the last sweep moved nothing by more than the tolerance.
    """

    poses: Array
    sweeps: int
    settled: bool


def relax_links(
    graph: PoseGraph,
    start: Array,
    sweeps: int,
    config: RelaxationConfig,
    *,
    robust: bool = False,
    shares: Array | None = None,
    settles: bool = True,
) -> Relaxed:
    """Sweep over the links, in the order of source node and then of age, as OpenRatSLAM does.

    Each link moves both of its ends by theta times its error: x and y in the world frame, and yaw wrapped to +-pi.

    Args:
        graph: its edges are the links; their information is not used.
        start: (N, 3) initial poses, m and rad.
        sweeps: most sweeps. The run ends earlier if a sweep moves no coordinate by more than `TOLERANCE_M`, or diverges.
        config: theta and its decay from sweep to sweep.
        robust: multiply theta by the Geman-McClure weight 1 / (1 + r^2)^2 of a loop's error, r^2 being the sum of its squared
            components in units of the scales. The scales shrink geometrically from `ROBUST_START` times their value to
            their value during the first half of the sweeps; in that half the tolerance does not end the run.
        shares: (E, 2) factors on theta for the position and the heading of each edge; None: one.
        settles: end the run where a sweep moves nothing by more than the tolerance.
    """
    order = np.argsort(graph.sources, kind="stable")
    poses = np.array(start, dtype=np.float64, order="C")
    done, settled = _sweep(
        poses,
        np.empty_like(poses),
        graph.sources[order],
        graph.targets[order],
        np.ascontiguousarray(graph.deltas[order]),
        np.ones((graph.n_edges, 2)) if shares is None else np.ascontiguousarray(shares[order]),
        graph.is_loop[order] & robust,
        config.theta,
        config.theta_decay,
        sweeps,
        TOLERANCE_M if settles else -1.0,
        ROBUST_SCALE_M,
        ROBUST_SCALE_RAD,
        ROBUST_START if robust else 1.0,
    )
    poses[:, 2] = wrap_angle(poses[:, 2])
    return Relaxed(poses, done, settled)


@compiled("float64(float64[:, ::1], float64[:, ::1])")
def _most_moved(poses: Array, before: Array) -> float:
    """Largest change of a coordinate, m or rad; infinite if one is infinite or no number."""
    most = 0.0
    for node in range(len(poses)):
        for k in range(3):
            moved = abs(poses[node, k] - before[node, k])
            if not moved < np.inf:
                return np.inf
            most = max(most, moved)
    return most


@compiled(_SIGNATURE)
def _sweep(
    poses: Array,
    before: Array,
    sources: NDArray[np.int64],
    targets: NDArray[np.int64],
    deltas: Array,
    shares: Array,
    weighed: NDArray[np.bool_],
    theta: float,
    theta_decay: float,
    sweeps: int,
    tolerance: float,
    scale_m: float,
    scale_rad: float,
    start: float,
) -> tuple[int, bool]:
    """Sweep over `poses` in place, with a buffer for a copy; returns the number of sweeps and whether they converged.

    Element by element, since an operation on a whole array takes seconds to compile.
    """
    for done in range(1, sweeps + 1):
        scale = start ** max(0.0, 1.0 - 2.0 * done / sweeps)
        per_m, per_rad = 1.0 / (scale * scale_m), 1.0 / (scale * scale_rad)
        for node in range(len(poses)):
            for k in range(3):
                before[node, k] = poses[node, k]
        for link in range(len(sources)):
            source, target = sources[link], targets[link]
            yaw = poses[source, 2]
            cos, sin = np.cos(yaw), np.sin(yaw)
            dx = poses[target, 0] - poses[source, 0] - (cos * deltas[link, 0] - sin * deltas[link, 1])
            dy = poses[target, 1] - poses[source, 1] - (sin * deltas[link, 0] + cos * deltas[link, 1])
            turn = poses[target, 2] - yaw - deltas[link, 2]
            turn -= _TURN * np.rint(turn * _PER_RAD)
            rate = theta
            if weighed[link]:
                x, y, angle = dx * per_m, dy * per_m, turn * per_rad
                falloff = 1.0 + x * x + y * y + angle * angle
                rate /= falloff * falloff
            shift, twist = rate * shares[link, 0], rate * shares[link, 1]
            poses[source, 0] += shift * dx
            poses[source, 1] += shift * dy
            poses[source, 2] += twist * turn
            poses[target, 0] -= shift * dx
            poses[target, 1] -= shift * dy
            poses[target, 2] -= twist * turn
        moved = _most_moved(poses, before)
        settled = scale == 1.0 and moved <= tolerance
        if settled or not moved < np.inf:
            return done, settled
        theta *= theta_decay
    return sweeps, False


_REJECTED = 0.25  # weight of a loop whose residual is the scale itself
_TOLERANCE = 1e-9  # relative decrease of the cost at which least squares is done: the start must not show in the result

Rule = Callable[[PoseGraph, Array, int], Outcome]
"""At most so many sweeps over a graph that has edges, from poses (N, 3)."""


def swept(rule: Rule, sweeps: int) -> Solver:
    """Make a solver that runs up to this many sweeps of a relaxation rule; poses that grow without bound are refused."""

    def solve(graph: PoseGraph, start: Array) -> Outcome:
        if graph.n_edges == 0:
            return Outcome(start, SolveStatus.CONVERGED, "nothing to relax", 0)
        with np.errstate(over="ignore", invalid="ignore"):
            outcome = rule(graph, start, sweeps)
        if np.isfinite(outcome.poses).all():
            return outcome
        return Outcome(start, SolveStatus.DIVERGED, "poses were not finite; kept those before", outcome.iterations)

    return solve


def relaxing(name: str, config: BackendsConfig, rule: Rule) -> Driver:
    """A back-end that runs sweeps of `rule` whenever the graph grows; the end of the drive is one more such update."""
    follow = swept(rule, config.relaxation.sweeps_per_node)
    solve = swept(rule, config.relaxation.solve_sweeps)
    return Driver(name, config, solve, follow=follow, last=follow, works=Works.ON_GROWTH)


def plain(name: str, config: BackendsConfig) -> Driver:
    """A back-end with RatSLAM's rule: every edge moves both of its nodes by theta times its error."""
    return relaxing(name, config, partial(_relaxed, config.relaxation))


def robust(name: str, config: BackendsConfig) -> Driver:
    """A back-end with RatSLAM's rule and each loop's correction multiplied by a Geman-McClure weight of its error.

    The scale of the weight shrinks geometrically to 1 during a call. For a whole graph that takes a quarter of the sweeps; the
    others use the plain rule on the inlier loops, which are chosen once more in between. Where loops were rejected, the graph
    is also relaxed with all loops at first, and the better map is kept (`_in_rounds`).
    At the end of a drive, the whole graph is solved from the map of the drive, and the better of the two maps is kept.
    """
    rules = config.relaxation
    solve = swept(partial(_in_rounds, rules), rules.solve_sweeps)
    given = swept(partial(_in_rounds, rules, anywhere=False), rules.solve_sweeps)

    def follow(graph: PoseGraph, start: Array, sweeps: int) -> Outcome:
        return _judged(graph, relax_links(graph, start, sweeps, rules, robust=True))

    def onward(graph: PoseGraph, driven: Array) -> Outcome:
        settled, bound = solve(graph, driven), gate_of(config)
        if truncated_cost(graph, settled.poses, bound) <= truncated_cost(graph, driven, bound):
            return settled
        kept = _judged(graph, Relaxed(driven, settled.iterations, settled=False))
        return replace(kept, message=f"kept the map of the drive; {kept.message}")

    following = swept(follow, rules.sweeps_per_node)
    return Driver(name, config, solve, follow=following, onward=onward, given=given, works=Works.ON_GROWTH)


def then_least_squares(name: str, config: BackendsConfig) -> Driver:
    """A back-end with RatSLAM's plain rule while driving, then Levenberg-Marquardt over all edges."""
    rule, rules = partial(_relaxed, config.relaxation), config.relaxation
    relax = swept(rule, rules.solve_sweeps)

    def solve(graph: PoseGraph, start: Array) -> Outcome:
        relaxed = relax(graph, start)
        if relaxed.status is SolveStatus.DIVERGED:
            return relaxed
        refined = _refined(graph, relaxed.poses, config, counted(relaxed.iterations, "sweep"))
        return replace(refined, iterations=relaxed.iterations + refined.iterations)

    def onward(graph: PoseGraph, driven: Array) -> Outcome:
        return _refined(graph, driven, config, "driven")

    return Driver(name, config, solve, follow=swept(rule, rules.sweeps_per_node), onward=onward, works=Works.ON_GROWTH)


def weights(graph: PoseGraph, poses: Array) -> Array:
    """The Geman-McClure weight (E,) of each edge's error at poses (N, 3), as if every edge were a loop, at the final scales."""
    return np.asarray(1.0 / (1.0 + _squared(graph, poses)) ** 2)


def _squared(graph: PoseGraph, poses: Array) -> Array:
    """Squared error (E,) of each edge at poses (N, 3), in units of the scales."""
    predicted = compose(poses[graph.sources], graph.deltas)
    errors = between(predicted, poses[graph.targets])
    return np.asarray(np.sum(errors[:, :2] ** 2, axis=1) / ROBUST_SCALE_M**2 + errors[:, 2] ** 2 / ROBUST_SCALE_RAD**2)


def _relaxed(config: RelaxationConfig, graph: PoseGraph, start: Array, sweeps: int) -> Outcome:
    return outcome_of(relax_links(graph, start, sweeps, config))


def _in_rounds(config: RelaxationConfig, graph: PoseGraph, start: Array, sweeps: int, *, anywhere: bool = True) -> Outcome:
    """Relax with weighted loops; where that rejects any, also with all loops at first, and return the better map.

    A weight trusts the start more than the loops. After a long drift it rejects true ones, and so it may not have the last
    word. A map that keeps most loops is better than one that does not; else the one with the lower `_cost` is. False
    loops bend the map of all loops, which costs far more than to reject them. With all loops it begins at `best_start`, unless
    it may not begin `anywhere` but at `start`.
    """
    quarter = max(sweeps // 4, 1)
    weighted = _pruned(config, graph, relax_links(graph, start, min(sweeps, quarter), config, robust=True), sweeps, quarter)
    judged = _judged(graph, weighted)
    if not judged.rejected:
        return judged
    trusting = relax_links(graph, best_start(graph, start) if anywhere else start, max(sweeps - quarter, 1), config)
    other = _judged(graph, _pruned(config, graph, trusting, sweeps, quarter))
    if not np.isfinite(other.poses).all():
        return judged
    better = min((judged, other), key=lambda one: (_rejects_most(one), _cost(graph, one.poses)))
    return judged if better is judged else replace(other, message=f"{other.message} (start: all loops)")


def _pruned(config: RelaxationConfig, graph: PoseGraph, relaxed: Relaxed, sweeps: int, quarter: int) -> Relaxed:
    """Spend the rest of the sweeps on the plain rule and the inlier loops, which are chosen anew after each quarter."""
    relaxed = replace(relaxed, settled=False)
    while relaxed.sweeps < sweeps and not relaxed.settled:
        kept = ~(graph.is_loop & (weights(graph, relaxed.poses) < _REJECTED))
        part = min(quarter, sweeps - relaxed.sweeps)
        onward = relax_links(graph.with_edges(kept), relaxed.poses, part, config)
        relaxed = replace(onward, sweeps=relaxed.sweeps + onward.sweeps)
    return relaxed


def _rejects_most(outcome: Outcome) -> bool:
    return 2 * len(outcome.rejected) > len(outcome.weights)


def _cost(graph: PoseGraph, poses: Array) -> float:
    """Sum of the squared errors of the edges, in units of the scales, that of a loop truncated where it is rejected."""
    squared = _squared(graph, poses)
    return float(np.where(graph.is_loop, np.minimum(squared, 1.0), squared).sum())


def _judged(graph: PoseGraph, relaxed: Relaxed) -> Outcome:
    """The outcome with every loop's weight; loops with less than `_REJECTED` are rejected."""
    loops = graph.only(EdgeKind.LOOP)
    by_id = dict(zip(loops.edge_ids.tolist(), weights(loops, relaxed.poses).tolist(), strict=True))
    rejected = tuple(edge for edge, weight in by_id.items() if weight < _REJECTED)
    outcome = outcome_of(relaxed)
    message = f"{outcome.message}; {len(rejected)} of {counted(len(by_id), 'loop')} rejected"
    return replace(outcome, message=message, weights=by_id, rejected=rejected)


def outcome_of(relaxed: Relaxed) -> Outcome:
    """What a back-end reports of a run of sweeps: `converged` if the last sweep moved nothing, else `max-iterations`."""
    if relaxed.settled:
        message = f"no node moved more than {TOLERANCE_M} m"
        return Outcome(relaxed.poses, SolveStatus.CONVERGED, message, relaxed.sweeps)
    return Outcome(relaxed.poses, SolveStatus.MAX_ITERATIONS, counted(relaxed.sweeps, "sweep"), relaxed.sweeps)


def _refined(graph: PoseGraph, start: Array, config: BackendsConfig, before: str) -> Outcome:
    from hybridmap.backends.gtsam.batch import run
    from hybridmap.backends.gtsam.factors import NoiseModels, factor_graph

    outcome = run("lm", factor_graph(graph, NoiseModels()), start, config.max_iterations, tolerance=_TOLERANCE)
    if chi2(graph, outcome.poses) > chi2(graph, start):
        return Outcome(start, SolveStatus.STALLED, f"{before}; {outcome.message}; kept the relaxed map", outcome.iterations)
    return replace(outcome, message=f"{before}; {outcome.message} after {counted(outcome.iterations, 'iteration')}")
