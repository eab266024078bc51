"""Global localisation by camera: the view of a lost robot is compared with the whole map."""

from __future__ import annotations

from collections.abc import Callable, Sequence

import numpy as np
from numpy.typing import NDArray

from hybridmap.geometry import loosest_direction
from hybridmap.graph.edges import Edge, Lack, Proposer, Search, Status
from hybridmap.vision.relocalising import ChainState
from hybridmap.vision.rgbd.keyframe import Keyframe
from hybridmap.vision.rgbd.pnp import Candidate, Verifier
from hybridmap.vision.templates import Matcher

Indices = NDArray[np.int64]

CANDIDATES, SEPARATION = 5, 4
"""Views of the whole map that are verified for a node, the best first, and nodes that they lie apart."""
UNCERTAIN_M = 0.1
"""Standard deviation in the loosest direction of a registration above which the chain is uncertain, m."""
RANKED = 6
"""Profiles ranked for each candidate that is verified: the best of one place lie next to each other."""


class GlobalSearch:
    """Finds where a lost robot is: nodes anywhere on the map with the most similar profiles, verified by features.

    Args:
        keyframes: of all nodes, by number.
        matcher: has the profiles of all nodes stored under their numbers.
        verifier: measures the relative pose of two keyframes.
        new_key: returns the key of a new edge.
    """

    def __init__(
        self,
        keyframes: Sequence[Keyframe],
        matcher: Matcher,
        verifier: Verifier,
        new_key: Callable[[], int],
    ) -> None:
        self._keyframes = keyframes
        self._matcher = matcher
        self._verifier = verifier
        self._new_key = new_key

    def search(self, node: int, elsewhere: Indices) -> list[Edge]:
        """Compare a node with the older nodes `elsewhere` (n,), ascending: the few with the most similar profiles.

        Returns an edge from the node to each of these: pending if it is verified, else rejected.
        """
        return [self._measured(node, target, candidate) for target, candidate in self._candidates(node, elsewhere).items()]

    def _candidates(self, node: int, targets: Indices) -> dict[int, Candidate]:
        """The best by profile, some nodes apart, with their figures."""
        most = CANDIDATES
        match = self._matcher.best(self._keyframes[node].profile, RANKED * most, targets, ending_at=node)
        chosen: dict[int, Candidate] = {}
        for target, score, shift in zip(match.indices.tolist(), match.score, match.shift, strict=True):
            if len(chosen) < most and all(abs(target - other) >= SEPARATION for other in chosen):
                chosen[target] = Candidate(Search.WHOLE_MAP, Proposer.GLOBAL, int(shift), {"profile_G": float(score)})
        return chosen

    def _measured(self, node: int, target: int, candidate: Candidate) -> Edge:
        found = self._verifier.verify(self._keyframes[node], self._keyframes[target])
        return found.proposed(node, target, self._new_key(), candidate, Lack.WAITING)


def chain_state(steps: Sequence[Edge]) -> ChainState:
    """How certain the motion to a node is, from its registrations: broken if all are rejected.

    It is uncertain if the best accepted one may slide along a wall. Without any, the odometry counts as certain.
    """
    if not steps:
        return ChainState.HOLDS
    accepted = [step.relative for step in steps if step.status is Status.ACCEPTED and step.relative is not None]
    if not accepted:
        return ChainState.BROKEN
    loosest_m = min(loosest_direction(relative.covariance)[0] for relative in accepted)
    return ChainState.UNCERTAIN if loosest_m > UNCERTAIN_M else ChainState.HOLDS
