"""The interface of a back-end: a frozen graph in, poses and a typed report out."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field
from enum import StrEnum
from typing import Any, Protocol

from hybridmap.errors import counted
from hybridmap.geometry import Array
from hybridmap.graph.pose_graph import PoseGraph

ODOMETRY = "odometry"
"""Name of dead reckoning, which counts as a back-end."""


class SolveStatus(StrEnum):
    """Why a solver stopped. After `diverged`, `singular` and `failed` the poses are those that it started from.

    `max-iterations`: the limit ended the solver before it had converged.
    `stalled`: no step lowered the cost, far from an optimum, or an update raised chi2. The poses are the last ones reached.
    `waiting`: the update only placed new nodes; the solver takes the new edges at a loop closure or at the end of the drive.
    `fell-back`: a robust solver could not go on, and its poses are those of a simpler method, which the message names.
    """

    CONVERGED = "converged"
    WAITING = "waiting"
    MAX_ITERATIONS = "max-iterations"
    STALLED = "stalled"
    FELL_BACK = "fell-back"
    DIVERGED = "diverged"
    SINGULAR = "singular"
    FAILED = "failed"

    @property
    def has_map(self) -> bool:
        """Whether the solver itself computed the poses, i.e. they are not just the initial ones."""
        return self not in (SolveStatus.DIVERGED, SolveStatus.SINGULAR, SolveStatus.FAILED)


@dataclass(frozen=True, slots=True)
class Outcome:
    """The result of a solver, before the figures common to all back-ends are added.

    Attributes:
        poses: (N, 3) poses of all nodes, m and rad.
        status, message: why the solver stopped; one line for people.
        iterations: number of iterations (sweeps for relaxation).
        weights: loop edge id -> final weight in [0, 1]; empty without a robust kernel.
        rejected: edge ids of the loops treated as outliers.
        values: the poses in the solver's own form, for a warm start; None if it needs none.
        calibrated: the graph with the odometry calibration that the solver estimated; None if it estimates none.
        figures: further figures of the solver, by name, for tables.
    """

    poses: Array
    status: SolveStatus
    message: str
    iterations: int
    weights: dict[int, float] = field(default_factory=dict)
    rejected: tuple[int, ...] = ()
    values: Any = None
    calibrated: PoseGraph | None = None
    figures: dict[str, float] = field(default_factory=dict)


Solver = Callable[[PoseGraph, Array], Outcome]
"""Works on a graph from poses (N, 3) of its nodes; a RuntimeError says that it failed."""


class Remembering(Protocol):
    """A solver that keeps state from update to update, in a form of its own."""

    def memory(self) -> Any:
        """The state as plain values and arrays."""

    def remember(self, memory: Any) -> None:
        """Take over the state that `memory` returned: all further outcomes have the same bits."""


@dataclass(frozen=True, slots=True)
class SolveReport:
    """The report of a solution.

    Attributes:
        backend: name of the back-end.
        status: why the solver stopped.
        message: one line for people.
        iterations: number of iterations (sweeps for relaxation).
        chi2_initial, chi2: chi2 over all edges, rejected ones too, at the poses before and after, by
            `backends.objective.chi2` for every back-end; never the solver's own cost.
        cpu_s: process time spent, s.
        rejected_edge_ids: edge ids of the loops treated as outliers: those of weight zero (graduated non-convexity), or with
            a residual beyond the gate (robust kernels).
        weights: loop edge id -> final weight in [0, 1]; empty for back-ends without a robust kernel.
        chi2_odometry: part of `chi2` from edges that are not loops; None: not computed. A large part with rejected loops means
            a wrong map.
        unit_variance: chi2 of the inlier edges per degree of freedom; 1 if the stated covariances are right; None: not
            computed.
        rejected_clusters: groups of rejected loops that agree with each other, the largest first: either rejected true
            loops, or one place mistaken for another. Only if a whole graph was solved.
        inconsistent_edge_ids: the rejected loops that the pre-filter (`judging.prefilter`) removed before solving.
        weak_edges: edge id -> weight, for odometry and registration edges that the kernel `backends.robust.odometry` gave a
            weight below a tenth. They are excluded from the unit variance.
        hanging_nodes: number of nodes that only down-weighted edges and rejected loops join to node 0.
        figures: further figures of the solver, by name, for tables.

    If the back-end calibrates odometry, its estimate applies to odometry chi2, unit variance, clusters and down-weighted edges.
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
    figures: dict[str, float] = field(default_factory=dict)

    @property
    def doubt(self) -> str:
        """A warning about rejected loops that agree with each other; empty string if there are none."""
        together, groups = sum(map(len, self.rejected_clusters)), len(self.rejected_clusters)
        if not groups:
            return ""
        where = counted(groups, "group")
        found = f"{together} of {len(self.rejected_edge_ids)} rejected loops agree with each other, in {where}"
        return f"{found}: either false loops with one common error, or true loops and odometry worse than its covariance"

    @property
    def summary(self) -> str:
        """The message of the solver, with the warning about rejected loops that agree with each other."""
        return "; ".join(filter(None, (self.message, self.doubt)))


@dataclass(frozen=True, slots=True)
class Solution:
    """Poses of every node, with the report.

    Attributes:
        poses: (N, 3) poses in the map frame, m and rad; node 0 keeps its pose of the graph's `initial`.
        report: how the solution was reached.
        calibrated: the graph with the odometry as the back-end calibrated it; None if it did not. It is not stored.
    """

    poses: Array
    report: SolveReport
    calibrated: PoseGraph | None = None


class SupportsPoseGraph(Protocol):
    """An object that can be turned into a frozen graph, such as the experience map."""

    def pose_graph(self) -> PoseGraph:
        """Nodes and accepted edges as arrays."""


class Backend(Protocol):
    """Interface of a back-end.

    `update` follows a growing graph while driving; `solve` solves a whole graph from its `initial`. Between updates nodes keep
    their numbers, and each new node has an edge to one before it.
    """

    @property
    def name(self) -> str:
        """The name from which `registry.create` makes this back-end."""

    def update(self, graph: PoseGraph) -> Solution:
        """Follow the graph as it has grown (or lost edges) since the last call, by a cheap warm start.

        Raises:
            GraphError: a new edge is malformed, or a node is not connected; the state before the call is kept.
            BackendError: the graph cannot be solved; the state before the call is kept.
        """

    def finish(self, graph: PoseGraph) -> Solution:
        """The final solution at the end of a drive, from the state that `update` has reached. It may be called again.

        Raises:
            GraphError: the graph is malformed or not connected.
            BackendError: the graph cannot be solved; the state before the call is kept.
        """

    def solve(self, graph: PoseGraph | SupportsPoseGraph) -> Solution:
        """Solve a whole graph, independently of earlier calls; what `update` has reached stays as it is.

        Raises:
            GraphError: the graph is malformed (see `PoseGraph.validate`) or not connected.
            BackendError: the solver failed; the message says why.
        """
