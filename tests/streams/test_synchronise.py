"""The synchroniser: order, interpolation, displacements that add up, and what is dropped."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from hybridmap import geometry
from hybridmap.errors import StreamError
from hybridmap.streams.base import SelfMotion, Velocity
from hybridmap.streams.laser import LaserScan
from hybridmap.streams.order import merge
from hybridmap.streams.synchronise import Synchroniser
from tests.narrowing import known

MS = 1_000_000


def _motion(ms: int, x: float = 0.0, y: float = 0.0, yaw: float = 0.0) -> SelfMotion:
    return SelfMotion(ms * MS, np.array([x, y, yaw]))


def _scan(ms: int) -> LaserScan:
    return LaserScan(ms * MS, np.array([ms], np.float32))


def _run(samples, **settings):
    synchroniser = Synchroniser(**settings)
    steps = [step for sample in samples for step in synchroniser.push(sample)]
    return steps + list(synchroniser.flush()), synchroniser.report.counts


def test_an_observation_waits_for_odometry_and_is_interpolated():
    synchroniser = Synchroniser()
    (first,) = synchroniser.push(_motion(0, 1.0))
    np.testing.assert_array_equal(first.delta_robot, 0)
    assert (first.dt_s, first.observation) == (0.0, None)
    assert list(synchroniser.push(_scan(25))) == []
    seen, moved = synchroniser.push(_motion(100, 1.4, 0.0, 0.4))
    assert (seen.stamp_ns, known(seen.observation).stamp_ns) == (25 * MS, 25 * MS)
    expected = geometry.interpolate([1.0, 0, 0], [1.4, 0, 0.4], 0.25)
    np.testing.assert_allclose(seen.pose_odom_robot, expected)
    np.testing.assert_allclose(seen.delta_robot, geometry.between([1.0, 0, 0], expected))
    assert (moved.observation, seen.dt_s, moved.dt_s) == (None, 0.025, 0.075)
    np.testing.assert_allclose(geometry.compose(seen.pose_odom_robot, moved.delta_robot), [1.4, 0, 0.4], atol=1e-15)


@pytest.mark.parametrize("scan_first", [True, False])
def test_at_one_stamp_motion_comes_first(scan_first):
    same = [_scan(10), _motion(10, 0.1)] if scan_first else [_motion(10, 0.1), _scan(10)]
    steps, _ = _run([_motion(0), *same])
    assert [(step.stamp_ns // MS, step.observation is None) for step in steps] == [(0, True), (10, True), (10, False)]
    np.testing.assert_array_equal(steps[2].delta_robot, 0)
    assert steps[2].dt_s == 0.0


def test_of_equal_odometry_stamps_the_first_counts():
    steps, counts = _run([_motion(0), _motion(10, 1.0), _motion(10, 5.0), _motion(20, 2.0)])
    assert [step.pose_odom_robot[0] for step in steps] == [0.0, 1.0, 2.0]
    assert counts == {"equal odometry stamps": 1}


def test_observations_without_odometry_are_dropped_and_counted():
    steps, counts = _run([_scan(0), _scan(5), _motion(10), _motion(20, 1.0), _scan(400), _scan(2000)])
    assert [step.stamp_ns // MS for step in steps] == [10, 20, 400]
    assert steps[-1].pose_odom_robot[0] == 1.0
    np.testing.assert_array_equal(steps[-1].delta_robot, 0)
    assert counts == {"observations before odometry": 2, "observations after odometry": 1}


def test_an_observation_at_the_first_stamp_is_kept():
    steps, counts = _run([_scan(10), _motion(10), _motion(20)])
    assert [step.observation is not None for step in steps] == [False, True, False]
    assert counts == {}


def test_an_observation_that_comes_behind_odometry_is_dropped_and_counted():
    steps, counts = _run([_motion(0), _motion(20), _scan(10), _motion(30)])
    assert [step.stamp_ns // MS for step in steps] == [0, 20, 30]
    assert counts == {"observations behind odometry": 1}


def test_nothing_but_observations_gives_nothing():
    assert _run([_scan(0), _scan(1)]) == ([], {"observations before odometry": 2})


@given(
    st.lists(st.integers(0, 60), min_size=1, max_size=25),
    st.lists(st.integers(0, 60), max_size=25),
    st.integers(0, 2**32 - 1),
)
def test_displacements_add_up_and_stamps_never_go_back(motion_ms, scan_ms, seed):
    rng = np.random.default_rng(seed)
    motions = [_motion(ms, *rng.uniform(-3, 3, 3)) for ms in sorted(motion_ms)]
    steps, _ = _run(merge(motions, [_scan(ms) for ms in sorted(scan_ms)]))
    stamps = [step.stamp_ns for step in steps]
    assert stamps == sorted(stamps)
    assert [s.stamp_ns // MS for s in steps if s.observation is None] == sorted(set(motion_ms))
    assert [s.stamp_ns // MS for s in steps if s.observation is not None] == [t for t in sorted(scan_ms) if t >= min(motion_ms)]
    pose = steps[0].pose_odom_robot
    for step in steps:
        pose = geometry.compose(pose, step.delta_robot)
        error = geometry.between(step.pose_odom_robot, pose)
        np.testing.assert_allclose(error, 0, atol=1e-9)
    assert sum(step.dt_s for step in steps) == pytest.approx((stamps[-1] - stamps[0]) / 1e9)


@given(st.permutations(list(range(24))), st.integers(0, 2**32 - 1))
def test_late_samples_give_the_same_steps_as_sorted_ones(order, seed):
    rng = np.random.default_rng(seed)
    ordered = [_motion(10 * i, *rng.uniform(-1, 1, 3)) if i % 2 else _scan(10 * i) for i in range(24)]
    delays = {id(sample): 10 * i + 5 * place for i, (sample, place) in enumerate(zip(ordered, order, strict=True))}
    arriving = sorted(ordered, key=lambda sample: delays[id(sample)])
    live, live_counts = _run(arriving, latency_s=0.24)
    offline, offline_counts = _run(ordered)
    assert live_counts == offline_counts
    assert [step.stamp_ns for step in live] == [step.stamp_ns for step in offline]
    for one, other in zip(live, offline, strict=True):
        np.testing.assert_array_equal(one.delta_robot, other.delta_robot)
        assert one.observation is other.observation


def test_velocities_hold_until_the_next():
    steps, _ = _run([Velocity(0, 1.0, 0.0), Velocity(1000 * MS, 2.0, np.pi / 2), Velocity(2000 * MS, 0.0, 0.0)])
    np.testing.assert_allclose(steps[1].delta_robot, [1.0, 0.0, 0.0], atol=1e-12)
    radius = 2.0 / (np.pi / 2)
    np.testing.assert_allclose(steps[2].delta_robot, [radius, radius, np.pi / 2], atol=1e-12)  # a quarter circle


def test_an_observation_between_velocities_sits_on_the_arc():
    samples = [Velocity(0, 1.0, 1.0), _scan(300), Velocity(1000 * MS, 0.0, 0.0)]
    steps, _ = _run(samples)
    np.testing.assert_allclose(steps[1].delta_robot, geometry.exp([0.3, 0.0, 0.3]))
    np.testing.assert_allclose(geometry.compose(steps[1].delta_robot, steps[2].delta_robot), geometry.exp([1.0, 0.0, 1.0]))


def test_of_equal_velocity_stamps_the_last_holds():
    steps, _ = _run([Velocity(0, 5.0, 0.0), Velocity(0, 1.0, 0.0), Velocity(1000 * MS, 0.0, 0.0)])
    assert len(steps) == 2
    np.testing.assert_allclose(steps[1].delta_robot, [1.0, 0.0, 0.0], atol=1e-12)


@pytest.mark.parametrize(
    ("samples", "words"),
    [
        ([_motion(20), _motion(10)], ["0.010000000", "goes back behind", "0.020000000"]),
        ([_motion(10, float("nan"))], ["NaN", "0.010000000"]),
        ([Velocity(10 * MS, float("inf"), 0.0)], ["NaN or Inf", "0.010000000"]),
        ([_motion(0), Velocity(10 * MS, 0.0, 0.0)], ["mixed"]),
        ([_motion(0), _scan(30), _scan(20)], ["observation", "0.020000000", "0.030000000"]),
    ],
)
def test_what_cannot_be_put_in_order_is_refused_by_stamp(samples, words):
    with pytest.raises(StreamError) as caught:
        _run(samples)
    for word in words:
        assert word in str(caught.value)
