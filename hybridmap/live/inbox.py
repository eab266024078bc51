"""Which sample the mapper gets next, and when: order across sources, late sources, and a machine that is too slow.

No threads and no clock of its own: the caller says what time it is, so that a test can.
"""

from __future__ import annotations

import heapq
from collections import Counter, deque
from collections.abc import Iterable
from dataclasses import dataclass, field
from enum import Enum

from hybridmap.streams.base import Observation, Sample
from hybridmap.streams.order import sort_key
from hybridmap.streams.sensors import kind_of
from hybridmap.trajectory import NS_PER_S

ODOMETRY = "odometry"
LATE, SLOW, PAUSED, AHEAD_OF = "late", "too slow", "paused", "ahead of odometry"
"""Reasons for which a sample is left out: it came after its turn; the machine was too slow, and newer views waited; the mapper
was paused; no odometry came at its time, or it was stamped later than those of its source that followed."""
SOURCE_MIN_S = 1.0
"""A source that is silent for less is always waited for."""
GAPS_WAITED = 3.0
"""A source is waited for so many times as long as it was ever silent of late."""
LONGEST_WAIT_S = 10.0
"""No sample waits longer for another source: one that was never heard, or whose clock is another."""
AHEAD = 1
"""Views in the pipe, besides the one that is being mapped."""
MOST_WAITING = 90
"""Views that may wait for odometry: 3 s of a camera."""
_RECENT = 10


@dataclass(frozen=True, slots=True)
class LiveLimits:
    """Limits of a live mapper.

    Attributes:
        lag_s: views are left out so that none is mapped later than this after its turn; infinite: none is left out.
        correction_m_s, correction_deg_s: fastest change of the smoothed correction, as the robot feels it.
    """

    lag_s: float = 2.0
    correction_m_s: float = 0.1
    correction_deg_s: float = 5.0


@dataclass(slots=True)
class Source:
    """What is known about one source of samples.

    Attributes:
        count: samples so far.
        stamp_ns: stamp of the newest one; None before the first.
        heard_s: when that one came, by the wall clock.
        gaps_s: the latest times between two of them, by the wall clock.
        ahead_s: how far the latest stamps are ahead of the wall clock.
        back_s: by how much the stamps went back at the last jump; 0 if they never did.
        left_out: reason -> number of samples that the mapper did not get.
    """

    count: int = 0
    stamp_ns: int | None = None
    heard_s: float = 0.0
    gaps_s: deque[float] = field(default_factory=lambda: deque(maxlen=_RECENT))
    ahead_s: deque[float] = field(default_factory=lambda: deque(maxlen=_RECENT))
    back_s: float = 0.0
    left_out: Counter[str] = field(default_factory=Counter)

    def hear(self, stamp_ns: int, now_s: float) -> None:
        """Note a sample."""
        if self.stamp_ns is not None:
            self.gaps_s.append(now_s - self.heard_s)
            step_s = (stamp_ns - self.stamp_ns) / NS_PER_S
            if step_s < -SOURCE_MIN_S:
                self.back_s = -step_s
        self.count, self.stamp_ns, self.heard_s = self.count + 1, stamp_ns, now_s
        self.ahead_s.append(stamp_ns / NS_PER_S - now_s)

    @property
    def patience_s(self) -> float:
        """How long it may be silent before others stop waiting for it."""
        return min(max(SOURCE_MIN_S, GAPS_WAITED * max(self.gaps_s, default=0.0)), LONGEST_WAIT_S)


@dataclass(slots=True)
class _Waiting:
    sample: Sample
    since_s: float


class _Turn(Enum):
    LATER, NOW, NEVER = range(3)


