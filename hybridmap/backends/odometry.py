"""The back-end `odometry`: dead reckoning, which ignores all other edges."""

from __future__ import annotations

import numpy as np

from hybridmap.backends.base import Outcome, SolveStatus
from hybridmap.backends.driver import Driver, Works
from hybridmap.config.backends import BackendsConfig
from hybridmap.geometry import Array, between, compose
from hybridmap.graph.edges import EdgeKind
from hybridmap.graph.pose_graph import PoseGraph


def create(name: str, config: BackendsConfig) -> Driver:
    """The dead reckoning back-end, the baseline of every comparison."""
    return Driver(name, config, _solve, works=Works.NEVER, place=dead_reckoning)


def dead_reckoning(graph: PoseGraph, placed: Array) -> Array:
    """Poses (N, 3) of all nodes: `placed` (M, 3) for the first M, and for further nodes the chain of odometry edges; m and rad.

    A node may have no odometry edge, because a registration that contradicts it drops the edge. Then the relative pose of the
    graph's `initial` is used: in a map `initial` is the odometry chain.
    """
    poses = np.concatenate([placed, np.zeros((graph.n_nodes - len(placed), 3))])
    forward = (graph.kinds == EdgeKind.ODOMETRY) & (graph.sources < graph.targets) & (graph.targets >= len(placed))
    edges = np.flatnonzero(forward)
    into = dict(zip(graph.targets[edges].tolist(), edges.tolist(), strict=True))
    for node in range(len(placed), graph.n_nodes):
        edge = into.get(node)
        if edge is None:
            poses[node] = compose(poses[node - 1], between(graph.initial[node - 1], graph.initial[node]))
        else:
            poses[node] = compose(poses[graph.sources[edge]], graph.deltas[edge])
    return poses


def _solve(graph: PoseGraph, start: Array) -> Outcome:
    return Outcome(dead_reckoning(graph, start[:1]), SolveStatus.CONVERGED, "dead reckoning", 0)
