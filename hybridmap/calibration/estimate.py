"""The result of a calibration: the estimate, its covariance, and whether it differs from the values in use."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
import yaml
from numpy.typing import NDArray

from hybridmap.config import Config
from hybridmap.config.gone import without_gone
from hybridmap.geometry import Array
from hybridmap.metrics import Metric
from hybridmap.odometry_model import GAIN_KEYS, NEUTRAL, Gains

SIGNIFICANT_SIGMAS = 3.0
"""An estimate differs from a value where it lies further off than this many standard deviations."""
_NAMED = (
    ("gain", "1", "k_m, metres a metre of odometry"),
    ("turn_gain", "1", "k_w, radians a radian of odometry"),
    ("heading_bias", "rad/m", "radians added to the heading a metre forward"),
)


@dataclass(frozen=True, slots=True)
class Estimate:
    """Systematic errors of wheel odometry, estimated from pieces of the drive ("legs"), with their uncertainty.

    Attributes:
        gains: the estimated gain, turn gain and heading bias.
        delay_s: delay of the odometry clock, beside one that its stamps were corrected by: odometry of stamp t gives the pose
            at t + delay_s. Estimated together with the gains, as a delay would otherwise look like an error of the turn gain.
        covariance: (4, 4) covariance of gain, turn gain, heading bias and delay, scaled by the unit variance. A value that the
            drive leaves open has infinite variance, and is neutral (gain 1, turn gain 1, bias 0, delay 0).
        leg_m: length of the legs, m.
        legs: number of independent legs, i.e. travel divided by length.
        travel_m: path length that was used, m.
        unit_variance: mean squared residual of a leg, in units of the assumed variance.
        downweighted: share of legs that the robust fit gave a weight below one half, e.g. where wheels slipped.
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
        """(4,) standard deviations of gain (1), turn gain (1), heading bias (rad/m) and delay (s); infinite if unobservable."""
        return np.asarray(np.sqrt(np.diag(self.covariance)))

    @property
    def measured(self) -> NDArray[np.bool_]:
        """(4,) which of gain, turn gain, heading bias and delay the drive determines: those whose variance is finite."""
        return np.isfinite(np.diag(self.covariance))

    def kept(self, in_use: Gains) -> Gains:
        """The gains to use from now on: the estimate where the drive determines it (`measured`), else the value in use.

        Whether they differ significantly is not asked: see `differs`.
        """
        return Gains.from_array(np.where(self.measured[:3], self.gains.to_array(), in_use.to_array()))

    def off(self, other: Gains = NEUTRAL) -> Array:
        """(3,) gain, turn gain and heading bias minus those of `other`, in standard deviations; 0 if unobservable."""
        difference = self.gains.to_array() - other.to_array()
        return np.asarray(difference / np.maximum(self.sigmas[:3], 1e-12))

    @property
    def delay_differs(self) -> bool:
        """Whether the delay differs from zero by more than `SIGNIFICANT_SIGMAS` standard deviations."""
        return bool(abs(self.delay_s) > SIGNIFICANT_SIGMAS * self.sigmas[3])

    def differs(self, other: Gains = NEUTRAL) -> bool:
        """Whether gain, turn gain or heading bias differs from that of `other` by more than `SIGNIFICANT_SIGMAS`."""
        return bool(np.any(np.abs(self.off(other)) > SIGNIFICANT_SIGMAS))


