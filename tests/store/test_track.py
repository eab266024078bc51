from __future__ import annotations

import numpy as np
import pytest

from hybridmap.errors import StoreError
from hybridmap.geometry import between, compose, log
from hybridmap.store import Track, trajectory_of
from hybridmap.trajectory import anchors_on
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


def test_motion_that_the_odometry_did_not_see_is_spread_by_time():
    stamps = np.arange(5) * SECOND
    odometry = np.zeros((5, 3))
    odometry[1:, 0] = 0.4
    deltas = np.array([[0, 0, 0], [0.4, 0, 0], [0.4, 0, 0], [0.4, 0, 0], [0, 0, 0]])
    track = Track(stamps, np.array([0, 0, 0, 0, 1]), deltas, odometry)
    seen = trajectory_of(track, np.array([[0.0, 0, 0], [0.6, 0, 0]])).poses[:, 0]
    np.testing.assert_allclose(seen, [0, 0.6, 0.6, 0.6, 0.6], atol=1e-12)
    unseen = trajectory_of(track, np.array([[0.0, 0, 0], [2.4, 0, 0]])).poses[:, 0]
    np.testing.assert_allclose(unseen, [0, 0.9, 1.4, 1.9, 2.4], atol=1e-12)


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
    below = Track(np.arange(2) * SECOND, np.array([-1, 0]), np.zeros((2, 3)), np.zeros((2, 3)))
    with pytest.raises(StoreError, match="names node -1"):
        trajectory_of(below, np.zeros((1, 3)))


def make_anchored(every: int = 10, skip: int = 3) -> tuple[Track, np.ndarray, np.ndarray]:
    """A drive with a drop-out of the wheels between two nodes, and every third stamp measured on the true map."""
    track, truth, at = make_track(every)
    odometry = track.poses_odom.copy()
    odometry[55:] = compose(compose(odometry[55], [0.2, 0.0, 0.3]), between(odometry[55], odometry[55:]))
    deltas = between(odometry[at], odometry)
    rows = np.arange(0, len(truth), skip)
    nodes = track.nodes[rows]
    anchors = anchors_on(truth[::every], track.stamps_ns[rows], nodes, between(truth[at[rows]], truth[rows]))
    return Track(track.stamps_ns, track.nodes, deltas, odometry, anchors), truth, rows


def test_anchors_are_met_exactly_and_hold_the_way_between_them():
    track, truth, rows = make_anchored()
    found = trajectory_of(track, truth[::10]).poses
    np.testing.assert_allclose(log(between(truth[rows], found[rows])), 0.0, atol=1e-12)
    without = trajectory_of(Track(track.stamps_ns, track.nodes, track.deltas, track.poses_odom), truth[::10]).poses
    off, off_without = (np.abs(log(between(truth, poses)))[:, :2].mean() for poses in (found, without))
    assert off < off_without / 3


def test_anchors_follow_another_map_without_a_jump():
    """A back-end that has every node elsewhere gets the shape of the way, not the map it was measured on."""
    track, truth, _ = make_anchored()
    bent = truth[::10] + np.column_stack([0.05 * np.arange(11) ** 2, np.zeros(11), 0.02 * np.arange(11)])
    found = trajectory_of(track, bent).poses
    np.testing.assert_allclose(found[::10], bent, atol=1e-9)
    step = np.hypot(*between(found[:-1], found[1:])[:, :2].T)
    way = np.hypot(*between(bent[:-1], bent[1:])[:, :2].T)[np.minimum(np.arange(len(step)) // 10, 9)]
    assert np.all(step[:50] < 1.6 * way[:50] / 10)


def test_anchors_at_stamps_that_the_track_does_not_have_are_left_out():
    track, truth, _ = make_track()
    anchors = anchors_on(truth[::10], np.array([5]), np.array([0]), np.array([[9.0, 9.0, 0.0]]))
    with_anchor = Track(track.stamps_ns, track.nodes, track.deltas, track.poses_odom, anchors)
    np.testing.assert_array_equal(trajectory_of(with_anchor, truth[::10]).poses, trajectory_of(track, truth[::10]).poses)
