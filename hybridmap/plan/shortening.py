"""A way through free space pulled taut: straight where there is room, and round the corners of what is in the way."""

from __future__ import annotations

import numpy as np

from hybridmap.geometry import Array
from hybridmap.plan.free_space import FreeSpace

_SPACING_M = 0.1
"""Points are so near each other where the way is first straightened."""
_ROUNDS = 12
_SHARES = np.array([0.5, 0.35, 0.2, 0.1, 0.05])
"""How much of the two straights at a corner is cut off. Half at most, so that both ends of one straight can be cut at once."""
_LEAST_GAIN_M = 1e-3


def length_m(points: Array) -> float:
    """Length of a way (K, 2), m."""
    return float(np.hypot(*np.diff(points, axis=0).T).sum())


def shortened(points: Array, space: FreeSpace) -> Array:
    """A shorter way (J, 2) between the same ends, each straight of which the robot can drive; m.

    The way is straightened: from each point on to the farthest one that can be reached straight. Then corners are cut off as
    far as there is room, round by round. The result cannot be pulled shorter without going round another side of something.

    Args:
        points: (K, 2) of a way in `map`. Where one of its own straights has no room, it is kept all the same.
        space: where the robot can be.
    """
    way = _straightened(_dense(points), space)
    for _ in range(_ROUNDS):
        before = length_m(way)
        way = _straightened(_cut(way, space), space)
        if before - length_m(way) < _LEAST_GAIN_M:
            break
    return way


def _dense(points: Array) -> Array:
    """The way with points at most `_SPACING_M` apart."""
    steps = np.hypot(*np.diff(points, axis=0).T)
    along = np.concatenate([[0.0], np.cumsum(steps)])
    at = np.union1d(along, np.arange(0.0, along[-1], _SPACING_M))
    return np.stack([np.interp(at, along, points[:, axis]) for axis in (0, 1)], axis=1)


def _straightened(points: Array, space: FreeSpace) -> Array:
    """From each point on to the farthest that can be reached straight, found by doubling the stretch, then halving it."""
    kept, here, last = [0], 0, len(points) - 1
    while here < last:
        step = 1
        while here + 2 * step <= last and _sees(points, here, here + 2 * step, space):
            step *= 2
        reached, beyond = here + step, min(here + 2 * step, last + 1)
        if beyond == last + 1 and reached < last and _sees(points, here, last, space):
            reached = last
        while beyond - reached > 1:
            middle = (reached + beyond) // 2
            reached, beyond = (middle, beyond) if _sees(points, here, middle, space) else (reached, middle)
        here = reached
        kept.append(here)
    return points[kept]


def _sees(points: Array, start: int, end: int, space: FreeSpace) -> bool:
    return bool(space.sees(points[start : start + 1], points[end : end + 1])[0])


def _cut(points: Array, space: FreeSpace) -> Array:
    """The way with the largest piece of each corner cut off for which there is room."""
    if len(points) < 3:
        return points
    corner, back, on = points[1:-1, None], points[:-2, None] - points[1:-1, None], points[2:, None] - points[1:-1, None]
    first, second = (share.ravel() for share in np.meshgrid(_SHARES, _SHARES))
    starts, ends = corner + first[:, None] * back, corner + second[:, None] * on
    gain = np.hypot(*np.moveaxis(starts - corner, -1, 0)) + np.hypot(*np.moveaxis(ends - corner, -1, 0))
    gain -= np.hypot(*np.moveaxis(ends - starts, -1, 0))
    room = space.sees(starts.reshape(-1, 2), ends.reshape(-1, 2)).reshape(gain.shape)
    gain = np.where(room, gain, -1.0)
    best = np.argmax(gain, axis=1)
    out = [points[:1]]
    for k, choice in enumerate(best):
        cut = gain[k, choice] > 0.0
        out.append(np.stack([starts[k, choice], ends[k, choice]]) if cut else points[k + 1 : k + 2])
    return np.concatenate([*out, points[-1:]])
