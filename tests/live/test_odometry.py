"""Odometry as received, and the smoothed correction."""

import numpy as np
import pytest

from hybridmap.errors import StreamError
from hybridmap.geometry import between, compose
from hybridmap.live.odometry import ReceivedOdometry, Smoother
from hybridmap.streams.base import SelfMotion, Velocity
from hybridmap.streams.synchronise import Synchroniser
from hybridmap.trajectory import NS_PER_S


def test_poses_between_stamps_are_interpolated_and_later_ones_held():
    odometry = ReceivedOdometry()
    np.testing.assert_array_equal(odometry.newest, np.zeros(3))
    for second in range(3):
        odometry.add(SelfMotion(second * NS_PER_S, np.array([2.0 * second + 1.0, 0.0, 0.0])))
    odometry.add(SelfMotion(NS_PER_S, np.array([9.0, 9.0, 0.0])))  # came late
    np.testing.assert_allclose(odometry.at(NS_PER_S * 5 // 4), [3.5, 0.0, 0.0])
    np.testing.assert_array_equal(odometry.at(NS_PER_S), [3.0, 0.0, 0.0])
    np.testing.assert_array_equal(odometry.at(9 * NS_PER_S), odometry.newest)
    np.testing.assert_array_equal(odometry.first, [1.0, 0.0, 0.0])
    with pytest.raises(StreamError, match=r"expected 0\.0+ s or later"):
        odometry.at(-1)


def test_a_long_drive_keeps_the_newest_poses():
    odometry = ReceivedOdometry()
    for number in range(20_000):
        odometry.add(SelfMotion(number, np.full(3, float(number))))
    assert odometry.at(19_000)[0] == 19_000.0
    assert odometry.first[0] == 0.0
    with pytest.raises(StreamError):
        odometry.at(5)


def test_velocities_are_integrated_as_the_mapper_does():
    odometry, synchroniser = ReceivedOdometry(), Synchroniser()
    for second, (v_m_s, omega_rad_s) in enumerate([(1.0, 0.5), (0.5, -0.2), (0.0, 0.0), (2.0, 0.1)]):
        sample = Velocity(second * NS_PER_S, v_m_s, omega_rad_s)
        odometry.add(sample)
        (ready,) = synchroniser.push(sample)
        np.testing.assert_allclose(odometry.newest, ready.pose_odom_robot, atol=1e-12)


def test_the_smoothed_correction_moves_the_robot_no_faster_than_its_limits_and_says_how_far_off_it_is():
    smoother, robot = Smoother(0.1, np.deg2rad(5.0)), np.array([80.0, 10.0, 0.3])  # far from the origin of odom
    before = smoother.step(0.0, np.zeros(3), robot)
    assert (before.off_m, before.off_rad) == (0.0, 0.0)
    closed = np.array([1.0, -0.5, np.deg2rad(12.0)])
    wanted = compose(closed, robot)
    shown = robot
    for tick in range(1, 5000):
        step = smoother.step(0.05 * tick, closed, robot)
        now = compose(step.pose_map_odom, robot)
        assert np.hypot(*(now - shown)[:2]) <= 0.1 * 0.05 + 1e-8
        assert abs(between(shown, now)[2]) <= np.deg2rad(5.0) * 0.05 + 1e-8
        left = between(now, wanted)
        assert (step.off_m, step.off_rad) == pytest.approx((np.hypot(left[0], left[1]), abs(left[2])), abs=1e-6)
        shown = now
        if step.off_m == 0.0:
            break
    assert tick == pytest.approx(np.hypot(*(wanted - robot)[:2]) / 0.1 / 0.05, abs=2)
    np.testing.assert_array_equal(step.pose_map_odom, closed)


def test_a_small_correction_is_taken_over_at_once():
    smoother = Smoother(0.1, 0.1)
    smoother.step(0.0, np.zeros(3), np.zeros(3))
    small = np.array([0.005, 0.0, 0.001])
    assert smoother.step(0.1, small, np.zeros(3)).off_m == 0.0
