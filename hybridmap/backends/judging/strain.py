"""How far a map is from what its own edges say: where it bends the chain of motion, and how far it is from their optimum.

A bent chain means wrong loops or wrong motion. One kind of wrong motion does no harm where loops hold the map: wheels that
err alike on every metre. `recalibrated` tells it from the others.
"""

from __future__ import annotations

import math
from collections.abc import Iterator, Mapping
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from hybridmap.backends.gtsam.batch import run
from hybridmap.backends.gtsam.calibrated import calibrate, with_calibrated_odometry
from hybridmap.backends.gtsam.covariance import expected_loops
from hybridmap.backends.gtsam.factors import NoiseModels, factor_graph
from hybridmap.backends.judging.clusters import lone_loops, loops_of
from hybridmap.backends.objective import residuals, squared_norms, unit_variance
from hybridmap.config.backends import BackendsConfig
from hybridmap.errors import BackendError, EvaluationError
from hybridmap.geometry import Array, apart_m, between, log, squared_distance
from hybridmap.graph.agreement import BOUND, QUANTILE, Loops, Ring, ring
from hybridmap.graph.paths import Chain, chain_of, own_odometry
from hybridmap.graph.pose_graph import PoseGraph
from hybridmap.odometry_model import NEUTRAL, Gains

WINDOWS_M = (5.0, 10.0, 20.0)
"""Stretches on which map and chain are compared: shorter ones judge single edges, longer ones the drift of good odometry."""
BENT_MAX = 10.0
"""Standard deviations by which a map may bend a stretch of the chain of motion. Right maps stay below 6; wrong loops, a
kidnapping or a bent odometry give more than 14."""
APART_M = 10.0
"""Way between the middles of two sets of loops from which on they say different things about the chain of motion."""
_ITERATIONS, _TOLERANCE = 30, 1e-9


@dataclass(frozen=True, slots=True)
class Bend:
    """A stretch of the chain of motion and how a map bends it.

    Attributes:
        first, last: the nodes at its ends.
        sigmas: distance between the map and the chain, in standard deviations of the chain.
        apart_m: the same in m.
    """

    first: int
    last: int
    sigmas: float
    apart_m: float


def largest_bend(graph: PoseGraph, poses: Array, variance: float = 1.0) -> Bend | None:
    """The stretch of 5, 10 or 20 m that a map bends most against the edges of motion, in standard deviations.

    Args:
        graph: the measurements. Of several edges of motion (odometry, registration) of two nodes the motion is the weighted
            mean, as `graph.paths.chain_of` has it.
        poses: (N, 3) poses of the map, m and rad.
        variance: factor on the covariances of the edges.

    Returns:
        None if the drive is shorter than the shortest stretch, or its chain is broken on all of them.
    """
    chain = chain_of(graph)
    travel, worst = _travel(chain), None
    for window_m in WINDOWS_M:
        last = np.searchsorted(travel, travel + window_m)
        first = np.flatnonzero(last < graph.n_nodes)
        bend = _most_bent(chain, poses, first, last[first])
        if bend is not None and (worst is None or bend.sigmas > worst.sigmas):
            worst = bend
    return None if worst is None else replace(worst, sigmas=worst.sigmas / math.sqrt(variance))


def bend_of(chain: Chain, poses: Array, first: int, last: int) -> Bend | None:
    """How a map bends one stretch of a chain, from node to node; None where the chain is broken."""
    return _most_bent(chain, poses, np.array([first]), np.array([last]))


def _most_bent(chain: Chain, poses: Array, first: NDArray[np.int64], last: NDArray[np.int64]) -> Bend | None:
    ways = chain.ways(first, last)
    known = np.isfinite(ways.covariance).all(axis=(1, 2))
    first, last, covariance = first[known], last[known], ways.covariance[known]
    if not len(first):
        return None
    error = log(between(ways.delta[known], between(poses[first], poses[last])))
    squared = squared_distance(error, covariance)
    worst = int(np.argmax(squared))
    apart_m = math.hypot(*error[worst, :2])
    return Bend(int(first[worst]), int(last[worst]), math.sqrt(squared[worst]), apart_m)


