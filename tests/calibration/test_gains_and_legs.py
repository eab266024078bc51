"""What gains do to steps and legs, against the path integrator and against differences."""

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from hybridmap.calibration.legs import Legs, Motion, chain
from hybridmap.config.mapping import NeuralConfig
from hybridmap.geometry import between, compose, log
from hybridmap.neural.path_integrator import PathIntegrator
from hybridmap.odometry_model import NEUTRAL, Gains, apply

gains_of = st.builds(Gains, st.floats(0.8, 1.2), st.floats(0.8, 1.2), st.floats(-0.1, 0.1))


def steps_of(seed=0, count=120):
    return np.random.default_rng(seed).normal(size=(count, 3)) * [0.02, 0.01, 0.08] + [0.03, 0.0, 0.01]


def legs_of(steps):
    stamps = np.arange(len(steps) + 1) * 100_000_000
    return Legs(Motion(stamps, steps), stamps[[5, 20, 20, 60]], stamps[[6, 50, 110, 115]])


def test_the_path_integrator_does_the_same():
    gains, steps = Gains(1.05, 0.95, 0.03), steps_of(count=60)
    integrator = PathIntegrator(NeuralConfig(gain=1.05, turn_gain=0.95, heading_bias_rad_m=0.03, rectifier="softplus"))
    for step in steps:
        integrator.step(step, 0.1)
    np.testing.assert_allclose(integrator.pose, chain(apply(steps, gains))[-1], atol=1e-4)


def test_gains_can_change_on_the_way():
    steps, integrator = steps_of(count=40), PathIntegrator(NeuralConfig(rectifier="softplus"))
    for step in steps[:20]:
        integrator.step(step, 0.1)
    integrator.gains = Gains(1.1, 0.9, -0.05)
    for step in steps[20:]:
        integrator.step(step, 0.1)
    expected = compose(chain(steps[:20])[-1], chain(apply(steps[20:], Gains(1.1, 0.9, -0.05)))[-1])
    np.testing.assert_allclose(integrator.pose, expected, atol=1e-4)


def test_a_leg_is_the_way_from_its_first_stamp_to_its_last():
    gains, legs = Gains(1.05, 0.95, 0.03), legs_of(steps_of())
    path = chain(apply(steps_of(), gains))
    np.testing.assert_allclose(legs.predict(gains)[1], between(path[20], path[50]), atol=1e-12)


def test_a_delay_shifts_both_ends():
    legs = legs_of(steps_of())
    later = Legs(legs.motion, legs.first_ns + 200_000_000, legs.last_ns + 200_000_000)
    np.testing.assert_allclose(later.predict(NEUTRAL, 0.2), legs.predict(NEUTRAL), atol=1e-12)


@settings(max_examples=10, deadline=None)
@given(gains_of)
def test_jacobian_agrees_with_differences(gains):
    legs, h = legs_of(steps_of()), 1e-6
    jacobian = legs.jacobian(gains, 0.03)
    for column in range(3):
        shift = np.eye(3)[column] * h
        more, less = (legs.predict(Gains.from_array(gains.to_array() + s), 0.03) for s in (shift, -shift))
        np.testing.assert_allclose(jacobian[:, :, column], log(between(less, more)) / (2 * h), atol=1e-6)
    more, less = legs.predict(gains, 0.05), legs.predict(gains, 0.01)
    np.testing.assert_allclose(jacobian[:, :, 3], log(between(less, more)) / 0.04, atol=1e-9)


def test_travel_and_turn_of_legs():
    legs = legs_of(np.tile([0.1, 0.0, -0.2], (120, 1)))
    assert legs.travel_m[1] == pytest.approx(3.0)
    assert legs.turned_rad[1] == pytest.approx(6.0)
