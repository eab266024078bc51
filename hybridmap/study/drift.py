"""What is done to a frozen graph before a back-end gets it: errors of its odometry, false loops."""

from __future__ import annotations

from dataclasses import replace
from typing import Literal

import numpy as np

from hybridmap.geometry import Array, between, compose, exp
from hybridmap.graph.edges import EdgeKind
from hybridmap.graph.pose_graph import PoseGraph
from hybridmap.study.false_loops import drop_out, inject
from hybridmap.study.model import DriftConfig

Kind = Literal["random", "aliased"]
_STREAMS = ("drift", "dropouts")  # each draws from a stream of its own


def with_drift(graph: PoseGraph, drift: DriftConfig, seed: int) -> PoseGraph:
    """The graph with wrong odometry edges; `initial` moves along with them.

    A step of length s turns by a further bias * s, half of it before the step, and is (1 + scale) s long.
    """
    if drift.idle:
        return graph
    odometry = np.flatnonzero(graph.kinds == EdgeKind.ODOMETRY)
    deltas = graph.deltas.copy()
    deltas[odometry] = _drifted(deltas[odometry], drift)
    if drift.noise > 0.0:
        covariance = np.linalg.inv(graph.information[odometry])
        white = _generator("drift", 0.0, seed).standard_normal((len(odometry), 3, 1))
        twist = drift.noise * (np.linalg.cholesky(covariance) @ white)[:, :, 0]
        deltas[odometry] = compose(deltas[odometry], exp(twist))
    if drift.dropouts > 0.0:
        deltas = drop_out(replace(graph, deltas=deltas), drift.dropouts, _generator("dropouts", drift.dropouts, seed)).deltas
    return replace(graph, deltas=deltas, initial=_moved(graph, deltas))


def with_false_loops(graph: PoseGraph, kind: Kind, rate: float, seed: int) -> PoseGraph:
    """The graph with false loops appended (`study.false_loops.inject`); the same for every back-end.

    Raises:
        GraphError: no loop to copy.
    """
    return graph if rate == 0.0 else inject(graph, rate, kind, np.random.default_rng(seed))


def _generator(stream: str, rate: float, seed: int) -> np.random.Generator:
    """The chance of one error of the odometry at one rate; that of false loops is the seed's own."""
    return np.random.default_rng([seed, _STREAMS.index(stream), round(1e6 * rate)])


def _drifted(deltas: Array, drift: DriftConfig) -> Array:
    length = np.hypot(deltas[:, 0], deltas[:, 1])
    turn = np.deg2rad(drift.heading_bias_deg_per_m) * length
    half = np.column_stack([np.zeros((len(turn), 2)), 0.5 * turn])
    longer = deltas * np.array([1.0 + drift.scale_bias, 1.0 + drift.scale_bias, 1.0])
    return compose(compose(half, longer), half)


def _moved(graph: PoseGraph, deltas: Array) -> Array:
    """The graph's initial poses, each step between them changed as the odometry edge of the same two nodes was."""
    forward = (graph.kinds == EdgeKind.ODOMETRY) & (graph.targets - graph.sources == 1)
    steps = between(graph.initial[:-1], graph.initial[1:])
    before, after = graph.deltas[forward], deltas[forward]
    at = graph.sources[forward]
    steps[at] = compose(steps[at], between(before, after))
    poses = graph.initial.copy()
    for k in range(1, graph.n_nodes):
        poses[k] = compose(poses[k - 1], steps[k - 1])
    return poses
