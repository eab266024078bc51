"""The verdict on a finished map: trusted, doubtful or failed, with the reasons.

Each rule is one function from the facts of a finished drive to reasons against its map. A map is trusted if no rule finds a
reason. No rule needs a ground truth.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from enum import StrEnum
from typing import Any

import numpy as np
from numpy.typing import NDArray

from hybridmap.backends.base import ODOMETRY, Solution
from hybridmap.backends.judging.clusters import rejected_clusters
from hybridmap.backends.judging.rivals import Rival, rivals, spans
from hybridmap.backends.judging.strain import bend_of, largest_bend, optimum
from hybridmap.backends.objective import SLACK, squared_norms, unit_variance
from hybridmap.geometry import Array
from hybridmap.graph.agreement import BOUND
from hybridmap.graph.edges import Edge, EdgeKind, Status
from hybridmap.graph.experience_map import ExperienceMap
from hybridmap.graph.gaps import free_lengths
from hybridmap.graph.paths import chain_of
from hybridmap.graph.pose_graph import PoseGraph
from hybridmap.trajectory import NS_PER_S

HAIR = 0.2
"""A loop that missed its limits by up to this share of them may be right; in one that missed by more the views differ."""
TOGETHER = 6
"""Fewest refused loops that speak against a map: as many as find a lost robot (`vision.relocalising.SUPPORT`)."""
MOVES_M, MOVES_RAD = 0.1, math.radians(2.0)
"""A group of refused loops that would move the map by less than both says nothing that matters: a place is found within it."""
OUTNUMBER = 2
"""So many times as many loops of a group must stand against the map as loops of the map against the group."""
BENT_MAX = 10.0
"""Standard deviations by which a map may bend a stretch of the chain of motion. Right maps stay below 6; wrong loops, a
kidnapping or a bent odometry give more than 14."""
UNSETTLED_MAX_M = 0.5
"""Distance of a node from the optimum of the map's own edges, m. A relaxation that ends early is off by some 0.4 m at its
worst node, outliers that a kernel does not silence pull by more."""
STRAIN_MAX = SLACK
"""Most unit variance of the map's own edges at their optimum: above, they contradict each other or are far too sure."""
KEPT_MIN = 0.1
"""Fewest loops of a map, as a share of those that its back-end rejected: it keeps more where seven of ten are false."""
DROPPED_MAX = 0.2
"""Largest share of contradicted odometry edges. Wheels that slip now and then lose some per cent; a clock that is off, or a
registration that is, contradicts the wheels all the way."""
WHEELS_MAX = 5.0
"""Standard deviations of the odometry by which the map may contradict it where no loop decides between them."""
FREE_MAX_M = 5.0
"""Longest way on which odometry alone may know the motion where no loop spans it: wheels slip by some per cent of it."""


class Verdict(StrEnum):
    """How far a map can be relied on.

    `trusted`: nothing speaks against it. `doubtful`: something does; it may be right all the same. `failed`: there is no
    map beyond dead reckoning.
    """

    TRUSTED = "trusted"
    DOUBTFUL = "doubtful"
    FAILED = "failed"

    @property
    def grade(self) -> int:
        """0 trusted, 1 doubtful, 2 failed."""
        return list(Verdict).index(self)


_WORDS = ("value", "limit", "count", "against", "apart_m", "name")  # attributes of a reason that its words may have


