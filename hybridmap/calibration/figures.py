"""A calibration as figures, and as a configuration."""

from __future__ import annotations

from typing import Any

import numpy as np
import yaml

from hybridmap.calibration.estimate import SIGNIFICANT_SIGMAS, Estimate
from hybridmap.config import Config
from hybridmap.metrics import Metric
from hybridmap.odometry_model import GAIN_KEYS, Gains

_NAMED = (
    ("gain", "1", "k_m, metres a metre of odometry"),
    ("turn_gain", "1", "k_w, radians a radian of odometry"),
    ("heading_bias", "rad/m", "radians added to the heading a metre forward"),
)


def metrics_of(estimate: Estimate, in_use: Gains) -> list[Metric]:
    """Each gain with its standard deviation and how far it lies from the one in use (NaN where the drive does not tell it);
    then what it was made from.
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
        Metric("delay/calibration", float(values[3]), "s", "odometry of stamp t is where the robot is at t + delay"),
        Metric("delay_sigma/calibration", float(sigmas[3]), "s", "its standard deviation"),
        Metric("leg/calibration", estimate.leg_m, "m", "length of the legs that were compared"),
        Metric("legs/calibration", estimate.legs, "1", "independent legs"),
        Metric("travel/calibration", estimate.travel_m, "m", "path length that was used"),
        Metric("unit_variance/calibration", estimate.unit_variance, "1", "mean squared residual over the assumed variance"),
        Metric("downweighted/calibration", estimate.downweighted, "1", "share of legs that count less than half"),
    ]


def changes(estimate: Estimate, in_use: Gains) -> bool:
    """Whether the estimate changes a configuration: a gain differs from the one in use, or the delay from none."""
    return estimate.differs(in_use) or estimate.delay_differs


def verdict(estimate: Estimate, in_use: Gains) -> str:
    """One line for people: what is significant, what follows, and what the drive did not tell."""
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
        f"the drive does not tell the {name.replace('_', ' ')}: the one in use is kept"
        for name, told in zip([*names, "delay"], estimate.measured, strict=True)
        if not told
    ]
    return "; ".join(said)


def calibrated(config_tree: dict[str, Any], estimate: Estimate, in_use: Gains) -> str:
    """A configuration (the nested mapping of its file) with what the estimate changes in it, as YAML that `Config.load` reads.

    The gains change together, where one of them is significant: each is estimated given the others. One that was not
    measured stays. The delay is judged alone, and added to the one in use: it is what that one left.

    Raises:
        ConfigError: the result is no configuration of this version, e.g. a delay beyond its limit.
    """
    neural, sensors = dict(config_tree.get("neural") or {}), dict(config_tree.get("sensors") or {})
    if estimate.differs(in_use):
        neural |= dict(zip(GAIN_KEYS, estimate.kept(in_use).to_array().tolist(), strict=True))
    if estimate.delay_differs:
        sensors["odometry_delay_s"] = float(sensors.get("odometry_delay_s", 0.0)) + estimate.delay_s
    tree = config_tree | {"neural": neural, "sensors": sensors}
    Config.from_tree(tree, "calibrated configuration, not written")
    return yaml.safe_dump(tree, sort_keys=False, allow_unicode=True)
