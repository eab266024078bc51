"""The noise of registrations, learnt while driving from the error with which three of them close a ring."""

from __future__ import annotations

from collections import deque

import numpy as np

from hybridmap.geometry import RelativePose, between, compose_relative, log

NOISE_FACTOR = 10.0
"""Factor on the residuals' covariance until there are enough rings: that of a Kinect."""
QUANTILE = 0.7
CHI2_QUANTILE = 3.665
"""Quantile of the rings' squared error that is compared, and its value for three degrees of freedom: above the median, as
errors have heavier tails."""
SHARED = 2.0
"""Registrations of one ring share keyframes and their noise: half of it does not show in the ring."""
REMEMBERED = 200
ENOUGH = 15
"""Number of rings that are kept, and the least number that counts."""


class NoiseLevel:
    """Learns a factor by which the covariance that a registration's residuals give must be multiplied.

    Residuals do not show errors that a whole surface shares (calibration, bias of depth, blur), which make real errors several
    times larger than simulated ones. The factor comes from rings of three registrations (k-2 to k-1, k-1 to k, and k-2 to k):
    it is the squared error with which a ring closes, relative to its covariance.
    """

    def __init__(self, initial: float = NOISE_FACTOR) -> None:
        """Start; `initial` is the factor until enough rings have been observed."""
        self._factor = initial
        self._squared: deque[float] = deque(maxlen=REMEMBERED)

    @property
    def factor(self) -> float:
        """The factor on covariances; at least 1."""
        return self._factor

    def observe(self, first: RelativePose, second: RelativePose, across: RelativePose) -> None:
        """Add a ring of registrations between three nodes in a row, with the covariances before `applied`.

        Args:
            first, second: pose of the second node in the frame of the first, and of the third in that of the second.
            across: pose of the third node in the frame of the first.
        """
        around = compose_relative(first, second)
        error = log(between(around.delta, across.delta))
        self._squared.append(float(error @ np.linalg.solve(around.covariance + across.covariance, error)))
        if len(self._squared) >= ENOUGH:
            self._factor = max(1.0, SHARED * float(np.quantile(np.array(self._squared), QUANTILE)) / CHI2_QUANTILE)

    def applied(
        self, relative: RelativePose, translation_floor_m: float, rotation_floor_deg: float, shared: float = 1.0
    ) -> RelativePose:
        """The same registration with its covariance times the factor, plus the squares of the floors (standard deviations).

        Args:
            relative: a registration with the covariance that its residuals give.
            translation_floor_m, rotation_floor_deg: the floors.
            shared: a further factor on the whole covariance, for errors that overlapping registrations have in common.
        """
        floor = np.diag([translation_floor_m**2, translation_floor_m**2, np.deg2rad(rotation_floor_deg) ** 2])
        return RelativePose(relative.delta, shared * (self.factor * relative.covariance + floor))
