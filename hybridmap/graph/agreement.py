"""Whether loops agree through the chain, and the largest set of loops that do.

Two loops and the chain between their older and between their newer ends form a ring. If all four are right, the ring closes
within its covariance. Mangelson et al., "Pairwise Consistent Measurement Set Maximization for Robust Multi-robot Map
Merging" (2018), keep the largest set of loops that are consistent in pairs.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.special import gammaincinv

from hybridmap.geometry import Array, RelativePose, between, compose_relative, invert_relative, log, squared_distance

Indices = NDArray[np.int64]
Ways = Callable[[Indices, Indices], RelativePose]
"""From nodes (P,), or one for all (1,), and nodes (P,) to the poses of the latter seen from the former, by the chain. Not
finite where unknown."""


def chi2_quantile(probability: float) -> float:
    """Quantile, at a probability of 0 to 1, of the chi-square distribution with 3 degrees of freedom."""
    return float(2.0 * gammaincinv(1.5, probability))  # importing `scipy.stats` would take half a second


QUANTILE = 0.99
"""Share of pairs of true loops that agree, given right covariances."""
BOUND = chi2_quantile(QUANTILE)
"""Squared Mahalanobis distance up to which two loops agree."""


@dataclass(frozen=True, slots=True)
class Loops:
    """Measured loop closures, each from its older to its newer node.

    Attributes:
        older, newer: (L,) nodes.
        relative: pose (L, 3) of the newer node in the frame of the older one, m and rad, with its covariance (L, 3, 3).
    """

    older: Indices
    newer: Indices
    relative: RelativePose

    @classmethod
    def of(cls, sources: Indices, targets: Indices, relative: RelativePose) -> Loops:
        """Make L loops from the poses (`relative`) of the nodes `targets` (L,) in the frames of the nodes `sources` (L,)."""
        back, forward = invert_relative(relative), sources < targets
        delta = np.where(forward[:, None], relative.delta, back.delta)
        covariance = np.where(forward[:, None, None], relative.covariance, back.covariance)
        return cls(np.minimum(sources, targets), np.maximum(sources, targets), RelativePose(delta, covariance))

    @classmethod
    def measured(cls, loops: Sequence[tuple[int, int, RelativePose]]) -> Loops:
        """Make loops from a list of (source, target, pose of the target in the frame of the source)."""
        ends = np.array([(source, target) for source, target, _ in loops], dtype=np.int64).reshape(-1, 2)
        delta = np.array([relative.delta for *_, relative in loops]).reshape(-1, 3)
        covariance = np.array([relative.covariance for *_, relative in loops]).reshape(-1, 3, 3)
        return cls.of(ends[:, 0], ends[:, 1], RelativePose(delta, covariance))

    def __getitem__(self, chosen: Indices) -> Loops:
        """The loops of the given indices (P,)."""
        relative = RelativePose(self.relative.delta[chosen], self.relative.covariance[chosen])
        return Loops(self.older[chosen], self.newer[chosen], relative)


@dataclass(frozen=True, slots=True)
class Ring:
    """Errors with which P rings close; a ring is two loops and the two chains of motion between their ends.

    Attributes:
        error: (P, 3) twist (m, m, rad) in the frame of the newer node of the second loop.
        covariance: (P, 3, 3) of the error.
    """

    error: Array
    covariance: Array

    @property
    def distance(self) -> Array:
        """Squared Mahalanobis distance (P,) of the error: chi-square with 3 degrees of freedom if both loops are right.

        It is infinite where the covariance is unknown.
        """
        known: NDArray[np.bool_] = np.asarray(np.isfinite(self.covariance).all(axis=(-2, -1)))
        out = np.full(len(known), np.inf)
        out[known] = squared_distance(self.error[known], self.covariance[known])
        return out


def ring(first: Loops, second: Loops, ways: Ways) -> Ring:
    """Errors of the P rings that pair each of `first`, or its only one, with the same one of `second`.

    A ring compares two ways: the first loop and the chain between the newer nodes, and the chain between the older nodes
    and the second loop. `ways` gives the chains. The four parts count as independent, although the chains may overlap.
    """
    with np.errstate(invalid="ignore"):  # an unknown way
        along_new = compose_relative(first.relative, ways(first.newer, second.newer))
        along_old = compose_relative(ways(first.older, second.older), second.relative)
    error = log(between(along_old.delta, along_new.delta))
    return Ring(error, along_new.covariance + along_old.covariance)


def agrees(loops: Loops, one: int, others: Indices, ways: Ways, bound: float = BOUND) -> NDArray[np.bool_]:
    """Which (P,) of the loops with indices `others` (P,) agree with the loop of index `one`; see `agreement` for the rest."""
    return np.asarray(ring(loops[np.array([one])], loops[others], ways).distance <= bound)


def agreement(loops: Loops, ways: Ways, bound: float = BOUND, known: NDArray[np.bool_] | None = None) -> NDArray[np.bool_]:
    """Find which loops agree in pairs: (L, L), symmetric, with a true diagonal.

    Args:
        loops: L loops.
        ways: gives the relative poses along the chain between the ends of loops; called twice for each loop beyond `known`.
        bound: largest squared Mahalanobis distance of a pair that agrees.
        known: (K, K) result of an earlier call for the first K loops, which is not computed again; None: no earlier result.
    """
    count, first = len(loops.older), 0 if known is None else len(known)
    out = np.eye(count, dtype=bool)
    if known is not None:
        out[:first, :first] = known
    for new in range(max(first, 1), count):
        before = np.arange(new)
        out[new, before] = out[before, new] = agrees(loops, new, before, ways, bound)
    return out


def largest_consistent_set(
    agree: NDArray[np.bool_], weights: Array | None = None, first: int | None = None
) -> NDArray[np.bool_]:
    """Find a set of loops of large total weight that all agree with each other: a mask (L,). It may not be the largest.

    Greedy: the next member is the one whose agreeing candidates, itself among them, have the largest weight (as a step
    of Pattabiraman et al., "Fast Algorithms for the Maximum Clique Problem on Massive Graphs", 2015).

    Args:
        agree: (L, L) which pairs agree: symmetric, with a true diagonal.
        weights: (L,) positive; None: all 1.
        first: index of a loop that must be in the set; None: any.
    """
    weights = np.ones(len(agree)) if weights is None else weights
    members, possible = np.zeros(len(agree), dtype=bool), np.ones(len(agree), dtype=bool)
    support = agree @ weights  # of each, among those still possible
    best = first
    while np.any(candidates := possible & ~members):
        best = int(np.argmax(np.where(candidates, support, -1.0))) if best is None else best
        members[best] = True
        gone = possible & ~agree[best]
        support -= agree[:, gone] @ weights[gone]
        possible &= agree[best]
        best = None
    return members
