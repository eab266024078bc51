"""`gtsam-isam2`: incremental smoothing; edges may go again, and after a failure the state before it is restored."""

from __future__ import annotations

import gtsam
import numpy as np
from numpy.typing import NDArray

from hybridmap.backends.base import Solution, SolveStatus
from hybridmap.backends.factors import anchor, factors, poses_of, values
from hybridmap.backends.following import Change, GraphBackend, Outcome, difference, prefix
from hybridmap.backends.kernels import loop_kernel, noise_models
from hybridmap.backends.objective import gate_of
from hybridmap.backends.robust import judged
from hybridmap.config.backends import BackendsConfig
from hybridmap.geometry import Array
from hybridmap.graph.connectivity import extend
from hybridmap.graph.pose_graph import PoseGraph


class Smoother:
    """One ISAM2 and what it was given."""

    def __init__(self, config: BackendsConfig) -> None:
        params = gtsam.ISAM2Params()
        params.setRelinearizeThreshold(config.isam2.relinearize_threshold)
        params.relinearizeSkip = 1
        self._isam = gtsam.ISAM2(params)
        self._settle = config.isam2.settle_updates
        self._models = noise_models(config.robust, loop_kernel("gtsam-cauchy", config.robust) if _robust(config) else None)
        self._slots: dict[int, int] = {}
        self.graph: PoseGraph | None = None

    def follow(self, graph: PoseGraph, start: Array) -> int:
        """Bring ISAM2 up to the graph; `start` (N, 3) places the nodes that it does not know. Returns the updates done."""
        change = difference(self.graph, graph)
        known = self.graph.n_nodes if self.graph is not None else 0
        fresh = gtsam.NonlinearFactorGraph()
        if known == 0:
            fresh.push_back(anchor(graph.initial[0]))
        new = graph.with_edges(change.added)
        for factor in factors(new, self._models):
            fresh.push_back(factor)
        gone = self._forget(change.removed)
        result = self._isam.update(fresh, values(start[known:], known), gone)
        slots = list(result.getNewFactorsIndices())[-new.n_edges :] if new.n_edges else []
        self._slots.update(zip(new.edge_ids.tolist(), slots, strict=True))
        self.graph = graph
        extra = self._settle if known == 0 or len(change.removed) else 0
        for _ in range(extra):
            self._isam.update()
        return 1 + extra

    def settle(self, most: int) -> int:
        """Empty updates until nothing is linearised anew; returns how many."""
        for done in range(1, most + 1):
            if self._isam.update().getVariablesRelinearized() == 0:
                return done
        return most

    def poses(self) -> Array:
        """Current estimate (N, 3)."""
        return poses_of(self._isam.calculateEstimate())

    def _forget(self, removed: NDArray[np.int64]) -> list[int]:
        if self.graph is None:
            return []
        return [self._slots.pop(int(edge)) for edge in self.graph.edge_ids[removed]]


def _robust(config: BackendsConfig) -> bool:
    return config.isam2.loop_kernel == "cauchy"


class Isam2Backend(GraphBackend):
    """Follows a growing graph; `solve` grows a frozen one from loop to loop."""

    _softens = True

    def __init__(self, name: str, config: BackendsConfig) -> None:
        super().__init__(name, config)
        self._smoother: Smoother | None = None

    def finish(self, graph: PoseGraph) -> Solution:
        """See `Backend.finish`: goes on from where the drive ended."""
        return self.update(graph)

    def _follow(self, graph: PoseGraph, start: Array, change: Change) -> Outcome:
        del change
        smoother = self._smoother or Smoother(self._config)
        self._smoother = None  # a failure leaves ISAM2 half changed: the next call makes one from the poses kept
        updates = smoother.follow(graph, start)
        outcome = self._outcome(smoother, graph, updates)
        if np.isfinite(outcome.poses).all():
            self._smoother = smoother
        return outcome

    def _optimise(self, graph: PoseGraph, start: Array) -> Outcome:
        smoother = Smoother(self._config)
        updates = smoother.follow(graph, start)
        return self._outcome(smoother, graph, updates + smoother.settle(self._config.max_iterations))

    def _solve_whole(self, graph: PoseGraph) -> Outcome:
        smoother, poses, updates = Smoother(self._config), graph.initial[:1], 0
        for nodes in _closing_nodes(graph):
            part = prefix(graph, nodes)
            updates += smoother.follow(part, extend(part, poses))
            poses = smoother.poses()
        return self._outcome(smoother, graph, updates + smoother.settle(self._config.max_iterations))

    def _outcome(self, smoother: Smoother, graph: PoseGraph, updates: int) -> Outcome:
        poses = smoother.poses()
        outcome = Outcome(poses, SolveStatus.CONVERGED, f"isam2: {updates} updates", updates)
        if not _robust(self._config):
            return outcome
        return judged(outcome, loop_kernel("gtsam-cauchy", self._config.robust), graph, gate_of(self._config))


def _closing_nodes(graph: PoseGraph) -> list[int]:
    """Sizes of the graph at which its newest node closes a loop, and the whole."""
    newest = np.maximum(graph.sources, graph.targets)
    return sorted({*(newest[graph.is_loop] + 1).tolist(), graph.n_nodes})
