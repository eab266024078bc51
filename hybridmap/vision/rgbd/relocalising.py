"""A lost robot is looked for on the whole map, and told where it is once several of its views say the same."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from hybridmap.config.vision import RelocalisingConfig
from hybridmap.geometry import Array, RelativePose, between, compose, inverse
from hybridmap.vision.base import Belief, Proposal, Verdict
from hybridmap.vision.rgbd.keyframe import Keyframe
from hybridmap.vision.rgbd.pnp import Verifier
from hybridmap.vision.templates import Matcher
from hybridmap.vision.whereabouts import Whereabouts

Indices = NDArray[np.int64]

RANKED = 6
"""Profiles ranked for each candidate that is verified."""
REHUNG_M, REHUNG_RAD = 0.5, float(np.deg2rad(10.0))
"""Standard deviations of the edge in the place of the broken one: it holds the chain together, the closures place it."""


@dataclass(frozen=True, slots=True)
class _Sighting:
    """A verified closure far from where the map has the robot."""

    proposal: Proposal
    relative: RelativePose


class Relocaliser:
    """Searches the whole map while the robot is lost. The newer node is the source of an edge.

    Sightings wait until `support` of them, of distinct nodes over `span_m` of travel, put the robot at one and the same pose,
    and those that contradict them are fewer than half as many. Then all of them enter the map together, and the odometry edge
    at which the chain broke gives way to one that leads to where they have it; registrations across the break are taken back.
    """

    def __init__(
        self,
        keyframes: Sequence[Keyframe],
        matcher: Matcher,
        verifier: Verifier,
        config: RelocalisingConfig,
        new_key: Callable[[], int],
    ) -> None:
        self.whereabouts = Whereabouts(config)
        self._keyframes = keyframes
        self._matcher = matcher
        self._verifier = verifier
        self._config = config
        self._new_key = new_key
        self._waiting: list[_Sighting] = []
        self._steps: list[Proposal] = []

    def tracked(self, node: int, steps: list[Proposal]) -> None:
        """Take notice of how a new node was registered to the ones before it; nothing was tried where there are no steps."""
        accepted = [step for step in steps if step.verdict is Verdict.ACCEPTED]
        if steps:
            sigma_m = min((step.scores.get("sigma_m", 0.0) for step in accepted), default=None)
            self.whereabouts.tracked(node, sigma_m)
        if self.whereabouts.lost:
            self._steps += accepted
        else:
            self._steps = accepted

    def search(self, node: int, elsewhere: Indices, belief: Belief) -> list[Proposal]:
        """Compare a node with the nodes outside the gate; what changed, the new ones first.

        Args:
            node: the new node.
            elsewhere: (n,) older nodes outside the gate, ascending.
            belief: the map's; poses on either side of the break are right among themselves.
        """
        out = [self._measured(node, target, scores) for target, scores in self._candidates(node, elsewhere).items()]
        return out + self._settle(belief)

    def dismiss(self, reason: str) -> list[Proposal]:
        """Refuse all sightings that wait."""
        out = [replace(s.proposal, verdict=Verdict.REJECTED, reason=reason) for s in self._waiting]
        self._waiting = []
        return out

    def _candidates(self, node: int, targets: Indices) -> dict[int, dict[str, float]]:
        """The best by profile, some nodes apart, with their scores."""
        most = self._config.candidates
        match = self._matcher.best(self._keyframes[node].profile, RANKED * most, targets, ending_at=node)
        chosen: dict[int, dict[str, float]] = {}
        for target, score, shift in zip(match.indices.tolist(), match.score, match.shift, strict=True):
            if len(chosen) < most and all(abs(target - other) >= self._config.separation for other in chosen):
                chosen[target] = {"profile_G": float(score), "shift": float(shift), "whole_map": 1.0}
        return chosen

    def _measured(self, node: int, target: int, scores: dict[str, float]) -> Proposal:
        found = self._verifier.verify(self._keyframes[node], self._keyframes[target])
        scores = {**scores, **found.scores}
        proposal = Proposal(self._new_key(), "loop", node, target, Verdict.REJECTED, found.reason, found.relative, scores)
        if found.relative is None:
            return proposal
        proposal = replace(proposal, verdict=Verdict.PENDING, reason="lost: waits for others that put the robot there")
        self._waiting.append(_Sighting(proposal, found.relative))
        return proposal

    def _settle(self, belief: Belief) -> list[Proposal]:
        """Accept the largest set of sightings that agree, if it is good enough."""
        if not self._waiting:
            return []
        agree = self._agreement(belief)
        seed = int(np.argmax(agree.sum(axis=1)))
        chosen = np.flatnonzero(agree[seed])
        if not self._enough(chosen, len(self._waiting) - len(chosen), belief):
            return []
        friends = [self._waiting[i] for i in chosen]
        reason = f"lost; {len(friends)} closures put the robot there"
        out = [replace(s.proposal, verdict=Verdict.ACCEPTED, reason=reason) for s in friends]
        self._waiting = [s for i, s in enumerate(self._waiting) if i not in set(chosen.tolist())]
        out += self.dismiss("contradicts the closures that put the robot elsewhere")
        broken_at = self.whereabouts.break_before(min(s.proposal.source for s in friends))
        if broken_at is not None:
            out += [*self._crossing(broken_at), self._rehung(broken_at, friends, belief)]
        self.whereabouts.recognised()
        return out

    def _crossing(self, broken_at: int) -> list[Proposal]:
        """Registrations across the break that had been believed."""
        crossing = [step for step in self._steps if step.source < broken_at <= step.target]
        reason = f"the robot was carried between nodes {broken_at - 1} and {broken_at}"
        return [replace(step, verdict=Verdict.REJECTED, reason=reason) for step in crossing]

    def _agreement(self, belief: Belief) -> NDArray[np.bool_]:
        """(n, n) which sightings put the robot at the same pose, each carried along the chain to the newest node."""
        poses = belief.poses_map_node
        sources = np.array([s.proposal.source for s in self._waiting])
        newest = int(sources.max())
        placed = np.array([self._placed(s, newest, poses) for s in self._waiting])
        apart = between(placed[:, None], placed[None])
        travelled = np.abs(belief.travel_m[sources][:, None] - belief.travel_m[sources][None])
        near = np.hypot(apart[..., 0], apart[..., 1]) <= self._config.agree_m + 0.05 * travelled
        return np.asarray(near & (np.degrees(np.abs(apart[..., 2])) <= self._config.agree_deg + travelled))

    def _enough(self, chosen: Indices, others: int, belief: Belief) -> bool:
        sources = sorted({self._waiting[i].proposal.source for i in chosen.tolist()})
        span_m = float(belief.travel_m[sources[-1]] - belief.travel_m[sources[0]])
        return len(sources) >= self._config.support and span_m >= self._config.span_m and 2 * others < len(chosen)

    def _rehung(self, broken_at: int, friends: list[_Sighting], belief: Belief) -> Proposal:
        """The edge into the node at which the chain broke, by way of the closures; it contradicts the odometry beside it."""
        poses = belief.poses_map_node
        placed = np.array([self._placed(s, broken_at, poses) for s in friends])
        middle = placed[int(np.argmin(np.abs(placed[:, None, :2] - placed[None, :, :2]).sum(axis=(1, 2))))]
        relative = RelativePose(between(poses[broken_at - 1], middle), np.diag([REHUNG_M, REHUNG_M, REHUNG_RAD]) ** 2)
        moved_m = float(np.hypot(*(middle - poses[broken_at])[:2]))
        reason = f"carried: {len(friends)} closures put the robot {moved_m:.1f} m from where the odometry has it"
        scores = {"closures": float(len(friends)), "carried_m": moved_m}
        return Proposal(
            self._new_key(), "registration", broken_at - 1, broken_at, Verdict.ACCEPTED, reason, relative, scores, True
        )

    @staticmethod
    def _placed(sighting: _Sighting, at: int, poses: Array) -> Array:
        """Pose (3,) on the map of a node of the new piece of chain, as one sighting has it."""
        source, target = sighting.proposal.source, sighting.proposal.target
        seen = compose(poses[target], inverse(sighting.relative.delta))
        return compose(seen, between(poses[source], poses[at]))
