"""Which loops agree with each other through the chain: pairwise consistency maximisation before anything is solved.

Mangelson et al., "Pairwise Consistent Measurement Set Maximization for Robust Multi-robot Map Merging" (2018): two loops
are consistent where the ring of both and of the ways between their ends closes within its uncertainty; the largest set
that is consistent in pairs is kept. The largest clique is approximated greedily.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from hybridmap.backends.judging.clusters import neighbouring_pairs
from hybridmap.backends.objective import SLACK, chi2_quantile
from hybridmap.config.backends import ConsistencyConfig
from hybridmap.geometry import Array, adjoint, compose, inverse, log
from hybridmap.graph.pose_graph import PoseGraph
from hybridmap.graph.uncertainty import chain_of


@dataclass(frozen=True, slots=True)
class _Asked:
    """What loops ask of the chain, all in the frame of its first node.

    Attributes:
        older, newer: (L,) their ends.
        shift: (L, 3) motion of the chain at the newer end that would make the loop fit. Loops that agree ask for the same.
        covariance: (L, 3, 3) of the measurement alone.
        chain: (N, 3, 3) covariance of the chain up to each node.
    """

    older: NDArray[np.int64]
    newer: NDArray[np.int64]
    shift: Array
    covariance: Array
    chain: Array

    @classmethod
    def by(cls, graph: PoseGraph, loops: NDArray[np.int64]) -> _Asked:
        chain = chain_of(graph)
        source, target, delta = graph.sources[loops], graph.targets[loops], graph.deltas[loops]
        seen = compose(chain.poses[source], delta)  # the target, from its source
        forward = (source < target)[:, None]
        shift = np.where(
            forward,
            compose(seen, inverse(chain.poses[target])),
            compose(chain.poses[target], inverse(seen)),
        )
        carry = adjoint(np.where(forward, seen, chain.poses[target]))
        covariance = carry @ np.linalg.inv(graph.information[loops]) @ carry.transpose(0, 2, 1)
        return cls(np.minimum(source, target), np.maximum(source, target), shift, covariance, chain.covariance)

    def apart(self, first: NDArray[np.int64] | int, second: NDArray[np.int64]) -> Array:
        """Squared Mahalanobis distance (P,) between what two loops ask for.

        Ways between older and between newer ends count as independent, although they may overlap.
        """
        difference = log(compose(self.shift[second], inverse(self.shift[first])))
        carry = adjoint(self.shift[first])
        between_newer = self._between(self.newer, first, second)
        covariance = self.covariance[first] + self.covariance[second] + self._between(self.older, first, second)
        covariance = covariance + carry @ between_newer @ np.swapaxes(carry, -1, -2)
        return np.asarray(np.einsum("ei,ei->e", difference, np.linalg.solve(covariance, difference[:, :, None])[:, :, 0]))

    def _between(self, ends: NDArray[np.int64], first: NDArray[np.int64] | int, second: NDArray[np.int64]) -> Array:
        sign = np.where(ends[second] >= ends[first], 1.0, -1.0)
        return np.asarray(sign[:, None, None] * (self.chain[ends[second]] - self.chain[ends[first]]))


@dataclass(frozen=True, slots=True)
class Consistent:
    """What the test of pairs found.

    Attributes:
        loops: (L,) indices of the edges that agree in pairs with all others of them, and with some beside them.
        variance: in units of what the edges state, that of neighbouring loops that agree; 1 where there are none.
    """

    loops: NDArray[np.int64]
    variance: float


def consistent_loops(graph: PoseGraph, config: ConsistencyConfig) -> Consistent:
    """Find the loops that are consistent with each other.

    Files mostly overstate their noise. How much is seen from neighbouring loops that agree: where the ring of two closes
    much better than its covariance says, the bound for all pairs is tightened accordingly.

    Args:
        graph: with a chain of edges of motion.
        config: quantile of the test, and how many neighbours a loop needs.

    Raises:
        GraphError: the chain is broken.
    """
    loops = np.flatnonzero(graph.is_loop)
    asked = _Asked.by(graph, loops)
    bound = chi2_quantile(config.quantile)
    near = neighbouring_pairs(graph, loops)
    apart = asked.apart(near[:, 0], near[:, 1])
    agreeing = apart[apart <= bound]
    variance = float(np.median(agreeing) / chi2_quantile(0.5)) if len(agreeing) else 1.0
    chosen = largest_clique(_pairwise(asked, bound * min(1.0, SLACK * variance)))
    backed = np.bincount(near[chosen[near].all(axis=1)].ravel(), minlength=len(loops))
    return Consistent(loops[chosen & (backed >= config.neighbours)], variance)


def _pairwise(asked: _Asked, bound: float) -> NDArray[np.bool_]:
    """(L, L) which loops are consistent."""
    count = len(asked.older)
    out = np.eye(count, dtype=bool)
    for first in range(count - 1):
        rest = np.arange(first + 1, count)
        out[first, rest] = out[rest, first] = asked.apart(first, rest) <= bound
    return out


def largest_clique(adjacent: NDArray[np.bool_]) -> NDArray[np.bool_]:
    """A large set (L,) of members that are all adjacent to each other, not always the largest.

    Again and again, the one that is adjacent to most of those still possible is added (the greedy step of Pattabiraman et
    al., "Fast Algorithms for the Maximum Clique Problem on Massive Graphs" (2015), which PCM uses).

    Args:
        adjacent: (L, L) symmetric, with a true diagonal.
    """
    members = np.zeros(len(adjacent), dtype=bool)
    possible = np.ones(len(adjacent), dtype=bool)
    support = adjacent.sum(axis=1)  # of each, among those still possible
    while np.any(open_ := possible & ~members):
        best = int(np.argmax(np.where(open_, support, -1)))
        members[best] = True
        gone = possible & ~adjacent[best]
        support -= adjacent[:, gone].sum(axis=1)
        possible &= adjacent[best]
    return members
