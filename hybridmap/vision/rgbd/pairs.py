"""Keypoints seen in two keyframes as pairs of points in space, for joint registration."""

from __future__ import annotations

import numpy as np

from hybridmap.geometry import Array
from hybridmap.vision.rgbd.depth_registration import PointPairs
from hybridmap.vision.rgbd.features import Correspondences
from hybridmap.vision.rgbd.keyframe import Keyframe
from hybridmap.vision.rgbd.spatial import apply


def point_pairs(
    fixed: Keyframe,
    moving: Keyframe,
    matches: Correspondences,
    focal_px: float,
    depth_sigma: float,
) -> PointPairs | None:
    """Matched keypoints as pairs of points; None where there are fewer than three.

    Each carries the information of one pixel (1 sigma) sideways and of its depth along the ray.

    Args:
        fixed, moving: the keyframes.
        matches: `first` of the fixed, `second` of the moving one.
        focal_px: focal length at the working width.
        depth_sigma: noise of depth at 1 m, m.
    """
    if len(matches.first) < 3:
        return None
    a, b = fixed.features.points[matches.first], moving.features.points[matches.second]
    rotation = fixed.surface.stance.T_base_camera[:3, :3]
    ray = (a / np.linalg.norm(a, axis=1, keepdims=True)) @ rotation.T
    z = a[:, 2]
    along = 1.0 / (2.0 * (0.005 + depth_sigma * z**2) ** 2)
    across = 1.0 / (2.0 * (z / focal_px) ** 2)
    outer = np.einsum("ki,kj->kij", ray, ray)
    information = across[:, None, None] * np.eye(3) + (along - across)[:, None, None] * outer
    return PointPairs(apply(fixed.surface.stance.T_base_camera, a), apply(moving.surface.stance.T_base_camera, b), information)


def near(pairs: PointPairs, T_fixed_moving: Array, reach_m: float) -> PointPairs | None:
    """The pairs that a guess (4, 4) brings within `reach_m` of each other; None where fewer than three."""
    gap = np.linalg.norm(apply(T_fixed_moving, pairs.moving) - pairs.fixed, axis=1)
    keep = gap < reach_m
    if keep.sum() < 3:
        return None
    return PointPairs(pairs.fixed[keep], pairs.moving[keep], pairs.information[keep])
