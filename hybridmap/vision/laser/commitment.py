"""Late decision on loops: hypotheses are pending until enough of them agree with each other and outweigh those that do not."""

from __future__ import annotations

from collections.abc import Callable
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
SPAN_PER_EFOLD_M = 1.0
"""Additional travel for each factor e by which the gate is wider, m: more places then look alike."""


@dataclass(frozen=True, slots=True)
class Waiting:
    """A pending loop hypothesis and the key of its proposed edge."""

    key: int
    hypothesis: Hypothesis


@dataclass(frozen=True, slots=True)
class Settled:
    """A decided loop hypothesis: the checks of its cluster if it is accepted, else what it lacked."""

    key: int
    hypothesis: Hypothesis
    checks: tuple[Check, ...] = ()
    lack: Lack | None = None

    @property
    def accepted(self) -> bool:
        """Whether the loop enters the map."""
        return self.lack is None

    def proposed(self) -> Edge:
        """The edge of the hypothesis, with its new status."""
        return self.hypothesis.proposed(self.key).settled(*self.checks, lack=self.lack)


@dataclass(frozen=True, slots=True)
class Cluster:
    """Loop hypotheses that agree with each other, at most one for each place from which loops were measured (probe).

    Attributes:
        members: positions of the hypotheses in the queue.
        score: sum of the quality of the members.
        probes: number of distinct probes.
        span_m: travel between the first and the last probe.
        sigma_m: median uncertainty of the expected position, over the members.
    """

    members: tuple[int, ...]
    score: float
    probes: int
    span_m: float
    sigma_m: float


@dataclass(frozen=True, slots=True)
class AcceptedCluster:
    """An accepted cluster, and the checks that it passed."""

    cluster: Cluster
    checks: tuple[Check, ...]


class Commitment:
    """The queue of pending loop hypotheses."""

    def __init__(self, travel_of: Callable[[int], float]) -> None:
        """Start with an empty queue; `travel_of` returns the path length (m) up to a node."""
        self._travel = travel_of
        self._queue: list[Waiting] = []
        self._given_up: list[Waiting] = []
        self._consistent: NDArray[np.bool_] = np.zeros((0, 0), dtype=bool)

    def add(self, key: int, hypothesis: Hypothesis) -> None:
        """Add a hypothesis, with the key of its proposed edge."""
        self._queue.append(Waiting(key, hypothesis))

    def settle(self, travel_m: float, belief: Belief) -> list[Settled]:
        """Give up hypotheses pending for too long; accept the best cluster if good enough, with all that agree with it.

        `travel_m` is the path length so far. Returns the hypotheses that were decided.
        """
        out = [Settled(w.key, w.hypothesis, lack=Lack.UNSUPPORTED) for w in self._expire(travel_m)]
        return out + self._commit_all(belief, SPAN_PER_EFOLD_M)

    def flush(self, belief: Belief) -> list[Settled]:
        """At the end of the drive, decide all hypotheses that found no cluster, those given up before included.

        May be called again after the map has changed. Returns the hypotheses that were decided.
        """
        fresh = {w.key for w in self._queue}
        again = sorted(self._given_up + self._queue, key=lambda w: (self._travel(w.hypothesis.probe), w.key))
        self._keep([])
        self._given_up = []
        out: list[Settled] = []
        for probe, group in groupby(again, key=lambda w: w.hypothesis.probe):
            self._expire(self._travel(probe))
            self._queue += group
            out += [s for s in self._commit_all(belief, 0.0) if s.accepted or s.key in fresh]
        self._expire(np.inf)
        settled = {s.key for s in out}
        left = [w for w in self._given_up if w.key in fresh and w.key not in settled]
        return out + [Settled(w.key, w.hypothesis, lack=Lack.UNSUPPORTED) for w in left]

    def _expire(self, travel_m: float) -> list[Waiting]:
        """Take out what has waited too long, and remember it for the end."""
        old = [w for w in self._queue if travel_m - self._travel(w.hypothesis.probe) > WAIT_M]
        self._keep([i for i, w in enumerate(self._queue) if w not in old])
        self._given_up += old
        return old

    def _commit_all(self, belief: Belief, span_per_efold_m: float) -> list[Settled]:
        out: list[Settled] = []
        while (best := self._best_cluster(belief, span_per_efold_m)) is not None:
            out += self._commit(best)
        return out

    def _keep(self, positions: list[int]) -> None:
        known = [p for p in positions if p < len(self._consistent)]
        self._consistent = self._consistent[np.ix_(known, known)]
        self._queue = [self._queue[p] for p in positions]

    def _best_cluster(self, belief: Belief, span_per_efold_m: float) -> AcceptedCluster | None:
        hypotheses = (w.hypothesis for w in self._queue)
        loops = Loops.measured([(h.probe, h.anchor, h.relative) for h in hypotheses])
        self._consistent = agreement(loops, belief.ways, known=self._consistent)
        clusters = self._clusters()
        if not clusters:
            return None
        best = clusters[0]
        rival = max((c.score for c in clusters[1:] if self._rivals(best, c)), default=0.0)
        asked = self._asked(best, rival, span_per_efold_m)
        return AcceptedCluster(best, asked) if passed(asked) else None

    def _asked(self, cluster: Cluster, rival: float, span_per_efold_m: float) -> tuple[Check, ...]:
        """Checks of a cluster; `rival`: score of the best one that contradicts it."""
        wider = max(0.0, float(np.log(max(cluster.sigma_m, 1e-9) / SURE_SIGMA_M)))
        probes = PROBES if wider > 0.0 else PROBES - 1
        span_m = SPAN_M + span_per_efold_m * wider
        return checks.of_cluster(cluster.probes, probes, cluster.span_m, span_m, rival / max(cluster.score, 1e-9))

    def _commit(self, chosen: AcceptedCluster) -> list[Settled]:
        """Accept all that agree with every member; reject those that contradict most of them."""
        members = list(chosen.cluster.members)
        agrees = self._consistent[:, members].mean(axis=1)
        out, left = [], []
        for i, w in enumerate(self._queue):
            if i in members or agrees[i] == 1.0:
                out.append(Settled(w.key, w.hypothesis, chosen.checks))
            elif agrees[i] < HALF:
                out.append(Settled(w.key, w.hypothesis, lack=Lack.CONTRADICTED))
            else:
                left.append(i)
        self._keep(left)
        return out

    def _rivals(self, best: Cluster, other: Cluster) -> bool:
        return bool(self._consistent[np.ix_(list(best.members), list(other.members))].mean() < HALF)

    def _clusters(self) -> list[Cluster]:
        """Sets of hypotheses that agree, one a probe, grown from each in turn; the largest score first."""
        quality = np.array([w.hypothesis.quality for w in self._queue])
        probes = np.array([w.hypothesis.probe for w in self._queue])
        together = self._consistent & (probes[:, None] != probes) | np.eye(len(probes), dtype=bool)
        found: dict[tuple[int, ...], Cluster] = {}
        for first in np.argsort(-quality, kind="stable").tolist():
            members = tuple(np.flatnonzero(largest_consistent_set(together, quality, first)).tolist())
            if members not in found:
                found[members] = self._describe(members)
        return sorted(found.values(), key=lambda c: (-c.score, c.members))

    def _describe(self, members: tuple[int, ...]) -> Cluster:
        chosen = [self._queue[i].hypothesis for i in members]
        travels = [self._travel(h.probe) for h in chosen]
        return Cluster(
            members,
            float(sum(h.quality for h in chosen)),
            len({h.probe for h in chosen}),
            max(travels) - min(travels),
            float(np.median([h.sigma_m for h in chosen])),
        )
