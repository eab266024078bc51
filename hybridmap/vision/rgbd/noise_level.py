"""How far registrations really err, learnt while driving from how badly three of them close."""

from __future__ import annotations

from collections import deque

import numpy as np

from hybridmap.geometry import RelativePose, between, compose_relative, log

NOISE_FACTOR = 10.0
"""What the residuals' covariance is multiplied by, until closures of registrations have shown by how much: as for a Kinect."""
QUANTILE = 0.7
CHI2_QUANTILE = 3.665
"""The quantile of the closures' squared error that is looked at, and what it is for three degrees of freedom: above the
median, because errors have heavier tails than the law."""
SHARED = 2.0
"""Two of the three registrations of a closure share each keyframe, whose noise they misread alike: half of it hides."""
REMEMBERED = 200
ENOUGH = 15
"""Closures that are remembered, and how many it takes before they are believed."""


class NoiseLevel:
    """A factor on the covariance that the residuals of a registration give.

    Residuals know the noise of a single point. They do not know what errs alike over a whole surface (calibration, a bias of
    depth, blur), which makes real edges several times worse than simulated ones. The registrations from k-2 to k-1, from
    k-1 to k and from k-2 to k must close; how badly they do, in terms of their own covariances, is the factor.
    """

    def __init__(self, initial: float = NOISE_FACTOR) -> None:
        """Begin with a factor that holds until enough closures have been seen."""
        self._factor = initial
        self._squared: deque[float] = deque(maxlen=REMEMBERED)

    @property
    def factor(self) -> float:
        """What covariances are multiplied by; 1 or more."""
        return self._factor

    def observe(self, first: RelativePose, second: RelativePose, across: RelativePose) -> None:
        """Take in a closure: from k-2 to k-1, from k-1 to k, and from k-2 to k, with covariances as the residuals give them."""
        around = compose_relative(first, second)
        error = log(between(around.delta, across.delta))
        self._squared.append(float(error @ np.linalg.solve(around.covariance + across.covariance, error)))
        if len(self._squared) >= ENOUGH:
            self._factor = max(1.0, SHARED * float(np.quantile(np.array(self._squared), QUANTILE)) / CHI2_QUANTILE)

    def applied(self, relative: RelativePose, translation_floor_m: float, rotation_floor_deg: float) -> RelativePose:
        """The same measurement with the factor on its covariance, and a floor under its standard deviations."""
        floor = np.diag([translation_floor_m**2, translation_floor_m**2, np.deg2rad(rotation_floor_deg) ** 2])
        return RelativePose(relative.delta, self.factor * relative.covariance + floor)
