"""`Ensemble` runs several back-ends on one graph."""

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
    """Gives the same graph to several back-ends. A back-end that fails is reported and keeps its last poses.

    Attributes:
        names: names of the back-ends, in order.
        primary: name of the first back-end, whose map the mapper uses.
        solutions: name -> latest solution of the back-end.
        failures: name -> error, for the back-ends whose latest call failed.
    """

    def __init__(self, config: BackendsConfig, clock: StageClock, backends: Sequence[str | Backend] | None = None) -> None:
        """Create the back-ends.

        Args:
            config: their settings, and their names.
            clock: gets a stage `backend/<name>` for each.
            backends: names, or back-ends in a fresh state, instead of those that `config` names.

        Raises:
            BackendError: an unknown name, no name, or a name that is given twice.
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
        """Latest poses (N, 3) by the back-end of this name (None: the primary), m and rad.

        Nodes newer than its solution are placed by their best edges (`graph.paths.extend`).

        Raises:
            BackendError: there is no back-end of this name here.
            GraphError: a node has no path to the others.
        """
        name = name or self.primary
        if name not in self._backends:
            raise BackendError(f"back-end {name!r}: is not in use; expected one of {', '.join(self.names)}")
        solution = self.solutions.get(name)
        return extend(graph, solution.poses if solution is not None else graph.initial[:1])

    @property
    def rejected(self) -> tuple[int, ...]:
        """Numbers of the edges that the primary gave no weight in its latest solution."""
        solution = self.solutions.get(self.primary)
        return () if solution is None else tuple(solution.report.rejected_edge_ids)

    def update(self, graph: PoseGraph) -> None:
        """Let every back-end follow the graph; `solutions` and `failures` say how that went."""
        for name, backend in self._backends.items():
            self._run(name, backend, graph, final=False)

    def finish(self, graph: PoseGraph) -> None:
        """Let every back-end compute its final solution; `solutions` and `failures` say how that went."""
        for name, backend in self._backends.items():
            self._run(name, backend, graph, final=True)

    def trial(self, graph: PoseGraph) -> Solution | None:
        """Solve another graph by the primary back-end, whose own state stays as it is; None if it fails."""
        try:
            with self._clock.stage(f"backend/{self.primary}"):
                return self._backends[self.primary].solve(graph)
        except BackendError:
            return None

    def _run(self, name: str, backend: Backend, graph: PoseGraph, *, final: bool) -> None:
        try:
            with self._clock.stage(f"backend/{name}"):
                self.solutions[name] = backend.finish(graph) if final else backend.update(graph)
            self.failures.pop(name, None)
        except BackendError as error:
            if name not in self.failures:
                log.warning("%s failed at node %d and keeps its last poses: %s", name, graph.n_nodes - 1, error)
            self.failures[name] = str(error)
