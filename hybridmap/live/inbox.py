"""Which sample the mapper gets next, and when: order across sources, late sources, and a machine that is too slow.

No threads and no clock of its own: the caller says what time it is, so that a test can.
"""

from __future__ import annotations

import heapq
import logging
from collections import Counter, deque
from collections.abc import Iterable
from dataclasses import dataclass, field
from enum import Enum

from hybridmap.streams.base import Observation, Sample
from hybridmap.streams.order import sort_key
from hybridmap.streams.sensors import kind_of
from hybridmap.trajectory import NS_PER_S, format_stamp

log = logging.getLogger(__name__)

ODOMETRY = "odometry"
LATE, SLOW, PAUSED, AHEAD = "late", "too slow", "paused", "ahead of odometry"
"""Reasons for which a sample is left out: it came after its turn; the machine was too slow, and newer views waited; the mapper
was paused; no odometry came up to its stamp, or it was stamped later than those of its source that followed."""
SILENT_MIN_S = 1.0
"""A source that is silent for less is always waited for."""
GAPS_WAITED = 3.0
"""A source is waited for so many times as long as it was ever silent of late."""
_GAPS_MIN = 3
"""Until it was heard oftener than this it is waited for as long as possible."""
LONGEST_WAIT_S = 10.0
"""No sample waits longer for another source: for one that was never heard, or whose clock is another."""
_TICK_MAX_S = 0.3
"""A pause of all sources counts as no more than this: then the network, the recording or this process stood still."""
_IN_PIPE = 1
"""Views in the pipe, besides the one that is being mapped."""
_MOST_WAITING = 90
"""Views that may wait for odometry: 3 s of a camera."""
_WORK_SHARE = 0.5
"""Share of the largest lag that the views which wait may need; the rest is for those that need longer than the mean."""
_RECENT = 10
"""Newest gaps of a source that its patience is learnt from, and offsets of its stamps."""
_RECENT_VIEWS = 30
"""Newest views whose time on the mapper tells how long the next ones will need."""


@dataclass(frozen=True, slots=True)
class LiveLimits:
    """Limits of a live mapper.

    Attributes:
        lag_s: views are left out so that none is mapped later than this after its turn, if two can be mapped in this time;
            infinite: none is left out.
        correction_m_s, correction_deg_s: fastest motion of the robot on the map by the smoothed correction.
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
        heard_s, tick_s: when that one came, by the wall clock, and by that of the input (`Inbox`).
        gaps_s: the latest times between two of them, by the clock of the input.
        apart_s: of views, how much later than the newest odometry the latest were stamped when they came.
        back_s: by how much the stamps went back when they last did so by more than a second; 0 if they never did.
        left_out: reason -> number of samples that the mapper did not get.
    """

    count: int = 0
    stamp_ns: int | None = None
    heard_s: float = 0.0
    tick_s: float = 0.0
    gaps_s: deque[float] = field(default_factory=lambda: deque(maxlen=_RECENT))
    apart_s: deque[float] = field(default_factory=lambda: deque(maxlen=_RECENT))
    back_s: float = 0.0
    left_out: Counter[str] = field(default_factory=Counter)

    def hear(self, stamp_ns: int, now_s: float, tick_s: float) -> None:
        """Note a sample."""
        if self.stamp_ns is not None:
            self.gaps_s.append(tick_s - self.tick_s)
            step_s = (stamp_ns - self.stamp_ns) / NS_PER_S
            self.back_s = -step_s if step_s < -SILENT_MIN_S else self.back_s
        self.count, self.stamp_ns, self.heard_s, self.tick_s = self.count + 1, stamp_ns, now_s, tick_s

    @property
    def patience_s(self) -> float:
        """How long it may be silent before others stop waiting for it."""
        if len(self.gaps_s) < _GAPS_MIN:
            return LONGEST_WAIT_S
        return min(max(SILENT_MIN_S, GAPS_WAITED * max(self.gaps_s, default=0.0)), LONGEST_WAIT_S)


@dataclass(slots=True)
class _Waiting:
    sample: Sample
    since_s: float  # when it came, by the clock of the input; after its turn, when that was, by the wall clock
    left_out: bool = False

    @property
    def is_view(self) -> bool:
        return isinstance(self.sample, Observation)


