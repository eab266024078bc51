"""What a calibration says: the estimate, how sure it is, and whether it differs from what is in use."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from hybridmap.geometry import Array
from hybridmap.odometry_model import NEUTRAL, Gains

SIGNIFICANT_SIGMAS = 3.0
"""An estimate differs from a value where it lies further off than this many standard deviations."""


@dataclass(frozen=True, slots=True)
class Estimate:
    """Gains with their uncertainty.

    Attributes:
        gains: the estimate.
        delay_s: how late the legs' clock is against that of odometry: odometry of stamp t tells where the robot is at
            t + delay_s. A nuisance, estimated so that it does not pass for a turn gain.
        covariance: (4, 4) of gain, turn gain, bias and delay, by the information matrix and the unit variance; the variance
            of what the drive does not tell is infinite, and its value the neutral one.
        leg_m: length of the legs that it was made from.
        legs: number of independent legs, i.e. travel over length.
        travel_m: path length that was used.
        unit_variance: mean squared residual of a leg, in units of the assumed variance.
        downweighted: share of legs that count less than half (drop-outs).
    """

    gains: Gains
    delay_s: float
    covariance: Array
    leg_m: float
    legs: float
    travel_m: float
    unit_variance: float
    downweighted: float

    @property
    def sigmas(self) -> Array:
        """(4,) standard deviations of gain (1), turn gain (1), heading bias (rad/m) and delay (s)."""
        return np.asarray(np.sqrt(np.diag(self.covariance)))

    @property
    def measured(self) -> NDArray[np.bool_]:
        """(4,) whether the drive told gain, turn gain, bias and delay."""
        return np.isfinite(np.diag(self.covariance))

    def kept(self, in_use: Gains) -> Gains:
        """The gains to use from now on: what was measured, and the one in use in place of what was not."""
        return Gains.from_array(np.where(self.measured[:3], self.gains.to_array(), in_use.to_array()))

    def off(self, other: Gains = NEUTRAL) -> Array:
        """(3,) how many standard deviations gain, turn gain and bias lie from others; 0 where not measured."""
        difference = self.gains.to_array() - other.to_array()
        return np.asarray(difference / np.maximum(self.sigmas[:3], 1e-12))

    @property
    def delay_differs(self) -> bool:
        """Whether the delay differs significantly from none."""
        return bool(abs(self.delay_s) > SIGNIFICANT_SIGMAS * self.sigmas[3])

    def differs(self, other: Gains = NEUTRAL) -> bool:
        """Whether any of the three differs significantly from others."""
        return bool(np.any(np.abs(self.off(other)) > SIGNIFICANT_SIGMAS))
