"""The null back-end: dead reckoning, whatever else the graph knows."""

from __future__ import annotations

import numpy as np

from hybridmap.backends.base import SolveStatus
from hybridmap.backends.following import Change, GraphBackend, Outcome
from hybridmap.geometry import Array, between, compose
from hybridmap.graph.edges import EdgeKind
from hybridmap.graph.pose_graph import PoseGraph


def dead_reckoning(graph: PoseGraph, placed: Array) -> Array:
    """Place the nodes beyond `placed` (M, 3) by odometry edges alone; (N, 3).

    Where a node has none (a registration that contradicts it drops an odometry edge), the step between the graph's
    initial poses stands in: in a map these are the odometry chain.
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


class OdometryBackend(GraphBackend):
    """Believes odometry: what every other back-end is compared with."""

    def _extend(self, graph: PoseGraph, placed: Array) -> Array:
        return dead_reckoning(graph, placed)

    def _must_work(self, change: Change) -> bool:
        del change
        return False

    def _extended(self, start: Array, waiting: int) -> Outcome:
        del waiting  # for ever: it believes nothing else
        return super()._extended(start, 0)

    def _optimise(self, graph: PoseGraph, start: Array) -> Outcome:
        del start
        return Outcome(dead_reckoning(graph, graph.initial[:1]), SolveStatus.CONVERGED, "dead reckoning", 0)
