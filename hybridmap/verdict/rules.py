"""The rules: each asks one question about a finished map, and gives its reasons to doubt it. None needs a ground truth."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterable, Iterator

import numpy as np
from numpy.typing import NDArray

from hybridmap.backends.base import ODOMETRY, SolveStatus
from hybridmap.backends.judging.breaks import SAME_DEG, SAME_M
from hybridmap.backends.judging.clusters import rejected_clusters
from hybridmap.backends.judging.rivals import Rival, admitted, rivals, spans
from hybridmap.backends.judging.strain import BENT_MAX, bend_of, largest_bend, lone_pull, optimum, recalibrated, rejected_pull
from hybridmap.backends.objective import SLACK, squared_norms, unit_variance
from hybridmap.calibration.clock import MATTERS_S, TRANSPORT_S, ClockState
from hybridmap.errors import BackendError
from hybridmap.geometry import Array
from hybridmap.graph.agreement import BOUND
from hybridmap.graph.edges import EdgeKind
from hybridmap.graph.paths import chain_of
from hybridmap.graph.pose_graph import PoseGraph
from hybridmap.verdict.facts import Facts
from hybridmap.verdict.reasons import Reason, Verdict

TOGETHER = 4
"""Fewest refused loops that speak against a map, as many as find a lost robot; one more for each doubling of the number of
groups, since of many false groups some fall where the map has nothing against them."""
WRONG_TIMES = 3.0
"""A map is wrong that is so many times as far off as it could be: refused loops that would move it by less are no reason."""
EXPECTED_MIN = 0.5
"""Share of refused loops that a map must expect, given its covariance, where their only fault is that they are not in it."""
PULLED_MAX_M = 0.05
"""Most by which rejected loops may pull a map, RMS, m: the error below which studies call a map right in any case."""
AS_MEANT = (SolveStatus.CONVERGED, SolveStatus.WAITING, SolveStatus.MAX_ITERATIONS)
"""Statuses of a solver that ended as it should. Whether it is at an optimum is asked apart, as a relaxation may end before."""
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
"""Standard deviations of the odometry by which the map may contradict it where no loop decides between them; on short ways
a single slip is more."""
BREAKS_MAX = 2
"""Most breaks of the motion without a kidnapping. Indoors there are none; bushes and trees, which look different from every
side, give dozens, and then a kidnapping that was found may be one of them."""
TOO_SLOW_MAX = 0.05
"""Largest share of views that a live mapper may have been too slow for: most views are near a node and bring nothing new."""
FREE_MAX_M = 10.0
"""Longest way on which odometry alone may know the motion where no loop spans it: good wheels err by some 0.1 m on it."""


def no_map(facts: Facts) -> Iterable[Reason]:
    """A reason if the primary back-end failed, diverged, ended in another way than meant, or the map is dead reckoning."""
    solution = facts.solution
    if solution is None or facts.failure:
        return [facts.reason("back-end failed", name=f"{facts.primary}: {facts.failure or 'it gave no map'}")]
    report = solution.report
    if not report.status.has_map:
        return [facts.reason("no map", report.chi2, report.chi2_initial, name=f"{facts.primary} ({report.status})")]
    if report.status not in AS_MEANT:
        return [facts.reason("fell back", name=f"{facts.primary} ({report.status})")]
    if facts.primary == ODOMETRY or not np.any(facts.in_map & (facts.graph.kinds != EdgeKind.ODOMETRY)):
        return [facts.reason("dead reckoning", int(np.count_nonzero(facts.graph.is_loop)), 0, name=facts.primary)]
    moved = not np.array_equal(solution.poses, facts.graph.initial)
    if not moved and report.chi2 > facts.graph.n_edges:
        return [facts.reason("no map", report.chi2, facts.graph.n_edges, name=f"{facts.primary} (returned its start)")]
    return []


def refused_together(facts: Facts) -> Iterable[Reason]:
    """A reason for each group of loops that are not in the map and agree with each other, where no more loops of the map
    contradict them.

    A group needs `TOGETHER` loops, or some more if there are many groups, and must move the map noticeably. The loops of a
    drive were verified by views, so that all groups of them count together. Of those in a file any share may be false. No
    reason are loops that the map expects and that would hardly make it better: a kernel rejects such true ones.

    The reason names the step that the group disputes most; on a drive, the one nearby whose registration differs oddly from
    the odometry, if there is one.
    """
    graph, poses = facts.graph, facts.poses
    if poses is None:
        return []
    out = facts.plausible & graph.is_loop & (squared_norms(graph, poses) > BOUND)
    groups = rejected_clusters(graph, poses, tuple(graph.edge_ids[out].tolist()), BOUND)
    if facts.driven and groups:
        groups = (tuple(edge for group in groups for edge in group),)
    least = TOGETHER + math.log2(max(len(groups), 1))
    strong = [
        one for one in rivals(graph, poses, groups, facts.kept) if _moves(one) and one.spanning >= max(least, one.against)
    ]
    if not strong or _lack_nothing(facts, poses, strong):
        return []
    return [
        facts.reason("loops refused", one.shift_m, SAME_M, node=_suspect(facts, one), count=one.spanning, against=one.against)
        for one in strong
    ]


def _lack_nothing(facts: Facts, poses: Array, groups: Iterable[Rival]) -> bool:
    """Whether a map expects most of the refused loops of groups, and is nearly as good as it would be with them."""
    loops = [edge for group in groups for edge in group.edge_ids]
    try:
        one = admitted(facts.graph, poses, facts.in_map, loops)
    except BackendError:  # the map is too loose to be compared
        return False
    return one.expected >= EXPECTED_MIN and one.shift_m <= WRONG_TIMES * one.error_m


def _suspect(facts: Facts, rival: Rival) -> int:
    """The node whose step is the most likely one to be wrong, if a group of loops is right."""
    odd = None if facts.steps is None else facts.steps.oddest(rival.first, rival.last)
    return rival.node if odd is None else odd


def _moves(rival: Rival) -> bool:
    return rival.shift_m > SAME_M or rival.turn_rad > math.radians(SAME_DEG)


def strained(facts: Facts) -> Iterable[Reason]:
    """Reasons if the map bends the chain of motion, is not where its own edges are met best, or these contradict each other.

    Odometry that errs alike on every metre bends the chain too. Such a map is judged by its calibrated odometry, if the
    loops of either half of the drive find a calibration that straightens the whole chain.
    """
    if facts.solution is None or facts.poses is None:
        return []
    graph = facts.graph.with_edges(facts.in_map)
    bends = _bent(facts, graph)
    straight = _straightened(facts, graph) if bends else None
    return [*bends, *_at_odds(facts, graph)] if straight is None else list(_at_odds(facts, straight))


def _straightened(facts: Facts, graph: PoseGraph) -> PoseGraph | None:
    """The graph with the odometry calibrated by all loops; None if a calibration leaves the chain bent, or there is none."""
    assert facts.poses is not None
    straight = None
    for straight in recalibrated(graph, facts.poses, TOGETHER):
        if straight is None or _bent(facts, straight):
            return None
    return straight


def _bent(facts: Facts, graph: PoseGraph) -> list[Reason]:
    """The map bends the chain of motion more than the noise of its edges allows."""
    assert facts.solution is not None
    assert facts.poses is not None
    variance = facts.solution.report.unit_variance
    bend = largest_bend(graph, facts.poses, min(variance or 1.0, 1.0))
    if bend is None or bend.sigmas <= BENT_MAX:
        return []
    return [facts.reason("bent", bend.sigmas, BENT_MAX, node=bend.first, until=bend.last, apart_m=bend.apart_m)]


def _at_odds(facts: Facts, graph: PoseGraph) -> Iterator[Reason]:
    """The map is not where its own edges are met best, or they contradict each other even there."""
    assert facts.solution is not None
    assert facts.poses is not None
    if facts.solution.report.weak_edges:
        return
    best = optimum(graph, facts.poses)
    apart_m = np.hypot(*(best - facts.poses)[:, :2].T)
    if apart_m.max() > UNSETTLED_MAX_M:
        yield facts.reason("unsettled", apart_m.max(), UNSETTLED_MAX_M, node=int(np.argmax(apart_m)))
    squared = squared_norms(graph, best)
    variance = unit_variance(graph, squared)
    if variance > STRAIN_MAX:
        first, last = sorted((int(graph.sources[np.argmax(squared)]), int(graph.targets[np.argmax(squared)])))
        yield facts.reason("edges contradict", variance, STRAIN_MAX, node=first, until=last)


def pulled(facts: Facts) -> Iterable[Reason]:
    """A reason if loops that the back-end rejects keep weight enough to pull the map away from where the others want it.

    There is none if the solution gives odometry or registrations little weight (`weak_edges`), which then hold nothing.
    """
    if facts.solution is None or facts.poses is None or facts.solution.report.weak_edges:
        return []
    pull = rejected_pull(facts.graph, facts.poses, facts.in_map, facts.solution.report.weights)
    if pull is None or pull.shift_m <= PULLED_MAX_M:
        return []
    return [facts.reason("pulled", pull.shift_m, PULLED_MAX_M, node=pull.node)]


def alone(facts: Facts) -> Iterable[Reason]:
    """A reason if loops of a file that no other loop confirms move the map to where nothing else has it.

    There is none for a drive, whose loops were verified by views, nor if the solution gives odometry or registrations little
    weight (`weak_edges`).
    """
    if facts.solution is None or facts.poses is None or facts.driven or facts.solution.report.weak_edges:
        return []
    try:
        pull = lone_pull(facts.graph.with_edges(facts.in_map), facts.poses)
    except BackendError:  # what the other edges hold is too loose to be tested
        return []
    if pull is None or pull.shift_m <= UNSETTLED_MAX_M:
        return []
    older, newer = pull.nodes
    return [facts.reason("loops alone", pull.shift_m, UNSETTLED_MAX_M, node=older, until=newer, count=pull.count)]


def none_kept(facts: Facts) -> Iterable[Reason]:
    """A reason if the back-end rejected nearly all loops that the front-end had accepted."""
    if facts.solution is None or facts.poses is None:
        return []
    rejected, kept = len(facts.solution.report.rejected_edge_ids), int(np.count_nonzero(facts.kept))
    few = rejected >= TOGETHER and kept < KEPT_MIN * rejected
    return [facts.reason("loops rejected", rejected, kept / KEPT_MIN, count=kept)] if few else []


def against_wheels(facts: Facts) -> Iterable[Reason]:
    """A reason for each way of at least `FREE_MAX_M` that no loop spans and where map and dead reckoning contradict."""
    if facts.poses is None or facts.wheels is None:
        return
    chain = chain_of(facts.wheels)
    travel = np.concatenate([[0.0], np.hypot(*np.diff(chain.poses[:, :2], axis=0).T).cumsum()])
    for run in _runs(spans(facts.graph, facts.kept)[1:] == 0):
        first, last = int(run[0]), int(run[-1]) + 1
        if travel[last] - travel[first] < FREE_MAX_M:
            continue
        bend = bend_of(chain, facts.poses, first, last)
        if bend is not None and bend.sigmas > WHEELS_MAX:
            yield facts.reason("against odometry", bend.sigmas, WHEELS_MAX, node=first, until=last, apart_m=bend.apart_m)


def _runs(mask: NDArray[np.bool_]) -> list[NDArray[np.int64]]:
    """The runs of indices where a mask is true."""
    parts = np.split(np.arange(len(mask)), np.flatnonzero(np.diff(mask)) + 1)
    return [part for part in parts if len(part) and mask[part[0]]]


def contradicted_odometry(facts: Facts) -> Iterable[Reason]:
    """A reason if registrations contradicted more than the share `DROPPED_MAX` of the odometry edges."""
    if facts.wheels is None or not facts.wheels.n_edges:
        return []
    dropped = facts.wheels.targets[~np.isin(facts.wheels.edge_ids, facts.graph.edge_ids)]
    share = len(dropped) / facts.wheels.n_edges
    if share <= DROPPED_MAX:
        return []
    place = {"node": int(dropped.min()), "until": int(dropped.max())}
    return [facts.reason("odometry dropped", 100.0 * share, 100.0 * DROPPED_MAX, count=len(dropped), **place)]


def clock_offset(facts: Facts) -> Iterable[Reason]:
    """A reason if scans or frames are stamped later or earlier than odometry, and the map was not corrected for it."""
    clock = facts.clock
    if clock is None:
        return []
    if clock.state is ClockState.TIME_BASE:
        return [facts.reason("clock offset", clock.offset_s, TRANSPORT_S)]
    least_s = max(MATTERS_S, 2.0 * clock.sigma_s)
    return [facts.reason("clock offset", clock.left_s, least_s)] if clock.known and abs(clock.left_s) > least_s else []


def not_held(facts: Facts) -> Iterable[Reason]:
    """A reason for each long way that odometry alone knows and no loop spans, and one if nodes hang on edges without weight."""
    report = None if facts.solution is None else facts.solution.report
    if report is not None and report.hanging_nodes:
        yield facts.reason("nodes without weight", report.hanging_nodes, 0)
    if facts.free_m is None:
        return
    for run in _runs((facts.free_m > 0.0) & (spans(facts.graph, facts.kept) == 0)):
        length_m = float(facts.free_m[run].sum())
        if length_m > FREE_MAX_M:
            yield facts.reason("motion unobserved", length_m, FREE_MAX_M, node=int(run[0]) - 1, until=int(run[-1]))


def broken(facts: Facts) -> Iterable[Reason]:
    """A reason if the motion seems broken in more than `BREAKS_MAX` places where no kidnapping was found."""
    if len(facts.breaks) <= BREAKS_MAX:
        return []
    first, last = facts.breaks[0], facts.breaks[-1]
    return [facts.reason("motion broken", len(facts.breaks), BREAKS_MAX, node=first, until=last)]


def lost(facts: Facts) -> Iterable[Reason]:
    """A reason if the robot was not localised at the end."""
    if facts.lost_since is None:
        return []
    nodes = facts.graph.n_nodes
    return [facts.reason("not localised", nodes - facts.lost_since, 0, node=facts.lost_since, until=nodes - 1)]


def messages_lost(facts: Facts) -> Iterable[Reason]:
    """A reason for each topic of the recording with missing or damaged messages."""
    return [
        facts.reason("messages lost", 100.0 * gone / max(every, 1), 0, count=gone, name=name)
        for name, (gone, every) in facts.lost.items()
        if gone
    ]


def views_dropped(facts: Facts) -> Iterable[Reason]:
    """A reason for each sensor of a live drive of whose views too many were left out, as the machine was too slow."""
    return [
        facts.reason("views dropped", 100.0 * gone / every, 100.0 * TOO_SLOW_MAX, count=gone, name=name)
        for name, (gone, every) in facts.dropped.items()
        if gone > TOO_SLOW_MAX * every
    ]


RULES: tuple[Callable[[Facts], Iterable[Reason]], ...] = (
    no_map,
    refused_together,
    none_kept,
    strained,
    pulled,
    alone,
    against_wheels,
    contradicted_odometry,
    clock_offset,
    not_held,
    broken,
    lost,
    messages_lost,
    views_dropped,
)
"""What is asked of every map."""


def reasons_of(facts: Facts) -> tuple[Reason, ...]:
    """Every reason against a map by all rules: those of a failed map first, else in the order of `RULES`."""
    found = [reason for rule in RULES for reason in rule(facts)]
    return tuple(sorted(found, key=lambda reason: reason.verdict is not Verdict.FAILED))
