"""What is wrong with the input of a live mapper, in sentences for the robot's owner."""

from __future__ import annotations

from collections.abc import Iterator
from statistics import median

from hybridmap.errors import counted
from hybridmap.live.inbox import AHEAD, LATE, PAUSED, SLOW, Inbox

QUIET_S = 3.0
"""Time that a source has before it is missed, s."""
AHEAD_MAX_S, BEHIND_MAX_S = 0.5, 2.0
"""How much later or earlier than the newest odometry a view may be stamped that comes, s: pictures take their time."""
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
    for name, source in inbox.sources.items():
        apart_s = median(source.apart_s) if source.apart_s else 0.0
        if apart_s > AHEAD_MAX_S:
            yield f"{name}: stamps are {apart_s:.3f} s later than those of odometry that has come by then; expected one clock"
        elif apart_s < -BEHIND_MAX_S:
            yield (
                f"{name}: stamps are {-apart_s:.3f} s earlier than those of odometry that has come by then: it comes late, or"
                " its clock is another"
            )
