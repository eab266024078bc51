"""How a batch solution comes about: what the same back-end reaches with fewer iterations."""

from __future__ import annotations

import numpy as np

from hybridmap.backends.base import Solution
from hybridmap.backends.objective import chi2
from hybridmap.backends.registry import create
from hybridmap.config.backends import BackendsConfig, ConsistencyConfig
from hybridmap.geometry import Array
from hybridmap.graph.pose_graph import PoseGraph

_NO_SEQUENCE = ("odometry", "gtsam-isam2", "gtsam-gnc", "gtsam-calibrated")  # not one row of iterations on one objective


def convergence(graph: PoseGraph, name: str, config: BackendsConfig, final: Solution) -> Array:
    """Iterations done and chi2 (K, 2) over the edges that `final` kept, from the graph's own poses to `final`.

    Each point is a solution of its own with that limit, at Fibonacci numbers of iterations or sweeps, so that it takes
    about two and a half times as long again. Back-ends whose work is no single sequence have only the two ends.

    Args:
        graph: what was solved.
        name, config: the back-end.
        final: its solution.
    """
    kept = graph.with_edges(~np.isin(graph.edge_ids, final.report.rejected_edge_ids))
    given = graph.with_edges(~np.isin(graph.edge_ids, final.report.inconsistent_edge_ids))
    points = [(0.0, chi2(kept, graph.initial))]
    limit, following = 1, 2
    while limit < final.report.iterations and name not in _NO_SEQUENCE:
        solution = create(name, _limited(config, limit)).solve(given)
        points.append((float(limit), chi2(kept, solution.poses)))
        limit, following = following, limit + following
    points.append((float(final.report.iterations), chi2(kept, final.poses)))
    return np.array(points)


def _limited(config: BackendsConfig, most: int) -> BackendsConfig:
    """The settings with at most so many iterations, or sweeps; the pre-filter has done its work already."""
    relaxation = config.relaxation.model_copy(update={"solve_sweeps": min(most, config.relaxation.solve_sweeps)})
    return config.model_copy(
        update={
            "max_iterations": min(most, config.max_iterations),
            "relaxation": relaxation,
            "consistency": ConsistencyConfig(),
        }
    )
