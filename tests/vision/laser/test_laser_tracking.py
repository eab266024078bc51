"""Refined self-motion: wheels that drift and drop out, corridors that hide the way, scans between nodes."""

from itertools import pairwise

import numpy as np
import pytest

from hybridmap.geometry import IDENTITY, RelativePose, between, compose
from hybridmap.vision.laser.cloud import cloud_of_scan
from hybridmap.vision.laser.submap import Atlas
from hybridmap.vision.laser.tracking import Tracker
from tests.vision.laser.laser_worlds import LASER, cast, corridor, ring, ring_drive, room

LOOSE = np.diag([0.03, 0.03, 0.05]) ** 2


class Drive:
    """Feeds true scans and given odometry to a tracker."""

    def __init__(self, world, start, seed=0):
        self.world, self.pose, self.rng = world, start, np.random.default_rng(seed)
        self.atlas = Atlas()
        self.tracker = Tracker(self.atlas)
        ranges = cast(world, start, self.rng)
        self.atlas.add(self.cloud(ranges), ranges, IDENTITY.copy(), np.zeros((3, 3)))

    def cloud(self, ranges):
        return cloud_of_scan(ranges, LASER)

    def step(self, truth, odometry, between_nodes=()):
        self.pose = compose(self.pose, truth)
        ranges = cast(self.world, self.pose, self.rng)
        cloud = self.cloud(ranges)
        step = self.tracker.step(
            cloud, RelativePose(np.asarray(odometry, float), LOOSE), lambda: between_nodes, len(self.atlas) - 1
        )
        self.atlas.add(cloud, ranges, compose(self.atlas.chain[-1], step.relative.delta), step.scatter)
        return step


def test_drift_of_the_wheels_is_taken_out():
    poses = ring_drive(0.7)[::5]
    drive = Drive(ring(), poses[0])
    for a, b in pairwise(poses):
        truth = between(a, b)
        step = drive.step(truth, truth + np.array([0.01, 0.0, np.deg2rad(1.0)]))
        assert step.measured
        assert not step.contradicts_odometry
    off = between(between(poses[0], poses[-1]), drive.atlas.chain[-1])
    assert np.hypot(off[0], off[1]) < 0.15
    assert abs(off[2]) < np.deg2rad(1.5)


def test_a_drop_out_of_the_heading_is_found_and_contradicts():
    drive = Drive(room(), np.array([-1.5, 0.0, 0.0]))
    for _ in range(3):
        drive.step(np.array([0.3, 0.0, 0.0]), [0.3, 0.0, 0.0])
    truth = np.array([0.4, 0.0, np.deg2rad(5.0)])
    step = drive.step(truth, [0.4, 0.0, np.deg2rad(-20.0)])
    assert step.contradicts_odometry
    off = between(truth, step.relative.delta)
    assert np.hypot(off[0], off[1]) < 0.03
    assert abs(off[2]) < np.deg2rad(0.5)


def test_in_a_bare_corridor_the_wheels_keep_the_long_axis():
    drive = Drive(corridor(), np.array([-6.0, 0.1, 0.0]))
    truth = np.array([0.5, 0.0, 0.0])
    for _ in range(24):
        step = drive.step(truth, truth + np.array([0.0, 0.0, np.deg2rad(1.5)]))
        assert np.sqrt(step.relative.covariance[0, 0]) > 0.3
        assert np.sqrt(step.relative.covariance[1, 1]) < 0.1
    end = drive.atlas.chain[-1]
    assert end[0] == pytest.approx(12.0, abs=0.3)
    assert abs(end[1]) < 0.05
    assert abs(end[2]) < np.deg2rad(0.5)


def test_another_room_is_not_tracked():
    drive = Drive(room(), np.array([-1.5, 0.0, 0.0]))
    drive.step(np.array([0.3, 0.0, 0.0]), [0.3, 0.0, 0.0])
    drive.world = np.array([(-30.0, 9.0, 30.0, 9.0), (-20.0, 9.0, 5.0, -30.0)])
    step = drive.step(np.array([0.3, 0.0, 0.0]), [0.3, 0.0, 0.0])
    assert not step.measured
    assert [check.figure for check in step.checks if not check.passed] == ["inliers"]
    np.testing.assert_array_equal(step.relative.delta, [0.3, 0.0, 0.0])


def test_scans_between_nodes_carry_over_a_turn_too_wide_for_the_search():
    start = np.array([-1.5, 0.0, 0.0])
    truth = np.array([0.1, 0.0, np.deg2rad(100.0)])
    believed = np.array([0.1, 0.0, np.deg2rad(20.0)])

    def outcome(count):
        drive = Drive(room(), start)
        between_nodes = []
        for i in range(1, count):
            pose = compose(start, truth * i / count)
            between_nodes.append((believed * i / count, drive.cloud(cast(room(), pose, drive.rng))))
        step = drive.step(truth, believed, between_nodes)
        return between(truth, step.relative.delta)

    off = outcome(8)
    assert abs(off[2]) < np.deg2rad(1.0)
    assert np.hypot(off[0], off[1]) < 0.05
