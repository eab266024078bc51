from __future__ import annotations

import numpy as np
import pytest

from hybridmap.errors import StoreError
from hybridmap.geometry import between, compose, log
from hybridmap.store import Track, trajectory_of
from tests.store.sessions import SECOND, odometry_of, truth_at


def make_track(every: int = 10, count: int = 101) -> tuple[Track, np.ndarray, np.ndarray]:
    stamps = np.arange(count) * (SECOND // 10)
    truth = truth_at(stamps)
    odometry = odometry_of(truth, bias_rad_per_m=0.1)
    nodes = np.arange(count) // every
    return Track(stamps, nodes, between(odometry[nodes * every], odometry), odometry), truth, nodes * every


def test_node_poses_are_met_exactly():
    track, truth, at = make_track()
    poses = truth[::10]
    trajectory = trajectory_of(track, poses)
    np.testing.assert_allclose(trajectory.poses[::10], poses, atol=1e-12)
    assert at[-1] == 100


def test_odometry_poses_give_odometry_back():
    track, _, _ = make_track()
    trajectory = trajectory_of(track, track.poses_odom[::10])
    assert np.abs(log(between(trajectory.poses, track.poses_odom))).max() < 1e-12


def test_residual_is_spread_so_that_the_trajectory_is_continuous():
    track, truth, _ = make_track()
    trajectory = trajectory_of(track, truth[::10])
    step = np.abs(log(between(trajectory.poses[:-1], trajectory.poses[1:])))
    true_step = np.abs(log(between(truth[:-1], truth[1:])))
    assert np.abs(step - true_step).max() < 6e-4
    raw = compose(truth[::10][track.nodes], track.deltas)
    raw_step = np.abs(log(between(raw[:-1], raw[1:])))
    assert np.abs(raw_step - true_step).max() > 3e-3
    assert np.abs(trajectory.poses - truth)[:, :2].max() < np.abs(raw - truth)[:, :2].max() / 2


def test_standing_still_spreads_by_time():
    stamps = np.arange(5) * SECOND
    track = Track(stamps, np.array([0, 0, 0, 0, 1]), np.zeros((5, 3)), np.zeros((5, 3)))
    poses = np.array([[0.0, 0, 0], [1.0, 0, 0]])
    np.testing.assert_allclose(trajectory_of(track, poses).poses[:, 0], [0, 0.25, 0.5, 0.75, 1], atol=1e-12)


def test_last_node_is_followed_by_odometry():
    stamps = np.arange(3) * SECOND
    deltas = np.array([[0, 0, 0], [1.0, 0, 0], [2.0, 0, 0]])
    track = Track(stamps, np.zeros(3, np.int64), deltas, deltas)
    poses = np.array([[5.0, 5, np.pi / 2]])
    np.testing.assert_allclose(trajectory_of(track, poses).poses, [[5, 5, np.pi / 2], [5, 6, np.pi / 2], [5, 7, np.pi / 2]])


def test_robot_re_anchored_to_an_older_node_goes_on_from_there():
    stamps = np.arange(4) * SECOND
    odometry = np.array([[0.0, 0, 0], [1, 0, 0], [2, 0, 0], [3, 0, 0]])
    track = Track(stamps, np.array([0, 1, 0, 0]), np.array([[0, 0, 0], [0, 0, 0], [0.1, 0, 0], [1.1, 0, 0]]), odometry)
    poses = np.array([[0.0, 0, 0], [1.0, 0, 0]])
    np.testing.assert_allclose(trajectory_of(track, poses).poses[:, 0], [0, 1, 0.1, 1.1], atol=1e-12)


def test_empty_track_and_unknown_node_are_refused():
    empty = Track(np.zeros(0, np.int64), np.zeros(0, np.int64), np.zeros((0, 3)), np.zeros((0, 3)))
    with pytest.raises(StoreError, match="no pose"):
        trajectory_of(empty, np.zeros((1, 3)))
    track, _, _ = make_track()
    with pytest.raises(StoreError, match="names node 10"):
        trajectory_of(track, np.zeros((3, 3)))
