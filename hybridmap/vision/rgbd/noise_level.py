"""The noise of registrations, learnt while driving from rings of three of them."""

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
    """A factor on the covariance that the residuals of a registration give.

    Residuals do not show errors that a whole surface shares (calibration, bias of depth, blur), and which make real edges
    several times worse than simulated ones. The factor is the squared error of the ring k-2 to k-1, k-1 to k and k-2 to k,
    relative to its covariance.
    """

    def __init__(self, initial: float = NOISE_FACTOR) -> None:
        """Begin with the factor that holds until there are enough rings."""
        self._factor = initial
        self._squared: deque[float] = deque(maxlen=REMEMBERED)

    @property
    def factor(self) -> float:
        """Factor on covariances; 1 or more."""
        return self._factor

    def observe(self, first: RelativePose, second: RelativePose, across: RelativePose) -> None:
        """Add a ring: k-2 to k-1, k-1 to k, and k-2 to k, with the residuals' covariances."""
        around = compose_relative(first, second)
        error = log(between(around.delta, across.delta))
        self._squared.append(float(error @ np.linalg.solve(around.covariance + across.covariance, error)))
        if len(self._squared) >= ENOUGH:
            self._factor = max(1.0, SHARED * float(np.quantile(np.array(self._squared), QUANTILE)) / CHI2_QUANTILE)

    def applied(self, relative: RelativePose, translation_floor_m: float, rotation_floor_deg: float) -> RelativePose:
        """The same measurement with the factor on its covariance, and a floor under its standard deviations."""
        floor = np.diag([translation_floor_m**2, translation_floor_m**2, np.deg2rad(rotation_floor_deg) ** 2])
        return RelativePose(relative.delta, self.factor * relative.covariance + floor)
