"""Late decision on loops: hypotheses are pending until enough of them agree with each other and outweigh those that do not.

Hypotheses that miss a limit by a hair count half, and only where none that keep the limits close the loop: in the open, where
leaves move and few things are near, each of many right hypotheses may fail for itself.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from itertools import groupby

import numpy as np
from numpy.typing import NDArray

from hybridmap.graph.agreement import Loops, agreement, largest_consistent_set
from hybridmap.graph.edges import Check, Edge, Lack, passed
from hybridmap.vision.base import Belief
from hybridmap.vision.laser import checks
from hybridmap.vision.laser.hypotheses import SURE_SIGMA_M, Hypothesis

HALF = 0.5
"""A hypothesis that agrees with less than this share of a cluster contradicts it."""
WAIT_M = 32.0
"""Travel after which a hypothesis without a cluster is set aside, m; it is tried again at the end."""
PROBES, SPAN_M = 3, 3.0
"""Probes that a cluster needs, one less in a narrow gate, and travel that they must cover, m."""
GROUP_M = 16.0
"""Travel for which a hypothesis that missed a limit by a hair waits for others that kept it, m; then the group is judged."""
HAIR_WEIGHT, HAIRS = 0.5, 2
"""What such a hypothesis counts, and how many of them a probe may have, the best starts first: they bound a group's cost."""
SPAN_PER_EFOLD_M = 1.0
"""Additional travel for each factor e by which the gate is wider, m: more places then look alike."""


@dataclass(frozen=True, slots=True)
class Waiting:
    """A pending loop hypothesis and the key of its proposed edge."""

    key: int
    hypothesis: Hypothesis

    @property
    def weight(self) -> float:
        """What the hypothesis counts in a cluster: 1, or half if it missed a limit by a hair (see `Hypothesis.by_a_hair`)."""
        return 1.0 if self.hypothesis.passed else HAIR_WEIGHT


@dataclass(frozen=True, slots=True)
class Settled:
    """A decided loop hypothesis with the key of its edge: the checks of its cluster if it is accepted, else what it lacked."""

    key: int
    hypothesis: Hypothesis
    checks: tuple[Check, ...] = ()
    lack: Lack | None = None

    @property
    def accepted(self) -> bool:
        """Whether the loop enters the map."""
        return self.lack is None

    def proposed(self) -> Edge:
        """The edge with its new status; if its hypothesis missed a limit by a hair and is accepted, with the easier limits."""
        chosen = self.hypothesis.within_a_hair if self.accepted else self.hypothesis
        return chosen.proposed(self.key).settled(*self.checks, lack=self.lack)


@dataclass(frozen=True, slots=True)
class Cluster:
    """Loop hypotheses that agree with each other, at most one for each place from which loops were measured (probe).

    Attributes:
        members: indices into `Pool.waiting`, ascending.
        score: sum of `Hypothesis.quality` of the members, each times its weight.
        probes: sum of the weights of the members, each from a probe of its own.
        span_m: travel between the first and the last probe, m.
        sigma_m: standard deviation of the position expected before the registration, m: the median over the members.
    """

    members: tuple[int, ...]
    score: float
    probes: float
    span_m: float
    sigma_m: float


@dataclass(frozen=True, slots=True)
class AcceptedCluster:
    """An accepted cluster, and the checks that it passed."""

    cluster: Cluster
    checks: tuple[Check, ...]


