"""Registration to a likelihood field: how far it converges, and what it admits not to know."""

from typing import NamedTuple

import numpy as np
import pytest

from hybridmap.geometry import IDENTITY, between, compose, log
from hybridmap.vision.laser.cloud import EMPTY, Cloud, LikelihoodField, build_field, cloud_of_scan
from hybridmap.vision.laser.scan_matching import (
    STEP_DEG,
    STEP_M,
    Prior,
    align,
    ambiguity_of,
    score_poses,
    score_starts,
    separated,
    sharpened,
    spaced,
    square,
    survivors,
)
from hybridmap.vision.laser.submap import Atlas, Field
from tests.vision.laser.laser_worlds import LASER, cast, corridor, room


class Target(NamedTuple):
    wide: LikelihoodField
    sharp: LikelihoodField
    fine: LikelihoodField


def atlas_of(world, poses, rng):
    atlas = Atlas()
    for pose in poses:
        ranges = cast(world, pose, rng)
        atlas.add(cloud_of_scan(ranges, LASER), ranges, between(poses[0], pose), np.zeros((3, 3)))
    return atlas


def target_of(world, poses, rng):
    atlas = atlas_of(world, poses, rng)
    submap = atlas.submap(0, range(len(poses)))
    return Target(atlas.scoring_field(submap, Field.WIDE), atlas.scoring_field(submap, Field.SHARP), atlas.fine_field(submap))


def test_converges_from_far_starts():
    rng = np.random.default_rng(3)
    target = target_of(room(), np.array([[0, 0, 0], [0.5, 0.1, 0.2], [1.0, 0.2, 0.4]], float), rng)
    good = 0
    for _ in range(60):
        truth = np.array([rng.uniform(-0.8, 1.2), rng.uniform(-1.0, 1.0), rng.uniform(-np.pi, np.pi)])
        cloud = cloud_of_scan(cast(room(), truth, rng), LASER)
        start = compose(truth, np.array([*rng.uniform(-0.4, 0.4, 2), np.deg2rad(rng.uniform(-10, 10))]))
        offsets = start[:2] + square(0.6, 2 * STEP_M)
        headings = start[2] + np.deg2rad(spaced(12.0, 2 * STEP_DEG))
        best = sharpened(target.sharp, cloud.points, survivors(target.wide, cloud.points, offsets, headings), 1)[0]
        pose = align(target.fine, cloud, best.pose[None]).poses[0]
        off = between(truth, pose)
        good += np.hypot(off[0], off[1]) < 0.03 and abs(off[2]) < np.deg2rad(0.5)
    assert good >= 57


def test_covariance_is_calibrated_within_a_room():
    rng = np.random.default_rng(4)
    target = target_of(room(), np.array([[0, 0, 0], [0.5, 0.1, 0.2], [1.0, 0.2, 0.4]], float), rng)
    chi2 = []
    for _ in range(60):
        truth = np.array([rng.uniform(-0.8, 1.2), rng.uniform(-1.0, 1.0), rng.uniform(-np.pi, np.pi)])
        cloud = cloud_of_scan(cast(room(), truth, rng), LASER)
        alignment = align(target.fine, cloud, truth[None])
        error = log(between(truth, alignment.poses[0]))
        chi2.append(error @ np.linalg.solve(alignment.covariance(0, 1e-3, 1e-3), error))
    assert 0.5 * 2.37 < np.median(chi2) < 2.0 * 2.37
    assert np.percentile(chi2, 95) < 2.0 * 7.81


def test_a_bare_corridor_is_loose_along_itself_and_ambiguous():
    rng = np.random.default_rng(5)
    target = target_of(corridor(), np.array([[-1, 0, 0], [0, 0.1, 0.1], [1, 0, 0]], float), rng)
    cloud = cloud_of_scan(cast(corridor(), np.array([0.5, 0.2, 0.4]), rng), LASER)
    alignment = align(target.fine, cloud, np.array([[1.5, 0.2, 0.4]]))
    covariance = alignment.covariance(0, 0.01, 0.003)
    value, vector = np.linalg.eigh(covariance[:2, :2])
    assert np.sqrt(value[1]) > 0.5
    assert np.sqrt(value[0]) < 0.1
    along = np.array([np.cos(0.4), -np.sin(0.4)])
    assert abs(vector[:, 1] @ along) > 0.99
    assert abs(alignment.weakest_direction(0) @ along) > 0.99
    assert ambiguity_of(target.fine, cloud, alignment) > 0.95
    assert abs(alignment.poses[0, 1] - 0.2) < 0.02