@dataclass(frozen=True, slots=True)
class Reason:
    """A reason against a map.

    Attributes:
        kind: name of the kind of reason, a key of `KINDS`.
        value, limit: the figure that decided and its limit, in the unit of the kind; NaN: no figure.
        node: the first node that it concerns; None: the whole map.
        until: the last node that it concerns; None: `node` alone.
        stamp_ns: stamp of `node`, ns; None if unknown.
        start_ns: stamp of the first node, ns; None if unknown.
        count: how many loops, edges or messages it concerns.
        against: how many loops of the map speak against it.
        apart_m: how far the map is from what it contradicts, m.
        name: name of the back-end or topic that it concerns; otherwise empty.
    """

    kind: str
    value: float = math.nan
    limit: float = math.nan
    node: int | None = None
    until: int | None = None
    stamp_ns: int | None = None
    start_ns: int | None = None
    count: int = 0
    against: int = 0
    apart_m: float = math.nan
    name: str = ""

    @property
    def verdict(self) -> Verdict:
        """The verdict on a map for which this reason holds."""
        return KINDS[self.kind].verdict

    @property
    def unit(self) -> str:
        """Unit of `value` and `limit`."""
        return KINDS[self.kind].unit

    @property
    def time_s(self) -> float | None:
        """Time of `node` since the first node, s."""
        return None if self.stamp_ns is None or self.start_ns is None else (self.stamp_ns - self.start_ns) / NS_PER_S

    def __str__(self) -> str:
        """The reason in words, with its place."""
        words = KINDS[self.kind].words.format_map({name: getattr(self, name) for name in _WORDS})
        if self.node is None:
            return words
        nodes = f"node {self.node}" if self.until in (None, self.node) else f"nodes {self.node} to {self.until}"
        return f"{nodes}{'' if self.time_s is None else f' ({self.time_s:.0f} s)'}: {words}"

    def to_json(self) -> dict[str, Any]:
        """The reason as a dictionary of JSON values; what is unknown is null."""
        return {
            "kind": self.kind,
            "verdict": str(self.verdict),
            "node": self.node,
            "until_node": self.until,
            "time_s": self.time_s,
            "stamp_s": None if self.stamp_ns is None else self.stamp_ns / NS_PER_S,
            "value": self.value if math.isfinite(self.value) else None,
            "limit": self.limit if math.isfinite(self.limit) else None,
            "unit": self.unit,
            "words": str(self),
        }


@dataclass(frozen=True, slots=True, kw_only=True)
class Facts:
    """What the kinds of reasons look at.

    Attributes:
        graph: the accepted edges, and the loops that were measured but are not accepted.
        in_map: (E,) which edges the map was made of: the accepted ones that its back-end did not reject.
        plausible: (E,) which of the other loops may be right all the same: not those that failed a check by far.
        solution: the map of the primary back-end; None if it never gave one.
        primary: name of that back-end.
        failure: why the primary back-end failed; empty if it did not.
        stamps_ns: (N,) stamps of the nodes; None if unknown.
        wheels: all odometry edges, also those that a registration contradicted; None if unknown.
        free_m: (N,) way to each node on which odometry alone knows the motion, in one direction or in all.
        lost_since: the first node since which the robot is lost; None if it is not.
        lost: topic -> (messages that are missing or damaged, messages in all).
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
    lost_since: int | None = None
    lost: Mapping[str, tuple[int, int]] = field(default_factory=dict)

    @classmethod
    def of_graph(cls, graph: PoseGraph, solution: Solution) -> Facts:
        """The facts of a graph without a drive, such as a file, and of a back-end's solution of it."""
        kept = ~np.isin(graph.edge_ids, np.array(solution.report.rejected_edge_ids, dtype=np.int64))
        meant = _calibrated(graph, solution)
        return cls(graph=meant, in_map=kept, plausible=~kept, solution=solution, primary=solution.report.backend)

    @classmethod
    def of_drive(cls, experiences: ExperienceMap, solution: Solution | None, primary: str, **more: Any) -> Facts:
        """The facts of a drive; `more` are attributes that the map does not tell."""
        edges = experiences.edges
        chosen = [
            number
            for number, edge in enumerate(edges)
            if edge.relative is not None and (edge.status is Status.ACCEPTED or edge.kind is EdgeKind.LOOP)
        ]
        accepted = np.array([edges[number].status is Status.ACCEPTED for number in chosen], dtype=bool)
        near = np.array([_may_be_right(edges[number]) for number in chosen], dtype=bool)
        rejected = () if solution is None else solution.report.rejected_edge_ids
        in_map = accepted & ~np.isin(chosen, np.array(rejected, dtype=np.int64))
        return cls(
            graph=_calibrated(_graph_of(experiences, chosen), solution),
            in_map=in_map,
            plausible=~in_map & near,
            solution=solution,
            primary=primary,
            stamps_ns=np.array([node.stamp_ns for node in experiences.nodes], dtype=np.int64),
            wheels=_graph_of(experiences, [number for number, edge in enumerate(edges) if edge.kind is EdgeKind.ODOMETRY]),
            free_m=free_lengths(experiences),
            **more,
        )

    @property
    def poses(self) -> Array | None:
        """(N, 3) the poses of the map; None if the primary back-end gave none but those that it began with."""
        return self.solution.poses if self.solution is not None and self.solution.report.status.has_map else None

    @property
    def kept(self) -> NDArray[np.bool_]:
        """(E,) which loops hold the map together."""
        return np.asarray(self.in_map & self.graph.is_loop)

    def reason(self, kind: str, value: float = math.nan, limit: float = math.nan, **more: Any) -> Reason:
        """A reason with the stamps of its node."""
        node, stamps = more.get("node"), self.stamps_ns
        if node is not None and stamps is not None:
            more |= {"stamp_ns": int(stamps[node]), "start_ns": int(stamps[0])}
        return Reason(kind, float(value), float(limit), **more)


