"""What is said of a drive at its end: the facts and figures in `metrics.json`, and what the verdict is made from."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any

from hybridmap.backends import objective
from hybridmap.backends.base import ODOMETRY, Solution, SolveReport
from hybridmap.calibration.clock import ClockOffset
from hybridmap.graph.edges import Edge, EdgeKind, Proposer, Status
from hybridmap.graph.experience_map import ExperienceMap
from hybridmap.graph.gaps import kidnappings, unobserved
from hybridmap.graph.io import graph_hash
from hybridmap.mapper import Mapper
from hybridmap.metrics import Metric, figure
from hybridmap.streams.base import Stream, StreamReport
from hybridmap.verdict import Facts, Reason, reasons_of, said_of

CORRECTED_ODOMETRY = "odometry, gains corrected"
"""Title of odometry where gains that were found while driving are in it: it is better than what the wheels said."""


@dataclass(frozen=True, slots=True)
class Origin:
    """What is known of how a map was made beside its graph.

    Attributes:
        titles: what back-ends are called for people, where it is not their name.
        failed_backends: back-end -> why it failed.
        stream: kind of message -> how many were read.
        lost: topic -> [messages that are missing or damaged, messages in all].
        remarks: what people should know.
    """

    titles: dict[str, str] = field(default_factory=dict)
    failed_backends: dict[str, str] = field(default_factory=dict)
    stream: dict[str, int] = field(default_factory=dict)
    lost: dict[str, list[int]] = field(default_factory=dict)
    remarks: list[str] = field(default_factory=list)


def head_of_map(
    experiences: ExperienceMap, reasons: Sequence[Reason], backends: Sequence[str], source: str, origin: Origin
) -> dict[str, Any]:
    """The keys of `metrics.json` beside the list of metrics: the verdict, the hash of the graph, what was read and assumed.

    Args:
        experiences: the map.
        reasons: what speaks against it.
        backends: names of the back-ends, the primary one first.
        source: what was mapped, for people.
        origin: how it was made.
    """
    return {
        **said_of(reasons),
        "graph_hash": graph_hash(experiences),
        "primary_backend": backends[0],
        "backends": list(backends),
        "titles": origin.titles,
        "source": source,
        "failed_backends": origin.failed_backends,
        "stream": origin.stream,
        "lost": origin.lost,
        "remarks": origin.remarks,
    }


def head_of(mapper: Mapper, stream: Stream) -> dict[str, Any]:
    """The keys of `metrics.json` beside the list of metrics, as they are at the end of a drive."""
    offset = mapper.calibration.clock.offset
    origin = Origin(
        titles={ODOMETRY: CORRECTED_ODOMETRY} if mapper.calibration.changes else {},
        failed_backends=dict(mapper.backends.failures),
        stream=dict(stream.report.counts),
        lost={name: list(counts) for name, counts in stream.report.lost.items()},
        remarks=[
            *stream.report.remarks,
            *stream.report.skips,
            *map(str, mapper.calibration.changes),
            *([str(offset)] if offset.used_s else []),
            *map(str, kidnappings(mapper.map)),
        ],
    )
    return head_of_map(mapper.map, reasons_of(facts_of(mapper, stream.report)), mapper.backends.names, stream.name, origin)


def facts_of(mapper: Mapper, report: StreamReport) -> Facts:
    """What the verdict on a drive is made from: the mapper after `finish`, and the report of its stream."""
    primary = mapper.backends.primary
    return Facts.of_drive(
        mapper.map,
        mapper.backends.solutions.get(primary),
        primary,
        failure=mapper.backends.failures.get(primary, ""),
        lost_since=mapper.lost_since,
        clock=mapper.calibration.clock.offset,
        lost=report.lost,
        dropped={name: (gone, gone + report.counts.get(name, 0)) for name, gone in report.dropped.items()},
    )


def _weak(name: str, report: SolveReport) -> list[Metric]:
    """Figures of the edges of motion that a back-end's kernel down-weights."""
    if not report.weak_edges:
        return []
    return [
        figure(f"weak_edges/{name}", len(report.weak_edges)),
        figure(f"hanging_nodes/{name}", report.hanging_nodes),
    ]


