"""Graphs in several pieces: every piece is solved by itself, and keeps the frame of the initial pose of its first node."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import replace

import numpy as np
from numpy.typing import NDArray
from scipy.sparse import csr_array
from scipy.sparse.csgraph import connected_components

from hybridmap.backends.base import Solution, SolveReport, SolveStatus
from hybridmap.graph.pose_graph import PoseGraph

Indices = NDArray[np.int64]


def pieces_of(graph: PoseGraph) -> list[Indices]:
    """The nodes of each connected piece, ascending; pieces in the order of their first nodes."""
    ones, n = np.ones(graph.n_edges, dtype=np.int8), graph.n_nodes
    matrix = csr_array((ones, (graph.sources, graph.targets)), shape=(n, n))
    count, label = connected_components(matrix, directed=False)
    return sorted((np.flatnonzero(label == piece) for piece in range(count)), key=lambda nodes: int(nodes[0]))


def solve_by_piece(solve: Callable[[PoseGraph], Solution], graph: PoseGraph) -> Solution:
    """Solve every piece of a graph by itself; poses of two pieces cannot be compared.

    Args:
        solve: solves a connected graph.
        graph: the graph.

    Returns:
        The poses of all nodes, and one report: counts and costs are sums, the status is the worst one.

    Raises:
        GraphError, BackendError: as `solve` raises them.
    """
    pieces = pieces_of(graph)
    if len(pieces) == 1:
        return solve(graph)
    poses, reports = graph.initial.copy(), []
    for nodes in pieces:
        if len(nodes) > 1:
            solution = solve(_piece(graph, nodes))
            poses[nodes] = solution.poses
            reports.append(solution.report)
    return Solution(poses, _together(reports, len(pieces)))


def _piece(graph: PoseGraph, nodes: Indices) -> PoseGraph:
    """The nodes of a piece, numbered from 0, and their edges."""
    number = np.full(graph.n_nodes, -1, dtype=np.int64)
    number[nodes] = np.arange(len(nodes))
    own = graph.with_edges(number[graph.sources] >= 0)
    return replace(
        own, initial=graph.initial[nodes], sources=number[own.sources], targets=number[own.targets], entered=None, file=None
    )


def _together(reports: Sequence[SolveReport], pieces: int) -> SolveReport:
    worst = max(reports, key=lambda report: list(SolveStatus).index(report.status))
    return replace(
        worst,
        message=f"{pieces} pieces that are not joined, each in its own frame; {worst.message}",
        iterations=max(report.iterations for report in reports),
        chi2_initial=sum(report.chi2_initial for report in reports),
        chi2=sum(report.chi2 for report in reports),
        cpu_s=sum(report.cpu_s for report in reports),
        rejected_edge_ids=tuple(sorted(edge for report in reports for edge in report.rejected_edge_ids)),
        weights={edge: weight for report in reports for edge, weight in report.weights.items()},
        weak_edges={edge: weight for report in reports for edge, weight in report.weak_edges.items()},
        hanging_nodes=sum(report.hanging_nodes for report in reports),
        rejected_clusters=tuple(cluster for report in reports for cluster in report.rejected_clusters),
    )
