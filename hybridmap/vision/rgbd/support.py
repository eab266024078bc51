"""Measured loops are pending until another one agrees; none enters the map alone."""

from __future__ import annotations

from collections import defaultdict
from dataclasses import dataclass

import numpy as np

from hybridmap.geometry import RelativePose
from hybridmap.graph.agreement import Loops, agrees
from hybridmap.graph.edges import Edge, Lack, Status, passed
from hybridmap.vision.base import Belief
from hybridmap.vision.rgbd import checks

SUPPORT_NODES = 12
"""Loops support each other if their sources, and their targets, are at most so many nodes apart."""


@dataclass(slots=True)
class MeasuredLoop:
    """A loop that was measured: it is pending, accepted, or given up.

    Attributes:
        proposal: the edge, with its present status.
        relative: the measured pose of the target in the frame of the source.
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
    """Keeps measured loops by their source node, and accepts those that agree with each other."""

    def __init__(self) -> None:
        self._of_source: defaultdict[int, list[MeasuredLoop]] = defaultdict(list)
        self._pending: list[MeasuredLoop] = []
        self._filed: set[tuple[int, int]] = set()

    def has(self, source: int, target: int) -> bool:
        """Whether there is an edge from `source` to `target` (in this order) that was not given up."""
        return (source, target) in self._filed

    def join(self, source: int, target: int) -> None:
        """Note for `has` that two nodes have an edge that is kept elsewhere."""
        self._filed.add((source, target))

    def accepted(self, source: int) -> int:
        """Number of accepted loops of a source node."""
        return sum(h.proposal.status is Status.ACCEPTED for h in self._of_source.get(source, ()))

    def file(self, new: MeasuredLoop, belief: Belief) -> list[Edge]:
        """Add a loop. If a loop from another node nearby agrees with it, accept it and the pending ones that agree with it.

        Returns the edge of the new loop, then those whose status changed.
        """
        near = [h for h in self._beside(new) if h.proposal.status in (Status.PENDING, Status.ACCEPTED)]
        agreeing = _agreeing(new, near, belief)
        waiting = [h for h in agreeing if h.proposal.status is Status.PENDING]
        asked = checks.of_support(len(agreeing))
        self._of_source[new.source].append(new)
        self._pending.append(new)
        self._filed.add((new.source, new.target))
        if not passed(asked):
            return [new.proposal]
        changed = [new, *waiting]
        for h in changed:
            h.proposal = h.proposal.settled(*(asked if h is new else checks.of_support(1)))
        return [h.proposal for h in changed]

    def replace(self, proposal: Edge) -> None:
        """Replace the edge with the key of this one, measured again; one without a pose is dropped, a new one ignored."""
        of_source = self._of_source[proposal.source]
        kept = [h for h in of_source if h.proposal.key != proposal.key]
        if proposal.relative is not None and len(kept) < len(of_source):
            kept.append(MeasuredLoop(proposal, proposal.relative))
        self._of_source[proposal.source] = kept

    def give_up(self, before: int) -> list[Edge]:
        """Reject the pending loops whose source has a number below `before`; returns their edges."""
        self._pending = [h for h in self._pending if h.proposal.status is Status.PENDING]
        late = [h for h in self._pending if h.source < before]
        for h in late:
            self._filed.discard((h.source, h.target))
            h.proposal = h.proposal.settled(lack=Lack.UNSUPPORTED)
        return [h.proposal for h in late]

    def _beside(self, new: MeasuredLoop) -> list[MeasuredLoop]:
        """Loops from other nodes near its source to nodes near its target."""
        reach = SUPPORT_NODES
        sources = (source for source in range(new.source - reach, new.source + reach + 1) if source != new.source)
        return [h for source in sources for h in self._of_source.get(source, ()) if abs(h.target - new.target) <= reach]


def _agreeing(new: MeasuredLoop, near: list[MeasuredLoop], belief: Belief) -> list[MeasuredLoop]:
    """Which of the loops `near` agree with a new one.

    Where edges join all their nodes, the covariance of the map only makes more of them agree. So it is not searched for loops
    that agree as if the map were exact.
    """
    loops = Loops.measured([(h.source, h.target, h.relative) for h in (new, *near)])
    others = np.arange(1, len(loops.older))
    joined = np.isfinite(belief.covariance_from(new.source)[:, 0, 0])
    joined = joined[loops.older] & joined[loops.newer]
    agree = agrees(loops, 0, others, belief.exact_ways) & joined[0] & joined[1:]
    if not agree.all():
        agree[~agree] = agrees(loops, 0, others[~agree], belief.ways)
    return [h for h, yes in zip(near, agree.tolist(), strict=True) if yes]
