"""What is wrong with the input of a live mapper, in sentences for the robot's owner."""

from __future__ import annotations

from collections.abc import Iterator
from statistics import median

from hybridmap.errors import counted
from hybridmap.live.inbox import AHEAD, LATE, ODOMETRY, PAUSED, SLOW, Inbox

QUIET_S = 3.0
"""Time that a source has before it is missed, s."""
CLOCKS_APART_S = 0.5
"""Stamps of two sources that come at the same time differ by less than this, s."""
_OF_REASON = {
    LATE: "came after their turn: stamps out of order, or a source that comes and goes",
    SLOW: "left out, as mapping is slower than they come: give the machine more time, or send fewer",
    PAUSED: "left out while paused",
    AHEAD: "left out, as no odometry came up to their stamps",
}


def sentences(inbox: Inbox, now_s: float) -> list[str]:
    """What is wrong; empty if nothing. See `LiveMapper.doctor`."""
    found = [*_missing(inbox, now_s), *_jumps(inbox), *_clocks(inbox)]
    for name, source in inbox.sources.items():
        found += [f"{name}: {number} of {source.count} {_OF_REASON[why]}" for why, number in source.left_out.items()]
    return found


def _missing(inbox: Inbox, now_s: float) -> Iterator[str]:
    for name, source in inbox.sources.items():
        silent_s = now_s - (source.heard_s if source.count else inbox.began_s)
        if silent_s < QUIET_S or (source.count and silent_s < source.patience_s):
            continue
        if source.stamp_ns is None:
            yield f"{name}: none came in {silent_s:.0f} s; is the sensor running, and is its topic the right one?"
        else:
            yield f"{name}: none for {silent_s:.0f} s, after {counted(source.count, 'message')}"


def _jumps(inbox: Inbox) -> Iterator[str]:
    for name, source in inbox.sources.items():
        if source.back_s:
            yield (
                f"{name}: stamps went back by {source.back_s:.3f} s; what is stamped before the newest that was mapped is left"
                " out. If a clock was set back, begin a new map (reset)"
            )


def _clocks(inbox: Inbox) -> Iterator[str]:
    odometry = inbox.sources[ODOMETRY]
    for name, source in inbox.sources.items():
        if source is odometry or not source.ahead_s or not odometry.ahead_s:
            continue
        apart_s = median(source.ahead_s) - median(odometry.ahead_s)
        if abs(apart_s) > CLOCKS_APART_S:
            way = "later" if apart_s > 0 else "earlier"
            yield f"{name}: stamps are {abs(apart_s):.3f} s {way} than those of odometry of the same moment; expected one clock"
