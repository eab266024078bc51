"""What vision proposes, written into the map as edges; and what a back-end thinks of them, brought back to vision."""

from __future__ import annotations

from dataclasses import replace

from hybridmap.backends.base import SolveReport
from hybridmap.config.mapping import EdgesConfig
from hybridmap.graph.edges import Edge, EdgeKind, Status
from hybridmap.graph.experience_map import ExperienceMap
from hybridmap.vision.base import Doubted


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

    def enter(self, proposals: list[Edge]) -> list[int]:
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

    def doubted(self, report: SolveReport) -> list[Doubted]:
        """The proposed loops that a back-end holds for false."""
        key_of = {number: key for key, number in self._edge_of_proposal.items()}
        numbers = [number for number in report.rejected_edge_ids if number in key_of]
        return [Doubted(key_of[n], self._map.edge(n).source, self._map.edge(n).target) for n in numbers]

    def enter_again(self, proposals: list[Edge], backend: str) -> list[int]:
        """Write what became of loops that were measured again because a back-end held them for false."""
        words = {
            Status.ACCEPTED: f"measured again, as {backend} had given it no weight: ",
            Status.REJECTED: f"given no weight by {backend} and not found again on its map: ",
        }
        again = [replace(p, reason=words.get(p.status, "") + p.reason) for p in proposals]
        self.tried_again = tuple(self.enter(again))
        return list(self.tried_again)

    def report(self, report: SolveReport) -> list[int]:
        """Say of each loop that is in the graph but has no weight that it is so; returns which."""
        for number in report.rejected_edge_ids:
            edge = self._map.edge(number)
            why = ", as it contradicts the other loops" if number in report.inconsistent_edge_ids else ""
            reason = f"{edge.reason}; given no weight by {report.backend} at the end{why}"
            self._map.update_edge(number, replace(edge, reason=reason))
        return list(report.rejected_edge_ids)

    def _drop_odometry(self, proposal: Edge) -> list[int]:
        ends = {proposal.source, proposal.target}
        dropped = [
            number
            for number in self._map.edges_into(max(ends))
            if self._map.edge(number).kind is EdgeKind.ODOMETRY and self._map.edge(number).source in ends
        ]
        for number in dropped:
            self._map.set_status(number, Status.REJECTED, f"contradicted by registration: {proposal.reason}")
        return dropped
