"""Calibration of odometry: gain, turn gain and heading bias per metre, from loop closures or from a reference trajectory."""

from hybridmap.calibration.estimate import Estimate
from hybridmap.calibration.legs import Legs, Motion
from hybridmap.calibration.regression import Sighting, regress
from hybridmap.odometry_model import NEUTRAL, Gains

__all__ = ["NEUTRAL", "Estimate", "Gains", "Legs", "Motion", "Sighting", "regress"]