class _Turn(Enum):
    LATER, NOW, NEVER = range(3)


class Inbox:
    """Sorts the samples of all sources by stamp, and gives them to the mapper one after the other.

    A sample's turn has come when every source has given one that is as new, or is overdue. A view waits for odometry in any
    case. So, if all messages come, the order is that of a recording, whatever the order in which they came. How long a source
    is silent is measured by a clock that runs only while others are heard.

    Odometry is never left out for want of time. Views are, where the mapper would lag behind by more than
    `LiveLimits.lag_s`; the newest one never is.

    Attributes:
        sources: name -> what is known about it; `odometry` and the sensors (`scans`, `frames`).
        began_s: when it began, by the wall clock.
        paused: whether views are left out now.
        largest_lag_s: longest time from the turn of a view to its end on the map.
    """

    def __init__(self, views: Iterable[str], limits: LiveLimits, now_s: float) -> None:
        """Start without a sample; `views` are the names of the sensors that are waited for."""
        self.sources = {name: Source() for name in (ODOMETRY, *views)}
        self.began_s = now_s
        self.paused = False
        self.largest_lag_s = 0.0
        self._limits = limits
        self._tick_s, self._heard_s = 0.0, now_s
        self._unsorted: list[tuple[tuple[int, int], int, _Waiting]] = []
        self._arrivals = 0
        self._due: deque[_Waiting] = deque()
        self._due_views: list[_Waiting] = []  # the views of `_due` that are not left out
        self._given_ns = 0  # stamp of the newest view that was given
        self._passed: tuple[int, int] | None = None  # sort key of the newest sample whose turn has come
        self._untaken = 0  # views in the pipe
        self._unmapped: deque[float] = deque()  # when the turn came of the views that were given and are not mapped yet
        self._busy_s: deque[float] = deque(maxlen=_RECENT_VIEWS)

    def add(self, sample: Sample, now_s: float) -> None:
        """Take in a sample that has come just now."""
        name = source_of(sample)
        source, waiting = self.sources[name], _Waiting(sample, self._tick(now_s))
        jumped_s = source.back_s
        source.hear(sample.stamp_ns, now_s, self._tick_s)
        if source.back_s and not jumped_s:
            log.warning("%s: stamps went back by %.3f s to %s s", name, source.back_s, format_stamp(sample.stamp_ns))
        odometry = self.sources[ODOMETRY]
        if waiting.is_view and odometry.stamp_ns is not None and self._tick_s - odometry.tick_s < SILENT_MIN_S:
            source.apart_s.append((sample.stamp_ns - odometry.stamp_ns) / NS_PER_S)
        if self.paused and waiting.is_view:
            source.left_out[PAUSED] += 1
        elif self._passed is not None and sort_key(sample) < self._passed:
            source.left_out[LATE] += 1
        else:
            self._arrivals += 1
            heapq.heappush(self._unsorted, (sort_key(sample), self._arrivals, waiting))
        self._sort(now_s)

    def take(self, now_s: float) -> list[Sample]:
        """The samples that the mapper should get now, in order."""
        self._sort(now_s)
        taken: list[Sample] = []
        while self._due and not (self._due[0].is_view and self._untaken >= _IN_PIPE and not self._due[0].left_out):
            taken += self._give()
        return taken

    def flush(self, now_s: float) -> list[Sample]:
        """End of the drive: all remaining samples, in order; from here on nothing lags."""
        while self._unsorted:
            self._pass(_Turn.NOW, now_s)
        remaining = [sample for _ in range(len(self._due)) for sample in self._give()]
        self.largest_lag_s = max(self.largest_lag_s, self.lag_s(now_s))
        self._unmapped.clear()
        return remaining

    def done(self, taken: int, mapped: int, busy_s: float, now_s: float) -> None:
        """Note that the mapper has taken views from the pipe, and has mapped some, in `busy_s` seconds."""
        self._untaken -= taken
        self.largest_lag_s = max(self.largest_lag_s, self.lag_s(now_s))
        for _ in range(min(mapped, len(self._unmapped))):
            self._unmapped.popleft()
        self._busy_s.extend([busy_s / max(mapped, 1)] * mapped)

    def lag_s(self, now_s: float) -> float:
        """How long the oldest view whose turn has come is waiting for its end on the map."""
        if self._unmapped:
            return now_s - self._unmapped[0]
        return now_s - self._due_views[0].since_s if self._due_views else 0.0

    @property
    def left_out(self) -> Counter[tuple[str, str]]:
        """(source, reason) -> number of samples that the mapper did not get."""
        every = self.sources.items()
        return Counter({(name, why): number for name, source in every for why, number in source.left_out.items()})

    def _tick(self, now_s: float) -> float:
        """Let the clock of the input run on to now."""
        self._tick_s += min(max(now_s - self._heard_s, 0.0), _TICK_MAX_S)
        self._heard_s = now_s
        return self._tick_s

    def _sort(self, now_s: float) -> None:
        """Find the samples whose turn has come, and leave out views that cannot be mapped in time."""
        while self._unsorted and (turn := self._turn(self._unsorted[0][2])) is not _Turn.LATER:
            self._pass(turn, now_s)
        self._bound()
        self._thin(now_s)

    def _thin(self, now_s: float) -> None:
        """Leave out views that cannot be mapped in time: those that are missed least, and the oldest ones if they are too late.

        The newest one stays. Least missed is the view whose neighbours are nearest to each other, so what stays is spread
        evenly over the drive.
        """
        views, busy_s = self._due_views, self._busy_s
        mean_s, longest_s, before = sum(busy_s) / max(len(busy_s), 1), max(busy_s, default=0.0), len(self._unmapped)
        while len(views) > 1 and (before + len(views)) * mean_s > _WORK_SHARE * self._limits.lag_s:
            stamps = [self._given_ns, *(one.sample.stamp_ns for one in views)]
            gaps = [after - earlier for earlier, after in zip(stamps, stamps[2:], strict=False)]
            self._leave_out(views.pop(gaps.index(min(gaps))), SLOW)
        while len(views) > 1 and now_s - views[0].since_s + (before + 1) * longest_s > self._limits.lag_s:
            self._leave_out(views.pop(0), SLOW)

    def _turn(self, waiting: _Waiting) -> _Turn:
        stamp_ns, own = waiting.sample.stamp_ns, self.sources[source_of(waiting.sample)]
        behind = [one for one in self.sources.values() if one is not own and (one.stamp_ns is None or one.stamp_ns < stamp_ns)]
        needs = waiting.is_view and any(one is self.sources[ODOMETRY] for one in behind)
        needs |= own.stamp_ns is not None and stamp_ns - own.stamp_ns > SILENT_MIN_S * NS_PER_S
        if self._tick_s - waiting.since_s > LONGEST_WAIT_S:
            return _Turn.NEVER if needs else _Turn.NOW
        return _Turn.LATER if needs or not all(map(self._overdue, behind)) else _Turn.NOW

    def _overdue(self, source: Source) -> bool:
        return self._tick_s - source.tick_s > source.patience_s

    def _pass(self, turn: _Turn, now_s: float) -> None:
        key, _, waiting = heapq.heappop(self._unsorted)
        if turn is _Turn.NEVER:
            self._leave_out(waiting, AHEAD)
            return
        self._passed, waiting.since_s = key, now_s
        self._due.append(waiting)
        if waiting.is_view:
            self._due_views.append(waiting)

    def _give(self) -> list[Sample]:
        """The next sample; none if it was left out."""
        waiting = self._due.popleft()
        if waiting.left_out:
            return []
        if waiting.is_view:
            self._untaken += 1
            self._given_ns = waiting.sample.stamp_ns
            self._unmapped.append(self._due_views.pop(0).since_s)
        return [waiting.sample]

    def _bound(self) -> None:
        """Leave out the oldest view where too many wait for odometry."""
        views = [row for row in self._unsorted if row[2].is_view]
        if len(views) > _MOST_WAITING:
            oldest = min(views)
            self._leave_out(oldest[2], AHEAD)
            self._unsorted.remove(oldest)
            heapq.heapify(self._unsorted)

    def _leave_out(self, waiting: _Waiting, why: str) -> None:
        waiting.left_out = True
        self.sources[source_of(waiting.sample)].left_out[why] += 1


def source_of(sample: Sample) -> str:
    """Name of the source of a sample: `odometry`, or what its sensor's observations are counted as."""
    return kind_of(sample).counted if isinstance(sample, Observation) else ODOMETRY
