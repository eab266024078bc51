"""The null back-end: the chain of odometry edges as it is."""

from __future__ import annotations

from hybridmap.backends.base import SolveStatus
from hybridmap.backends.following import Change, GraphBackend, Outcome
from hybridmap.geometry import Array
from hybridmap.graph.connectivity import chain
from hybridmap.graph.pose_graph import PoseGraph


class OdometryBackend(GraphBackend):
    """Believes odometry: what every other back-end is compared with."""

    def _must_work(self, change: Change) -> bool:
        del change
        return False

    def _optimise(self, graph: PoseGraph, start: Array) -> Outcome:
        del start
        return Outcome(chain(graph).initial, SolveStatus.CONVERGED, "the chain as it is", 0)
