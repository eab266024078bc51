"""The one referee of every comparison: the sum of squared Mahalanobis residuals on SE(2)."""

from __future__ import annotations

import numpy as np

from hybridmap.config.backends import BackendsConfig
from hybridmap.geometry import Array, log
from hybridmap.graph.agreement import chi2_quantile
from hybridmap.graph.pose_graph import PoseGraph

SLACK = 4.0
"""Factor on a unit variance that is estimated, before measurements are refused for it: files mostly overstate their noise."""


def residuals(graph: PoseGraph, poses: Array) -> Array:
    """Residuals `(E, 3)`: log(inverse(delta) * between(source, target)) in the target's frame, m, m, rad.

    Args:
        graph: the measurements.
        poses: (N, 3) pose of every node.
    """
    source, target, delta = poses[graph.sources], poses[graph.targets], graph.deltas
    cos, sin = np.cos(source[:, 2]), np.sin(source[:, 2])  # written out, not composed: every update asks for it
    x, y = target[:, 0] - source[:, 0], target[:, 1] - source[:, 1]
    x, y = cos * x + sin * y - delta[:, 0], cos * y - sin * x - delta[:, 1]
    cos, sin = np.cos(delta[:, 2]), np.sin(delta[:, 2])
    return log(np.stack([cos * x + sin * y, cos * y - sin * x, target[:, 2] - source[:, 2] - delta[:, 2]], axis=1))


def squared_norms(graph: PoseGraph, poses: Array) -> Array:
    """Squared Mahalanobis norm `(E,)` of each edge's residual."""
    r = residuals(graph, poses)
    return np.asarray(np.einsum("ei,eij,ej->e", r, graph.information, r))


def chi2(graph: PoseGraph, poses: Array) -> float:
    """Sum of the squared Mahalanobis residuals of all edges; infinite where a pose is not finite."""
    with np.errstate(invalid="ignore", over="ignore"):
        return total(squared_norms(graph, poses))


def total(squared: Array) -> float:
    """Sum of squared residuals (E,); infinite where one is not finite."""
    summed = float(squared.sum())
    return summed if np.isfinite(summed) else float("inf")


def unit_variance(graph: PoseGraph, squared: Array, rejected: tuple[int, ...] = ()) -> float:
    """Sum of squared residuals (E,) of the edges that were not rejected, per degree of freedom; 1 without redundancy."""
    inliers = squared[~np.isin(graph.edge_ids, rejected)] if rejected else squared
    freedom = 3 * (len(inliers) - graph.n_nodes + 1)
    return float(inliers.sum()) / freedom if freedom > 0 else 1.0


def truncated_cost(graph: PoseGraph, poses: Array, bound: float) -> float:
    """Chi2 with the squared residual of each loop cut off at a bound: what judges poses where loops may be false."""
    every = squared_norms(graph, poses)
    return float(np.where(graph.is_loop, np.minimum(every, bound), every).sum())


def gate_of(config: BackendsConfig) -> float:
    """Squared residual from which a loop is held for false: the configured quantile of chi2 with 3 degrees of freedom."""
    return chi2_quantile(config.gnc.quantile)
