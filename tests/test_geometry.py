"""Laws of SE(2)."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from hybridmap import geometry as g

finite = st.floats(-50.0, 50.0)
angle = st.floats(-3.1, 3.1)
pose = st.tuples(finite, finite, angle).map(np.array)


def close(a, b, tolerance=1e-9):
    difference = np.asarray(a) - np.asarray(b)
    difference[..., 2] = g.wrap_angle(difference[..., 2])
    return np.abs(difference).max() < tolerance


@given(pose, pose, pose)
def test_composition_is_associative(a, b, c):
    assert close(g.compose(g.compose(a, b), c), g.compose(a, g.compose(b, c)))


@given(pose)
def test_inverse_undoes(a):
    assert close(g.compose(a, g.inverse(a)), g.IDENTITY)
    assert close(g.compose(g.inverse(a), a), g.IDENTITY)


@given(pose)
def test_exponential_of_logarithm_is_identity(a):
    assert close(g.exp(g.log(a)), a, 1e-8)


@given(pose, pose)
def test_adjoint_carries_a_twist_over(a, xi):
    xi = 0.01 * xi
    assert close(g.compose(a, g.exp(xi)), g.compose(g.exp(g.adjoint(a) @ xi), a), 1e-7)


@given(pose, pose, st.floats(0, 1))
def test_interpolation_meets_both_ends_and_is_symmetric(a, b, f):
    assert close(g.interpolate(a, b, 0.0), a)
    assert close(g.interpolate(a, b, 1.0), b, 1e-7)
    if abs(g.between(a, b)[2]) < 3.0:
        assert close(g.interpolate(a, b, f), g.interpolate(b, a, 1.0 - f), 1e-6)


@given(st.floats(-1e4, 1e4))
def test_wrap_stays_in_range_and_keeps_the_direction(x):
    wrapped = float(g.wrap_angle(x))
    assert -np.pi <= wrapped < np.pi
    assert np.isclose(np.cos(wrapped), np.cos(x), atol=1e-9)


@given(angle)
def test_quaternion_carries_the_yaw(yaw):
    assert np.isclose(g.yaw_from_quaternion(*g.quaternion_from_yaw(yaw)), yaw, atol=1e-12)


def test_alignment_finds_the_transform():
    rng = np.random.default_rng(3)
    truth = np.array([2.0, -1.0, 0.7])
    points = rng.normal(size=(20, 2))
    assert close(g.align(g.transform_points(truth, points), points), truth)


def test_chained_covariance_agrees_with_samples():
    rng = np.random.default_rng(5)
    first = g.RelativePose(np.array([1.0, 0.2, 0.5]), np.diag([1e-4, 2e-4, 3e-4]))
    second = g.RelativePose(np.array([0.5, -0.3, -0.2]), np.diag([2e-4, 1e-4, 1e-4]))
    chained = g.compose_relative(first, second)
    noise = [rng.multivariate_normal(np.zeros(3), r.covariance, 40_000) for r in (first, second)]
    sampled = g.compose(g.compose(first.delta, g.exp(noise[0])), g.compose(second.delta, g.exp(noise[1])))
    spread = np.cov(g.log(g.between(chained.delta, sampled)).T)
    assert np.abs(spread - chained.covariance).max() < 2e-5


def test_inverted_relative_pose_agrees_with_samples():
    rng = np.random.default_rng(6)
    relative = g.RelativePose(np.array([2.0, 1.0, 1.0]), np.diag([1e-4, 2e-4, 3e-4]))
    inverted = g.invert_relative(relative)
    noise = rng.multivariate_normal(np.zeros(3), relative.covariance, 40_000)
    sampled = g.inverse(g.compose(relative.delta, g.exp(noise)))
    spread = np.cov(g.log(g.between(inverted.delta, sampled)).T)
    assert np.abs(spread - inverted.covariance).max() < 0.05 * np.abs(inverted.covariance).max()


@pytest.mark.parametrize("yaw", [0.0, 1e-9, -1e-7, 1e-5])
def test_small_angles_are_smooth(yaw):
    a = np.array([1.0, 2.0, yaw])
    assert close(g.exp(g.log(a)), a, 1e-12)


def test_a_quaternion_of_another_length_has_the_same_heading_and_none_has_none():
    unit = g.quaternion_from_yaw(np.array([0.3, -2.0, 3.0]))
    assert np.allclose(g.yaw_from_quaternion(*(2.5 * unit).T), [0.3, -2.0, 3.0])
    for none in ((0.0, 0.0, 0.0, 0.0), (0.0, 0.0, 1e300, 1.0), (0.0, 0.0, np.nan, 1.0), (0.0, 0.0, np.inf, 1.0)):
        assert np.isnan(g.yaw_from_quaternion(*none))


def test_squared_distances_of_errors_also_where_a_covariance_is_singular():
    error = np.array([[1.0, 2.0, 0.0], [0.0, 0.0, 3.0]])
    regular = np.array([np.diag([1.0, 4.0, 1.0]), np.diag([1.0, 1.0, 9.0])])
    assert g.squared_distance(error, regular) == pytest.approx([2.0, 1.0])
    assert g.squared_distance(error[0], regular[0]) == pytest.approx(2.0)
    alike = np.array([[[1.0, 1.0, 0.0], [1.0, 1.0, 0.0], [0.0, 0.0, 1.0]], np.diag([1.0, 1.0, 9.0])])
    assert g.squared_distance(np.array([[1.0, 1.0, 0.0], error[1]]), alike) == pytest.approx([1.0, 1.0])
    assert np.isfinite(g.squared_distance(error, np.array([np.diag([1e300, 1e-300, 0.0]), regular[1]]))).all()
