"""How far behind the mapper is: what it was given and has not done yet, and how long its steps take."""

from __future__ import annotations

from collections import deque
from dataclasses import dataclass

_RECENT_VIEWS, _MEMORY_VIEWS = 30, 300
"""Newest views whose mean tells how long the next ones will take, and whose longest tells how long one may."""

_COLD_VIEWS = 2
"""The first views take longer than any later ones, as code is loaded for them."""


@dataclass(frozen=True, slots=True)
class _Given:
    number: int  # of all samples that were given, from 1
    came_s: float
    since_s: float


class Pace:
    """Follows the samples that were given to the mapper, and the times that it needs for them.

    A view whose odometry is still to come waits in the mapper, but not for it. So the mapper is behind with a view until it has
    taken it in, and from the turn of the odometry that follows until it has taken that in. Times are of the wall clock, s.

    Attributes:
        mean_s, longest_s: time that the mapper needed for one of the newest views; 0 before the first.
        motion_s: time that it needs for a sample of odometry.
        count, consumed: samples that it was given, and has taken in as far as is known.
    """

    def __init__(self) -> None:
        self.mean_s = self.longest_s = self.motion_s = 0.0
        self.count = self.consumed = self._mapped = 0
        self._pending: deque[_Given] = deque()  # not taken in yet, from the first view on that is not on the map
        self._unmapped: deque[_Given] = deque()  # views that are not on the map
        self._busy_s: deque[float] = deque(maxlen=_MEMORY_VIEWS)

    def give(self, *, is_view: bool, came_s: float, since_s: float) -> None:
        """Note that a sample is given, which came at one time, and whose turn came at another."""
        self.count += 1
        given = _Given(self.count, came_s, since_s)
        if is_view:
            self._unmapped.append(given)
        if self._unmapped:
            self._pending.append(given)

    def done(self, consumed: int, mapped: int, busy_s: float, motion_s: float) -> None:
        """Note how far the mapper is.

        Args:
            consumed: samples that it has taken in so far.
            mapped: views that it has mapped since the last call.
            busy_s: time that it needed for these.
            motion_s: time that it needs for a sample of odometry.
        """
        self.consumed, self.motion_s = consumed, motion_s
        for _ in range(min(mapped, len(self._unmapped))):
            self._unmapped.popleft()
        first = self._unmapped[0].number if self._unmapped else self.count + 1
        while self._pending and self._pending[0].number < max(consumed + 1, first):
            self._pending.popleft()
        self._mapped += mapped
        if mapped and self._mapped > _COLD_VIEWS:
            self._busy_s.extend([busy_s / mapped] * mapped)
            recent = list(self._busy_s)[-_RECENT_VIEWS:]
            self.mean_s, self.longest_s = sum(recent) / len(recent), max(self._busy_s)

    def forget(self) -> None:
        """What was given lags no longer."""
        self._pending.clear()
        self._unmapped.clear()

    @property
    def since_s(self) -> float | None:
        """Since when the mapper is behind with what it was given; None if it is not."""
        return self._pending[0].since_s if self._pending else None

    @property
    def waiting_since_s(self) -> float | None:
        """When the oldest view came that the mapper has taken in, and for which odometry is still to come."""
        first = self._unmapped[0] if self._unmapped else None
        return first.came_s if first is not None and first.number <= self.consumed and not self._pending else None

    @property
    def is_busy(self) -> bool:
        """Whether the mapper has something to do for a view that it was given."""
        return bool(self._pending)

    @property
    def views_ahead(self) -> int:
        """Views that it was given and has not taken in, besides the one that it may be busy with."""
        ahead = [view.number for view in self._unmapped if view.number > self.consumed]
        return len(ahead) - bool(ahead and self._pending[0].number == ahead[0])

    @property
    def remaining_s(self) -> float:
        """How long the mapper may need for all that it was given, if the view that it may be busy with takes as long as any."""
        return self.is_busy * self.longest_s + (self.count - self.consumed) * self.motion_s
