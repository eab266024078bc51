"""Small pose graphs with a known truth."""

from __future__ import annotations

import numpy as np

from hybridmap.geometry import between, compose, exp
from hybridmap.graph.edges import EdgeKind
from hybridmap.graph.paths import chain
from hybridmap.graph.pose_graph import PoseGraph

SIGMA = np.array([0.03, 0.02, 0.01])


def laps(rng, nodes=60, per_lap=20, noise=1.0, every=1):
    """Make the graph of a robot that drives in laps. A loop joins node k to node k - per_lap. Return it and the true poses."""
    way = [np.zeros(3)]
    for _ in range(nodes - 1):
        way.append(compose(way[-1], [0.5, 0.05, 2 * np.pi / per_lap]))
    truth = np.array(way)
    pairs = [(k - 1, k, EdgeKind.ODOMETRY) for k in range(1, nodes)]
    pairs += [(k, k - per_lap, EdgeKind.LOOP) for k in range(per_lap, nodes, every)]
    pairs.sort(key=lambda p: (max(p[:2]), p[2]))
    return graph_of(truth, pairs, rng, noise), truth


def star(degree):
    """Make a graph of one hub with `degree` spokes. Loops join the ends of neighbouring spokes."""
    truth = np.array([[0.0, 0.0, 0.0]] + [[np.cos(a), np.sin(a), a] for a in np.linspace(0, 6, degree)])
    pairs = [(0, k, EdgeKind.ODOMETRY) for k in range(1, degree + 1)]
    pairs += [(k, k + 1, EdgeKind.LOOP) for k in range(1, degree)]
    return graph_of(truth, pairs, np.random.default_rng(0), noise=3.0)


def graph_of(truth, pairs, rng, noise=1.0):
    """Make a graph of noisy relative poses between pairs (source, target, kind). `initial` is the chain."""
    sources, targets = np.array([p[0] for p in pairs]), np.array([p[1] for p in pairs])
    count = len(pairs)
    twists = rng.normal(size=(count, 3)) * SIGMA * noise
    deltas = compose(between(truth[sources], truth[targets]), exp(twists))
    mixing = np.array([[1.0, 0.3, 0.0], [0.0, 1.0, 0.2], [0.0, 0.0, 1.0]])
    information = mixing.T @ np.diag(SIGMA**-2.0) @ mixing
    return chain(
        PoseGraph(
            initial=truth.copy(),
            sources=sources.astype(np.int64),
            targets=targets.astype(np.int64),
            deltas=deltas,
            information=np.repeat(information[None], count, axis=0),
            kinds=np.array([p[2] for p in pairs], dtype=np.int8),
            edge_ids=np.arange(count, dtype=np.int64),
        )
    )
