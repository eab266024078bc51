"""A robot that is picked up while it drives and put down elsewhere: its wheels feel nothing, its sensors see nothing."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from hybridmap.errors import ConfigError
from hybridmap.geometry import Array, between, compose, interpolate, wrap_angle

_KNOWN_M, _KNOWN_RAD = 0.5, float(np.deg2rad(20.0))
"""The robot is put down where it drove before, this near and looking the same way."""
_WALK_M_S = 1.0
_EVERY = 15
"""Steps of the drive between two moments that are tried."""


@dataclass(frozen=True, slots=True)
class Carry:
    """When the robot is carried, and how far.

    Attributes:
        first, last: steps of the drive between which it is in the air; the last is the first one on the floor again.
        distance_m: straight distance that it is carried, m.
        truth: (N, 3) true poses with the carry in them.
        felt: (N, 3) poses of a robot that did only what the wheels felt: it stands still while it is carried.
    """

    first: int
    last: int
    distance_m: float
    truth: Array
    felt: Array


def carry(drive: Array, distance_m: float, step_s: float) -> Carry:
    """Cut a piece out of a drive: from where the robot is picked up to where it goes on, in a place that it knows.

    It is picked up past the middle of the drive, as early as there is a known place so far away, farther on along the
    drive; where the world is smaller, as far away as there is one.

    Args:
        drive: (N, 3) true poses, m and rad.
        distance_m: straight distance, m.
        step_s: time between two poses, s.

    Raises:
        ConfigError: the drive comes to no place twice.
    """
    onward = _onward(drive)
    known = np.array([_seen_before(drive, int(end), len(drive) // 2) for end in onward])
    best: tuple[int, int] | None = None
    farthest = 0.0
    for start in onward:
        away = np.hypot(*(drive[onward, :2] - drive[start, :2]).T)
        ends = np.flatnonzero(known & (onward > start) & (away > farthest))
        if len(ends):
            reached = np.flatnonzero(away[ends] >= distance_m)
            end = ends[reached[0]] if len(reached) else ends[int(np.argmax(away[ends]))]
            best, farthest = (int(start), int(onward[end])), float(min(away[end], distance_m))
        if farthest >= distance_m:
            break
    if best is None:
        raise ConfigError(
            "simulation.carried_m: this drive comes to no place twice, so that there is no known place to carry to"
        )
    return _cut(drive, *best, step_s)


def _onward(drive: Array) -> np.ndarray[tuple[int], np.dtype[np.int64]]:
    """Steps past the middle of the drive; at least a tenth of it is left to drive after the last."""
    return np.arange(len(drive) // 2, len(drive) - len(drive) // 10, _EVERY)


def _seen_before(drive: Array, step: int, middle: int) -> bool:
    earlier = drive[:middle:_EVERY]
    near = np.hypot(*(earlier[:, :2] - drive[step, :2]).T) <= _KNOWN_M
    return bool(np.any(near & (np.abs(wrap_angle(earlier[:, 2] - drive[step, 2])) <= _KNOWN_RAD)))


def _cut(drive: Array, start: int, end: int, step_s: float) -> Carry:
    distance_m = float(np.hypot(*(drive[end, :2] - drive[start, :2])))
    steps = max(2, round(distance_m / _WALK_M_S / step_s))
    on_the_way = np.array([interpolate(drive[start], drive[end], at / steps) for at in range(1, steps)])
    truth = np.concatenate([drive[: start + 1], on_the_way, drive[end:]])
    after = compose(drive[start], between(drive[end], drive[end:]))
    felt = np.concatenate([drive[: start + 1], np.repeat(drive[start][None], steps - 1, axis=0), after])
    return Carry(start, start + steps, distance_m, truth, felt)
