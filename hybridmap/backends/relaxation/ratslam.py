"""Relaxation link by link, in place, headings too: the rule of RatSLAM's experience map, plain and robust."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from hybridmap.backends.base import Solution, SolveStatus
from hybridmap.backends.following import Outcome
from hybridmap.backends.objective import gate_of, truncated_cost
from hybridmap.backends.relaxation.relaxing import RelaxationBackend
from hybridmap.backends.relaxation.sweeps import Relaxed, relax_links
from hybridmap.config.backends import RelaxationConfig
from hybridmap.geometry import Array, between, compose
from hybridmap.graph.edges import EdgeKind
from hybridmap.graph.pose_graph import PoseGraph

_REJECTED = 0.25  # weight of a loop whose residual is the scale itself


class RatslamRelaxation(RelaxationBackend):
    """`relaxation-ratslam`: every link moves both of its ends by theta times its error."""

    def _relax(self, graph: PoseGraph, start: Array, sweeps: int) -> Outcome:
        config = self._config.relaxation
        return _outcome(relax_links(graph, start, sweeps, config), config)


class RobustRelaxation(RelaxationBackend):
    """`relaxation-robust`: a loop's correction is multiplied by a Geman-McClure weight of its error.

    The scale of the weight shrinks geometrically to 1 in the course of a call. When a whole graph is solved, that takes a
    quarter of the sweeps; the rest are of the plain rule on the loops that are left, with a look at all of them in between.
    The end of a drive is solved as a whole from the map that the drive led to, and the better of the two is kept.
    """

    def finish(self, graph: PoseGraph) -> Solution:
        """See `Backend.finish`."""
        driven = self.update(graph)
        settled = self._timed(graph, lambda: self._optimise(graph, driven.poses))
        bound = gate_of(self._config)
        return min(settled, driven, key=lambda solution: truncated_cost(graph, solution.poses, bound))

    def _relax(self, graph: PoseGraph, start: Array, sweeps: int) -> Outcome:
        config = self._config.relaxation
        quarter = max(sweeps // 4, 1)
        relaxed = replace(relax_links(graph, start, min(sweeps, quarter), config, robust=True), settled=False)
        while relaxed.sweeps < sweeps and not relaxed.settled:
            kept = ~(graph.is_loop & (weights(graph, relaxed.poses, config) < _REJECTED))
            part = min(quarter, sweeps - relaxed.sweeps)
            onward = relax_links(graph.with_edges(kept), relaxed.poses, part, config)
            relaxed = replace(onward, sweeps=relaxed.sweeps + onward.sweeps)
        return _judged(graph, relaxed, config)

    def _relax_on(self, graph: PoseGraph, start: Array, sweeps: int) -> Outcome:
        config = self._config.relaxation
        return _judged(graph, relax_links(graph, start, sweeps, config, robust=True), config)


def weights(graph: PoseGraph, poses: Array, config: RelaxationConfig) -> Array:
    """The Geman-McClure weight (E,) that each edge of the graph would have as a loop, at the robust scales themselves."""
    predicted = compose(poses[graph.sources], graph.deltas)
    errors = between(predicted, poses[graph.targets])
    squared = np.sum(errors[:, :2] ** 2, axis=1) / config.robust_scale_m**2 + errors[:, 2] ** 2 / config.robust_scale_rad**2
    return np.asarray(1.0 / (1.0 + squared) ** 2)


def _judged(graph: PoseGraph, relaxed: Relaxed, config: RelaxationConfig) -> Outcome:
    """The outcome with every loop's weight, those of less than `_REJECTED` as rejected."""
    loops = graph.only(EdgeKind.LOOP)
    by_id = dict(zip(loops.edge_ids.tolist(), weights(loops, relaxed.poses, config).tolist(), strict=True))
    rejected = tuple(edge for edge, weight in by_id.items() if weight < _REJECTED)
    outcome = _outcome(relaxed, config)
    message = f"{outcome.message}; {len(rejected)} of {len(by_id)} loops rejected"
    return replace(outcome, message=message, weights=by_id, rejected=rejected)


def _outcome(relaxed: Relaxed, config: RelaxationConfig) -> Outcome:
    if relaxed.settled:
        message = f"no node moved more than {config.tolerance_m} m"
        return Outcome(relaxed.poses, SolveStatus.CONVERGED, message, relaxed.sweeps)
    return Outcome(relaxed.poses, SolveStatus.MAX_ITERATIONS, f"{relaxed.sweeps} sweeps", relaxed.sweeps)