class Pool:
    """Pending loop hypotheses (`waiting`), and which of them agree through the chain."""

    def __init__(self, travel_of: Callable[[int], float], waiting: Sequence[Waiting] = ()) -> None:
        """Start with some hypotheses; `travel_of` returns the path length (m) up to a node."""
        self._travel = travel_of
        self.waiting: list[Waiting] = list(waiting)
        self._consistent: NDArray[np.bool_] = np.zeros((0, 0), dtype=bool)

    def commit(self, belief: Belief, span_per_efold_m: float) -> list[Settled]:
        """Accept the best cluster if good enough, with all that agree with it, then the next.

        Args:
            belief: the map.
            span_per_efold_m: additional travel that a cluster must cover for each factor e by which its gate is wider, m.

        Returns:
            The accepted hypotheses, and the rejected ones, which contradict an accepted cluster. They leave the pool.
        """
        out: list[Settled] = []
        while (best := self._best_cluster(belief, span_per_efold_m)) is not None:
            out += self._commit(best)
        return out

    def keep(self, positions: list[int]) -> None:
        """Keep only the hypotheses at these positions (indices into `waiting`, ascending)."""
        known = [p for p in positions if p < len(self._consistent)]
        self._consistent = self._consistent[np.ix_(known, known)]
        self.waiting = [self.waiting[p] for p in positions]

    def _best_cluster(self, belief: Belief, span_per_efold_m: float) -> AcceptedCluster | None:
        hypotheses = (w.hypothesis for w in self.waiting)
        loops = Loops.measured([(h.probe, h.anchor, h.relative) for h in hypotheses])
        self._consistent = agreement(loops, belief.ways, known=self._consistent)
        clusters = self._clusters()
        if not clusters:
            return None
        best = clusters[0]
        rival = max((c.score for c in clusters[1:] if self._rivals(best, c)), default=0.0)
        asked = _asked(best, rival, span_per_efold_m)
        return AcceptedCluster(best, asked) if passed(asked) else None

    def _commit(self, chosen: AcceptedCluster) -> list[Settled]:
        """Accept all that agree with every member; reject those that contradict most of them."""
        members = list(chosen.cluster.members)
        agrees = self._consistent[:, members].mean(axis=1)
        out, left = [], []
        for i, w in enumerate(self.waiting):
            if i in members or agrees[i] == 1.0:
                out.append(Settled(w.key, w.hypothesis, chosen.checks))
            elif agrees[i] < HALF:
                out.append(Settled(w.key, w.hypothesis, lack=Lack.CONTRADICTED))
            else:
                left.append(i)
        self.keep(left)
        return out

    def _rivals(self, best: Cluster, other: Cluster) -> bool:
        return bool(self._consistent[np.ix_(list(best.members), list(other.members))].mean() < HALF)

    def _clusters(self) -> list[Cluster]:
        """Sets of hypotheses that agree, one a probe, grown from each in turn; the largest score first."""
        quality = np.array([w.weight * w.hypothesis.quality for w in self.waiting])
        probes = np.array([w.hypothesis.probe for w in self.waiting])
        together = self._consistent & (probes[:, None] != probes) | np.eye(len(probes), dtype=bool)
        found: dict[tuple[int, ...], Cluster] = {}
        for first in np.argsort(-quality, kind="stable").tolist():
            members = tuple(np.flatnonzero(largest_consistent_set(together, quality, first)).tolist())
            if members not in found:
                found[members] = self._describe(members)
        return sorted(found.values(), key=lambda c: (-c.score, c.members))

    def _describe(self, members: tuple[int, ...]) -> Cluster:
        chosen = [self.waiting[i] for i in members]
        travels = [self._travel(w.hypothesis.probe) for w in chosen]
        return Cluster(
            members,
            float(sum(w.weight * w.hypothesis.quality for w in chosen)),
            sum(w.weight for w in chosen),
            max(travels) - min(travels),
            float(np.median([w.hypothesis.sigma_m for w in chosen])),
        )


def _asked(cluster: Cluster, rival: float, span_per_efold_m: float) -> tuple[Check, ...]:
    """Checks of a cluster; `rival`: score of the best one that contradicts it."""
    wider = max(0.0, float(np.log(max(cluster.sigma_m, 1e-9) / SURE_SIGMA_M)))
    probes = PROBES if wider > 0.0 else PROBES - 1
    span_m = SPAN_M + span_per_efold_m * wider
    return checks.of_cluster(cluster.probes, probes, cluster.span_m, span_m, rival / max(cluster.score, 1e-9))


