"""Incremental smoothing by ISAM2. Edges may be removed again; a failure restores the state before."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Any

import gtsam
import numpy as np

from hybridmap.backends.base import Outcome, SolveStatus
from hybridmap.backends.driver import Driver
from hybridmap.backends.gtsam.factors import (
    NoiseModels,
    anchor,
    collected,
    factors,
    loop_kernel,
    noise_models,
    poses_of,
    values,
)
from hybridmap.backends.gtsam.initial import angular_start
from hybridmap.backends.gtsam.robust import judged
from hybridmap.backends.objective import gate_of, squared_norms, total, truncated_cost
from hybridmap.config.backends import BackendsConfig
from hybridmap.errors import counted
from hybridmap.geometry import Array, compose, exp
from hybridmap.graph.pose_graph import Change, PoseGraph, difference, prefix

RELINEARIZE_M, RELINEARIZE_RAD = 0.1, 0.01
"""Largest steps of a variable before it is linearised anew: edges bend with headings, not with positions."""
PATIENCE = 0.5
"""Closures wait while together they could move no pose by more than this many of its standard deviations: not to be seen."""
SETTLE_UPDATES = 10
"""Most empty updates after the first one and after an edge was removed; they end when nothing is linearised anew."""
_EACH_NODE = chr(0)  # GTSAM's letter of a key that is a plain number
_MANY = 4  # share of the nodes, as its inverse, from which reading all of them is the quicker way
_RISE = 1e-3  # relative, of chi2: what the thresholds of linearisation leave open
_SETTLED = 1e-5  # relative decrease of the cost that no longer counts: the batch optimisers' tolerance


def create(name: str, config: BackendsConfig) -> Driver:
    """A back-end that follows a growing graph; `solve` replays a frozen one from loop to loop."""
    isam2 = Isam2(config)
    most_rise = np.inf if isam2.is_robust else _RISE

    def solve(graph: PoseGraph, initial: Array) -> Outcome:
        del initial  # the chain is grown from node 0
        drive = create(name, config)
        *grown, _ = _closing_nodes(graph)
        updates = sum(drive.update(prefix(graph, nodes)).report.iterations for nodes in grown)
        end = drive.finish(graph)
        report, updates = end.report, updates + end.report.iterations
        message = f"isam2: {counted(updates, 'update')}"
        return Outcome(end.poses, report.status, message, updates, report.weights, report.rejected_edge_ids)

    def given(graph: PoseGraph, start: Array) -> Outcome:
        return Isam2(config).conclude(graph, start)

    follow, last = isam2.follow, isam2.conclude
    return Driver(
        name, config, solve, follow=follow, last=last, given=given, most_rise=most_rise, softens=True, remembers=isam2
    )


class Isam2:
    """The solvers of the ISAM2 back-end: `follow` for updates while driving, and `conclude` for the end of the drive.

    Loop closures that agree with the map are delayed. To first order, adding measurements with residuals r to a least-squares
    map moves no pose by more than sqrt(sum of r' information r) of its standard deviations (Cauchy-Schwarz on the Kalman
    gain), and without them chi2 is at most that sum above its minimum. ISAM2 runs once the root exceeds `PATIENCE`.
    """

    def __init__(self, config: BackendsConfig) -> None:
        self._config = config
        self._smoother: Smoother | None = None
        self._weights: dict[int, float] = {}
        self._rejected: tuple[int, ...] = ()
        self._kernel = loop_kernel("cauchy", config.robust) if config.isam2.loop_kernel == "cauchy" else None

    @property
    def is_robust(self) -> bool:
        """Whether loops or odometry edges have a robust kernel."""
        return self._kernel is not None or self._config.robust.odometry != "none"

    def memory(self) -> Any:
        """Weights, rejected loops, and all that the smoother was told; see `Remembering`."""
        return self._weights, self._rejected, None if self._smoother is None else self._smoother.told()

    def remember(self, memory: Any) -> None:
        """Take over what `memory` returned, by telling a new smoother the same again: ISAM2 gives its state to nobody."""
        self._weights, self._rejected, told = memory
        if told is not None:
            self._smoother = self._empty(orthogonal=told.orthogonal)
            self._smoother.tell(told)

    def follow(self, graph: PoseGraph, start: Array) -> Outcome:
        """Solve a grown graph from poses `start` (N, 3); loop closures that would hardly move the map may be delayed."""
        if self._smoother is not None:
            shift = _largest_shift(graph, self._smoother.lacks(graph), start)
            if shift <= PATIENCE:
                message = f"isam2: loop closures wait; they would move no pose by more than {shift:.2g} standard deviations"
                return Outcome(start, SolveStatus.CONVERGED, message, 0, self._weights, self._rejected)
        return self._kept(*self._brought_up(graph, start), graph)

    def conclude(self, graph: PoseGraph, start: Array) -> Outcome:
        """Solve the graph at the end of a drive from poses `start` (N, 3): nothing waits, and every node is linearised anew."""
        return self._kept(*self._polished(*self._brought_up(graph, start), graph), graph)

    def _brought_up(self, graph: PoseGraph, start: Array) -> tuple[Smoother, int]:
        """The smoother with the new part of the graph, and the number of updates.

        Meanwhile the smoother is not stored, because a failure leaves it half changed; the next call then makes a new one.
        """
        smoother, self._smoother = self._smoother, None
        if smoother is None:
            return self._anew(graph, start)
        try:
            return self._told(smoother, graph, start)
        except RuntimeError:
            return self._anew(graph, start)

    def _told(self, smoother: Smoother, graph: PoseGraph, start: Array) -> tuple[Smoother, int]:
        """A smoother that knows the graph, converged if it is new or if edges were removed, and the number of updates.

        A map bent by false edges may stay in a wrong local minimum when they are removed: then a fresh smoother is made.
        """
        new, lacks = smoother.is_empty, smoother.lacks(graph)
        smoother.follow(graph, start, lacks)
        if not new and len(lacks.removed) == 0:
            return smoother, 1
        updates = 1 + smoother.settle()
        if new:
            return smoother, updates
        straight = angular_start(graph)
        if straight is not None and self._cost(graph, straight) < self._cost(graph, smoother.poses()):
            smoother, more = self._anew(graph, straight)
            updates += more
        return self._polished(smoother, updates, graph)

    def _polished(self, smoother: Smoother, updates: int, graph: PoseGraph) -> tuple[Smoother, int]:
        """The smoother, relinearised at every node as long as that lowers the cost, and the number of updates so far."""
        cost = self._cost(graph, smoother.poses())
        for _ in range(self._config.max_iterations):
            onward, more = self._anew(graph, smoother.poses())
            before, cost, updates = cost, self._cost(graph, onward.poses()), updates + more
            if not cost < before:
                break
            smoother = onward
            if before - cost <= _SETTLED * before:
                break
        return smoother, updates

    def _anew(self, graph: PoseGraph, start: Array) -> tuple[Smoother, int]:
        """A new smoother with a whole graph from poses (N, 3), and the number of updates."""
        try:
            return self._told(self._empty(), graph, start)
        except RuntimeError:  # Cholesky factors square the condition of the graph, orthogonal ones do not
            return self._told(self._empty(orthogonal=True), graph, start)

    def _empty(self, *, orthogonal: bool = False) -> Smoother:
        return Smoother(noise_models(self._config.robust, self._kernel), orthogonal=orthogonal)

    def _cost(self, graph: PoseGraph, poses: Array) -> float:
        """The cost that the smoother minimises, by the common objective."""
        bound = np.inf if self._kernel is None else gate_of(self._config)
        return truncated_cost(graph, poses, bound, self._config.robust)

    def _kept(self, smoother: Smoother, updates: int, graph: PoseGraph) -> Outcome:
        """The outcome; if finite, the smoother is kept for the next update."""
        outcome = Outcome(smoother.poses(), SolveStatus.CONVERGED, f"isam2: {counted(updates, 'update')}", updates)
        if self._kernel is not None:
            outcome = judged(outcome, self._kernel, graph, gate_of(self._config))
        if np.isfinite(outcome.poses).all():
            self._smoother, self._weights, self._rejected = smoother, outcome.weights, outcome.rejected
        return outcome


def _largest_shift(graph: PoseGraph, lacks: Change, start: Array) -> float:
    """Bound of the shift of any pose by the missing edges, in standard deviations; infinite if edges are to be removed."""
    if len(lacks.removed):
        return np.inf
    return float(np.sqrt(total(squared_norms(graph.with_edges(lacks.added), start))))


def _closing_nodes(graph: PoseGraph) -> list[int]:
    """Sizes of the graph at which its newest node closes a loop, and the full size."""
    newest = np.maximum(graph.sources, graph.targets)
    return sorted({*(newest[graph.is_loop] + 1).tolist(), graph.n_nodes})


@dataclass(frozen=True, slots=True)
class Step:
    """One update of a smoother with something new.

    Attributes:
        first: (3,) pose of node 0, m and rad.
        edges: the new edges, without nodes.
        poses: (M, 3) poses of the new nodes.
        removed: numbers of the edges that are removed.
    """

    first: Array
    edges: PoseGraph
    poses: Array
    removed: tuple[int, ...]


@dataclass(frozen=True, slots=True)
class Told:
    """What a smoother was told, from which another one comes to the same state.

    Attributes:
        orthogonal: by which factorisation.
        graph: the graph that it holds.
        steps: its updates; None: one without anything new.
    """

    orthogonal: bool
    graph: PoseGraph | None
    steps: tuple[Step | None, ...]


class Smoother:
    """An ISAM2 object that follows a graph. After an exception it may be half changed and must be discarded.

    Attributes:
        isam: the GTSAM object.
    """

    def __init__(self, models: NoiseModels, *, orthogonal: bool) -> None:
        """An empty smoother.

        Args:
            models: makes the noise models of its factors.
            orthogonal: QR factorisation: slower than Cholesky, which squares the condition number.
        """
        thresholds = gtsam.ISAM2ThresholdMap()
        limits = np.array([RELINEARIZE_M, RELINEARIZE_M, RELINEARIZE_RAD])
        thresholds.insert((_EACH_NODE, limits))
        params = gtsam.ISAM2Params()
        params.setRelinearizeThreshold(thresholds)
        params.relinearizeSkip = 1
        params.setFactorization("QR" if orthogonal else "CHOLESKY")
        params.enablePartialRelinearizationCheck = True
        self.isam = gtsam.ISAM2(params)
        self._models = models
        self._orthogonal = orthogonal
        self._steps: list[Step | None] = []
        self._slots: dict[int, int] = {}
        self._point: Array = np.zeros((0, 3))
        self._marked: set[int] = set()
        self._graph: PoseGraph | None = None

    @property
    def is_empty(self) -> bool:
        """Whether `follow` was not called yet."""
        return self._graph is None

    def lacks(self, graph: PoseGraph) -> Change:
        """What differs between the edges that the smoother holds and a graph, to be given to `follow`."""
        return difference(self._graph, graph)

    def follow(self, graph: PoseGraph, start: Array, change: Change) -> None:
        """Bring ISAM2 up to date with the graph by one update.

        Args:
            graph: the graph.
            start: (N, 3) poses; those of new nodes are used.
            change: the difference between the graph and the edges that the smoother holds (`lacks`).
        """
        new, known = graph.with_edges(change.added), len(self._point)
        gone = () if self._graph is None else tuple(self._graph.edge_ids[change.removed].tolist())
        self._take(Step(graph.initial[0], replace(new, initial=new.initial[:0]), start[known:].copy(), gone))
        self._graph = graph

    def told(self) -> Told:
        """All that it was told so far; it grows with the updates."""
        return Told(self._orthogonal, self._graph, tuple(self._steps))

    def tell(self, told: Told) -> None:
        """Come to the state of the smoother that was told this; this one must be empty."""
        for step in told.steps:
            self._update() if step is None else self._take(step)
        self._graph = told.graph

    def settle(self) -> int:
        """Run updates without new factors until nothing is relinearised, at most `SETTLE_UPDATES`; returns their number."""
        for done in range(1, SETTLE_UPDATES + 1):
            self._steps.append(None)
            if self._update().getVariablesRelinearized() == 0:
                return done
        return SETTLE_UPDATES

    def poses(self) -> Array:
        """Current estimate (N, 3) of the nodes that `follow` has added, m and rad."""
        point, n = self.isam.getLinearizationPoint(), len(self._point)
        if _MANY * len(self._marked) > n:
            self._point = poses_of(point)
        else:
            for key in self._marked:
                pose = point.atPose2(key)
                self._point[key] = pose.x(), pose.y(), pose.theta()
        self._marked = set()
        return compose(self._point, exp(self.isam.getDelta().vector(range(n)).reshape(-1, 3)))

    def _take(self, step: Step) -> None:
        """Run one update with something new."""
        self._steps.append(step)
        known, new = len(self._point), step.edges
        held = [anchor(step.first)] if known == 0 else []
        gone = [self._slots.pop(edge) for edge in step.removed]
        result = self._update(collected([*held, *factors(new, self._models)]), values(step.poses, known), gone)
        slots = list(result.getNewFactorsIndices())[-new.n_edges :] if new.n_edges else []
        self._slots.update(zip(new.edge_ids.tolist(), slots, strict=True))
        self._point = np.concatenate([self._point, step.poses])

    def _update(self, *given: Any) -> Any:
        """Run one update and mark the nodes that may have been relinearised."""
        result = self.isam.update(*given)
        self._marked.update(result.getMarkedKeys())
        return result
