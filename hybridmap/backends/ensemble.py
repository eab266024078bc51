"""Any number of back-ends side by side on one graph; the first is the primary."""

from __future__ import annotations

import logging
from collections.abc import Sequence

from hybridmap.backends.base import Backend, Solution
from hybridmap.backends.registry import create
from hybridmap.config.backends import BackendsConfig
from hybridmap.errors import BackendError
from hybridmap.geometry import Array
from hybridmap.graph.paths import extend
from hybridmap.graph.pose_graph import PoseGraph
from hybridmap.metrics import StageClock

log = logging.getLogger(__name__)


class Ensemble:
    """Feeds every back-end the same graph, in the same order; one that fails is reported and keeps its last poses.

    Attributes:
        names: of the back-ends, in order.
        primary: name of the first.
        solutions: latest of each, by name.
        failures: why one failed the last time, by name.
    """

    def __init__(self, config: BackendsConfig, clock: StageClock, backends: Sequence[str | Backend] | None = None) -> None:
        """Create the back-ends.

        Args:
            config: their settings, and their names.
            clock: gets a stage `backend/<name>` for each.
            backends: names, or back-ends in a fresh state, in place of those that `config` names.

        Raises:
            BackendError: an unknown name, none at all, or one that is there twice.
        """
        made = [create(backend, config) for backend in (config.names if backends is None else backends)]
        self.solutions: dict[str, Solution] = {}
        self.failures: dict[str, str] = {}
        self._clock = clock
        self._backends: dict[str, Backend] = {backend.name: backend for backend in made}
        if not made or len(self._backends) < len(made):
            raise BackendError(f"back-ends: expected one or more, each once, found {[backend.name for backend in made]}")
        self.names = tuple(self._backends)
        self.primary = self.names[0]

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
