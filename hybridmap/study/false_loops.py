"""Disturbances of a frozen graph before a back-end gets it: errors of its odometry, drop-outs, false loops."""

from __future__ import annotations

from dataclasses import replace
from typing import Literal

import numpy as np
from numpy.typing import NDArray

from hybridmap.errors import GraphError
from hybridmap.geometry import Array, between, compose, exp
from hybridmap.graph.edges import EdgeKind
from hybridmap.graph.paths import chain
from hybridmap.graph.pose_graph import PoseGraph
from hybridmap.study.model import DriftConfig

Kind = Literal["random", "aliased"]
_STREAMS = ("drift", "dropouts")  # each draws from a stream of its own
_DROP_OUT_M, _DROP_OUT_RAD = 0.5, np.deg2rad(20.0)
_RUN = 5  # aliased loops that come one after the other and agree with each other


def with_drift(graph: PoseGraph, drift: DriftConfig, seed: int) -> PoseGraph:
    """Copy of the graph with errors added to its odometry edges; other edges stay. Without errors: the graph itself.

    An edge of length s, m, turns by `heading_bias_deg_per_m` * s more, half of it before and half after the step, and its
    length becomes (1 + `scale_bias`) s. Then come noise and drop-outs (see `drop_out`). `initial` keeps its steps from node to
    node, each changed as the odometry edge of the same two nodes.

    Args:
        graph: the clean graph.
        drift: the errors.
        seed: seed of noise and drop-outs; bias and scale are not random.
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
    """Copy of the graph with false loops appended (see `inject`); the same arguments give the same loops.

    Args:
        graph: a graph with true loops.
        kind: kind of false loops.
        rate: share of false loops among all loops afterwards; at 0 the graph itself is returned.
        seed: seed of the false loops.

    Raises:
        GraphError: no loop to copy, or a rate outside [0, 1).
    """
    return graph if rate == 0.0 else inject(graph, rate, kind, np.random.default_rng(seed))


def inject(graph: PoseGraph, share: float, mode: Kind, rng: np.random.Generator) -> PoseGraph:
    """Copy of the graph with false loops appended: so many that they are `share` of all loops, rounded to a whole number.

    Their `edge_ids` follow the last one of the graph; `initial` stays.

    Args:
        graph: a graph with true loops, whose measurements and information the false ones copy.
        share: share of false loops among all loops afterwards, 0 <= share < 1.
        mode: kind of false loops. `random` joins two random nodes. `aliased` copies a run of neighbouring true loops with all
            old nodes shifted by the same number, as two similar corridors would.
        rng: random generator; its state advances.

    Raises:
        GraphError: no loop to copy, or a share outside [0, 1).
    """
    true = np.flatnonzero(graph.is_loop)
    if not 0.0 <= share < 1.0:
        raise GraphError(f"graph: cannot inject a share of {share} false loops; expected 0 <= share < 1")
    if len(true) == 0:
        raise GraphError("graph: found no loops, expected at least one for false ones to copy")
    count = round(len(true) * share / (1.0 - share))
    copied, ends = _random_pairs(graph, true, count, rng) if mode == "random" else _aliased_pairs(graph, true, count, rng)
    last = int(graph.edge_ids[-1]) if graph.n_edges else -1
    entered = None if graph.entered is None else np.concatenate([graph.entered, ends.max(axis=1, initial=0)])
    return replace(
        graph,
        sources=np.concatenate([graph.sources, ends[:, 0]]),
        targets=np.concatenate([graph.targets, ends[:, 1]]),
        deltas=np.concatenate([graph.deltas, graph.deltas[copied]]),
        information=np.concatenate([graph.information, graph.information[copied]]),
        kinds=np.concatenate([graph.kinds, np.full(count, EdgeKind.LOOP, dtype=np.int8)]),
        edge_ids=np.concatenate([graph.edge_ids, last + 1 + np.arange(count)]),
        entered=entered,
    )


def drop_out(graph: PoseGraph, share: float, rng: np.random.Generator) -> PoseGraph:
    """Copy of the graph with large errors in random odometry edges; `initial` is composed anew along the disturbed edges.

    Each chosen edge turns by 20 deg more, to either side, and slips 0.5 m in any direction. Its information stays the same,
    as the wheels do not notice.

    Args:
        graph: a graph with odometry edges.
        share: share of the odometry edges to disturb, 0 <= share <= 1.
        rng: random generator; its state advances.

    Raises:
        GraphError: a share outside [0, 1].
    """
    if not 0.0 <= share <= 1.0:
        raise GraphError(f"graph: cannot drop out a share of {share} of its odometry; expected 0 <= share <= 1")
    odometry = np.flatnonzero(graph.kinds == EdgeKind.ODOMETRY)
    hit = np.sort(rng.choice(odometry, round(share * len(odometry)), replace=False))
    direction = rng.uniform(-np.pi, np.pi, len(hit))
    turn = _DROP_OUT_RAD * rng.choice([-1.0, 1.0], len(hit))
    deltas = graph.deltas.copy()
    slip = np.column_stack([_DROP_OUT_M * np.cos(direction), _DROP_OUT_M * np.sin(direction), turn])
    deltas[hit] = compose(deltas[hit], slip)
    return chain(replace(graph, deltas=deltas))


def _generator(stream: str, rate: float, seed: int) -> np.random.Generator:
    """The random generator of one kind of odometry error at one rate; that of false loops is made from the seed alone."""
    return np.random.default_rng([seed, _STREAMS.index(stream), round(1e6 * rate)])


def _drifted(deltas: Array, drift: DriftConfig) -> Array:
    length = np.hypot(deltas[:, 0], deltas[:, 1])
    turn = np.deg2rad(drift.heading_bias_deg_per_m) * length
    half = np.column_stack([np.zeros((len(turn), 2)), 0.5 * turn])
    longer = deltas * np.array([1.0 + drift.scale_bias, 1.0 + drift.scale_bias, 1.0])
    return compose(compose(half, longer), half)


def _moved(graph: PoseGraph, deltas: Array) -> Array:
    """The graph's initial poses, with each step changed as the odometry edge of the same two nodes."""
    forward = (graph.kinds == EdgeKind.ODOMETRY) & (graph.targets - graph.sources == 1)
    steps = between(graph.initial[:-1], graph.initial[1:])
    before, after = graph.deltas[forward], deltas[forward]
    at = graph.sources[forward]
    steps[at] = compose(steps[at], between(before, after))
    poses = graph.initial.copy()
    for k in range(1, graph.n_nodes):
        poses[k] = compose(poses[k - 1], steps[k - 1])
    return poses


