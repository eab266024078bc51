"""Order in time: stamps within a topic, and merging of streams."""

from __future__ import annotations

import heapq
from collections.abc import Iterable, Iterator
from dataclasses import dataclass
from itertools import islice
from typing import Protocol, TypeVar

import numpy as np
from numpy.typing import NDArray

from hybridmap.errors import StreamError
from hybridmap.streams.base import Sample
from hybridmap.trajectory import NS_PER_S, format_stamp

Stamps = NDArray[np.int64]


def sorted_order(stamps_ns: Stamps, what: str) -> NDArray[np.intp]:
    """Indices (N,) that sort the stamps, stably; a message may be swapped with its direct successor, no further.

    Args:
        stamps_ns: (N,) header stamps in recorded order, ns.
        what: file and topic, for the error.

    Raises:
        StreamError: a stamp is older than that of the message before the previous one, or all stamps are equal.
    """
    if len(stamps_ns) > 2:
        if stamps_ns.min() == stamps_ns.max():
            raise StreamError(
                f"{what}: all {len(stamps_ns)} messages carry the stamp {format_stamp(int(stamps_ns[0]))} s; "
                "expected header stamps that tell when each was taken"
            )
        newest = np.maximum.accumulate(stamps_ns)[:-2]
        late = np.flatnonzero(stamps_ns[2:] < newest)
        if len(late):
            at = int(late[0])
            raise StreamError(
                f"{what}: stamp {format_stamp(int(stamps_ns[at + 2]))} s (message {at + 3}) goes back behind "
                f"{format_stamp(int(newest[at]))} s; expected stamps in order, at most one message out of place"
            )
    return np.argsort(stamps_ns, kind="stable")


_LONGEST_S = 1e9
"""No recording is 30 years long."""


@dataclass(frozen=True, slots=True)
class Window:
    """The part of a recording to use.

    Attributes:
        start_s, end_s: seconds from the first stamp, both inclusive; None: no limit.

    Raises:
        StreamError: a limit is negative, not finite or over 1e9 s, or the end lies before the start.
    """

    start_s: float | None = None
    end_s: float | None = None

    def __post_init__(self) -> None:
        for name, value in (("--start", self.start_s), ("--end", self.end_s)):
            if value is not None and not 0.0 <= value <= _LONGEST_S:
                raise StreamError(f"{name} {value}: expected seconds from the first stamp, 0 to {_LONGEST_S:g}")
        if self.start_s is not None and self.end_s is not None and self.end_s < self.start_s:
            raise StreamError(f"--end {self.end_s} s lies before --start {self.start_s} s; give a later end")

    def limits_ns(self, first_ns: int) -> tuple[int, int]:
        """First and last stamp of the part, ns, given the first stamp of the recording, ns."""
        low = -(2**62) if self.start_s is None else first_ns + round(self.start_s * NS_PER_S)
        high = 2**62 if self.end_s is None else first_ns + round(self.end_s * NS_PER_S)
        return low, high

    def limits_over(self, motion_ns: Stamps, first_ns: int, name: str) -> tuple[int, int]:
        """As `limits_ns`, for the recording `name` with self-motion at the stamps (N,) `motion_ns`, ns, N > 0.

        Raises:
            StreamError: none of these stamps lies in the part.
        """
        low, high = self.limits_ns(first_ns)
        if not ((motion_ns >= low) & (motion_ns <= high)).any():
            from_s, until_s = (int(stamp - first_ns) / NS_PER_S for stamp in (motion_ns.min(), motion_ns.max()))
            raise StreamError(
                f"{name}: no odometry between --start and --end; the recording has it from {from_s:.3f} to {until_s:.3f} s"
                " after its first stamp"
            )
        return low, high


WHOLE = Window()
"""No limits."""


def check_overlap(motion_ns: Stamps, observation_ns: Stamps, what: str) -> None:
    """Refuse observations that share no time with the self-motion, with a tolerance of one second; empty ones pass.

    Args:
        motion_ns, observation_ns: stamps, ns, ascending.
        what: the source, for the error.

    Raises:
        StreamError: there is no common time; the message names both spans.
    """
    if not len(motion_ns) or not len(observation_ns):
        return
    if observation_ns[-1] < motion_ns[0] - NS_PER_S or observation_ns[0] > motion_ns[-1] + NS_PER_S:
        raise StreamError(
            f"{what}: odometry runs from {_span(motion_ns)}, observations from {_span(observation_ns)}; "
            "expected one clock and a common time"
        )


def _span(stamps_ns: Stamps) -> str:
    return f"{format_stamp(int(stamps_ns[0]))} to {format_stamp(int(stamps_ns[-1]))} s"


def first_of(count: int, *stamps_ns: Iterable[int]) -> tuple[int, ...]:
    """The first stamps of sorted lists together, ns; `count` of them, or all."""
    return tuple(int(stamp) for stamp in islice(heapq.merge(*stamps_ns), count))


class Stamped(Protocol):
    """A sample, or what one will be made of."""

    @property
    def stamp_ns(self) -> int:
        """Stamp, ns."""

    @property
    def precedence(self) -> int:
        """Order among those of equal stamps."""


S = TypeVar("S", bound=Stamped)


def sort_key(sample: Stamped) -> tuple[int, int]:
    """Key that sorts samples by stamp, then by precedence, so that motion comes first."""
    return sample.stamp_ns, sample.precedence


class ReorderBuffer:
    """Sorts samples that arrive a little late, as on a live robot; with latency 0, samples pass at once."""

    def __init__(self, latency_s: float) -> None:
        """Hold each sample until the newest stamp is `latency_s` later."""
        self._latency_ns = round(latency_s * NS_PER_S)
        self._newest_ns: int | None = None
        self._heap: list[tuple[tuple[int, int], int, Sample]] = []
        self._arrivals = 0

    def push(self, sample: Sample) -> list[Sample]:
        """Add one sample; returns the samples that have waited long enough, in order.

        A sample that comes later than the latency allows is returned at once, after newer ones.
        """
        heapq.heappush(self._heap, (sort_key(sample), self._arrivals, sample))
        self._arrivals += 1
        newest = sample.stamp_ns if self._newest_ns is None else max(self._newest_ns, sample.stamp_ns)
        self._newest_ns = newest
        return self._pop_until(newest - self._latency_ns)

    def flush(self) -> list[Sample]:
        """End of the stream: returns all remaining samples, in order."""
        return self._pop_until(self._newest_ns or 0)

    def _pop_until(self, stamp_ns: int) -> list[Sample]:
        ready = []
        while self._heap and self._heap[0][0][0] <= stamp_ns:
            ready.append(heapq.heappop(self._heap)[2])
        return ready


def merge(*sources: Iterable[S]) -> Iterator[S]:
    """Merge sorted streams, lazily, by stamp, then by precedence, so that motion comes first."""
    return heapq.merge(*sources, key=sort_key)
