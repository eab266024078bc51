"""Edges of motion that a robust kernel holds for drop-outs of the wheels, and the nodes that hang on nothing better."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace

import numpy as np
from scipy.sparse import csr_array
from scipy.sparse.csgraph import connected_components

from hybridmap.backends.objective import squared_norms
from hybridmap.config.backends import RobustConfig
from hybridmap.geometry import Array
from hybridmap.graph.pose_graph import PoseGraph

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


def motion_weights(graph: PoseGraph, squared: Array, config: RobustConfig) -> Array:
    """Weight (E,) of each edge at its squared residual (E,): of the configured kernel for edges of motion, else one."""
    return np.where(graph.is_motion, _WEIGHTS[config.odometry](squared, ODOMETRY_SCALE), 1.0)


def truncated_cost(graph: PoseGraph, poses: Array, bound: float, config: RobustConfig) -> float:
    """As `objective.truncated_cost`, with the configured kernel's cost for edges of motion."""
    every = squared_norms(graph, poses)
    motion = _COSTS[config.odometry](every, ODOMETRY_SCALE)
    return float(np.where(graph.is_loop, np.minimum(every, bound), np.where(graph.is_motion, motion, every)).sum())


def weak_edges(graph: PoseGraph, squared: Array, config: RobustConfig) -> dict[int, float]:
    """`edge_ids` -> weight of the edges of motion that hold next to nothing."""
    if config.odometry == "none":
        return {}
    weights = motion_weights(graph, squared, config)
    return {int(graph.edge_ids[edge]): float(weights[edge]) for edge in np.flatnonzero(weights < WEAK)}


def softened(graph: PoseGraph, poses: Array, config: RobustConfig) -> PoseGraph:
    """The graph with the information of each edge of motion multiplied by its weight at some poses (N, 3)."""
    weights = motion_weights(graph, squared_norms(graph, poses), config)
    return replace(graph, information=graph.information * weights[:, None, None])


def hanging_nodes(graph: PoseGraph, without: tuple[int, ...]) -> int:
    """Number of nodes that no path joins to node 0 if some edges (`edge_ids`) are left out."""
    kept = ~np.isin(graph.edge_ids, without)
    n = graph.n_nodes
    joined = csr_array((np.ones(int(kept.sum())), (graph.sources[kept], graph.targets[kept])), shape=(n, n))
    _, label = connected_components(joined, directed=False)
    return int(np.count_nonzero(label != label[0]))