def optimum(graph: PoseGraph, poses: Array) -> Array:
    """Poses (N, 3) where the edges of a graph are met best in least squares, searched from poses (N, 3); m and rad."""
    return run("lm", factor_graph(graph, NoiseModels()), poses, _ITERATIONS, tolerance=_TOLERANCE).poses


MOST_PAIRS = 20_000
"""Most pairs of lone loops that are asked whether they confirm each other: of more, some would by chance."""


@dataclass(frozen=True, slots=True)
class Pull:
    """What the rejected loops of a map do to it.

    Attributes:
        node: the node that they move farthest.
        shift_m: how far they move the map, RMS over the nodes.
    """

    node: int
    shift_m: float


def rejected_pull(graph: PoseGraph, poses: Array, in_map: NDArray[np.bool_], weights: Mapping[int, float]) -> Pull | None:
    """How far the loops that a robust kernel rejects pull its map: to where its other edges alone would not have it.

    A kernel gives a rejected loop a small weight, but a far loop pulls by its weight times its distance. Both maps are the
    optimum of their weighted edges, so that a solver that ended early counts as no pull.

    Args:
        graph: edges of the map, and rejected loops.
        poses: (N, 3) poses of the map, m and rad.
        in_map: (E,) which edges are not rejected.
        weights: edge id -> final weight; edges that are not in it count in full.

    Returns:
        None if no rejected loop has weight.
    """
    weight = np.array([weights.get(edge, float(kept)) for edge, kept in zip(graph.edge_ids.tolist(), in_map, strict=True)])
    if not np.any(~in_map & (weight > 0.0)):
        return None
    heavy = replace(graph, information=graph.information * weight[:, None, None])
    without = optimum(heavy.with_edges(in_map & (weight > 0.0)), poses)
    pulled = optimum(heavy.with_edges(weight > 0.0), poses)
    return Pull(int(np.argmax(np.hypot(*(pulled - without)[:, :2].T))), apart_m(pulled, without))


