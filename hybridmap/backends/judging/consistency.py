"""Which loops agree with each other through the chain: pairwise consistency maximisation before anything is solved."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from hybridmap.backends.judging.clusters import loops_of, neighbouring_pairs
from hybridmap.backends.objective import SLACK
from hybridmap.errors import GraphError
from hybridmap.graph.agreement import BOUND, agreement, chi2_quantile, largest_consistent_set, ring
from hybridmap.graph.paths import chain_of
from hybridmap.graph.pose_graph import PoseGraph

NEIGHBOURS = 1
"""Loops between the same places, within 10 nodes at both ends, that each must agree with: a false loop seldom has one."""


@dataclass(frozen=True, slots=True)
class Consistent:
    """What the test of pairs found.

    Attributes:
        loops: (L,) indices of the edges that agree in pairs with all others of them, and with some beside them.
        variance: in units of what the edges state, that of neighbouring loops that agree; 1 where there are none.
    """

    loops: NDArray[np.int64]
    variance: float


def consistent_loops(graph: PoseGraph) -> Consistent:
    """Find the loops that are consistent with each other.

    Files mostly overstate their noise. How much is seen from neighbouring loops that agree: where the ring of two closes
    much better than its covariance says, the bound for all pairs is tightened accordingly.

    Args:
        graph: with a chain of edges of motion.

    Raises:
        GraphError: no edge of motion joins two consecutive nodes; it names them.
    """
    chain = chain_of(graph)
    if len(chain.breaks):
        raise GraphError(f"graph: no edge of motion joins nodes {chain.breaks[0] - 1} and {chain.breaks[0]}")
    edges = np.flatnonzero(graph.is_loop)
    loops, near = loops_of(graph, edges), neighbouring_pairs(graph, edges)
    apart = ring(loops[near[:, 0]], loops[near[:, 1]], chain.ways).distance
    agreeing = apart[apart <= BOUND]
    variance = float(np.median(agreeing) / chi2_quantile(0.5)) if len(agreeing) else 1.0
    chosen = largest_consistent_set(agreement(loops, chain.ways, BOUND * min(1.0, SLACK * variance)))
    backed = np.bincount(near[chosen[near].all(axis=1)].ravel(), minlength=len(edges))
    return Consistent(edges[chosen & (backed >= NEIGHBOURS)], variance)
