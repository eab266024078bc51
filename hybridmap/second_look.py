"""After the drive: was the robot carried where nobody noticed, and do the loops that the solver rejected fit after all?

A short carry passes for a bad registration, and a robust back-end then rejects every true loop that contradicts it; a longer
one puts true loops outside the gate of the front-end. Here the chain is loosened at the places that betray themselves. Where
that frees many loops and costs few, the robot was kidnapped; single views tell before which node.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from hybridmap.backends.base import Solution
from hybridmap.backends.ensemble import Ensemble
from hybridmap.backends.judging.breaks import (
    LEAST_LOOPS,
    Freed,
    drove,
    freed,
    is_group,
    leads_across,
    loosened,
    shift,
    wanted_motion,
)
from hybridmap.backends.judging.clusters import loops_of, rejected_clusters
from hybridmap.backends.judging.rivals import rivals, spans
from hybridmap.backends.judging.strain import BENT_MAX, largest_bend
from hybridmap.backends.objective import gate_of, squared_norms
from hybridmap.config import Config
from hybridmap.edge_book import EdgeBook
from hybridmap.geometry import IDENTITY, Array, RelativePose, between
from hybridmap.graph.contradictions import contradictions
from hybridmap.graph.edges import Check, Edge, EdgeKind, Lack, Method, Status, at_most
from hybridmap.graph.experience_map import ExperienceMap
from hybridmap.graph.gaps import kidnappings
from hybridmap.graph.paths import chain_of
from hybridmap.graph.pose_graph import PoseGraph
from hybridmap.metrics import StageClock
from hybridmap.vision.base import Belief, FrontEnd, PartingFrontEnd, VerifyingFrontEnd
from hybridmap.vision.relocalising import REATTACHED_M, REATTACHED_RAD

Indices = NDArray[np.int64]

TRIED = 8
"""Places that are tried for each sign of a break: those where it is strongest."""
ALONG = 5
"""Places that are tried along the stretch that the map bends most: from near the node of a carry, views lead to it."""
EQUAL = 0.5
"""A place is as good as the best one if it gains this share: which one it was, the signs say."""
DIVISIONS = 3
"""How often views are asked again on the map that their last answer gives."""
MOST_CARRIES = 4
"""Kidnappings that are looked for one after the other."""


@dataclass(frozen=True, slots=True)
class _Trial:
    """The chain loosened before a node.

    Attributes:
        place: the node.
        signs: failed checks of whether the robot drove there from the node before.
        solved: (N, 3) poses with the loose chain, m and rad.
        found: what that changes.
        blurred: numbers of the loops, refused ones among them, that are measured by views from both sides.
        wanted: whether a group of loops against the map want the place moved. In a small world most of them are blurred, and
            then free no others: views alone can tell.
    """

    place: int
    signs: tuple[Check, ...]
    solved: Array
    found: Freed
    blurred: tuple[int, ...]
    wanted: bool

    @property
    def promises(self) -> bool:
        """Whether the loops do not contradict a carry here."""
        return self.found.pays or self.found.straightens or (self.wanted and self.found.gain > 0.0 and self.found.lost == 0)


@dataclass(frozen=True, slots=True)
class _Disputed:
    """The loops that are against the map.

    Attributes:
        graph: the edges of the map, and the loops that were refused only because the map did not expect them.
        poses: (N, 3) the map, m and rad.
        outliers: (L,) indices of the loops that do not fit it.
        claimed: nodes to whose steps groups of them point, and some of the stretch of the chain that the map bends most.
        asked: node -> checks of whether the robot drove there from the node before, for the steps that many of them span.
    """

    graph: PoseGraph
    poses: Array
    outliers: Indices
    claimed: set[int]
    asked: Mapping[int, tuple[Check, ...]]


class SecondLook:
    """Takes the final map apart where the robot was carried unnoticed; measures again the loops that the solver rejects."""

    def __init__(
        self, experiences: ExperienceMap, book: EdgeBook, backends: Ensemble, vision: FrontEnd | None, config: Config
    ) -> None:
        """Look at a map by the solutions of the primary back-end, with a front-end that may test and measure."""
        self._map = experiences
        self._book = book
        self._backends = backends
        self._vision = vision
        self._gate = gate_of(config.backends)
        self._enabled = config.edges.gate != "odometry"
        self._may_part = may_part(config)

    def take(self, belief: Callable[[Sequence[int]], Belief], clock: StageClock) -> Iterator[tuple[str, list[int]]]:
        """Change edges of the map in steps; the graph must be solved (`Ensemble.finish`) before the first step and after each.

        With the setting `edges.gate: odometry` nothing is done.

        Args:
            belief: from numbers of edges to the map solved without them.
            clock: measures the time (stage `matching`).

        Yields:
            What was done, and the numbers of the edges that changed.
        """
        if not self._enabled:
            return
        for _ in range(MOST_CARRIES):
            if (solution := self._solution()) is None:
                return
            trial = self._break(solution)
            if trial is None:
                break
            edges = self._parted(solution.poses, trial)
            refused = {number for number in trial.found.loops.tolist() if self._map.edge(number).status is Status.REJECTED}
            again = sorted(refused.union(trial.blurred))
            there = replace(belief(again), poses_map_node=trial.solved)
            edges += self._measured(again, there, clock)
            yield "a kidnapping was found on the final map", edges
        if (solution := self._solution()) is None:
            return
        outliers = solution.report.rejected_edge_ids
        if edges := self._measured(outliers, belief(outliers), clock):
            yield "loops without weight measured again", edges

    def _solution(self) -> Solution | None:
        """The map of the primary back-end; None if its latest call failed: what it has then is of a smaller graph."""
        failed = self._backends.primary in self._backends.failures
        return None if failed else self._backends.solutions.get(self._backends.primary)

    def _break(self, solution: Solution) -> _Trial | None:
        """Find the place whose loosening frees the most loops; None if there is none that shows signs of a break."""
        disputed = self._disputed(solution)
        if disputed is None:
            return None
        known = {one.after for one in kidnappings(self._map)}
        trials = [self._trial(disputed, place) for place in sorted((disputed.claimed | _oddest(disputed.asked)) - known)]
        promising = [trial for trial in trials if trial is not None and trial.promises]
        most = max((trial.found.gain for trial in promising), default=0.0)
        good = [trial for trial in promising if trial.found.gain >= EQUAL * most]
        good.sort(key=lambda trial: (-len(trial.signs), -trial.found.gain))
        divided = (self._divided(disputed, trial) for trial in good if not self._drove(disputed, trial))
        return next((trial for trial in divided if trial is not None), None)

    def _drove(self, disputed: _Disputed, trial: _Trial) -> bool:
        """Whether dead reckoning has the robot where the loops that a trial frees have it: then it was not carried."""
        own = [
            number
            for number, edge in enumerate(self._map.edges)
            if edge.kind is EdgeKind.ODOMETRY and edge.relative is not None and not edge.spans_kidnapping
        ]
        wheels = chain_of(self._map.pose_graph(also=own).only(EdgeKind.ODOMETRY))
        graph, place = disputed.graph, trial.place
        freed_there = np.isin(graph.edge_ids, trial.found.loops) & leads_across(graph, place)
        step = between(trial.solved[place - 1], trial.solved[place])
        return bool(freed_there.any()) and drove(wheels, loops_of(graph, np.flatnonzero(freed_there)), place, step)

    def _disputed(self, solution: Solution) -> _Disputed | None:
        """What the loops say that are against the map; None if they are too few and the map does not bend the chain either."""
        if not self._may_part:
            return None
        own, poses = self._map.pose_graph().edge_ids, solution.poses
        graph = self._map.pose_graph(also=self._unexpected())
        refused = ~np.isin(graph.edge_ids, own)
        outliers = graph.is_loop & np.isin(graph.edge_ids, solution.report.rejected_edge_ids)
        outliers |= refused & (squared_norms(graph, poses) > self._gate)
        variance = min(solution.report.unit_variance or 1.0, 1.0)
        bend = largest_bend(graph.with_edges(~outliers & ~refused), poses, variance)
        bent = bend is not None and bend.sigmas > BENT_MAX
        if np.count_nonzero(outliers) < LEAST_LOOPS and not bent:
            return None
        asked = self._asked(np.flatnonzero(spans(graph, outliers) >= LEAST_LOOPS))
        groups = rejected_clusters(graph, poses, tuple(graph.edge_ids[outliers].tolist()), self._gate)
        found = rivals(graph, poses, groups, graph.is_loop & ~refused & ~outliers)
        claimed = {one.node for one in found if one.spanning >= LEAST_LOOPS}
        if bend is not None:
            claimed.update(np.linspace(bend.first + 1, bend.last, ALONG).astype(np.int64).tolist())
        return _Disputed(graph, poses, np.flatnonzero(outliers), claimed, asked)

    def _unexpected(self) -> list[int]:
        """Numbers of the loops that were refused only because the map did not expect them."""
        if not isinstance(self._vision, PartingFrontEnd):
            return []
        return [
            number
            for number, edge in enumerate(self._map.edges)
            if edge.kind is EdgeKind.LOOP
            and edge.status is Status.REJECTED
            and edge.relative is not None
            and self._vision.unexpected(edge)
        ]

    def _divided(self, disputed: _Disputed, trial: _Trial) -> _Trial | None:
        """The trial before the node at which single views divide the chain; None if neither they nor the step show a break."""
        for _ in range(DIVISIONS):
            divided = self._vision.divided(trial.place, trial.solved) if isinstance(self._vision, PartingFrontEnd) else None
            if divided is None or divided.evidence.passed:
                break
            if divided.node == trial.place:
                return replace(trial, signs=(*trial.signs, divided.evidence))
            there = self._trial(disputed, divided.node)
            if there is None or not there.promises:
                break
            trial = there
        return trial if trial.signs and trial.found.pays else None

    def _asked(self, places: Indices) -> dict[int, tuple[Check, ...]]:
        """Checks of whether the robot drove to each of some nodes: registration against wheels, and what it saw."""
        steps, out = contradictions(self._map.edges), dict[int, tuple[Check, ...]]()
        for place in places.tolist():
            way = self._vision.way(place) if isinstance(self._vision, PartingFrontEnd) else ()
            out[place] = (at_most("odometry_sigma", steps.sigmas.get(place, 0.0), steps.odd), *way)
        return out

    def _trial(self, disputed: _Disputed, place: int) -> _Trial | None:
        """Solve the graph with its chain loosened before a node; None if the back-end cannot.

        Loops that fitted may be lost to those that are against both maps. Then all that fit one of the two are tried together.
        """
        graph, poses = disputed.graph, disputed.poses
        clear = self._clear(graph, place)
        voting = disputed.outliers[leads_across(graph, place)[disputed.outliers]]
        motion = wanted_motion(graph, poses, voting, place) if len(voting) else IDENTITY
        tried = self._loosened(graph.with_edges(clear), disputed, place, motion, clear)
        if tried is not None and tried[1].lost and tried[1].gain > 0.0:
            fits = np.minimum(squared_norms(graph, poses), squared_norms(graph, tried[0])) <= self._gate
            together = self._loosened(graph.with_edges(clear & (fits | ~graph.is_loop)), disputed, place, motion, clear)
            tried = max(tried, together or tried, key=lambda one: one[1].gain)
        if tried is None:
            return None
        solved, found = tried
        signs = tuple(check for check in disputed.asked.get(place, ()) if not check.passed)
        return _Trial(place, signs, solved, found, tuple(graph.edge_ids[~clear].tolist()), is_group(graph, voting))

    def _loosened(
        self, graph: PoseGraph, disputed: _Disputed, place: int, motion: Array, clear: NDArray[np.bool_]
    ) -> tuple[Array, Freed] | None:
        """Poses (N, 3) of a graph with its chain loosened before a node, and what that changes; None if it cannot be solved."""
        solved = self._backends.trial(loosened(graph, disputed.poses, place, motion))
        if solved is None:
            return None
        return solved.poses, freed(disputed.graph, disputed.poses, solved.poses, place, self._gate, clear)

    def _clear(self, graph: PoseGraph, place: int) -> NDArray[np.bool_]:
        """(E,) edges but the loops across a node that are measured by views from both sides of it."""
        travel_m = np.array([node.travel_m for node in self._map.nodes])
        reach_m = self._vision.reach_m if isinstance(self._vision, PartingFrontEnd) else 0.0
        low, high = np.minimum(graph.sources, graph.targets), np.maximum(graph.sources, graph.targets)
        near = (travel_m[high] - travel_m[place] < reach_m) | (travel_m[place] - travel_m[low] <= reach_m)
        return np.asarray(~(graph.is_loop & leads_across(graph, place) & near & (reach_m > 0.0)))

    def _parted(self, poses: Array, trial: _Trial) -> list[int]:
        """Write a break into the map with poses (N, 3): no motion leads across it, but a loose edge by way of the loops."""
        place, graph, changed = trial.place, self._map.pose_graph(), []
        for number in graph.edge_ids[graph.is_motion & leads_across(graph, place)].tolist():
            edge = self._map.edge(number)
            broken_by = trial.signs if (edge.source, edge.target) == (place - 1, place) else ()
            edge = replace(edge.settled(lack=Lack.KIDNAPPED), broken_by=broken_by, contradicts_odometry=False, since_node=-1)
            self._map.update_edge(number, edge)
            changed.append(number)
        covariance = np.diag([REATTACHED_M, REATTACHED_M, REATTACHED_RAD]) ** 2
        reattached = Edge.decided(
            place - 1,
            place,
            EdgeKind.REGISTRATION,
            RelativePose(between(trial.solved[place - 1], trial.solved[place]), covariance),
            method=Method.LOOPS,
            figures={"agreeing": float(len(trial.found.loops))},
            kidnapped_m=shift(trial.found.motion, poses, place)[0],
            contradicts_odometry=True,
        )
        if isinstance(self._vision, PartingFrontEnd):
            self._vision.part(place)
        return [*changed, self._map.add_edge(reattached)]

    def _measured(self, numbers: Sequence[int], belief: Belief, clock: StageClock) -> list[int]:
        """Let vision measure loops again, from the map without them; returns the numbers of the edges that changed."""
        loops = self._book.proposed(numbers)
        if not loops or not isinstance(self._vision, VerifyingFrontEnd):
            return []
        with clock.stage("matching"):
            proposals = self._vision.verify(loops, belief)
        return self._book.enter_again(proposals)


def may_part(config: Config) -> bool:
    """Whether the chain may be taken apart at the end of the drive, where the robot was carried unnoticed."""
    edges = config.edges
    return config.vision.relocalising.enabled and edges.hanging == "chain" and edges.gate != "odometry"


def _oddest(asked: Mapping[int, Sequence[Check]]) -> set[int]:
    """For each check, the nodes that fail it by most."""
    out: set[int] = set()
    for index in range(max(map(len, asked.values()), default=0)):
        worst = [
            (checks[index].slack, node) for node, checks in asked.items() if len(checks) > index and not checks[index].passed
        ]
        out |= {node for _, node in sorted(worst)[:TRIED]}
    return out
