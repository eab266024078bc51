"""What a back-end is, said once: a frozen graph in, poses and a typed report out."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field
from enum import StrEnum
from typing import Any, Protocol

from hybridmap.geometry import Array
from hybridmap.graph.pose_graph import PoseGraph

ODOMETRY = "odometry"
"""Name of dead reckoning, which counts as a back-end."""


class SolveStatus(StrEnum):
    """Why a solver stopped; `diverged`, `singular` and `failed` came with no map, but for the one they began with.

    `waiting`: an update only placed new nodes, and measurements beside the chain wait for a closure or the end of the drive.
    """

    CONVERGED = "converged"
    WAITING = "waiting"
    MAX_ITERATIONS = "max-iterations"
    STALLED = "stalled"
    DIVERGED = "diverged"
    SINGULAR = "singular"
    FAILED = "failed"

    @property
    def has_map(self) -> bool:
        """Whether the poses are a result."""
        return self not in (SolveStatus.DIVERGED, SolveStatus.SINGULAR, SolveStatus.FAILED)


@dataclass(frozen=True, slots=True)
class Outcome:
    """What a solver says.

    Attributes:
        poses: (N, 3) of every node, m and rad.
        status, message, iterations: why it stopped, and when.
        weights: loop edge id -> final weight.
        rejected: loops held for false.
        values: the poses in the solver's own form, to start from again.
        calibrated: the graph under the odometry calibration that the solver found.
    """

    poses: Array
    status: SolveStatus
    message: str
    iterations: int
    weights: dict[int, float] = field(default_factory=dict)
    rejected: tuple[int, ...] = ()
    values: Any = None
    calibrated: PoseGraph | None = None


Solver = Callable[[PoseGraph, Array], Outcome]
"""Works on a graph from poses (N, 3) of its nodes; a RuntimeError says that it failed."""


@dataclass(frozen=True, slots=True)
class SolveReport:
    """How a solution came about.

    Attributes:
        backend: its name.
        status: why it stopped.
        message: one line for people.
        iterations: of the solver (sweeps for relaxation).
        chi2_initial, chi2: by the one referee, `backends.objective.chi2`, over all edges; never the solver's own cost.
        cpu_s: process time spent.
        rejected_edge_ids: loop edges held for false: of weight zero (GNC), or with a residual beyond the gate (kernels).
        weights: loop edge id -> final weight in [0, 1]; empty for back-ends without a robust kernel.
        chi2_odometry: share of `chi2` that is not of loops. Where loops were rejected and this is large, the map is wrong.
        unit_variance: chi2 of the edges that were not rejected per degree of freedom; 1 where the stated noise is the true one.
        rejected_clusters: groups of rejected loops that agree with each other, the largest first: true loops that were
            dropped, or a place taken for another one. Only where a whole graph was solved.
        inconsistent_edge_ids: of the rejected loops, those that the pre-filter (`judging.prefilter`) kept from the solver.
        weak_edges: odometry and registration edges -> weight, where a kernel on them (`backends.robust.odometry`) leaves less
            than a tenth. They do not count for the unit variance.
        hanging_nodes: nodes that only such edges and rejected loops join to node 0: nothing else holds them.

    Odometry chi2, unit variance, clusters and weak edges are under the calibration of odometry that the back-end found, if
    it looks for one.
    """

    backend: str
    status: SolveStatus
    message: str
    iterations: int
    chi2_initial: float
    chi2: float
    cpu_s: float
    rejected_edge_ids: tuple[int, ...] = ()
    weights: dict[int, float] = field(default_factory=dict)
    chi2_odometry: float | None = None
    unit_variance: float | None = None
    rejected_clusters: tuple[tuple[int, ...], ...] = ()
    inconsistent_edge_ids: tuple[int, ...] = ()
    weak_edges: dict[int, float] = field(default_factory=dict)
    hanging_nodes: int = 0

    @property
    def doubt(self) -> str:
        """What the rejected loops that agree with each other say against the map; empty where there are none."""
        together, groups = sum(map(len, self.rejected_clusters)), len(self.rejected_clusters)
        if not groups:
            return ""
        where = "one group" if groups == 1 else f"{groups} groups"
        found = f"{together} of {len(self.rejected_edge_ids)} rejected loops agree with each other, in {where}"
        return f"{found}: false ones that repeat one mistake, or true ones, where odometry errs more than it says"

    @property
    def summary(self) -> str:
        """The message, and what speaks against the map."""
        return "; ".join(filter(None, (self.message, self.doubt)))


@dataclass(frozen=True, slots=True)
class Solution:
    """Poses of every node in `map`, with the report.

    Attributes:
        poses: (N, 3) m and rad; node 0 stays where the graph's `initial` has it.
        report: why and how.
    """

    poses: Array
    report: SolveReport


class SupportsPoseGraph(Protocol):
    """Anything that can be frozen into a graph, such as the experience map."""

    def pose_graph(self) -> PoseGraph:
        """The accepted edges as arrays."""


class Backend(Protocol):
    """A solver. `update` follows a growing graph while driving; `solve` takes a whole one, from its `initial`."""

    @property
    def name(self) -> str:
        """The name by which `create` knows it."""

    def update(self, graph: PoseGraph) -> Solution:
        """Follow the graph as it has grown (or lost edges) since the last call; cheap, warm-started.

        Raises:
            BackendError: the graph cannot be solved; the state before the call is kept.
        """

    def finish(self, graph: PoseGraph) -> Solution:
        """End of the drive: the best solution of this back-end, from the state that `update` has reached.

        Raises:
            BackendError: the graph cannot be solved; the state before the call is kept.
        """

    def solve(self, graph: PoseGraph | SupportsPoseGraph) -> Solution:
        """Solve a whole graph in a fresh state.

        Raises:
            GraphError: the graph is malformed (see `PoseGraph.validate`).
            BackendError: the solver failed; the message says why.
        """
