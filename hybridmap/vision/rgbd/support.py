"""Measured loops wait until another one agrees with them; nothing enters the map alone."""

from __future__ import annotations

from collections import defaultdict
from dataclasses import dataclass

import numpy as np

from hybridmap.config.rgbd import RgbdClosingConfig
from hybridmap.geometry import RelativePose, between, compose
from hybridmap.graph.edges import Edge, Lack, Status, passed
from hybridmap.vision.base import Belief
from hybridmap.vision.rgbd import checks


@dataclass(slots=True)
class Hypothesis:
    """A measured edge, waiting for support or accepted.

    Attributes:
        proposal: as it stands.
        relative: what was measured.
    """

    proposal: Edge
    relative: RelativePose

    @property
    def source(self) -> int:
        """The newer node."""
        return self.proposal.source

    @property
    def target(self) -> int:
        """The older node."""
        return self.proposal.target


class Support:
    """Keeps hypotheses by their source and lets those enter that agree with each other."""

    def __init__(self, config: RgbdClosingConfig) -> None:
        self._config = config
        self._of_source: defaultdict[int, list[Hypothesis]] = defaultdict(list)
        self._pending: list[Hypothesis] = []
        self._filed: set[tuple[int, int]] = set()

    def has(self, source: int, target: int) -> bool:
        """The two nodes are joined, or wait to be."""
        return (source, target) in self._filed

    def join(self, source: int, target: int) -> None:
        """The two nodes were joined in another way."""
        self._filed.add((source, target))

    def accepted(self, source: int) -> int:
        """How many edges of a node have entered."""
        return sum(h.proposal.status is Status.ACCEPTED for h in self._of_source.get(source, ()))

    def file(self, new: Hypothesis, belief: Belief) -> list[Edge]:
        """Take in a hypothesis; accept it and what it supports if another one agrees. Its own proposal comes first."""
        near = self._beside(new)
        friends = [h for h in near if h.proposal.status is Status.PENDING and self._agrees(new, h, belief)]
        accepted = (h for h in near if h.proposal.status is Status.ACCEPTED)
        supporting = len(friends) or int(any(self._agrees(new, h, belief) for h in accepted))
        asked = checks.of_support(supporting, self._config)
        self._of_source[new.source].append(new)
        self._pending.append(new)
        self._filed.add((new.source, new.target))
        if not passed(asked):
            return [new.proposal]
        changed = [new, *friends]
        for h in changed:
            h.proposal = h.proposal.settled(*(asked if h is new else checks.of_support(1, self._config)))
        return [h.proposal for h in changed]

    def replace(self, proposal: Edge) -> None:
        """A loop was measured again: from now on it supports others as it is now, or no longer."""
        of_source = self._of_source[proposal.source]
        kept = [h for h in of_source if h.proposal.key != proposal.key]
        if proposal.relative is not None and len(kept) < len(of_source):
            kept.append(Hypothesis(proposal, proposal.relative))
        self._of_source[proposal.source] = kept

    def give_up(self, before: int) -> list[Edge]:
        """Reject what nodes before one have waited for too long."""
        self._pending = [h for h in self._pending if h.proposal.status is Status.PENDING]
        late = [h for h in self._pending if h.source < before]
        for h in late:
            self._filed.discard((h.source, h.target))
            h.proposal = h.proposal.settled(lack=Lack.UNSUPPORTED)
        return [h.proposal for h in late]

    def _beside(self, new: Hypothesis) -> list[Hypothesis]:
        """Edges from other nodes near its source, to nodes near its target."""
        reach = self._config.support_nodes
        sources = (source for source in range(new.source - reach, new.source + reach + 1) if source != new.source)
        return [h for source in sources for h in self._of_source.get(source, ()) if abs(h.target - new.target) <= reach]

    def _agrees(self, a: Hypothesis, b: Hypothesis, belief: Belief) -> bool:
        """Two edges give the same pose through the chain between them."""
        poses = belief.poses_map_node
        around = compose(between(poses[a.source], poses[b.source]), b.relative.delta)
        around = compose(around, between(poses[b.target], poses[a.target]))
        gap = between(a.relative.delta, around)
        length = sum(
            abs(float(belief.travel_m[i] - belief.travel_m[j])) for i, j in ((a.source, b.source), (a.target, b.target))
        )
        limit_m = self._config.support_m + 0.03 * length
        limit_rad = np.deg2rad(self._config.support_deg + 0.5 * length)
        return bool(np.hypot(gap[0], gap[1]) < limit_m and abs(gap[2]) < limit_rad)
