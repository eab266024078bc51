"""Keypoints seen in two keyframes as pairs of points in space, for joint registration."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from hybridmap.geometry import Array
from hybridmap.graph.agreement import BOUND
from hybridmap.vision.rgbd.features import Correspondences
from hybridmap.vision.rgbd.keyframe import Keyframe
from hybridmap.vision.rgbd.stance import apply, wrenches

KEYPOINT_DEPTH_M = 0.005
"""Noise of a keypoint's depth that does not grow with the distance, m: edges of objects."""


@dataclass(frozen=True, slots=True)
class PointPairs:
    """Keypoints seen in both frames of a registration, each with its position's information (inverse variance).

    Attributes:
        fixed, moving: (K, 3) points in the base of either frame, m.
        ray: (K, 3) unit vectors along the lines of sight, in the fixed base.
        across: (K,) information across the line of sight, m^-2.
        excess: (K,) information along the line of sight less that across, m^-2 (negative: depth is the less certain).
    """

    fixed: Array
    moving: Array
    ray: Array
    across: Array
    excess: Array

    def __len__(self) -> int:
        return len(self.fixed)

    def agreeing(self, T_fixed_moving: Array) -> int:
        """Number of pairs that fit a pose (4, 4) of the moving base in the fixed one: 99 % of right ones do."""
        error = apply(T_fixed_moving, self.moving) - self.fixed
        return int(np.count_nonzero(self._squared(error, np.einsum("ki,ki->k", self.ray, error)) < BOUND))

    def near(self, T_fixed_moving: Array, reach_m: float) -> PointPairs | None:
        """The pairs whose two points are within `reach_m` of each other under a pose (4, 4) of the moving base.

        Returns None if they are fewer than three.
        """
        gap = np.linalg.norm(apply(T_fixed_moving, self.moving) - self.fixed, axis=1)
        keep = np.flatnonzero(gap < reach_m)
        if len(keep) < 3:
            return None
        return PointPairs(self.fixed[keep], self.moving[keep], self.ray[keep], self.across[keep], self.excess[keep])

    def terms(self, T_fixed_moving: Array) -> tuple[Array, Array]:
        """H (6, 6) and b (6,) of the normal equations H xi = b at a pose (4, 4), with Cauchy weights.

        xi is a shift (3) and a small turn (3) in the fixed frame, applied from the left.
        """
        arm = T_fixed_moving[:3, :3] @ self.moving.T
        error = arm + T_fixed_moving[:3, 3:] - self.fixed.T
        along = np.einsum("ki,ik->k", self.ray, error)
        weight = 1.0 / (1.0 + self._squared(error.T, along) / 9.0)
        across, excess = weight * self.across, weight * self.excess
        sight = wrenches(arm, self.ray.T)
        pull = across * error + (excess * along) * self.ray.T
        moment = arm @ pull.T
        turn = moment[[1, 2, 0], [2, 0, 1]] - moment[[2, 0, 1], [1, 2, 0]]
        return _isotropic(arm, across) + (sight * excess) @ sight.T, -np.concatenate([pull.sum(axis=1), turn])

    def _squared(self, error: Array, along: Array) -> Array:
        return np.asarray(self.across * np.einsum("ki,ki->k", error, error) + self.excess * along**2)


def _isotropic(arm: Array, information: Array) -> Array:
    """Sum (6, 6) of information J' J with J = [1, -[arm]x], over arms (3, K) and information (K,)."""
    carried = arm * information
    total = float(information.sum())
    x, y, z = carried.sum(axis=1).tolist()
    (xx, xy, xz), (_, yy, yz), (_, _, zz) = (carried @ arm.T).tolist()
    return np.array(
        [
            [total, 0.0, 0.0, 0.0, z, -y],
            [0.0, total, 0.0, -z, 0.0, x],
            [0.0, 0.0, total, y, -x, 0.0],
            [0.0, -z, y, yy + zz, -xy, -xz],
            [z, 0.0, -x, -xy, xx + zz, -yz],
            [-y, x, 0.0, -xz, -yz, xx + yy],
        ]
    )


def point_pairs(
    fixed: Keyframe,
    moving: Keyframe,
    matches: Correspondences,
    focal_px: float,
    depth_sigma: float,
) -> PointPairs | None:
    """Turn matched keypoints into pairs of points in space. Returns None if they are fewer than three.

    A keypoint is uncertain by one pixel (1 sigma) across the line of sight, and by the noise of depth along it.

    Args:
        fixed, moving: the keyframes.
        matches: `first` are keypoints of the fixed, `second` of the moving keyframe.
        focal_px: focal length at the working width.
        depth_sigma: noise of depth at 1 m, m; it grows with the square of the distance.
    """
    if len(matches.first) < 3:
        return None
    a, b = fixed.features.points[matches.first], moving.features.points[matches.second]
    T_base_camera, z = fixed.surface.stance.T_base_camera, a[:, 2]
    ray = (a / np.linalg.norm(a, axis=1, keepdims=True)) @ T_base_camera[:3, :3].T
    along = 0.5 / (KEYPOINT_DEPTH_M + depth_sigma * z**2) ** 2
    across = 0.5 * (focal_px / z) ** 2
    return PointPairs(apply(T_base_camera, a), apply(moving.surface.stance.T_base_camera, b), ray, across, along - across)