class Inbox:
    """Sorts the samples of all sources by stamp, and gives them to the mapper one after the other.

    A sample's turn has come when every other source has given one that is as new, or is overdue. A view waits for odometry in
    any case. So, if all messages come, the order is that of a recording, whatever the order in which they came. Odometry is
    never left out for want of time. Views are, where the mapper would lag behind by more than `LiveLimits.lag_s`: then only
    the newest one is kept.

    Attributes:
        sources: name -> what is known about it; `odometry` and the sensors (`scans`, `frames`).
        began_s: when it began, by the wall clock.
        paused: whether views are left out now.
        largest_lag_s: longest time from the turn of a view to its end on the map.
    """

    def __init__(self, views: Iterable[str], limits: LiveLimits, now_s: float) -> None:
        """Start without a sample; `views` are the names of the sensors that are waited for."""
        self.sources = {name: Source() for name in (ODOMETRY, *views)}
        self.largest_lag_s = 0.0
        self.paused = False
        self.began_s = now_s
        self._limits = limits
        self._unsorted: list[tuple[tuple[int, int], int, _Waiting]] = []
        self._due: deque[_Waiting] = deque()
        self._in_child: deque[float] = deque()  # when the turn of each view came that is not mapped yet
        self._untaken = 0
        self._passed: tuple[int, int] | None = None
        self._busy_s: deque[float] = deque(maxlen=_RECENT)

    def add(self, sample: Sample, now_s: float) -> None:
        """Take in a sample that has come just now."""
        name = source_of(sample)
        source, is_view = self.sources[name], isinstance(sample, Observation)
        source.hear(sample.stamp_ns, now_s)
        if self.paused and is_view:
            source.left_out[PAUSED] += 1
        elif self._passed is not None and sort_key(sample) < self._passed:
            source.left_out[LATE] += 1
        else:
            heapq.heappush(self._unsorted, (sort_key(sample), source.count, _Waiting(sample, now_s)))
            self._bound()

    def take(self, now_s: float) -> list[Sample]:
        """The samples that the mapper should get now, in order."""
        while self._unsorted and (turn := self._turn(self._unsorted[0][2], now_s)) is not _Turn.LATER:
            self._pass(now_s, never=turn is _Turn.NEVER)
        self._shed(now_s)
        taken: list[Sample] = []
        while self._due and not (isinstance(self._due[0].sample, Observation) and self._untaken >= AHEAD):
            taken.append(self._give())
        return taken

    def flush(self, now_s: float) -> list[Sample]:
        """End of the drive: all remaining samples, in order."""
        while self._unsorted:
            self._pass(now_s, never=False)
        return [self._give() for _ in range(len(self._due))]

    def done(self, taken: int, mapped: int, busy_s: float, now_s: float) -> None:
        """Note that the mapper has taken views from the pipe, and has mapped some, in `busy_s` seconds."""
        self._untaken -= taken
        self.largest_lag_s = max(self.largest_lag_s, self.lag_s(now_s))
        for _ in range(min(mapped, len(self._in_child))):
            self._in_child.popleft()
        if mapped:
            self._busy_s.append(busy_s / mapped)

    def lag_s(self, now_s: float) -> float:
        """How long the oldest view whose turn has come is waiting for its end on the map."""
        since = self._in_child[0] if self._in_child else min((one.since_s for one in self._views()), default=now_s)
        return now_s - since

    @property
    def waits(self) -> bool:
        """Whether a sample is here that only time can bring on."""
        return bool(self._unsorted or self._due)

    def overdue(self, name: str, now_s: float) -> bool:
        """Whether others need not wait for a source: it is silent, or was never heard since the beginning."""
        source = self.sources[name]
        if source.stamp_ns is None:
            return now_s - self.began_s > LONGEST_WAIT_S
        return now_s - source.heard_s > source.patience_s

    def _views(self) -> list[_Waiting]:
        return [one for one in self._due if isinstance(one.sample, Observation)]

    def _turn(self, waiting: _Waiting, now_s: float) -> _Turn:
        stamp_ns, needed = waiting.sample.stamp_ns, (ODOMETRY, source_of(waiting.sample))
        behind = [name for name, source in self.sources.items() if source.stamp_ns is None or source.stamp_ns < stamp_ns]
        if now_s - waiting.since_s > LONGEST_WAIT_S:
            return _Turn.NEVER if any(name in needed for name in behind) else _Turn.NOW
        waits = any(name in needed or not self.overdue(name, now_s) for name in behind)
        return _Turn.LATER if waits else _Turn.NOW

    def _pass(self, now_s: float, *, never: bool) -> None:
        key, _, waiting = heapq.heappop(self._unsorted)
        if never:
            self.sources[source_of(waiting.sample)].left_out[AHEAD_OF] += 1
            return
        self._passed, waiting.since_s = key, now_s
        self._due.append(waiting)

    def _give(self) -> Sample:
        waiting = self._due.popleft()
        if isinstance(waiting.sample, Observation):
            self._untaken += 1
            self._in_child.append(waiting.since_s)
        return waiting.sample

    def _shed(self, now_s: float) -> None:
        """Leave out all views but the newest, where the oldest would be mapped too late."""
        views = self._views()
        needed_s = max(self._busy_s, default=0.0) * (len(self._in_child) + 1)
        if len(views) > 1 and now_s - views[0].since_s + needed_s > self._limits.lag_s:
            for one in views[:-1]:
                self.sources[source_of(one.sample)].left_out[SLOW] += 1
            gone = {id(one) for one in views[:-1]}
            self._due = deque(one for one in self._due if id(one) not in gone)

    def _bound(self) -> None:
        """Leave out the oldest view where too many wait for odometry."""
        views = [row for row in self._unsorted if isinstance(row[2].sample, Observation)]
        if len(views) > MOST_WAITING:
            oldest = min(views, key=lambda row: row[:2])
            self.sources[source_of(oldest[2].sample)].left_out[AHEAD_OF] += 1
            self._unsorted = [row for row in self._unsorted if row is not oldest]
            heapq.heapify(self._unsorted)


def source_of(sample: Sample) -> str:
    """Name of the source of a sample: `odometry`, or what its sensor's observations are counted as."""
    return kind_of(sample).counted if isinstance(sample, Observation) else ODOMETRY