def recalibrated(graph: PoseGraph, poses: Array, least: int) -> Iterator[PoseGraph | None]:
    """The graph with its odometry calibrated to a map, in several ways that must all straighten its chain.

    Gain, turn gain and heading bias are three numbers for the whole drive. If loops of one half of the drive find numbers
    that straighten the other half too, the odometry errs alike everywhere. Wrong loops, a slip or a kidnapping bend the
    chain at one place, which no such numbers straighten.

    Args:
        graph: the edges of the map.
        poses: (N, 3) poses of the map, m and rad.
        least: fewest loops of a half.

    Yields:
        The graph calibrated by the steps of the map, which is quick, by the loops of the earlier half, by those of the later
        half, and by all. Nothing if the loops cannot be halved; None, and no more, once a way gives numbers that no robot has.
    """
    loops, travel = np.flatnonzero(graph.is_loop), _travel(chain_of(graph))
    newer = np.maximum(graph.sources, graph.targets)[loops]
    order = np.argsort(newer, kind="stable")
    earlier, later = order[: len(order) // 2], order[len(order) // 2 :]
    if len(earlier) < least or travel[int(np.median(newer[later]))] - travel[int(np.median(newer[earlier]))] < APART_M:
        return
    try:
        yield with_calibrated_odometry(graph, _gains_of(graph, poses))
        for left_out in (later, earlier, order[:0]):
            kept = graph.with_edges(np.setdiff1d(np.arange(graph.n_edges), loops[left_out]))
            gains, _ = calibrate(kept, NEUTRAL.to_array(), poses, BackendsConfig())
            yield with_calibrated_odometry(graph, Gains.from_array(gains).checked("odometry"))
    except (BackendError, EvaluationError):
        yield None


def _gains_of(graph: PoseGraph, poses: Array) -> Gains:
    """The calibration with which the odometry edges fit the steps of a map best, in least squares."""
    own = own_odometry(graph)
    raw, seen = log(graph.deltas[own]), log(between(poses[graph.sources[own]], poses[graph.targets[own]]))
    more = np.sum(raw[:, :2] * (seen - raw)[:, :2]) / max(float(np.sum(raw[:, :2] ** 2)), 1e-12)
    turn, bias = np.linalg.lstsq(raw[:, [2, 0]], seen[:, 2] - raw[:, 2])[0]
    return Gains(1.0 + more, 1.0 + turn, bias).checked("odometry")


def _travel(chain: Chain) -> Array:
    """Path length (N,) along a chain, m."""
    return np.concatenate([[0.0], np.hypot(*np.diff(chain.poses[:, :2], axis=0).T).cumsum()])


@dataclass(frozen=True, slots=True)
class LonePull:
    """Loops that no other loop confirms and that the rest of the map does not expect, and what they do to it.

    Attributes:
        nodes: older and newer node of the loop that was farthest from what the rest of the map expects.
        count: number of these loops.
        shift_m: how far they move a node of the map, at most.
    """

    nodes: tuple[int, int]
    count: int
    shift_m: float


def lone_pull(graph: PoseGraph, poses: Array) -> LonePull | None:
    """Find the loops of a map that nothing confirms and whose innovation against the map without such loops is too large.

    True loops mostly come in runs. A single one that says what the others say is harmless; a single one that says something
    else may be false, and where a file overstates its noise, it fits all the same. Two that say the same, better than chance
    would have it, confirm each other.

    Args:
        graph: the edges of the map.
        poses: (N, 3) poses near the optimum of these edges, m and rad.

    Returns:
        None if there are none.
    """
    lone, every = lone_loops(graph), np.arange(graph.n_edges)
    if not len(lone):
        return None
    rest = graph.with_edges(np.setdiff1d(every, lone))
    bare = optimum(rest, poses)
    variance = unit_variance(rest, squared_norms(rest, bare))
    odd = lone[~expected_loops(graph, bare, lone, variance, BOUND)]
    odd = odd[~_confirmed(loops_of(graph, odd), chain_of(rest, bare), min(1.0, variance))]
    if not len(odd):
        return None
    without = optimum(graph.with_edges(np.setdiff1d(every, odd)), bare)
    shift_m = float(np.hypot(*(optimum(graph, poses) - without)[:, :2].T).max())
    farthest = odd[int(np.argmax(np.hypot(*residuals(graph.with_edges(odd), bare)[:, :2].T)))]
    ends = sorted((int(graph.sources[farthest]), int(graph.targets[farthest])))
    return LonePull((ends[0], ends[1]), len(odd), shift_m)


def _confirmed(loops: Loops, chain: Chain, variance: float) -> NDArray[np.bool_]:
    """Which (L,) of loops that contradict a map agree with another of them so well that two false ones hardly would.

    Of false loops as far off as these, the share (distance of the ring / distance of the loop) ** 3, in standard deviations,
    closes a ring as well or better: the three errors of a ring lie anywhere in a ball of that radius. With many pairs some
    agree by chance, so the share is multiplied by their number.

    Args:
        loops: the L loops.
        chain: the poses of the map without them, with the covariance of its motion.
        variance: factor on all covariances.
    """
    confirmed = np.zeros(len(loops.older), dtype=bool)
    first, second = np.triu_indices(len(confirmed), 1)
    if not 0 < len(first) <= MOST_PAIRS:
        return confirmed
    off = log(between(loops.relative.delta, between(chain.poses[loops.older], chain.poses[loops.newer])))
    chance = np.zeros(len(first))
    for one, other in ((first, second), (second, first)):
        closing = ring(loops[one], loops[other], chain.ways)
        far = Ring(off[other], closing.covariance).distance
        chance = np.maximum(chance, (closing.distance / np.maximum(far, 1e-12)) ** 1.5)
        chance[closing.distance > BOUND * variance] = np.inf
    sure = len(chance) * chance <= 1.0 - QUANTILE
    confirmed[first[sure]] = confirmed[second[sure]] = True
    return confirmed
