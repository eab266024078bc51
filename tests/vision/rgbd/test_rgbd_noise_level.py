import numpy as np
import pytest

from hybridmap.geometry import RelativePose, compose, compose_relative, exp
from hybridmap.vision.rgbd.noise_level import ENOUGH, SHARED, NoiseLevel

COVARIANCE = np.diag([0.002, 0.003, 0.001]) ** 2
STEP = np.array([0.25, 0.02, 0.1])


def closures(level, times_sigma, count, seed=0):
    rng = np.random.default_rng(seed)
    for _ in range(count):
        first, second = (measured(STEP, rng, times_sigma) for _ in range(2))
        level.observe(first, second, measured(compose(STEP, STEP), rng, times_sigma))


def measured(delta, rng, times_sigma):
    return RelativePose(compose(delta, exp(times_sigma * rng.normal(size=3) * np.sqrt(np.diag(COVARIANCE)))), COVARIANCE)


def test_the_configured_factor_holds_until_enough_closures_were_seen():
    level = NoiseLevel(10.0)
    closures(level, 1.0, ENOUGH - 1)
    assert level.factor == 10.0
    closures(level, 1.0, 1)
    assert level.factor != 10.0


@pytest.mark.parametrize("times_sigma", [1.0, 4.0])
def test_the_factor_is_how_much_worse_than_their_covariance_registrations_close(times_sigma):
    level = NoiseLevel(10.0)
    closures(level, times_sigma, 200)
    assert level.factor == pytest.approx(SHARED * times_sigma**2, rel=0.3)


def test_one_bad_closure_in_ten_hardly_counts():
    level = NoiseLevel(10.0)
    closures(level, 1.0, 90)
    closures(level, 100.0, 10)
    assert level.factor < 2.0 * SHARED


def test_covariances_are_never_taken_for_too_large():
    level = NoiseLevel(10.0)
    closures(level, 1e-3, 50)
    assert level.factor == 1.0


def test_factor_and_floor_are_applied():
    level = NoiseLevel(4.0)
    relative = compose_relative(RelativePose(STEP, COVARIANCE), RelativePose(STEP, COVARIANCE))
    applied = level.applied(relative, 0.01, 1.0)
    assert applied.delta is relative.delta
    assert applied.covariance == pytest.approx(4.0 * relative.covariance + np.diag([0.01, 0.01, np.deg2rad(1.0)]) ** 2)


def test_errors_in_common_multiply_factor_and_floor():
    level = NoiseLevel(4.0)
    alone, common = (level.applied(RelativePose(STEP, COVARIANCE), 0.01, 1.0, shared) for shared in (1.0, 3.0))
    assert common.covariance == pytest.approx(3.0 * alone.covariance)
