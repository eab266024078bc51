"""The noise of the wheels, learnt from registrations, and what it means for covariances."""

from __future__ import annotations

import numpy as np
import pytest

from hybridmap.config.mapping import EdgesConfig
from hybridmap.geometry import RelativePose, between, log
from hybridmap.graph.agreement import BOUND
from hybridmap.graph.paths import odometry_covariance
from hybridmap.wheel_noise import FIRST_M, WheelNoise
from tests.narrowing import known

CONFIG = EdgesConfig(rotation_deg_per_sqrt_m=2.0, rotation_floor_deg=0.3, rotation_per_turn=0.1, translation_per_sqrt_m=0.05)
STEP_M = 0.5
TRUE = np.array([STEP_M, 0.0, 0.0])
SURE = np.diag([0.005, 0.005, np.deg2rad(0.05)]) ** 2


def driven(
    heading_deg: float, way_m: float = 200.0, scale: float = 1.0, wrong_every: int = 0, unseen_every: int = 0
) -> WheelNoise:
    """Wheels of so much heading noise, degrees per root metre, after a drive; some registrations are wrong or lacking."""
    rng, noise = np.random.default_rng(1), WheelNoise(CONFIG)
    for step in range(1, round(way_m / STEP_M) + 2):
        yaw = float(np.deg2rad(heading_deg) * np.sqrt(STEP_M) * rng.normal())
        noise.drive(STEP_M, abs(yaw), np.array([scale * STEP_M, 0.0, yaw]))
        if unseen_every and step % unseen_every == 0:
            continue
        wrong = wrong_every and step % wrong_every < 2  # there and back again
        noise.register(RelativePose(TRUE + np.array([0.0, 0.0, 0.1 * (-1.0) ** step]) if wrong else TRUE, SURE))
    return noise


def test_nothing_is_learnt_before_some_driving():
    assert driven(0.3, FIRST_M - 2.0 * STEP_M).learnt is None
    assert driven(0.3, FIRST_M + 2.0 * STEP_M).learnt is not None


@pytest.mark.parametrize("heading_deg", [0.2, 0.3, 2.0, 5.0])
def test_the_noise_is_found_whether_small_or_large(heading_deg):
    learnt = known(driven(heading_deg, 800.0).learnt)
    assert 0.8 * heading_deg < learnt.heading_deg < 1.6 * heading_deg
    assert learnt.good == (heading_deg < 1.0)


def test_a_wrong_registration_now_and_then_and_missing_ones_do_not_make_wheels_bad():
    assert driven(0.2, wrong_every=300, unseen_every=15).trusted


def test_stretches_that_lack_many_registrations_do_not_count():
    assert driven(0.2, unseen_every=2).learnt is None


def test_bad_wheels_keep_the_configured_noise_and_registrations_their_own():
    noise = driven(2.0)
    assert np.array_equal(noise.covariance(0.5, 0.1), odometry_covariance(CONFIG, 0.5, 0.1))
    registration = RelativePose(TRUE, SURE)
    assert noise.beside(registration, RelativePose(TRUE, noise.covariance(0.5, 0.0))) is registration


def test_good_wheels_are_as_sure_as_they_were_found_and_good_registrations_keep_their_covariance():
    noise = driven(0.3)
    wheels = RelativePose(TRUE, noise.covariance(STEP_M, 0.0))
    share = known(noise.learnt).heading_deg / CONFIG.rotation_deg_per_sqrt_m
    configured = odometry_covariance(CONFIG, STEP_M, 0.0)
    assert np.sqrt(wheels.covariance[2, 2]) == pytest.approx(share * np.sqrt(configured[2, 2]))
    assert not known(noise.learnt).overrules
    assert noise.beside(RelativePose(TRUE, SURE), wheels).covariance == pytest.approx(SURE)


@pytest.mark.parametrize("scale", [1.0, 0.96])
def test_where_many_registrations_contradict_good_wheels_none_is_surer_than_they_are(scale):
    noise = driven(0.2, wrong_every=50, scale=scale)
    assert known(noise.learnt).contradicting == pytest.approx(0.04, abs=0.01)
    wheels = RelativePose(TRUE, noise.covariance(STEP_M, 0.0))
    least = wheels.covariance
    if scale != 1.0:  # of these wheels only the heading is good
        least = np.diag([0.0, 0.0, least[2, 2]])
    assert noise.beside(RelativePose(TRUE, SURE), wheels).covariance == pytest.approx(SURE + least)


def test_a_registration_that_contradicts_good_wheels_hardly_counts():
    noise = driven(0.2)
    wheels = RelativePose(TRUE, noise.covariance(STEP_M, 0.0))
    for yaw_deg in (5.0, 10.0):
        wrong = noise.beside(RelativePose(TRUE + np.array([0.0, 0.0, np.deg2rad(yaw_deg)]), SURE), wheels)
        error = log(between(wheels.delta, wrong.delta))
        assert error @ np.linalg.solve(wheels.covariance + wrong.covariance, error) < BOUND
        gain = wheels.covariance[2, 2] / (wheels.covariance[2, 2] + wrong.covariance[2, 2])
        assert gain * yaw_deg < 0.1
