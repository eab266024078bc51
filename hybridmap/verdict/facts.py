"""The facts about a finished map that the rules look at."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from hybridmap.backends.base import Solution
from hybridmap.calibration.clock import ClockOffset
from hybridmap.geometry import Array
from hybridmap.graph.contradictions import Contradictions, contradictions
from hybridmap.graph.edges import Edge, EdgeKind, Status
from hybridmap.graph.experience_map import ExperienceMap
from hybridmap.graph.gaps import free_lengths, kidnappings
from hybridmap.graph.pose_graph import PoseGraph
from hybridmap.verdict.reasons import Reason

NEAR_MISS_SHARE = 0.1
"""A loop that missed its limits by up to this share of them may be right; in one that missed by more the views differ."""


@dataclass(frozen=True, slots=True, kw_only=True)
class Facts:
    """What the rules look at: the map of one back-end, and what is known about its drive. What is unknown gives no reason.

    Attributes:
        graph: the E accepted edges, and loops that were measured but are not accepted; of N nodes.
        in_map: (E,) which edges the map was made of: the accepted ones that its back-end did not reject.
        plausible: (E,) which of the other loops may be right all the same: not those that failed a check by more than
            `NEAR_MISS_SHARE`.
        solution: the solution of the primary back-end, also without a map of its own; None if it never gave one.
        primary: name of that back-end.
        failure: why the primary back-end failed; empty if it did not.
        stamps_ns: (N,) stamps of the nodes; None if unknown.
        wheels: all odometry edges but those across a kidnapping, also the contradicted ones; None if unknown.
        free_m: (N,) way to each node from the one before it on which odometry alone knows the motion, in one direction or in
            all, m; elsewhere 0 (see `graph.gaps.free_lengths`). None if unknown.
        breaks: nodes to which the robot seems not to have driven, without a kidnapping that was found there.
        steps: how registrations and odometry of the same steps differ; None if unknown.
        lost_since: the first node since which the robot is lost; None if it is not.
        clock: the offset between the clocks of views and odometry; None if it was not looked for.
        driven: whether the loops were proposed by a front-end on a drive, and not read from a file.
        lost: topic -> (messages that are missing or damaged, messages in all).
        dropped: kind of observation -> (those that a live mapper was too slow for, observations in all).
    """

    graph: PoseGraph
    in_map: NDArray[np.bool_]
    plausible: NDArray[np.bool_]
    solution: Solution | None
    primary: str
    failure: str = ""
    stamps_ns: NDArray[np.int64] | None = None
    wheels: PoseGraph | None = None
    free_m: Array | None = None
    breaks: tuple[int, ...] = ()
    steps: Contradictions | None = None
    lost_since: int | None = None
    clock: ClockOffset | None = None
    driven: bool = False
    lost: Mapping[str, tuple[int, int]] = field(default_factory=dict)
    dropped: Mapping[str, tuple[int, int]] = field(default_factory=dict)

    @classmethod
    def of_graph(cls, graph: PoseGraph, solution: Solution) -> Facts:
        """The facts of a graph without a drive, such as a file, and of a back-end's solution of it.

        Loops that the back-end rejected are plausible; what only a drive knows stays unknown.
        """
        kept = ~np.isin(graph.edge_ids, np.array(solution.report.rejected_edge_ids, dtype=np.int64))
        meant = _calibrated(graph, solution)
        return cls(graph=meant, in_map=kept, plausible=~kept, solution=solution, primary=solution.report.backend)

    @classmethod
    def of_drive(
        cls,
        experiences: ExperienceMap,
        solution: Solution | None,
        primary: str,
        *,
        failure: str = "",
        lost_since: int | None = None,
        clock: ClockOffset | None = None,
        lost: Mapping[str, tuple[int, int]] | None = None,
        dropped: Mapping[str, tuple[int, int]] | None = None,
    ) -> Facts:
        """The facts of a finished drive: of its map and of the solution of its primary back-end.

        Args:
            experiences: nodes and all edges of the map, whatever their status.
            solution, primary, failure, lost_since, clock, lost, dropped: the attributes of the same names.
        """
        edges = experiences.edges
        chosen = [
            number
            for number, edge in enumerate(edges)
            if edge.relative is not None and (edge.status is Status.ACCEPTED or edge.kind is EdgeKind.LOOP)
        ]
        accepted = np.array([edges[number].status is Status.ACCEPTED for number in chosen], dtype=bool)
        near = np.array([_may_be_right(edges[number]) for number in chosen], dtype=bool)
        rejected = () if solution is None else solution.report.rejected_edge_ids
        found = {one.after for one in kidnappings(experiences)}
        in_map = accepted & ~np.isin(chosen, np.array(rejected, dtype=np.int64))
        return cls(
            graph=_calibrated(_graph_of(experiences, chosen), solution),
            in_map=in_map,
            plausible=~in_map & near,
            solution=solution,
            primary=primary,
            stamps_ns=np.array([node.stamp_ns for node in experiences.nodes], dtype=np.int64),
            wheels=_graph_of(
                experiences,
                [n for n, edge in enumerate(edges) if edge.kind is EdgeKind.ODOMETRY and not edge.spans_kidnapping],
            ),
            driven=True,
            free_m=free_lengths(experiences),
            breaks=tuple(sorted({edge.target for edge in edges if edge.broken_by} - found)),
            steps=contradictions(edges),
            failure=failure,
            lost_since=lost_since,
            clock=clock,
            lost=lost or {},
            dropped=dropped or {},
        )

    @property
    def poses(self) -> Array | None:
        """(N, 3) poses of the nodes, m and rad; None if the primary back-end failed or gave only those that it began with."""
        if self.solution is None or self.failure or not self.solution.report.status.has_map:
            return None
        return self.solution.poses

    @property
    def kept(self) -> NDArray[np.bool_]:
        """(E,) which edges are loops that the map was made of."""
        return np.asarray(self.in_map & self.graph.is_loop)

    def reason(self, kind: str, value: float = math.nan, limit: float = math.nan, **more: Any) -> Reason:
        """Make a reason; the stamps of its node are added, if known.

        Args:
            kind: a key of `KINDS`.
            value, limit: the figure that decided and its limit; NaN: none.
            more: other attributes of `Reason`.
        """
        node, stamps = more.get("node"), self.stamps_ns
        if node is not None and stamps is not None:
            more |= {"stamp_ns": int(stamps[node]), "start_ns": int(stamps[0])}
        return Reason(kind, float(value), float(limit), **more)


def _may_be_right(edge: Edge) -> bool:
    """Whether a loop that is not in the map may be right: it was in the map, or missed the limits of its checks by a hair."""
    return edge.status in (Status.ACCEPTED, Status.RETRACTED) or all(check.slack >= -NEAR_MISS_SHARE for check in edge.failed)


def _graph_of(experiences: ExperienceMap, chosen: Sequence[int]) -> PoseGraph:
    """The graph of measured edges of the numbers `chosen`, whatever their status."""
    edges = [experiences.edge(number) for number in chosen]
    measured = [edge.relative for edge in edges if edge.relative is not None]
    information = np.linalg.inv(np.array([relative.covariance for relative in measured]).reshape(-1, 3, 3))
    return PoseGraph(
        initial=experiences.initial,
        sources=np.array([edge.source for edge in edges], dtype=np.int64),
        targets=np.array([edge.target for edge in edges], dtype=np.int64),
        deltas=np.array([relative.delta for relative in measured]).reshape(-1, 3),
        information=information,
        kinds=np.array([edge.kind for edge in edges], dtype=np.int8),
        edge_ids=np.array(chosen, dtype=np.int64),
    )


def _calibrated(graph: PoseGraph, solution: Solution | None) -> PoseGraph:
    """The graph with the odometry as the back-end calibrated it, if it did."""
    calibrated = None if solution is None else solution.calibrated
    if calibrated is None:
        return graph
    _, here, there = np.intersect1d(graph.edge_ids, calibrated.edge_ids, return_indices=True)
    deltas, information = graph.deltas.copy(), graph.information.copy()
    deltas[here], information[here] = calibrated.deltas[there], calibrated.information[there]
    return replace(graph, deltas=deltas, information=information)
