"""A lost robot's view is compared with the whole map."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from hybridmap.config.vision import RelocalisingConfig
from hybridmap.graph.edges import Edge, EdgeKind, Status
from hybridmap.vision.gating import Chain
from hybridmap.vision.rgbd.keyframe import Keyframe
from hybridmap.vision.rgbd.pnp import Verifier
from hybridmap.vision.templates import Matcher

Indices = NDArray[np.int64]

RANKED = 6
"""Profiles ranked for each candidate that is verified: the best of one place lie next to each other."""


class WholeMap:
    """Sightings outside the gate: the likeliest nodes by their profiles, verified by features."""

    def __init__(
        self,
        keyframes: Sequence[Keyframe],
        matcher: Matcher,
        verifier: Verifier,
        config: RelocalisingConfig,
        new_key: Callable[[], int],
    ) -> None:
        self._keyframes = keyframes
        self._matcher = matcher
        self._verifier = verifier
        self._config = config
        self._new_key = new_key

    def search(self, node: int, elsewhere: Indices) -> list[Edge]:
        """Compare a node, the source, with older nodes (n,), ascending; what is verified waits."""
        return [self._measured(node, target, scores) for target, scores in self._candidates(node, elsewhere).items()]

    def _candidates(self, node: int, targets: Indices) -> dict[int, dict[str, float]]:
        """The best by profile, some nodes apart, with their scores."""
        most = self._config.candidates
        match = self._matcher.best(self._keyframes[node].profile, RANKED * most, targets, ending_at=node)
        chosen: dict[int, dict[str, float]] = {}
        for target, score, shift in zip(match.indices.tolist(), match.score, match.shift, strict=True):
            if len(chosen) < most and all(abs(target - other) >= self._config.separation for other in chosen):
                chosen[target] = {"profile_G": float(score), "shift": float(shift), "whole_map": 1.0}
        return chosen

    def _measured(self, node: int, target: int, scores: dict[str, float]) -> Edge:
        found = self._verifier.verify(self._keyframes[node], self._keyframes[target])
        scores = {**scores, **found.scores}
        proposal = Edge(node, target, EdgeKind.LOOP, Status.REJECTED, found.reason, found.relative, scores, key=self._new_key())
        if found.relative is None:
            return proposal
        return replace(proposal, status=Status.PENDING, reason="lost: waits for others that put the robot there")


def chain_of(steps: Sequence[Edge], config: RelocalisingConfig) -> Chain:
    """How a node hangs on those before it, by the registrations that were tried; where none was, it does by the odometry."""
    if not steps or config.candidates == 0:
        return Chain.HOLDS
    sigmas_m = [step.scores.get("sigma_m", 0.0) for step in steps if step.status is Status.ACCEPTED]
    if not sigmas_m:
        return Chain.BROKEN
    return Chain.DOUBTFUL if min(sigmas_m) > config.doubtful_m else Chain.HOLDS