def test_a_furnished_room_is_neither():
    rng = np.random.default_rng(6)
    target = target_of(room(), np.zeros((1, 3)), rng)
    cloud = cloud_of_scan(cast(room(), np.array([0.3, 0.2, 0.4]), rng), LASER)
    alignment = align(target.fine, cloud, np.array([[0.35, 0.2, 0.4]]))
    assert ambiguity_of(target.fine, cloud, alignment) < 0.8
    assert np.sqrt(np.linalg.eigvalsh(alignment.covariance(0, 0.01, 0.003)[:2, :2])[1]) < 0.05
    assert alignment.inliers[0] > 0.9


def test_the_prior_holds_what_the_walls_leave_free_and_is_no_part_of_the_covariance():
    rng = np.random.default_rng(7)
    target = target_of(corridor(), np.zeros((1, 3)), rng)
    cloud = cloud_of_scan(cast(corridor(), np.array([0.0, 0.1, 0.0]), rng), LASER)
    prior = Prior(np.array([0.7, 0.0, 0.0]), 0.01, 0.1)
    held = align(target.fine, cloud, np.array([[0.5, 0.0, 0.05]]), prior)
    assert held.poses[0, 0] == pytest.approx(0.7, abs=0.02)
    assert held.poses[0, 1] == pytest.approx(0.1, abs=0.05)
    assert np.sqrt(held.covariance(0, 0.01, 0.003)[0, 0]) > 0.5


def test_several_starts_at_once_give_what_each_gives_alone():
    rng = np.random.default_rng(8)
    target = target_of(room(), np.zeros((1, 3)), rng)
    cloud = cloud_of_scan(cast(room(), np.array([0.3, 0.2, 0.4]), rng), LASER)
    starts = np.array([[0.35, 0.2, 0.4], [0.3, 0.25, 0.35]])
    both = align(target.fine, cloud, starts)
    for k in range(2):
        alone = align(target.fine, cloud, starts[k : k + 1])
        np.testing.assert_allclose(both.poses[k], alone.poses[0], atol=1e-3)


def test_field_knows_the_nearest_point_and_nothing_beyond_its_reach():
    rng = np.random.default_rng(9)
    cloud = cloud_of_scan(cast(room(), np.zeros(3), rng), LASER)
    field = build_field(cloud, 0.05, 0.3, 0.1)
    usable = cloud.points[(cloud.normals**2).sum(axis=1) > 0.5]
    query = usable + rng.uniform(-0.1, 0.1, usable.shape)
    label = field.labels[field.cells(query[:, 0], query[:, 1])]
    found = np.hypot(*(usable[label - 1] - query).T)
    nearest = np.hypot(*(usable[None] - query[:, None]).transpose(2, 0, 1)).min(axis=1)
    assert (label > 0).all()
    assert np.max(found - nearest) < 0.08
    far = field.cells(np.array([0.0, 1e6, -1e6]), np.array([0.0, 1e6, 3.0]))
    assert (field.labels[far] == 0).all()
    np.testing.assert_allclose((field.lines[:2].T[1:] * usable).sum(axis=1), field.lines[2, 1:], atol=1e-12)


def test_scores_of_a_grid_and_of_poses_agree():
    rng = np.random.default_rng(10)
    cloud = cloud_of_scan(cast(room(), np.zeros(3), rng), LASER)
    field = build_field(cloud, 0.1, 0.5, 0.2, 1.0)
    offsets, headings = square(0.4, 0.2), np.array([-0.1, 0.0, 0.1])
    grid = score_starts(field, cloud.points, np.zeros(2), headings, offsets)
    poses = np.column_stack([np.tile(offsets, (3, 1)), np.repeat(headings, len(offsets))])
    np.testing.assert_allclose(grid.ravel(), score_poses(field, cloud.points, poses), atol=1e-2)
    assert np.argmax(grid) == np.ravel_multi_index((1, len(offsets) // 2), grid.shape)


def test_separated_starts_are_apart():
    poses = np.array([[0, 0, 0], [0.1, 0, 0], [2, 0, 0], [0, 0, 1.0]], float)
    starts = separated(poses, np.array([1.0, 0.99, 0.5, 0.7]), 3)
    assert [s.score for s in starts] == [1.0, 0.7, 0.5]


def test_an_empty_scan_is_no_error():
    field = build_field(EMPTY, 0.05, 0.3, 0.1)
    cloud = cloud_of_scan(cast(room(), np.zeros(3)), LASER)
    alignment = align(field, cloud, IDENTITY[None])
    assert alignment.inliers[0] == 0.0
    assert np.isfinite(alignment.covariance(0, 0.01, 0.003)).all()
    assert align(field, EMPTY, IDENTITY[None]).near[0] == 0.0


def test_points_at_the_origin_have_no_partner_in_an_empty_cloud():
    beside = Cloud(np.array([[0.1, 0.1], [0.0, 0.2]]), np.array([[0.0, 1.0], [1.0, 0.0]]))
    field = build_field(EMPTY)
    assert align(field, beside, IDENTITY[None]).near[0] == 0.0
    assert score_poses(field, beside.points, IDENTITY[None])[0] == 0.0
