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

from hybridmap.live.odometry import Odometer
from hybridmap.live.pace import Pace
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
_AHEAD = 1
"""Views that are given to the mapper while it is busy with one, so that it need not wait for the next."""
_MOST_WAITING = 90
"""Views that may wait for odometry: 3 s of a camera."""
_WORK_SHARE = 0.7
"""Share of the largest lag that the views which wait may need by their mean."""
_LONGER, _MARGIN_SHARE = 1.5, 0.25
"""The next step may take so many times as long as the longest of late, and at least this share of the largest lag."""
_RECENT = 10
"""Newest gaps of a source that its patience is learnt from, and offsets of its stamps."""


@dataclass(frozen=True, slots=True)
class LiveLimits:
    """Limits of a live mapper.

    Attributes:
        lag_s: views are left out so that none is mapped later than this after its turn, unless its own step takes longer;
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
    came_s: float  # by the wall clock
    tick_s: float  # when it came, by the clock of the input
    since_s: float = 0.0  # when its turn came, by the wall clock
    way: float = 0.0  # by then, of the odometer
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
    `LiveLimits.lag_s`; the newest one never is. A view is given to the mapper only when it will be mapped within that limit,
    even if this step, and the one that the mapper may be busy with, take as long as the longest of late. What is too late for
    that is left out before it is given.

    Attributes:
        sources: name -> what is known about it; `odometry` and the sensors (`scans`, `frames`).
        began_s: when it began, by the wall clock.
        paused: whether views are left out now.
        largest_lag_s: the largest `lag_s` so far.
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
        self._odometer = Odometer()
        self._given_way = 0.0  # of the newest view that was given
        self._passed: tuple[int, int] | None = None  # sort key of the newest sample whose turn has come
        self._pace = Pace()
        self._asked = 0  # samples that had been given when the mapper was asked how far it is

    def add(self, sample: Sample, now_s: float) -> None:
        """Take in a sample that has come just now."""
        name = source_of(sample)
        source, waiting = self.sources[name], _Waiting(sample, now_s, self._tick(now_s))
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
        while self._due and self._may_give(self._due[0], now_s):
            taken += self._give()
        return taken

    def flush(self, now_s: float) -> list[Sample]:
        """End of the drive: all remaining samples, in order; from here on nothing lags."""
        while self._unsorted:
            self._pass(_Turn.NOW, now_s)
        self.largest_lag_s = max(self.largest_lag_s, self.lag_s(now_s))
        remaining = [sample for _ in range(len(self._due)) for sample in self._give()]
        self._pace.forget()
        return remaining

    def done(self, consumed: int, mapped: int, busy_s: float, motion_s: float, now_s: float) -> None:
        """Note how far the mapper is; see `messages.Done`."""
        self.largest_lag_s = max(self.largest_lag_s, self.lag_s(now_s))
        self._pace.done(consumed, mapped, busy_s, motion_s)

    @property
    def is_held_up(self) -> bool:
        """Whether a view waits until the mapper has nothing to do, which it should tell once."""
        held = bool(self._due) and self._asked != self._pace.count
        self._asked = self._pace.count if held else self._asked
        return held

    def lag_s(self, now_s: float) -> float:
        """How far the mapper is behind: how long the oldest view that it could map by now has been waiting for it."""
        since = [self._pace.since_s, self._due_views[0].since_s if self._due_views else None]
        return now_s - min((one for one in since if one is not None), default=now_s)

    def waiting_s(self, now_s: float) -> float:
        """How long the oldest view has been waiting for odometry, or for another source that may have an older one."""
        unsorted = (row[2].came_s for row in self._unsorted if row[2].is_view)
        first_s = self._pace.waiting_since_s
        return now_s - min([*unsorted, *([] if first_s is None else [first_s])], default=now_s)

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

        The newest one stays. Least missed is the view whose neighbours are nearest to each other by the way that the robot has
        moved, so what stays is spread evenly over the drive.
        """
        views, pace, limit_s = self._due_views, self._pace, self._limits.lag_s
        moving_s = (pace.count - pace.consumed + len(self._due) - len(views)) * pace.motion_s
        while len(views) > 1 and moving_s + (pace.is_busy + len(views)) * pace.mean_s > _WORK_SHARE * limit_s:
            ways = [self._given_way, *(one.way for one in views)]
            gaps = [after - earlier for earlier, after in zip(ways, ways[2:], strict=False)]
            self._leave_out(views.pop(gaps.index(min(gaps))), SLOW)
        while len(views) > 1 and now_s - views[0].since_s + self._longest_s > limit_s:
            self._leave_out(views.pop(0), SLOW)

    @property
    def _longest_s(self) -> float:
        """How long the next step may take."""
        return max(_LONGER * self._pace.longest_s, _MARGIN_SHARE * self._limits.lag_s)

    def _may_give(self, waiting: _Waiting, now_s: float) -> bool:
        """Whether the mapper may have it now: a view that would be late waits until the mapper has nothing to do."""
        pace = self._pace
        if not waiting.is_view or waiting.left_out or pace.count == pace.consumed:
            return True
        in_time = now_s - waiting.since_s + pace.remaining_s + self._longest_s <= self._limits.lag_s
        return in_time and pace.views_ahead < _AHEAD

    def _turn(self, waiting: _Waiting) -> _Turn:
        stamp_ns, own = waiting.sample.stamp_ns, self.sources[source_of(waiting.sample)]
        behind = [one for one in self.sources.values() if one is not own and (one.stamp_ns is None or one.stamp_ns < stamp_ns)]
        needs = waiting.is_view and any(one is self.sources[ODOMETRY] for one in behind)
        needs |= own.stamp_ns is not None and stamp_ns - own.stamp_ns > SILENT_MIN_S * NS_PER_S
        if self._tick_s - waiting.tick_s > LONGEST_WAIT_S:
            return _Turn.NEVER if needs else _Turn.NOW
        return _Turn.LATER if needs or not all(map(self._overdue, behind)) else _Turn.NOW

    def _overdue(self, source: Source) -> bool:
        return self._tick_s - source.tick_s > source.patience_s

    def _pass(self, turn: _Turn, now_s: float) -> None:
        key, _, waiting = heapq.heappop(self._unsorted)
        if turn is _Turn.NEVER:
            self._leave_out(waiting, AHEAD)
            return
        self._passed, waiting.since_s, waiting.way = key, now_s, self._odometer.way(waiting.sample)
        self._due.append(waiting)
        if waiting.is_view:
            self._due_views.append(waiting)

    def _give(self) -> list[Sample]:
        """The next sample; none if it was left out."""
        waiting = self._due.popleft()
        if waiting.left_out:
            return []
        self._pace.give(is_view=waiting.is_view, came_s=waiting.came_s, since_s=waiting.since_s)
        if waiting.is_view:
            self._given_way = waiting.way
            self._due_views.pop(0)
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
