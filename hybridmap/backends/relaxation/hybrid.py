"""`relaxation-gtsam-lm`: relax first, optimise from there.

Relaxation needs no good start and thousands of sweeps for the last per cent; least squares needs a good start and a few
iterations. While driving the map is that of `relaxation-ratslam`; at the end Levenberg-Marquardt goes on from it.
"""

from __future__ import annotations

from dataclasses import replace

from hybridmap.backends.base import Solution, SolveStatus
from hybridmap.backends.following import Outcome
from hybridmap.backends.gtsam.batch import run
from hybridmap.backends.gtsam.factors import NoiseModels, factor_graph
from hybridmap.backends.objective import chi2
from hybridmap.backends.relaxation.ratslam import RatslamRelaxation
from hybridmap.geometry import Array
from hybridmap.graph.pose_graph import PoseGraph

_TOLERANCE = 1e-9  # relative decrease of the cost at which the optimiser is done: the start must not show in the result


class HybridRelaxation(RatslamRelaxation):
    """RatSLAM's rule, then Levenberg-Marquardt over all edges."""

    def finish(self, graph: PoseGraph) -> Solution:
        """See `Backend.finish`: optimises from the map that the drive led to."""
        driven = self.update(graph).poses
        return self._timed(graph, lambda: self._refined(graph, driven, "driven"))

    def _optimise(self, graph: PoseGraph, start: Array) -> Outcome:
        relaxed = super()._optimise(graph, start)
        if relaxed.status is SolveStatus.DIVERGED:
            return relaxed
        refined = self._refined(graph, relaxed.poses, f"{relaxed.iterations} sweeps")
        return replace(refined, iterations=relaxed.iterations + refined.iterations)

    def _refined(self, graph: PoseGraph, start: Array, before: str) -> Outcome:
        outcome = run("lm", factor_graph(graph, NoiseModels()), start, self._config.max_iterations, tolerance=_TOLERANCE)
        if chi2(graph, outcome.poses) > chi2(graph, start):
            return Outcome(start, SolveStatus.STALLED, f"{before}; {outcome.message}; kept the relaxed map", outcome.iterations)
        return replace(outcome, message=f"{before}; {outcome.message} after {outcome.iterations} iterations")
