"""How far the robot came ahead between two views, by the depth of what lies straight ahead; and k_m of the wheels from it."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from hybridmap.geometry import Array
from hybridmap.vision.base import SeenGain

_AHEAD_RAD = float(np.deg2rad(3.9))
"""Columns within this of straight ahead are compared: what lies beside the way comes no nearer."""
_NEAREST_M = 0.6
_LEAST_COS = 0.2
"""Of a bearing: the way along the heading of what lies farther to the side is not told by its distance ahead."""
_SPREAD_M = 0.06
"""Most median deviation of the columns, m: more, and they show surfaces at several depths or something that moved."""
_STRAIGHT_RAD, _STEP_M = float(np.deg2rad(2.0)), 0.15
"""Steps between nodes that tell the gain: straight, and long against the noise of depth."""
_ENOUGH = 10
"""Steps before the gain is told."""


def way_ahead(
    older: NDArray[np.floating], newer: NDArray[np.floating], bearings_rad: Array, yaw_rad: float, reach_m: float
) -> float | None:
    """How far ahead of an older view a newer one was taken, m; None if what they have straight ahead does not tell.

    Args:
        older, newer: (columns,) distance along the robot's heading of what is seen, m, see `retina.Glance.ahead_m`.
        bearings_rad: (columns,) of the columns, descending.
        yaw_rad: heading of the older view seen from the newer one, rad.
        reach_m: greatest distance that is looked at, m.
    """
    ahead = np.flatnonzero(np.abs(bearings_rad) <= _AHEAD_RAD)
    if len(ahead) == 0:
        return None
    columns = np.interp(-(bearings_rad[ahead] + yaw_rad), -bearings_rad, np.arange(len(bearings_rad)))
    same = np.rint(columns).astype(np.int64)
    along_older = np.cos(bearings_rad[ahead]) / np.maximum(np.cos(bearings_rad[same]), _LEAST_COS)
    before, after = older[ahead], newer[same] * along_older
    usable = (before > _NEAREST_M) & (before < reach_m) & (after > _NEAREST_M) & (after < reach_m)
    if 2 * np.count_nonzero(usable) < len(ahead):
        return None
    came = before[usable] - after[usable]
    middle = float(np.median(came))
    return middle if float(np.median(np.abs(came - middle))) <= _SPREAD_M else None


class GainMeter:
    """Compares the way by the views with that by self-motion, step by step."""

    def __init__(self) -> None:
        """Start without a step."""
        self._ratios: list[float] = []

    def step(self, motion: Array, seen_m: float | None) -> None:
        """Add the step to the newest node.

        Args:
            motion: (3,) by self-motion, m and rad.
            seen_m: way ahead by the two views, m; None if they do not tell.
        """
        if seen_m is not None and abs(motion[2]) < _STRAIGHT_RAD and motion[0] > _STEP_M:
            self._ratios.append(seen_m / float(motion[0]))

    def rescale(self, factor: float) -> None:
        """Take note that self-motion is told in ways longer by a factor from now on, and would have been before."""
        self._ratios = [ratio / factor for ratio in self._ratios]

    @property
    def gain(self) -> SeenGain | None:
        """The median of the steps so far; None before there are enough."""
        if len(self._ratios) < _ENOUGH:
            return None
        ratios = np.array(self._ratios)
        middle = float(np.median(ratios))
        spread = 1.4826 * float(np.median(np.abs(ratios - middle)))
        return SeenGain(middle, 1.2533 * spread / float(np.sqrt(len(ratios))), len(ratios))