def _may_be_right(edge: Edge) -> bool:
    """Whether a loop that is not in the map may be right: it was in the map, or missed the limits of its checks by a hair."""
    return edge.status in (Status.ACCEPTED, Status.RETRACTED) or all(check.slack >= -HAIR for check in edge.failed)


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


def no_map(facts: Facts) -> Iterable[Reason]:
    """The primary back-end failed, diverged, or returned the poses that it was given."""
    solution = facts.solution
    if solution is None or facts.failure:
        return [facts.reason("back-end failed", name=f"{facts.primary}: {facts.failure or 'it gave no map'}")]
    report = solution.report
    if not report.status.has_map:
        return [facts.reason("no map", report.chi2, report.chi2_initial, name=f"{facts.primary} ({report.status})")]
    if facts.primary == ODOMETRY:
        return [facts.reason("dead reckoning", len(facts.graph.edge_ids[facts.graph.is_loop]), 0, name=facts.primary)]
    moved = not np.array_equal(solution.poses, facts.graph.initial)
    if not moved and report.chi2 > facts.graph.n_edges:
        return [facts.reason("no map", report.chi2, facts.graph.n_edges, name=f"{facts.primary} (returned its start)")]
    return []


def refused_together(facts: Facts) -> Iterable[Reason]:
    """Loops that are not in the map although they agree with each other, and more of them than the map has against them."""
    graph, poses = facts.graph, facts.poses
    if poses is None:
        return []
    out = facts.plausible & graph.is_loop & (squared_norms(graph, poses) > BOUND)
    groups = rejected_clusters(graph, poses, tuple(graph.edge_ids[out].tolist()), BOUND)
    found = [one for one in rivals(graph, poses, groups, facts.kept) if _matters(one)]
    return [
        facts.reason("loops refused", one.shift_m, MOVES_M, node=one.node, count=one.spanning, against=one.against)
        for one in found
    ]


def _matters(rival: Rival) -> bool:
    moves = rival.shift_m > MOVES_M or rival.turn_rad > MOVES_RAD
    return moves and rival.spanning >= TOGETHER and rival.spanning > rival.against


def bent(facts: Facts) -> Iterable[Reason]:
    """The map bends the chain of motion more than the noise of its edges allows."""
    if facts.solution is None or facts.poses is None:
        return []
    variance = facts.solution.report.unit_variance
    bend = largest_bend(facts.graph.with_edges(facts.in_map), facts.poses, min(variance or 1.0, 1.0))
    if bend is None or bend.sigmas <= BENT_MAX:
        return []
    return [facts.reason("bent", bend.sigmas, BENT_MAX, node=bend.first, until=bend.last, apart_m=bend.apart_m)]


