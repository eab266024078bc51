"""Pre-filter: a back-end gets only loops that are consistent with each other; the others are tested against its solution."""

from __future__ import annotations

import time
from collections.abc import Callable
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from hybridmap.backends.base import Backend, Solution, SupportsPoseGraph
from hybridmap.backends.gtsam.covariance import expected_loops
from hybridmap.backends.judging.clusters import loops_of, neighbouring_pairs, rejected_clusters
from hybridmap.backends.objective import SLACK, chi2, gate_of, softened, truncated_cost
from hybridmap.config.backends import BackendsConfig
from hybridmap.errors import BackendError, GraphError, counted
from hybridmap.graph.agreement import BOUND, agreement, chi2_quantile, largest_consistent_set, ring
from hybridmap.graph.paths import chain_of
from hybridmap.graph.pose_graph import PoseGraph

NEIGHBOURS = 1
"""Loops between the same places, within 10 nodes at both ends, that each must agree with: a false loop seldom has one."""
_TRIES = 2  # of the loops left out


@dataclass(frozen=True, slots=True)
class _Tried:
    """A solution with some of the loops.

    Attributes:
        solution: the back-end's own.
        out: (L,) indices of the loops that it did not get.
        taken_in: number of loops that were left out at first and added later.
        iterations: of all its solutions.
    """

    solution: Solution
    out: NDArray[np.int64]
    taken_in: int
    iterations: int


class ConsistentBackend:
    """A back-end with the pre-filter before each whole graph; while driving it gets all loops.

    Loops that are left out count as rejected. Those consistent with the solution, given its covariance, are added and the
    graph is solved again from there. If some of the remaining ones agree with each other, a robust back-end is also run with
    all loops, and the better map is kept.
    """

    def __init__(self, inner: Backend, config: BackendsConfig) -> None:
        self._inner = inner
        self._config = config

    @property
    def name(self) -> str:
        """The name from which `registry.create` makes this back-end."""
        return self._inner.name

    def update(self, graph: PoseGraph) -> Solution:
        """Follow the graph with all loops, as it has grown (or lost edges) since the last call.

        Raises:
            BackendError: the graph cannot be solved.
        """
        return self._inner.update(graph)

    def finish(self, graph: PoseGraph) -> Solution:
        """Compute the final solution at the end of a drive.

        Raises:
            BackendError: the graph cannot be solved.
        """
        return self._filtered(graph, self._inner.finish)

    def solve(self, graph: PoseGraph | SupportsPoseGraph) -> Solution:
        """Solve a whole graph with its consistent loops, independently of earlier calls.

        Raises:
            GraphError: the graph is malformed.
            BackendError: the solver failed.
        """
        return self._filtered(graph if isinstance(graph, PoseGraph) else graph.pose_graph(), self._inner.solve)

    def _filtered(self, graph: PoseGraph, solve: Callable[[PoseGraph], Solution]) -> Solution:
        started = time.process_time()
        graph.validate()
        try:
            consistent = consistent_loops(graph)
        except GraphError as broken:
            solution = solve(graph)
            message = f"pre-filter not used, because {broken}; {solution.report.message}"
            return replace(solution, report=replace(solution.report, message=message))
        tried = self._tried(graph, consistent, solve)
        whole = solve(graph) if self._doubtful(graph, tried) else None
        if whole is not None and self._cost(graph, whole) < self._cost(graph, tried.solution):
            message = f"pre-filter not used, because all loops together fit better; {whole.report.message}"
            return replace(whole, report=replace(whole.report, message=message, cpu_s=time.process_time() - started))
        return self._on_whole(graph, tried, time.process_time() - started)

    def _tried(self, graph: PoseGraph, consistent: Consistent, solve: Callable[[PoseGraph], Solution]) -> _Tried:
        out = np.setdiff1d(np.flatnonzero(graph.is_loop), consistent.loops)
        first, solution = len(out), solve(_without(graph, out))
        iterations = solution.report.iterations
        for _ in range(_TRIES if solution.report.status.has_map else 0):
            expected = self._expected(graph, solution, out, SLACK * consistent.variance)
            if len(expected) == 0:
                break
            out = np.setdiff1d(out, expected)
            solution = solve(replace(_without(graph, out), initial=solution.poses))
            iterations += solution.report.iterations
        return _Tried(solution, out, first - len(out), iterations)

    def _doubtful(self, graph: PoseGraph, tried: _Tried) -> bool:
        """Whether left-out loops agree with each other and the back-end is robust itself."""
        report = tried.solution.report
        left_out = tuple(graph.edge_ids[tried.out].tolist())
        judges = report.status.has_map and bool(report.weights)
        return judges and bool(rejected_clusters(graph, tried.solution.poses, left_out, gate_of(self._config)))

    def _cost(self, graph: PoseGraph, solution: Solution) -> float:
        return truncated_cost(graph, solution.poses, gate_of(self._config), self._config.robust)

    def _expected(self, graph: PoseGraph, solution: Solution, out: NDArray[np.int64], most: float) -> NDArray[np.int64]:
        """The left-out loops that are consistent with the solution; a unit variance above `most` does not widen the gate."""
        rejected = np.flatnonzero(np.isin(graph.edge_ids, solution.report.rejected_edge_ids))
        judged = softened(_without(graph, rejected), solution.poses, self._config.robust)
        loops = np.flatnonzero(np.isin(judged.edge_ids, graph.edge_ids[out]))
        variance = solution.report.unit_variance
        try:
            return out[expected_loops(judged, solution.poses, loops, most if variance is None else min(variance, most))]
        except BackendError:  # the map is singular without them, so that it expects nothing of them
            return out[:0]

    def _on_whole(self, graph: PoseGraph, tried: _Tried, cpu_s: float) -> Solution:
        """The solution with a report about the whole graph."""
        poses, report = tried.solution.poses, tried.solution.report
        inconsistent = tuple(graph.edge_ids[tried.out].tolist())
        rejected = tuple(sorted({*report.rejected_edge_ids, *inconsistent}))
        loops = graph.edge_ids[graph.is_loop].tolist()
        weights = {edge: 0.0 if edge in set(inconsistent) else report.weights.get(edge, 1.0) for edge in loops}
        note = f"{len(inconsistent)} of {counted(len(loops), 'loop')} left out as inconsistent, {tried.taken_in} added again"
        whole = replace(
            report,
            message=f"{note}; {report.message}",
            iterations=tried.iterations,
            chi2_initial=chi2(graph, graph.initial),
            chi2=chi2(graph, poses),
            cpu_s=cpu_s,
            rejected_edge_ids=rejected,
            weights=weights,
            rejected_clusters=rejected_clusters(graph, poses, rejected, gate_of(self._config)) if rejected else (),
            inconsistent_edge_ids=inconsistent,
        )
        return replace(tried.solution, report=whole)


