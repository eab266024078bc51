"""The calibration of odometry: laws of the model, and that integrator, regression and graph have the same one."""

from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from hybridmap.backends.gtsam.calibrated import with_calibrated_odometry
from hybridmap.calibration import Legs, Motion
from hybridmap.geometry import compose, exp, log, wrap_angle
from hybridmap.graph.edges import EdgeKind
from hybridmap.graph.pose_graph import PoseGraph
from hybridmap.odometry_model import NEUTRAL, Gains, apply, remove, step_of, steps_of, twists

gains_of = st.builds(Gains, st.floats(0.5, 1.5), st.floats(0.5, 1.5), st.floats(-0.3, 0.3))
raw_steps = st.tuples(st.floats(-2.0, 2.0), st.floats(-1.0, 1.0), st.floats(-1.5, 1.5)).map(np.array)


def by_the_integrator(step, gains):
    """Pose after one step from the origin, of chord and turn as the path integrator takes them."""
    dx_m, dy_m, dyaw_rad = step
    forward, left, turn = step_of(dx_m, dy_m, dyaw_rad, gains)
    cos, sin = np.cos(0.5 * turn), np.sin(0.5 * turn)
    return np.array([cos * forward - sin * left, sin * forward + cos * left, turn])


def by_the_regression(step, gains):
    """The leg from the first stamp to the last."""
    legs = Legs(Motion(np.array([0, 100]), step[None]), np.array([0]), np.array([100]))
    return legs.predict(gains)[0]


def by_the_graph(step, gains):
    """The odometry edge as the calibrating back-end has it."""
    ends, kinds = (np.array([0]), np.array([1])), np.array([EdgeKind.ODOMETRY], dtype=np.int8)
    graph = PoseGraph(np.zeros((2, 3)), *ends, step[None], np.eye(3)[None], kinds, np.array([0]))
    return with_calibrated_odometry(graph, gains).deltas[0]


@settings(max_examples=100, deadline=None)
@given(raw_steps, gains_of)
def test_integrator_regression_and_graph_have_one_model(step, gains):
    x, y, turn = log(step)
    exact = exp([gains.gain * x, gains.gain * y, gains.turn_gain * turn + gains.heading_bias_rad_m * x])
    one = by_the_integrator(step, gains)
    for other, tolerance in ((by_the_regression(step, gains), 1e-12), (by_the_graph(step, gains), 1e-12), (exact, 1e-10)):
        apart = other - one
        apart[2] = wrap_angle(apart[2])
        np.testing.assert_allclose(apart, 0.0, atol=tolerance)  # `exp` loses digits where the turn is small


@settings(max_examples=100, deadline=None)
@given(raw_steps, gains_of)
def test_remove_undoes_apply(step, gains):
    gains = replace(gains, heading_bias_rad_m=0.3 * gains.heading_bias_rad_m)
    np.testing.assert_allclose(remove(apply(step[None], gains), gains)[0], step, atol=1e-12)


@settings(max_examples=100, deadline=None)
@given(raw_steps, gains_of, st.integers(2, 7))
def test_an_arc_in_parts_is_the_whole_arc(step, gains, parts):
    part = apply(steps_of(twists(step[None]) / parts), gains)[0]
    pose = np.zeros(3)
    for _ in range(parts):
        pose = compose(pose, part)
    apart = pose - apply(step[None], gains)[0]
    apart[2] = wrap_angle(apart[2])
    np.testing.assert_allclose(apart, 0.0, atol=1e-12)


@given(raw_steps)
def test_neutral_gains_change_nothing(step):
    np.testing.assert_allclose(apply(step[None], NEUTRAL)[0], step, atol=1e-14)
    dx_m, dy_m, dyaw_rad = step
    forward, left, turn = step_of(dx_m, dy_m, dyaw_rad, NEUTRAL)
    assert turn == step[2]
    assert np.hypot(forward, left) == pytest.approx(np.hypot(step[0], step[1]), abs=1e-14)


def test_wheels_that_stand_and_turn_only_turn():
    assert step_of(0.0, 0.0, 0.5, Gains(1.1, 2.0, 0.3)) == (0.0, 0.0, 1.0)
    assert step_of(0.4, 0.0, 0.0, Gains(2.0, 1.0, 0.0)) == (0.8, 0.0, 0.0)
