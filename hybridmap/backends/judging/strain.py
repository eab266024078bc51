"""How far a map is from what its own edges say: where it bends the chain of motion, and how far it is from their optimum."""

from __future__ import annotations

import math
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from hybridmap.backends.gtsam.batch import run
from hybridmap.backends.gtsam.factors import NoiseModels, factor_graph
from hybridmap.geometry import Array, between, log
from hybridmap.graph.paths import Chain, chain_of
from hybridmap.graph.pose_graph import PoseGraph

WINDOWS_M = (5.0, 10.0, 20.0)
"""Stretches on which map and chain are compared: shorter ones judge single edges, longer ones the drift of good odometry."""
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
    """The stretch of consecutive nodes that a map bends most against the edges of motion.

    Args:
        graph: the measurements; several edges of two nodes are fused.
        poses: (N, 3) poses of the map, m and rad.
        variance: factor on the covariances of the edges.

    Returns:
        None if the drive is too short.
    """
    chain = chain_of(graph)
    steps = np.hypot(*np.diff(chain.poses[:, :2], axis=0).T)
    travel, worst = np.concatenate([[0.0], steps.cumsum()]), None
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
    squared = np.einsum("ei,ei->e", error, np.linalg.solve(covariance, error[:, :, None])[:, :, 0])
    worst = int(np.argmax(squared))
    apart_m = math.hypot(*error[worst, :2])
    return Bend(int(first[worst]), int(last[worst]), math.sqrt(squared[worst]), apart_m)


def optimum(graph: PoseGraph, poses: Array) -> Array:
    """Poses (N, 3) where the edges of a graph are met best in least squares, searched from poses (N, 3); m and rad."""
    return run("lm", factor_graph(graph, NoiseModels()), poses, _ITERATIONS, tolerance=_TOLERANCE).poses