def _random_pairs(
    graph: PoseGraph, true: NDArray[np.int64], count: int, rng: np.random.Generator
) -> tuple[NDArray[np.int64], NDArray[np.int64]]:
    source = rng.integers(0, graph.n_nodes, count)
    target = (source + rng.integers(2, max(graph.n_nodes - 1, 3), count)) % graph.n_nodes
    return rng.choice(true, count), np.column_stack([source, target])


def _aliased_pairs(
    graph: PoseGraph, true: NDArray[np.int64], count: int, rng: np.random.Generator
) -> tuple[NDArray[np.int64], NDArray[np.int64]]:
    newest = np.maximum(graph.sources[true], graph.targets[true])
    in_order = true[np.argsort(newest, kind="stable")]
    copied: list[int] = []
    ends: list[tuple[int, int]] = []
    while len(ends) < count:
        first = int(rng.integers(0, len(in_order)))
        moved = int(rng.integers(10, max(graph.n_nodes - 10, 11)))
        for edge in in_order[first : first + _RUN].tolist():
            source, target = int(graph.sources[edge]), int(graph.targets[edge])
            if source < target:
                source = (source + moved) % graph.n_nodes
            else:
                target = (target + moved) % graph.n_nodes
            if abs(source - target) > 1 and len(ends) < count:
                copied.append(edge)
                ends.append((source, target))
    return np.array(copied, dtype=np.int64), np.array(ends, dtype=np.int64).reshape(-1, 2)