def metrics_of(estimate: Estimate, in_use: Gains, delay_s: float = 0.0) -> list[Metric]:
    """Each gain with its standard deviation, its distance from the value in use in these, the delay, and the data used.

    Values that are unobservable are NaN.

    Args:
        estimate: what was estimated.
        in_use: the gains in use.
        delay_s: the delay in use, s, to be listed beside the estimated one.
    """
    rows: list[Metric] = []
    told, sigmas, off = estimate.measured, estimate.sigmas, estimate.off(in_use)
    values = np.append(estimate.gains.to_array(), estimate.delay_s)
    values, sigmas, off = (np.where(told[: len(row)], row, np.nan) for row in (values, sigmas, off))
    for index, (name, unit, text) in enumerate(_NAMED):
        rows += [
            Metric(f"{name}/calibration", float(values[index]), unit, text),
            Metric(f"{name}_sigma/calibration", float(sigmas[index]), unit, "its standard deviation"),
            Metric(f"{name}_off/calibration", float(off[index]), "sigma", "how far it lies from the one in use"),
        ]
    return [
        *rows,
        Metric("delay/calibration", float(values[3]), "s", "odometry of stamp t is where the robot is at t + delay, beside:"),
        Metric("delay_in_use/calibration", delay_s, "s", "delay that the map was made with: configured, or found driving"),
        Metric("delay_sigma/calibration", float(sigmas[3]), "s", "standard deviation of the delay"),
        Metric("leg/calibration", estimate.leg_m, "m", "length of the legs that were compared"),
        Metric("legs/calibration", estimate.legs, "1", "independent legs"),
        Metric("travel/calibration", estimate.travel_m, "m", "path length that was used"),
        Metric("unit_variance/calibration", estimate.unit_variance, "1", "mean squared residual over the assumed variance"),
        Metric("downweighted/calibration", estimate.downweighted, "1", "share of legs that count less than half"),
    ]


def changes(estimate: Estimate, in_use: Gains) -> bool:
    """Whether the estimate changes a configuration: a gain differs significantly from that in use, or the delay from zero."""
    return estimate.differs(in_use) or estimate.delay_differs


def verdict(estimate: Estimate, in_use: Gains) -> str:
    """One line for people: which values differ significantly, what changes, and what was unobservable."""
    names = [name for name, _, _ in _NAMED]
    clear = [name for name, far in zip(names, estimate.off(in_use), strict=True) if abs(far) > SIGNIFICANT_SIGMAS]
    if clear:
        said = [f"{', '.join(clear)} {'differ' if len(clear) > 1 else 'differs'} by more than {SIGNIFICANT_SIGMAS:g} sigma"]
    else:
        said = [f"no gain differs from the one in use by more than {SIGNIFICANT_SIGMAS:g} sigma: keep them"]
    if estimate.delay_differs:
        said.append(
            f"the delay differs from the one in use by {estimate.delay_s:.3g} s, more than {SIGNIFICANT_SIGMAS:g} sigma"
        )
    said += [
        f"the drive does not determine the {name.replace('_', ' ')}: the one in use is kept"
        for name, told in zip([*names, "delay"], estimate.measured, strict=True)
        if not told
    ]
    return "; ".join(said)


def calibrated(config_tree: dict[str, Any], estimate: Estimate, in_use: Gains, delay_s: float | None = None) -> str:
    """Put the estimate into a configuration (the nested mapping of its file); returns YAML that `Config.load` reads.

    If one gain differs significantly, all observable gains change together, as each is estimated given the others. The delay
    is decided separately. The drive was mapped with the delay in use, so the estimated delay is added to it.

    Args:
        config_tree: the configuration.
        estimate: what was estimated.
        in_use: the gains in use.
        delay_s: the delay in use, s; None: that of the configuration.

    Raises:
        ConfigError: the result is not a valid configuration of this version, e.g. a delay beyond its limit.
    """
    tree = without_gone(config_tree)
    neural, sensors = dict(tree.get("neural") or {}), dict(tree.get("sensors") or {})
    if estimate.differs(in_use):
        neural |= dict(zip(GAIN_KEYS, estimate.kept(in_use).to_array().tolist(), strict=True))
    if estimate.delay_differs:
        used_s = float(sensors.get("odometry_delay_s") or 0.0) if delay_s is None else delay_s
        sensors["odometry_delay_s"] = used_s + estimate.delay_s
    tree |= {"neural": neural, "sensors": sensors}
    Config.from_tree(tree, "calibrated configuration, not written")
    return yaml.safe_dump(tree, sort_keys=False, allow_unicode=True)