def at_odds(facts: Facts) -> Iterable[Reason]:
    """The map is not where its own edges are met best, or they contradict each other even there."""
    if facts.solution is None or facts.poses is None or facts.solution.report.weak_edges:
        return
    graph = facts.graph.with_edges(facts.in_map)
    best = optimum(graph, facts.poses)
    apart_m = float(np.hypot(*(best - facts.poses)[:, :2].T).max())
    if apart_m > UNSETTLED_MAX_M:
        yield facts.reason("unsettled", apart_m, UNSETTLED_MAX_M)
    variance = unit_variance(graph, squared_norms(graph, best))
    if variance > STRAIN_MAX:
        yield facts.reason("edges contradict", variance, STRAIN_MAX)


def none_kept(facts: Facts) -> Iterable[Reason]:
    """The back-end rejected nearly all loops that the front-end had accepted."""
    if facts.solution is None or facts.poses is None:
        return []
    rejected, kept = len(facts.solution.report.rejected_edge_ids), int(np.count_nonzero(facts.kept))
    few = rejected >= TOGETHER and kept < KEPT_MIN * rejected
    return [facts.reason("loops rejected", rejected, kept / KEPT_MIN, count=kept)] if few else []


def against_wheels(facts: Facts) -> Iterable[Reason]:
    """Where no loop spans the way, the map contradicts dead reckoning, and nothing tells which of them is right."""
    if facts.poses is None or facts.wheels is None:
        return
    chain = chain_of(facts.wheels)
    for run in _runs(spans(facts.graph, facts.kept)[1:] == 0):
        first, last = int(run[0]), int(run[-1]) + 1
        bend = bend_of(chain, facts.poses, first, last)
        if bend is not None and bend.sigmas > WHEELS_MAX:
            yield facts.reason("against odometry", bend.sigmas, WHEELS_MAX, node=first, until=last, apart_m=bend.apart_m)


def _runs(mask: NDArray[np.bool_]) -> list[NDArray[np.int64]]:
    """The runs of indices where a mask is true."""
    parts = np.split(np.arange(len(mask)), np.flatnonzero(np.diff(mask)) + 1)
    return [part for part in parts if len(part) and mask[part[0]]]


def contradicted_odometry(facts: Facts) -> Iterable[Reason]:
    """Registrations contradicted many odometry edges."""
    if facts.wheels is None or not facts.wheels.n_edges:
        return []
    dropped = int(np.count_nonzero(~np.isin(facts.wheels.edge_ids, facts.graph.edge_ids)))
    share = dropped / facts.wheels.n_edges
    return [facts.reason("odometry dropped", 100.0 * share, 100.0 * DROPPED_MAX, count=dropped)] if share > DROPPED_MAX else []


def not_held(facts: Facts) -> Iterable[Reason]:
    """Long ways on which odometry alone knows the motion, and which no loop of the map spans; nodes that hang."""
    report = None if facts.solution is None else facts.solution.report
    if report is not None and report.hanging_nodes:
        yield facts.reason("nodes hang", report.hanging_nodes, 0)
    if facts.free_m is None:
        return
    for run in _runs((facts.free_m > 0.0) & (spans(facts.graph, facts.kept) == 0)):
        length_m = float(facts.free_m[run].sum())
        if length_m > FREE_MAX_M:
            yield facts.reason("nothing held", length_m, FREE_MAX_M, node=int(run[0]) - 1, until=int(run[-1]))


def lost(facts: Facts) -> Iterable[Reason]:
    """The robot was not localised at the end."""
    if facts.lost_since is None:
        return []
    nodes = facts.graph.n_nodes
    return [facts.reason("not localised", nodes - facts.lost_since, 0, node=facts.lost_since, until=nodes - 1)]


def messages_lost(facts: Facts) -> Iterable[Reason]:
    """Messages of the recording are missing or damaged."""
    return [
        facts.reason("messages lost", 100.0 * gone / max(every, 1), 0, count=gone, name=name)
        for name, (gone, every) in facts.lost.items()
        if gone
    ]


