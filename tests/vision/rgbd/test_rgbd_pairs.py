"""Pairs of keypoints in the normal equations, against sums over the pairs written out one by one."""

import numpy as np
import pytest

from hybridmap.vision.rgbd.pairs import PointPairs
from hybridmap.vision.rgbd.stance import from_planar, rotation_of

POSE = from_planar(np.array([0.3, -0.2, 0.4]))


@pytest.fixture
def pairs():
    rng = np.random.default_rng(5)
    moving = rng.uniform(-3.0, 3.0, (40, 3))
    fixed = moving @ POSE[:3, :3].T + POSE[:3, 3] + rng.normal(scale=0.02, size=(40, 3))
    ray = rng.normal(size=(40, 3))
    across, along = rng.uniform(1e3, 1e4, 40), rng.uniform(50.0, 500.0, 40)
    return PointPairs(fixed, moving, ray / np.linalg.norm(ray, axis=1, keepdims=True), across, along - across)


def informations(pairs):
    return [a * np.eye(3) + e * np.outer(r, r) for a, e, r in zip(pairs.across, pairs.excess, pairs.ray, strict=True)]


def weighted_cost(pairs, T, weights):
    error = pairs.moving @ T[:3, :3].T + T[:3, 3] - pairs.fixed
    return sum(w * e @ W @ e for w, e, W in zip(weights, error, informations(pairs), strict=True))


def test_terms_are_the_derivatives_of_the_weighted_cost(pairs):
    error = pairs.moving @ POSE[:3, :3].T + POSE[:3, 3] - pairs.fixed
    weights = [1.0 / (1.0 + e @ W @ e / 9.0) for e, W in zip(error, informations(pairs), strict=True)]
    H, b = pairs.terms(POSE)

    def cost(step):
        T = POSE.copy()
        T[:3, 3] += step[:3]
        T[:3, :3] = rotation_of(step[3:]) @ T[:3, :3]
        return 0.5 * weighted_cost(pairs, T, weights)

    steps = 1e-4 * np.eye(6)
    slope = np.array([(cost(s) - cost(-s)) / 2e-4 for s in steps])
    assert b == pytest.approx(-slope, rel=1e-5, abs=1e-3 * np.abs(slope).max())
    arm = pairs.moving @ POSE[:3, :3].T
    expected = np.zeros((6, 6))
    for w, W, (x, y, z) in zip(weights, informations(pairs), arm, strict=True):
        J = np.hstack([np.eye(3), -np.array([[0.0, -z, y], [z, 0.0, -x], [-y, x, 0.0]])])
        expected += w * J.T @ W @ J
    assert pytest.approx(expected, rel=1e-9, abs=1e-6) == H


def test_those_that_a_pose_brings_together_are_counted_and_kept(pairs):
    assert pairs.agreeing(POSE) > 30
    away = from_planar(np.array([2.3, -0.2, 0.4]))
    assert pairs.agreeing(away) == 0
    assert len(pairs.near(POSE, 0.2)) == len(pairs)
    assert pairs.near(away, 0.2) is None
