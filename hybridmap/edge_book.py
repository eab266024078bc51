"""What vision proposes, written into the map as edges; and what a back-end thinks of them, brought back to vision."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import replace

import numpy as np

from hybridmap.backends.base import SolveReport
from hybridmap.config.mapping import EdgesConfig
from hybridmap.geometry import Array, RelativePose
from hybridmap.graph.edges import Edge, EdgeKind, Lack, Method, Search
from hybridmap.graph.experience_map import ExperienceMap
from hybridmap.graph.paths import covariances_from
from hybridmap.graph.pose_graph import PoseGraph
from hybridmap.trajectory import NS_PER_S
from hybridmap.vision.base import Belief


class EdgeBook:
    """Keeps which edge a proposal became.

    Attributes:
        tried_again: numbers of the loops that were measured again because a back-end gave them no weight.
    """

    def __init__(self, experiences: ExperienceMap, config: EdgesConfig) -> None:
        self._map = experiences
        self._config = config
        self._edge_of_proposal: dict[int, int] = {}
        self.tried_again: tuple[int, ...] = ()

    def enter(self, proposals: Sequence[Edge]) -> list[int]:
        """Write proposals into the map; a later one with the same key replaces the edge of the earlier. Returns the edges."""
        changed = []
        for proposal in proposals:
            if proposal.key in self._edge_of_proposal:
                number = self._edge_of_proposal[proposal.key]
                self._map.update_edge(number, proposal)
            else:
                number = self._edge_of_proposal[proposal.key] = self._map.add_edge(proposal)
            changed.append(number)
            if proposal.contradicts_odometry and self._config.drop_contradicted:
                changed += self._drop_odometry(proposal)
        return changed

    def join(self, source: int, target: int, odometry: RelativePose) -> int:
        """Hang a new node on the one that the robot was at; returns the edge."""
        edge = Edge.decided(source, target, EdgeKind.ODOMETRY, odometry, method=Method.ODOMETRY, search=Search.CHAIN)
        return self._map.add_edge(edge)

    def belief(self, poses_of: Callable[[PoseGraph], Array], doubted: Sequence[int] = ()) -> Belief:
        """What the map believes, for vision.

        Args:
            poses_of: poses (N, 3) of the nodes by the primary back-end, of a graph.
            doubted: numbers of edges that hold nothing together.
        """
        own, nodes = self._config.gate == "odometry", self._map.nodes
        graph = self._map.pose_graph().only(EdgeKind.ODOMETRY) if own else self._map.pose_graph()
        graph = graph.with_edges(~np.isin(graph.edge_ids, doubted)) if len(doubted) else graph
        return Belief(
            poses_map_node=graph.initial if own else poses_of(graph),
            stamps_s=np.array([node.stamp_ns for node in nodes]) / NS_PER_S,
            travel_m=np.array([node.travel_m for node in nodes]),
            covariance_from=covariances_from(graph),
        )

    def without_weight(self, report: SolveReport) -> list[Edge]:
        """The proposed loops that a back-end gave no weight."""
        proposed = set(self._edge_of_proposal.values())
        return [self._map.edge(number) for number in report.rejected_edge_ids if number in proposed]

    def enter_again(self, proposals: Sequence[Edge]) -> list[int]:
        """Write what became of loops that were measured again because a back-end gave them no weight."""
        self.tried_again = tuple(self.enter(proposals))
        return list(self.tried_again)

    def _drop_odometry(self, proposal: Edge) -> list[int]:
        ends = {proposal.source, proposal.target}
        dropped = []
        for number in self._map.edges_into(max(ends)):
            edge = self._map.edge(number)
            if edge.kind is EdgeKind.ODOMETRY and edge.source in ends:
                self._map.update_edge(number, replace(edge.settled(lack=Lack.OVERRULED), since_node=-1))
                dropped.append(number)
        return dropped
