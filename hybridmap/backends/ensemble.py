"""Any number of back-ends side by side on one graph; the first is the primary."""

from __future__ import annotations

import logging

from hybridmap.backends.base import Backend, Solution
from hybridmap.backends.registry import create
from hybridmap.config.backends import BackendsConfig
from hybridmap.errors import BackendError
from hybridmap.geometry import Array
from hybridmap.graph.connectivity import extend
from hybridmap.graph.pose_graph import PoseGraph
from hybridmap.metrics import StageClock

log = logging.getLogger(__name__)


class Ensemble:
    """Feeds every back-end the same graph, in the same order; one that fails is reported and keeps its last poses."""

    def __init__(self, config: BackendsConfig, clock: StageClock) -> None:
        """Create the back-ends of `config.names`; `clock` gets a stage `backend/<name>` for each.

        Raises:
            BackendError: an unknown name.
        """
        self.solutions: dict[str, Solution] = {}
        self.failures: dict[str, str] = {}
        self._clock = clock
        self._backends: dict[str, Backend] = {name: create(name, config) for name in config.names}
        self.primary = config.names[0]

    def poses(self, graph: PoseGraph, name: str | None = None) -> Array:
        """(N, 3) latest poses of a back-end (default: the primary), carried on to newer nodes by their consecutive edges."""
        solution = self.solutions.get(name or self.primary)
        return extend(graph, solution.poses if solution is not None else graph.initial[:1])

    def update(self, graph: PoseGraph) -> None:
        """Let every back-end follow the graph."""
        for name, backend in self._backends.items():
            self._run(name, backend, graph, final=False)

    def finish(self, graph: PoseGraph) -> None:
        """Let every back-end come to its final solution."""
        for name, backend in self._backends.items():
            self._run(name, backend, graph, final=True)

    def _run(self, name: str, backend: Backend, graph: PoseGraph, *, final: bool) -> None:
        try:
            with self._clock.stage(f"backend/{name}"):
                self.solutions[name] = backend.finish(graph) if final else backend.update(graph)
            self.failures.pop(name, None)
        except BackendError as error:
            if name not in self.failures:
                log.warning("%s failed at node %d and keeps its last poses: %s", name, graph.n_nodes - 1, error)
            self.failures[name] = str(error)
