"""What all relaxation rules share: some sweeps whenever the graph has grown, and the state is the map."""

from __future__ import annotations

from abc import abstractmethod
from collections.abc import Callable

import numpy as np

from hybridmap.backends.base import Solution, SolveStatus
from hybridmap.backends.following import Change, GraphBackend, Outcome
from hybridmap.geometry import Array
from hybridmap.graph.pose_graph import PoseGraph


class RelaxationBackend(GraphBackend):
    """A rule that is swept over the graph; a subclass supplies `_relax`."""

    def finish(self, graph: PoseGraph) -> Solution:
        """See `Backend.finish`: the sweeps of one more update; the end of the drive goes on from the map."""
        return self.update(graph)

    def _must_work(self, change: Change) -> bool:
        del change
        return True

    def _follow(self, graph: PoseGraph, start: Array, change: Change) -> Outcome:
        del change
        return self._guard(self._relax_on, graph, start, self._config.relaxation.sweeps_per_node)

    def _optimise(self, graph: PoseGraph, start: Array) -> Outcome:
        return self._guard(self._relax, graph, start, self._config.relaxation.solve_sweeps)

    def _guard(self, relax: Callable[[PoseGraph, Array, int], Outcome], graph: PoseGraph, start: Array, sweeps: int) -> Outcome:
        if graph.n_edges == 0:
            return Outcome(start, SolveStatus.CONVERGED, "nothing to relax", 0)
        with np.errstate(over="ignore", invalid="ignore"):
            outcome = relax(graph, start, sweeps)
        if np.isfinite(outcome.poses).all():
            return outcome
        message = f"theta {self._config.relaxation.theta}: poses were not finite; kept those before"
        return Outcome(start, SolveStatus.DIVERGED, message, outcome.iterations)

    @abstractmethod
    def _relax(self, graph: PoseGraph, start: Array, sweeps: int) -> Outcome:
        """At most so many sweeps over a graph that has edges, from poses (N, 3)."""

    def _relax_on(self, graph: PoseGraph, start: Array, sweeps: int) -> Outcome:
        """The same while the graph grows."""
        return self._relax(graph, start, sweeps)
