"""Points and normals of scans; merging; free space."""

import numpy as np
import pytest

from hybridmap.geometry import IDENTITY
from hybridmap.vision.laser.cloud import EMPTY, Cloud, cloud_of_scan, merged
from hybridmap.vision.laser.submap import Atlas, violation
from tests.vision.laser.laser_worlds import LASER, cast, corridor, room


def test_points_lie_on_the_walls_and_normals_face_the_robot():
    cloud = cloud_of_scan(cast(corridor(), np.zeros(3)), LASER)
    np.testing.assert_allclose(np.abs(cloud.points[:, 1]), 1.2, atol=1e-3)
    has = (cloud.normals**2).sum(axis=1) > 0.5
    assert has.mean() > 0.9
    np.testing.assert_allclose(
        cloud.normals[has], np.stack([0 * cloud.points[has, 0], -np.sign(cloud.points[has, 1])], 1), atol=1e-3
    )


def test_invalid_and_far_returns_are_left_out():
    ranges = np.full(len(LASER.bearings_rad), np.nan, np.float32)
    assert len(cloud_of_scan(ranges, LASER)) == 0
    ranges[100:150] = 25.0
    ranges[10:60] = 3.0
    cloud = cloud_of_scan(ranges, LASER)
    assert np.hypot(*(cloud.points - LASER.pose_base_laser[:2]).T).max() == pytest.approx(3.0, abs=0.02)


def test_merging_averages_a_cell_and_forgets_the_order():
    rng = np.random.default_rng(1)
    a = Cloud(rng.uniform(-1, 1, (50, 2)), np.tile([0.0, 1.0], (50, 1)))
    b = Cloud(rng.uniform(-1, 1, (50, 2)), np.tile([0.0, 1.0], (50, 1)))
    ab, ba = merged([a, b], 0.25), merged([b, a, EMPTY], 0.25)
    np.testing.assert_allclose(ab.points, ba.points, atol=1e-12)
    assert len(ab) <= 81
    assert len(merged([], 0.1)) == 0


def _submap(world, pose):
    atlas = Atlas()
    ranges = cast(world, pose)
    atlas.add(cloud_of_scan(ranges, LASER), ranges, IDENTITY.copy(), np.zeros((3, 3)))
    return atlas.submap(0, [0]), [ranges]


def test_free_space_is_kept_by_the_same_place_and_violated_by_another():
    here, ranges = _submap(room(), np.zeros(3))
    assert violation(here, here, IDENTITY, ranges, LASER) == 0.0
    small, _ = _submap(0.4 * room(), np.zeros(3))
    assert violation(small, here, IDENTITY, ranges, LASER) > 0.5