class Commitment:
    """Decides about loop hypotheses, in the order in which the robot made them."""

    def __init__(self, travel_of: Callable[[int], float]) -> None:
        """Start with an empty queue; `travel_of` returns the path length (m) up to a node."""
        self._travel = travel_of
        self._queue = Pool(travel_of)
        self._given_up: list[Waiting] = []
        self._hairs: list[Waiting] = []

    def add(self, key: int, hypothesis: Hypothesis) -> None:
        """Add a hypothesis, with the key of its proposed edge.

        One that failed by a hair is kept aside, at most two of one probe node. One that failed by more is left out.
        """
        if hypothesis.passed:
            self._queue.waiting.append(Waiting(key, hypothesis))
        elif hypothesis.by_a_hair and sum(w.hypothesis.probe == hypothesis.probe for w in self._hairs) < HAIRS:
            self._hairs.append(Waiting(key, hypothesis))

    def settle(self, travel_m: float, belief: Belief) -> list[Settled]:
        """Give up hypotheses pending for too long; accept clusters that are good enough, with all that agree with them.

        Where none is, clusters with hypotheses that missed a limit by a hair may be accepted (see the module).
        `travel_m` is the path length so far, m. Returns the hypotheses that were decided: accepted, rejected or given up.
        """
        out = [Settled(w.key, w.hypothesis, lack=Lack.UNSUPPORTED) for w in self._expire(travel_m)]
        out += self._queue.commit(belief, SPAN_PER_EFOLD_M)
        return out + self._settle_group(travel_m - GROUP_M, belief, SPAN_PER_EFOLD_M, [s for s in out if s.accepted])

    def flush(self, belief: Belief) -> list[Settled]:
        """At the end of the drive, decide all hypotheses that found no cluster, those given up before included.

        May be called again after the map has changed: those without a cluster are tried again. Returns the accepted ones, and
        those rejected that were still pending.
        """
        fresh = {w.key for w in self._queue.waiting}
        again = sorted(self._given_up + self._queue.waiting, key=lambda w: (self._travel(w.hypothesis.probe), w.key))
        self._queue.keep([])
        self._given_up = []
        out: list[Settled] = []
        for probe, group in groupby(again, key=lambda w: w.hypothesis.probe):
            self._expire(self._travel(probe))
            self._queue.waiting += group
            out += [s for s in self._queue.commit(belief, 0.0) if s.accepted or s.key in fresh]
        together = self._settle_group(np.inf, belief, 0.0, [s for s in out if s.accepted])
        out += [s for s in together if s.accepted or s.key in fresh]
        self._expire(np.inf)
        settled = {s.key for s in out}
        left = [w for w in self._given_up if w.key in fresh and w.key not in settled]
        return out + [Settled(w.key, w.hypothesis, lack=Lack.UNSUPPORTED) for w in left]

    def _settle_group(
        self, until_m: float, belief: Belief, span_per_efold_m: float, closed: Sequence[Settled]
    ) -> list[Settled]:
        """Judge hypotheses that missed a limit by a hair together with those that wait, once the oldest are from `until_m`.

        Those within `GROUP_M` of travel of loops accepted without them (`closed`) are dropped. Each is part of one judgement of
        its own age, of at most `HAIRS` a probe over twice that way. Returns what was accepted, and what waited and was refused.
        """
        done_m = np.array([self._travel(s.hypothesis.probe) for s in closed])
        far = [bool(np.all(np.abs(done_m - self._travel(w.hypothesis.probe)) > GROUP_M)) for w in self._hairs]
        self._hairs = [w for w, is_far in zip(self._hairs, far, strict=True) if is_far]
        old = [w for w in self._hairs if self._travel(w.hypothesis.probe) <= until_m]
        if not old:
            return []
        waiting = {w.key for w in self._queue.waiting}
        pool = Pool(self._travel, [*self._queue.waiting, *self._hairs])
        out = [s for s in pool.commit(belief, span_per_efold_m) if s.accepted or s.key in waiting]
        decided = {s.key for s in out}
        self._hairs = [] if any(s.accepted for s in out) else [w for w in self._hairs if w not in old]
        self._queue.keep([i for i, w in enumerate(self._queue.waiting) if w.key not in decided])
        return out

    def _expire(self, travel_m: float) -> list[Waiting]:
        """Take out what has waited too long, and remember it for the end."""
        old = [w for w in self._queue.waiting if travel_m - self._travel(w.hypothesis.probe) > WAIT_M]
        self._queue.keep([i for i, w in enumerate(self._queue.waiting) if w not in old])
        self._given_up += old
        return old
