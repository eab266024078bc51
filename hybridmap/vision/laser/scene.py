"""The scale of the scene: how far the walls are tells how far scans are used and how coarse their points may be."""

from __future__ import annotations

from collections import deque
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

RANGE_MAX_M = 20.0
"""Largest range used in rooms and corridors, m: beyond it the beams of most lasers are too far apart for normals."""
CELL_M = 0.05
"""Side of the cells whose points are merged there, m: a few times the noise of a range."""
REACH_MAX_M = 1.0
"""Largest distance of the neighbours that give a point its normal there, m."""
NEAR_M = 8.0
"""Where three quarters of the returns are this near, the scene has the scale 1: a large room, a hall of a house."""
LARGEST = 2.0
"""The largest scale: there the cells are 0.1 m, and a laser of 80 m is used whole."""
STEP = 0.5
"""The scale changes in such steps, so that a map has few kinds of clouds."""
SHARE = 0.75
"""Share of a scan's returns that lie within its typical range."""
SCANS = 60
"""The median over so many scans is the scene's: people and doors beside the robot do not change it."""


@dataclass(frozen=True, slots=True)
class Scale:
    """Sizes in proportion to the scene.

    Attributes:
        factor: 1 indoors, up to `LARGEST` where the walls are far away.
    """

    factor: float = 1.0

    @property
    def cell_m(self) -> float:
        """Side of the cells whose points are merged, m; the residuals of a registration are judged by it."""
        return CELL_M * self.factor

    @property
    def range_max_m(self) -> float:
        """Largest range used, m. It grows faster than the cells: few returns are near, and far walls hold the heading."""
        return RANGE_MAX_M * self.factor**2

    @property
    def reach_max_m(self) -> float:
        """Largest distance of the neighbours that give a point its normal, m."""
        return REACH_MAX_M * self.factor**2


INDOORS = Scale()


class Scene:
    """Follows the scale of the scene, scan by scan, at a constant cost."""

    def __init__(self) -> None:
        """Start without a scan, at the scale of a room."""
        self._typical_m: deque[float] = deque(maxlen=SCANS)
        self.scale = INDOORS

    def observe(self, ranges_m: NDArray[np.float32]) -> Scale:
        """Take in one scan (B,), m, NaN where there is no return; returns the scale of the scene now.

        The scale changes only when the scene's typical range has gone a whole step on, so it does not flicker between two.
        """
        returns = ranges_m[np.isfinite(ranges_m)]
        if len(returns):
            at = int(SHARE * (len(returns) - 1))
            self._typical_m.append(float(np.partition(returns, at)[at]))
            wanted = min(max(sorted(self._typical_m)[len(self._typical_m) // 2] / NEAR_M, 1.0), LARGEST)
            if abs(wanted - self.scale.factor) >= STEP:
                self.scale = Scale(STEP * round(wanted / STEP))
        return self.scale
