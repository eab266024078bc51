"""Head-direction ring: m cells whose population vector is the only state of the heading."""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import DTypeLike, NDArray


class HeadDirectionRing:
    """Ring attractor of m cells with preferred directions theta_i = 2 pi i / m (paper eq. 1).

    The rates are d_i = 1 + cos(theta_i - phi): never negative, and with D = [cos theta; sin theta] the read-out
    (2/m) D d is exactly (cos phi, sin phi). A turn acts through the rank-two recurrent weights (2/m) D' R(dphi) D; the
    length of the population vector is restored at each turn (divisive inhibition), so rounding cannot let it grow or fade.

    Attributes:
        activity: (m,) firing rates, 0..2; the whole state.
    """

    def __init__(self, cells: int, dtype: DTypeLike = np.float64) -> None:
        preferred = 2.0 * np.pi * np.arange(cells) / cells
        self.preferred_rad: NDArray[np.float64] = preferred
        self._kernel = np.stack([np.cos(preferred), np.sin(preferred)]).astype(dtype)
        self._readout = (self._kernel * (2.0 / cells)).astype(dtype)
        self._tuning = np.concatenate([self._kernel, np.ones_like(self._kernel[:1])])
        self._vector = np.ones(3, dtype=dtype)
        self.activity: NDArray[np.floating] = 1.0 + self._kernel[0]

    def direction(self) -> tuple[float, float]:
        """Return (cos, sin) of the decoded heading."""
        c, s = self._readout.dot(self.activity).tolist()
        norm = math.hypot(c, s)
        return c / norm, s / norm

    def heading_of(self, activity: NDArray[np.floating]) -> float:
        """The heading of an activity (m,), rad in [-pi, pi]."""
        c, s = (self._readout @ activity).tolist()
        return math.atan2(s, c)

    def rates_at(self, heading_rad: float) -> NDArray[np.floating]:
        """The activity (m,) at a heading, rad."""
        vector = np.array([math.cos(heading_rad), math.sin(heading_rad), 1.0])
        return np.asarray(vector.astype(self._tuning.dtype).dot(self._tuning))

    @property
    def heading_rad(self) -> float:
        """Decoded heading, rad in [-pi, pi]."""
        return self.heading_of(self.activity)

    def turn(self, angle_rad: float) -> tuple[float, float]:
        """Rotate the population vector by omega dt, rad, left positive.

        Returns:
            (cos, sin) of the mid-point heading, half of the turn ahead of where the ring stood.
        """
        c, s = self.direction()
        if angle_rad == 0.0:
            return c, s
        cos, sin = math.cos(0.5 * angle_rad), math.sin(0.5 * angle_rad)
        middle_c, middle_s = c * cos - s * sin, c * sin + s * cos
        self._vector[0] = middle_c * cos - middle_s * sin
        self._vector[1] = middle_c * sin + middle_s * cos
        self.activity = self._vector.dot(self._tuning)
        return middle_c, middle_s

    def rates(self, turn_rate_rad_s: float = 0.0, modulation_s: float = 0.1) -> NDArray[np.floating]:
        """Return the rates (m,) with the turn-rate modulation of real cells, gain 1 + modulation |omega|; no state changes."""
        return self.activity * (1.0 + modulation_s * abs(turn_rate_rad_s))