def _without(graph: PoseGraph, edges: NDArray[np.int64]) -> PoseGraph:
    return graph.with_edges(np.setdiff1d(np.arange(graph.n_edges), edges))


@dataclass(frozen=True, slots=True)
class Consistent:
    """Result of the pairwise test of loops.

    Attributes:
        loops: (L,) indices among the graph's edges of the loops that agree in pairs, each also with some of its neighbours.
        variance: unit variance of neighbouring loops that agree, relative to the stated covariances; 1 if there are none.
    """

    loops: NDArray[np.int64]
    variance: float


def consistent_loops(graph: PoseGraph) -> Consistent:
    """Find the loops that are consistent with each other.

    Most graph files overstate their noise. Neighbouring loops that agree show by how much: if two loops and the chain between
    them close much better than their covariances say, the bound for all pairs is tightened accordingly.

    Args:
        graph: a graph with a chain of odometry or registration edges.

    Raises:
        GraphError: no odometry or registration edge joins two consecutive nodes; the message names them.
    """
    chain = chain_of(graph)
    if len(chain.breaks):
        raise GraphError(f"graph: no odometry or registration edge joins nodes {chain.breaks[0] - 1} and {chain.breaks[0]}")
    edges = np.flatnonzero(graph.is_loop)
    loops, near = loops_of(graph, edges), neighbouring_pairs(graph, edges)
    apart = ring(loops[near[:, 0]], loops[near[:, 1]], chain.ways).distance
    agreeing = apart[apart <= BOUND]
    variance = float(np.median(agreeing) / chi2_quantile(0.5)) if len(agreeing) else 1.0
    chosen = largest_consistent_set(agreement(loops, chain.ways, BOUND * min(1.0, SLACK * variance)))
    backed = np.bincount(near[chosen[near].all(axis=1)].ravel(), minlength=len(edges))
    return Consistent(edges[chosen & (backed >= NEIGHBOURS)], variance)
