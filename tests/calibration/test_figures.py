"""What is written and said: only what was measured, on top of what is in use, and never what does not load."""

import math

import numpy as np
import pytest
import yaml

from hybridmap.calibration.estimate import Estimate, calibrated, changes, metrics_of, verdict
from hybridmap.config import Config
from hybridmap.errors import ConfigError
from hybridmap.odometry_model import NEUTRAL, Gains

SIGMAS = np.array([0.01, 0.01, 0.002, 0.02])


def estimate_of(gains=NEUTRAL, delay_s=0.0, sigmas=SIGMAS):
    return Estimate(gains, delay_s, np.diag(np.square(sigmas)), 4.0, 20.0, 80.0, 1.0, 0.0)


def written(tree, estimate, in_use=NEUTRAL):
    return Config.from_tree(yaml.safe_load(calibrated(tree, estimate, in_use)), "test")


def test_a_delay_is_added_to_the_one_in_use():
    tree = {"sensors": {"odometry_delay_s": 0.1, "range_max_m": 9.0}}
    sensors = written(tree, estimate_of(delay_s=0.09)).sensors
    assert sensors.odometry_delay_s == pytest.approx(0.19)
    assert sensors.range_max_m == 9.0
    assert written(tree, estimate_of(delay_s=0.05)).sensors.odometry_delay_s == 0.1  # 2.5 sigma


def test_settings_that_have_gone_are_left_out():
    tree = {"neural": {"dtype": "float32"}, "vision": {"laser": {"tracking": {"narrow": {"half_m": 3.0}}}}, "seed": 4}
    assert written(tree, estimate_of()) == Config(seed=4)


def test_what_does_not_load_is_not_written():
    tree = {"sensors": {"odometry_delay_s": 0.5}}
    with pytest.raises(ConfigError, match=r"not written: sensors\.odometry_delay_s: .*less than or equal to 1, found 1\.4"):
        calibrated(tree, estimate_of(delay_s=0.9), NEUTRAL)


def test_a_gain_that_was_not_measured_stays_and_is_said():
    in_use = Gains(1.05, 1.0, 0.01)
    estimate = estimate_of(Gains(1.0, 0.9, 0.0), sigmas=[math.inf, 0.01, 0.002, math.inf])
    tree = {"neural": dict(zip(("gain", "turn_gain", "heading_bias_rad_m"), in_use.to_array().tolist(), strict=True))}
    assert Gains.of(written(tree, estimate, in_use).neural) == Gains(1.05, 0.9, 0.0)
    assert "the drive does not determine the gain: the one in use is kept" in verdict(estimate, in_use)
    assert "the drive does not determine the delay: the one in use is kept" in verdict(estimate, in_use)
    figures = {row.name: row.value for row in metrics_of(estimate, in_use)}
    assert all(
        math.isnan(figures[f"{name}/calibration"]) for name in ("gain", "gain_sigma", "gain_off", "delay", "delay_sigma")
    )
    assert figures["turn_gain/calibration"] == 0.9


def test_a_delay_alone_is_a_change_and_is_said():
    estimate = estimate_of(delay_s=0.13)
    assert changes(estimate, NEUTRAL)
    assert not changes(estimate_of(delay_s=0.05), NEUTRAL)
    assert verdict(estimate, NEUTRAL).endswith("keep them; the delay differs from the one in use by 0.13 s, more than 3 sigma")
