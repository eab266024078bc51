"""A lost robot's view is compared with the whole map."""

from __future__ import annotations

from collections.abc import Callable, Sequence

import numpy as np
from numpy.typing import NDArray

from hybridmap.geometry import loosest_direction
from hybridmap.graph.edges import Edge, Lack, Search, Status
from hybridmap.vision.relocalising import Chain
from hybridmap.vision.rgbd.keyframe import Keyframe
from hybridmap.vision.rgbd.pnp import Candidate, Verifier
from hybridmap.vision.templates import Matcher

Indices = NDArray[np.int64]

CANDIDATES, SEPARATION = 5, 4
"""Views of the whole map that are verified for a node, the best first, and nodes that they lie apart."""
DOUBTFUL_M = 0.1
"""A node whose view fits those before it but may slide by more than this (one standard deviation) may be elsewhere, m."""
RANKED = 6
"""Profiles ranked for each candidate that is verified: the best of one place lie next to each other."""


class WholeMap:
    """Sightings outside the gate: the likeliest nodes by their profiles, verified by features."""

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
        """Compare a node, the source, with older nodes (n,), ascending; what is verified waits."""
        return [self._measured(node, target, candidate) for target, candidate in self._candidates(node, elsewhere).items()]

    def _candidates(self, node: int, targets: Indices) -> dict[int, Candidate]:
        """The best by profile, some nodes apart, with their figures."""
        most = CANDIDATES
        match = self._matcher.best(self._keyframes[node].profile, RANKED * most, targets, ending_at=node)
        chosen: dict[int, Candidate] = {}
        for target, score, shift in zip(match.indices.tolist(), match.score, match.shift, strict=True):
            if len(chosen) < most and all(abs(target - other) >= SEPARATION for other in chosen):
                chosen[target] = Candidate(Search.WHOLE_MAP, int(shift), {"profile_G": float(score)})
        return chosen

    def _measured(self, node: int, target: int, candidate: Candidate) -> Edge:
        found = self._verifier.verify(self._keyframes[node], self._keyframes[target])
        return found.proposed(node, target, self._new_key(), candidate, Lack.WAITING)


def chain_of(steps: Sequence[Edge]) -> Chain:
    """How a node hangs on those before it, by the registrations that were tried; where none was, it does by the odometry."""
    if not steps:
        return Chain.HOLDS
    accepted = [step.relative for step in steps if step.status is Status.ACCEPTED and step.relative is not None]
    if not accepted:
        return Chain.BROKEN
    loosest_m = min(loosest_direction(relative.covariance)[0] for relative in accepted)
    return Chain.DOUBTFUL if loosest_m > DOUBTFUL_M else Chain.HOLDS
