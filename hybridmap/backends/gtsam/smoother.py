"""One ISAM2 and what it was given; its estimate as an array, of which only what has moved is read anew."""

from __future__ import annotations

from typing import Any

import gtsam
import numpy as np
from numpy.typing import NDArray

from hybridmap.backends.gtsam.factors import NoiseModels, anchor, collected, factors, poses_of, values
from hybridmap.geometry import Array, compose, exp
from hybridmap.graph.pose_graph import Change, PoseGraph, difference

RELINEARIZE_M, RELINEARIZE_RAD = 0.1, 0.01
"""Largest steps of a variable before it is linearised anew: edges bend with headings, not with positions."""
SETTLE_UPDATES = 10
"""Most empty updates after the first one and after an edge was removed; they end when nothing is linearised anew."""
_EACH_NODE = chr(0)  # GTSAM's letter of a key that is a plain number
_MANY = 4  # share of the nodes, as its inverse, from which reading all of them is the quicker way


class Smoother:
    """An ISAM2 that follows a graph. What raises may leave it half changed: throw it away then."""

    def __init__(self, models: NoiseModels, *, orthogonal: bool) -> None:
        """An empty one.

        Args:
            models: makes the noise models of its factors.
            orthogonal: QR factors, slower than Cholesky's, which square the condition of the graph.
        """
        thresholds = gtsam.ISAM2ThresholdMap()
        limits = np.array([RELINEARIZE_M, RELINEARIZE_M, RELINEARIZE_RAD])
        thresholds.insert((_EACH_NODE, limits))
        params = gtsam.ISAM2Params()
        params.setRelinearizeThreshold(thresholds)
        params.relinearizeSkip = 1
        params.setFactorization("QR" if orthogonal else "CHOLESKY")
        params.enablePartialRelinearizationCheck = True
        self._isam = gtsam.ISAM2(params)
        self._models = models
        self._slots: dict[int, int] = {}
        self._point: Array = np.zeros((0, 3))
        self._marked: set[int] = set()
        self._graph: PoseGraph | None = None

    @property
    def is_empty(self) -> bool:
        """Whether it knows nothing yet."""
        return self._graph is None

    def lacks(self, graph: PoseGraph) -> Change:
        """What it has not been told of a graph yet."""
        return difference(self._graph, graph)

    def follow(self, graph: PoseGraph, start: Array, change: Change) -> None:
        """Bring ISAM2 up to the graph by one update.

        Args:
            graph: the graph.
            start: (N, 3), of which the poses of the nodes that it does not know count.
            change: what it lacks of the graph.
        """
        known = len(self._point)
        new = graph.with_edges(change.added)
        held = [anchor(graph.initial[0])] if known == 0 else []
        gone = self._forget(change.removed)
        result = self._update(collected([*held, *factors(new, self._models)]), values(start[known:], known), gone)
        slots = list(result.getNewFactorsIndices())[-new.n_edges :] if new.n_edges else []
        self._slots.update(zip(new.edge_ids.tolist(), slots, strict=True))
        self._point = np.concatenate([self._point, start[known:]])
        self._graph = graph

    def settle(self) -> int:
        """Empty updates until nothing is linearised anew, at most `SETTLE_UPDATES`; returns how many."""
        for done in range(1, SETTLE_UPDATES + 1):
            if self._update().getVariablesRelinearized() == 0:
                return done
        return SETTLE_UPDATES

    def poses(self) -> Array:
        """Current estimate (N, 3)."""
        point, n = self._isam.getLinearizationPoint(), len(self._point)
        if _MANY * len(self._marked) > n:
            self._point = poses_of(point)
        else:
            for key in self._marked:
                pose = point.atPose2(key)
                self._point[key] = pose.x(), pose.y(), pose.theta()
        self._marked = set()
        return compose(self._point, exp(self._isam.getDelta().vector(range(n)).reshape(-1, 3)))

    def _update(self, *given: Any) -> Any:
        """One update; the nodes that it may have linearised anew are marked."""
        result = self._isam.update(*given)
        self._marked.update(result.getMarkedKeys())
        return result

    def _forget(self, removed: NDArray[np.int64]) -> list[int]:
        if self._graph is None:
            return []
        return [self._slots.pop(int(edge)) for edge in self._graph.edge_ids[removed]]