def _clock_figures(offset: ClockOffset) -> list[Metric]:
    return [
        figure("clock_offset", offset.offset_s, said=offset),
        figure("clock_offset_sigma", offset.sigma_s),
        figure("clock_offset_used", offset.used_s),
    ]


def _proposed_by(loops: Sequence[Edge]) -> list[Metric]:
    """How many accepted loops each proposer found first."""
    accepted = [loop.proposed_by for loop in loops if loop.status is Status.ACCEPTED]
    return [figure(f"loops_proposed_by/{who}", accepted.count(who), what=who.words) for who in Proposer]


def _measured_again(mapper: Mapper) -> list[Metric]:
    tried, edges = mapper.book.tried_again, mapper.map.edges
    solution = mapper.backends.solutions.get(mapper.backends.primary)
    without = set(solution.report.rejected_edge_ids) if solution is not None else set()
    kept = [number for number in tried if edges[number].status is Status.ACCEPTED and number not in without]
    return [
        figure("loops_tried_again", len(tried)),
        figure("loops_readmitted", len(kept)),
    ]


def counts_of(experiences: ExperienceMap) -> list[Metric]:
    """How many nodes and loops a map has."""
    loops = [edge for edge in experiences.edges if edge.kind is EdgeKind.LOOP]
    count = {status: float(sum(edge.status is status for edge in loops)) for status in Status}
    return [
        figure("nodes", len(experiences)),
        figure("loops_accepted", count[Status.ACCEPTED]),
        figure("loops_pending", count[Status.PENDING]),
        figure("loops_rejected", count[Status.REJECTED]),
        figure("loops_retracted", count[Status.RETRACTED]),
        *_proposed_by(loops),
    ]


def solved(experiences: ExperienceMap, solutions: Mapping[str, Solution]) -> list[Metric]:
    """How well each back-end's solution of a map meets its edges, and what it rejected."""
    graph = experiences.pose_graph()
    chain = objective.chi2(graph, graph.initial)
    rows = [figure(f"chi2_initial/{ODOMETRY}", chain), figure(f"chi2/{ODOMETRY}", chain)]
    for name, solution in solutions.items():
        if name != ODOMETRY:
            rows += [
                figure(f"chi2_initial/{name}", chain),
                figure(f"chi2/{name}", objective.chi2(graph, solution.poses)),
                figure(f"loops_rejected/{name}", len(solution.report.rejected_edge_ids)),
                *_weak(name, solution.report),
            ]
    return rows


def _learnt_noise(mapper: Mapper) -> list[Metric]:
    learnt = mapper.book.motion.wheels.learnt
    if learnt is None:
        return []
    heading = figure("wheels_heading_noise", learnt.heading_deg)
    return [heading, figure("wheels_translation_noise", learnt.translation_m)]


def figures_of(mapper: Mapper, largest_correction_m: float, duration_s: float) -> list[Metric]:
    """The figures of a drive after `finish`, without errors against truth.

    Args:
        mapper: after `finish`.
        largest_correction_m: largest shift of a node by one update.
        duration_s: time from the first to the last stamp.
    """
    dropped = [e for e in mapper.map.edges if e.kind is EdgeKind.ODOMETRY and e.status is not Status.ACCEPTED]
    rows = [
        *counts_of(mapper.map),
        *([figure("nodes_reused", mapper.known_places.followed)] if mapper.known_places.followed else []),
        *_measured_again(mapper),
        figure("odometry_dropped", len(dropped)),
        *_learnt_noise(mapper),
        *_clock_figures(mapper.calibration.clock.offset),
        figure("largest_correction", largest_correction_m),
        figure("travel", mapper.map.node(len(mapper.map) - 1).travel_m),
        figure("duration", duration_s),
    ]
    rows += solved(mapper.map, mapper.backends.solutions)
    rows += [figure(f"cpu_s/{stage}", cpu_s, what="the stage") for stage, cpu_s in mapper.clock.cpu_s.items()]
    total = sum(mapper.clock.cpu_s.values())
    rows.append(figure("cpu_s/mapping", total, what="all stages"))
    if duration_s > 0:
        rows.append(figure("cpu_s_per_min", 60.0 * total / duration_s))
    free = unobserved(mapper.map, mapper.poses())
    if free is not None:
        rows.append(figure("unobserved", free.sliding_m + free.blind_m, free=free))
    return rows
