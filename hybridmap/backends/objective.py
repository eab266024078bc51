"""The objective by which all back-ends are compared, squared Mahalanobis residuals on SE(2), and robust costs of edges."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from hybridmap.config.backends import BackendsConfig, RobustConfig
from hybridmap.geometry import Array, log
from hybridmap.graph.agreement import chi2_quantile
from hybridmap.graph.pose_graph import PoseGraph

SLACK = 4.0
"""Factor on a unit variance that is estimated, before measurements are refused for it: files mostly overstate their noise."""
ODOMETRY_SCALE = 1.0
"""Whitened residual at which the weight of the kernel on edges of motion is a half (Cauchy) or a quarter (Geman-McClure), or
from which its cost is linear (Huber): one standard deviation of the edge."""
WEAK = 0.1
"""Weight below which an edge holds next to nothing: Cauchy's at three times its scale."""

_Kernel = Callable[[Array, float], Array]  # of squared whitened residuals and a scale

_WEIGHTS: dict[str, _Kernel] = {
    "none": lambda squared, _: np.ones_like(squared),
    "huber": lambda squared, scale: scale / np.maximum(np.sqrt(squared), scale),
    "cauchy": lambda squared, scale: 1.0 / (1.0 + squared / scale**2),
    "geman-mcclure": lambda squared, scale: 1.0 / (1.0 + squared / scale**2) ** 2,
}

_COSTS: dict[str, _Kernel] = {
    "none": lambda squared, _: squared,
    "huber": lambda squared, scale: np.where(squared <= scale**2, squared, scale * (2.0 * np.sqrt(squared) - scale)),
    "cauchy": lambda squared, scale: scale**2 * np.log1p(squared / scale**2),
    "geman-mcclure": lambda squared, scale: squared / (1.0 + squared / scale**2),
}


def residuals(graph: PoseGraph, poses: Array) -> Array:
    """Residuals (E, 3) of the edges: log of the target's pose relative to its prediction by source and edge, m, m, rad.

    Args:
        graph: the measurements.
        poses: (N, 3) pose of every node, m and rad.
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
    """Sum of the squared Mahalanobis residuals of all edges; infinite if a pose is not finite."""
    with np.errstate(invalid="ignore", over="ignore"):
        return total(squared_norms(graph, poses))


def total(squared: Array) -> float:
    """Sum of squared residuals (E,); infinite if one is not finite."""
    summed = float(squared.sum())
    return summed if np.isfinite(summed) else float("inf")


def unit_variance(graph: PoseGraph, squared: Array, rejected: tuple[int, ...] = ()) -> float:
    """Sum of the squared residuals of the inlier edges per degree of freedom; 1 without redundancy.

    Args:
        graph: the graph.
        squared: (E,) squared residuals of its edges.
        rejected: ids of the edges to leave out.
    """
    inliers = squared[~np.isin(graph.edge_ids, rejected)] if rejected else squared
    freedom = 3 * (len(inliers) - graph.n_nodes + 1)
    return float(inliers.sum()) / freedom if freedom > 0 else 1.0


def truncated_cost(graph: PoseGraph, poses: Array, bound: float, config: RobustConfig | None = None) -> float:
    """Chi2 with the squared residual of each loop truncated at `bound`, to compare poses when some loops may be false.

    With `config`, odometry and registration edges have the configured robust cost; without, their squared residual.
    """
    every = squared_norms(graph, poses)
    motion = every if config is None else np.where(graph.is_motion, _COSTS[config.odometry](every, ODOMETRY_SCALE), every)
    return float(np.where(graph.is_loop, np.minimum(every, bound), motion).sum())


def truncated_weights(squared: Array, mu: float, bound: float) -> Array:
    """Weights (L,) of the surrogate of truncated least squares at control parameter mu (Yang et al., eq. 14).

    Args:
        squared: (L,) squared residuals.
        mu: control parameter; small: nearly convex; large: close to the truncated cost.
        bound: squared residual at which the cost is truncated.
    """
    between_ = np.sqrt(bound * mu * (mu + 1.0) / np.maximum(squared, 1e-300)) - mu
    inside, outside = squared <= bound * mu / (mu + 1.0), squared >= bound * (mu + 1.0) / mu
    return np.asarray(np.where(inside, 1.0, np.where(outside, 0.0, np.clip(between_, 0.0, 1.0))))


def gate_of(config: BackendsConfig) -> float:
    """Squared residual beyond which a loop is an outlier: the configured quantile of chi2 with 3 degrees of freedom."""
    return chi2_quantile(config.gnc.quantile)


def motion_weights(graph: PoseGraph, squared: Array, config: RobustConfig) -> Array:
    """Weight (E,) of each edge at squared residuals (E,): the configured kernel's on odometry and registration, 1 on others."""
    return np.where(graph.is_motion, _WEIGHTS[config.odometry](squared, ODOMETRY_SCALE), 1.0)


def weak_edges(graph: PoseGraph, squared: Array, config: RobustConfig) -> dict[int, float]:
    """Edge id -> weight, for the odometry and registration edges with a weight below `WEAK`; empty without a kernel on them.

    `squared` (E,) are the squared residuals of the graph's edges.
    """
    if config.odometry == "none":
        return {}
    weights = motion_weights(graph, squared, config)
    return {int(graph.edge_ids[edge]): float(weights[edge]) for edge in np.flatnonzero(weights < WEAK)}


def softened(graph: PoseGraph, poses: Array, config: RobustConfig) -> PoseGraph:
    """Copy of the graph with the information of odometry and registration edges multiplied by their weights at poses (N, 3)."""
    weights = motion_weights(graph, squared_norms(graph, poses), config)
    return replace(graph, information=graph.information * weights[:, None, None])


def parts(graph: PoseGraph, without: tuple[int, ...]) -> NDArray[np.int32]:
    """Label (N,) of each node, equal for connected ones, if the edges with the ids `without` are left out."""
    from scipy.sparse import csr_array
    from scipy.sparse.csgraph import connected_components

    kept = ~np.isin(graph.edge_ids, without)
    n = graph.n_nodes
    joined = csr_array((np.ones(int(kept.sum())), (graph.sources[kept], graph.targets[kept])), shape=(n, n))
    _, label = connected_components(joined, directed=False)
    return np.asarray(label, dtype=np.int32)


def hanging_nodes(graph: PoseGraph, without: tuple[int, ...]) -> int:
    """Number of nodes without a path to node 0 if the edges with the ids `without` are left out."""
    part = parts(graph, without)
    return int(np.count_nonzero(part != part[0]))