@dataclass(frozen=True, slots=True)
class Kind:
    """A kind of reason.

    Attributes:
        verdict: the verdict on a map for which it holds.
        unit: unit of its figure and limit.
        words: template of its words, with the attributes of `Reason`.
    """

    verdict: Verdict
    unit: str
    words: str


KINDS = {
    "back-end failed": Kind(Verdict.FAILED, "1", "{name}; the map is dead reckoning"),
    "no map": Kind(Verdict.FAILED, "1", "{name} gave no map: chi2 is {value:.4g} at the poses that it began with"),
    "dead reckoning": Kind(Verdict.DOUBTFUL, "1", "the map is dead reckoning, which uses no loop; there are {value:.0f}"),
    "loops refused": Kind(
        Verdict.DOUBTFUL,
        "m",
        "{count} loops agree with each other and would move the map by {value:.2f} m, but are not in it; {against} loops are"
        " against them: either they have one common error, or the motion here is wrong",
    ),
    "bent": Kind(
        Verdict.DOUBTFUL,
        "sigma",
        "the map bends the chain of motion by {apart_m:.2f} m, {value:.0f} standard deviations (at most {limit:.0f}): loops or"
        " motion are wrong here",
    ),
    "unsettled": Kind(
        Verdict.DOUBTFUL, "m", "a node lies {value:.2f} m from where the map's own edges want it (at most {limit:.1f} m)"
    ),
    "edges contradict": Kind(
        Verdict.DOUBTFUL, "1", "the edges of the map contradict each other: unit variance {value:.1f} (at most {limit:.0f})"
    ),
    "loops rejected": Kind(
        Verdict.DOUBTFUL, "1", "the back-end rejected {value:.0f} loops and kept {count}: hardly any loop holds the map"
    ),
    "against odometry": Kind(
        Verdict.DOUBTFUL,
        "sigma",
        "map and odometry differ by {apart_m:.2f} m, {value:.0f} standard deviations of the odometry, and no loop tells which"
        " of them is right",
    ),
    "odometry dropped": Kind(
        Verdict.DOUBTFUL,
        "%",
        "registrations contradict {count} odometry edges, {value:.0f} % of them (at most {limit:.0f} %): the wheels slip, or"
        " the clock of the sensor is not theirs",
    ),
    "nodes hang": Kind(Verdict.DOUBTFUL, "1", "{value:.0f} nodes are joined to the rest by edges that have no weight"),
    "nothing held": Kind(
        Verdict.DOUBTFUL,
        "m",
        "on {value:.1f} m nothing seen held the motion and no loop spans it: the map rests on odometry",
    ),
    "not localised": Kind(
        Verdict.DOUBTFUL,
        "1",
        "{value:.0f} nodes lie where the odometry has them: the robot may have been kidnapped, its views fit none before",
    ),
    "messages lost": Kind(Verdict.DOUBTFUL, "%", "{name}: {count} messages ({value:.2g} %) cannot be read"),
}
"""Every kind of reason by its name."""

RULES: tuple[Callable[[Facts], Iterable[Reason]], ...] = (
    no_map,
    refused_together,
    none_kept,
    bent,
    at_odds,
    against_wheels,
    contradicted_odometry,
    not_held,
    lost,
    messages_lost,
)
"""What is asked of every map."""


def reasons_of(facts: Facts) -> tuple[Reason, ...]:
    """Every reason against a map, the gravest first."""
    found = [reason for rule in RULES for reason in rule(facts)]
    return tuple(sorted(found, key=lambda reason: reason.verdict is not Verdict.FAILED))


def verdict_of(reasons: Iterable[Reason]) -> Verdict:
    """The verdict on a map with these reasons against it."""
    return max((reason.verdict for reason in reasons), key=lambda verdict: verdict.grade, default=Verdict.TRUSTED)


def said_of(reasons: Sequence[Reason]) -> dict[str, Any]:
    """The keys `verdict` and `reasons` of a JSON object about a map."""
    return {"verdict": str(verdict_of(reasons)), "reasons": [reason.to_json() for reason in reasons]}
