"""A calibration as figures, and as a configuration."""

from __future__ import annotations

from typing import Any

import yaml

from hybridmap.calibration.estimate import SIGNIFICANT_SIGMAS, Estimate
from hybridmap.calibration.gains import GAIN_KEYS, Gains
from hybridmap.metrics import Metric

_NAMED = (
    ("gain", "1", "k_m, metres a metre of odometry"),
    ("turn_gain", "1", "k_w, radians a radian of odometry"),
    ("heading_bias", "rad/m", "radians added to the heading a metre forward"),
)


def metrics_of(estimate: Estimate, in_use: Gains) -> list[Metric]:
    """Each gain with its standard deviation and how far it lies from the one in use; then what it was made from."""
    rows: list[Metric] = []
    values, sigmas, off = estimate.gains.to_array(), estimate.sigmas, estimate.off(in_use)
    for index, (name, unit, text) in enumerate(_NAMED):
        rows += [
            Metric(f"{name}/calibration", float(values[index]), unit, text),
            Metric(f"{name}_sigma/calibration", float(sigmas[index]), unit, "its standard deviation"),
            Metric(f"{name}_off/calibration", float(off[index]), "sigma", "how far it lies from the one in use"),
        ]
    return [
        *rows,
        Metric("delay/calibration", estimate.delay_s, "s", "odometry of stamp t is where the robot is at t + delay"),
        Metric("delay_sigma/calibration", float(sigmas[3]), "s", "its standard deviation"),
        Metric("leg/calibration", estimate.leg_m, "m", "length of the legs that were compared"),
        Metric("legs/calibration", estimate.legs, "1", "independent legs"),
        Metric("travel/calibration", estimate.travel_m, "m", "path length that was used"),
        Metric("unit_variance/calibration", estimate.unit_variance, "1", "mean squared residual over the assumed variance"),
        Metric("downweighted/calibration", estimate.downweighted, "1", "share of legs that count less than half"),
    ]


def verdict(estimate: Estimate, in_use: Gains) -> str:
    """One line for people: what is significant, and what follows."""
    off = estimate.off(in_use)
    clear = [name for (name, _, _), far in zip(_NAMED, off, strict=True) if abs(far) > SIGNIFICANT_SIGMAS]
    if not clear:
        return f"no gain differs from the one in use by more than {SIGNIFICANT_SIGMAS:g} sigma: keep them"
    return f"{', '.join(clear)} {'differ' if len(clear) > 1 else 'differs'} by more than {SIGNIFICANT_SIGMAS:g} sigma"


def calibrated(config_tree: dict[str, Any], estimate: Estimate, in_use: Gains) -> str:
    """A configuration (the nested mapping of its file) with what the estimate changes in it, as YAML.

    The gains change together, where one of them is significant: each is estimated given the others. So does the delay.
    """
    neural, sensors = dict(config_tree.get("neural") or {}), dict(config_tree.get("sensors") or {})
    if estimate.differs(in_use):
        neural |= dict(zip(GAIN_KEYS, estimate.gains.to_array().tolist(), strict=True))
    if estimate.delay_differs:
        sensors["odometry_delay_s"] = float(sensors.get("odometry_delay_s", 0.0)) + estimate.delay_s
    return yaml.safe_dump(config_tree | {"neural": neural, "sensors": sensors}, sort_keys=False, allow_unicode=True)
