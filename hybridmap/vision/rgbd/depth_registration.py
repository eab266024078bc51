"""Point-to-plane registration of two depth grids, optionally with pairs of keypoints, in all six degrees of freedom.

The robot stays on the floor: height and tilt have a tight prior, and only x, y and yaw leave this module. A perturbation is
a shift of the moving robot's origin and a turn about it, both along the axes of the fixed robot.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from hybridmap.config.rgbd import RegistrationConfig
from hybridmap.geometry import Array, RelativePose
from hybridmap.vision.rgbd.depth_grid import Surface
from hybridmap.vision.rgbd.spatial import apply, cross, from_planar, rotation_of, to_floor
from hybridmap.vision.rgbd.stance import LevelPair, Stance, level_pair

PLANAR = np.array([0, 1, 5])
OUT_OF_PLANE = np.array([2, 3, 4])
LOOSE = 1.0 / np.array([0.3, 0.3, np.deg2rad(10.0)]) ** 2
"""Information (m^-2, m^-2, rad^-2) that every edge keeps, so that a corridor's long axis stays loose and not infinite."""


@dataclass(frozen=True, slots=True)
class _FloorPrior:
    """How firmly both robots stand on the same floor: information of dz (m^-2) and of roll and pitch (rad^-2)."""

    information: Array

    @classmethod
    def of(cls, fixed: Stance, moving: Stance) -> _FloorPrior:
        height = fixed.height_sigma_m**2 + moving.height_sigma_m**2
        tilt = fixed.tilt_sigma_rad**2 + moving.tilt_sigma_rad**2
        return cls(1.0 / np.array([height, tilt, tilt]))


@dataclass(frozen=True, slots=True)
class _PlanarPrior:
    """Wheel odometry as prior: pose (3,) and information (3, 3) along the axes of the fixed robot."""

    delta: Array
    information: Array

    @classmethod
    def of(cls, odometry: RelativePose) -> _PlanarPrior:
        axes = from_planar(odometry.delta)[:3, :3]
        return cls(odometry.delta, np.asarray(axes @ np.linalg.inv(odometry.covariance) @ axes.T))


@dataclass(frozen=True, slots=True)
class PointPairs:
    """Keypoints seen in both frames.

    Attributes:
        fixed, moving: (K, 3) points in the base of either frame, m.
        information: (K, 3, 3) of their difference, in the fixed base.
    """

    fixed: Array
    moving: Array
    information: Array


@dataclass(frozen=True, slots=True)
class Registration:
    """Outcome of a registration.

    Attributes:
        T_fixed_moving: (4, 4) between the bases as their stances had them.
        level: the same between levelled bases.
        relative: planar part of it, with the covariance that the data alone give (the prior is taken out).
        points: matched points.
        inliers: share of the points in common view that fit.
        residual_m: root mean square point-to-plane distance of the inliers.
        overlap: share of the moving points that are in the fixed frame's view.
        height_m, tilt_rad: what is left out of the plane.
    """

    T_fixed_moving: Array
    level: LevelPair
    relative: RelativePose
    points: int
    inliers: float
    residual_m: float
    overlap: float
    height_m: float
    tilt_rad: float


@dataclass(frozen=True, slots=True)
class _Pairing:
    """Matched points at one iterate: indices of the fixed and moving points, residuals (m), and how many were in view."""

    fixed: NDArray[np.int64]
    moving: NDArray[np.int64]
    arm: Array
    residual: Array
    in_view: int


def register(
    fixed: Surface,
    moving: Surface,
    start: Array,
    prior: RelativePose | None,
    config: RegistrationConfig,
    pairs: PointPairs | None = None,
) -> Registration | None:
    """Register the moving robot to the fixed one.

    Args:
        fixed, moving: surfaces in their own bases.
        start: (4, 4) first guess of the moving base in the fixed one.
        prior: planar prior (wheel odometry) of the solve; taken out of the result's covariance.
        config: settings.
        pairs: keypoints that join the solve.

    Returns:
        None where too few points match.
    """
    T = start.copy()
    floor = _FloorPrior.of(fixed.stance, moving.stance)
    wheels = None if prior is None else _PlanarPrior.of(prior)
    for _ in range(config.iterations):
        pairing = _pair(fixed, moving, T, config)
        if len(pairing.residual) < config.min_points:
            return None
        H, b = _normal_equations(fixed, moving, pairing, T, pairs)
        H_prior, b_prior = _prior_terms(T, wheels, floor)
        step = np.asarray(np.linalg.solve(H + H_prior, b + b_prior), dtype=np.float64)
        T[:3, 3] += step[:3]
        T[:3, :3] = rotation_of(step[3:]) @ T[:3, :3]
        if np.abs(step).max() < 1e-4:
            break
    return _summarise(fixed, moving, T, floor, config, pairs)


def _summarise(
    fixed: Surface, moving: Surface, T: Array, floor: _FloorPrior, config: RegistrationConfig, pairs: PointPairs | None
) -> Registration | None:
    pairing = _pair(fixed, moving, T, config)
    if len(pairing.residual) < config.min_points:
        return None
    variance = fixed.sigma_m[pairing.fixed] ** 2 + moving.sigma_m[pairing.moving] ** 2
    unit = max(float(np.mean(pairing.residual**2 / variance)), 0.1)
    H, _ = _normal_equations(fixed, moving, pairing, T, None, scale=unit * config.correlation)
    if pairs is not None:
        H_pairs, _ = _pair_terms(pairs, T)
        H = H + H_pairs
    flat, level = to_floor(T), level_pair(T, fixed.stance, moving.stance)
    arm = moving.stance.T_base_camera[2, 3] * T[:3, 2]
    return Registration(
        T,
        level,
        RelativePose(level.delta, _planar_covariance(H, arm, level.delta[2], floor)),
        len(pairing.residual),
        len(pairing.residual) / max(pairing.in_view, 1),
        float(np.sqrt(np.mean(pairing.residual**2))),
        pairing.in_view / max(len(moving.points), 1),
        flat.height_m,
        flat.tilt_rad,
    )


def _pair(fixed: Surface, moving: Surface, T: Array, config: RegistrationConfig) -> _Pairing:
    """Projective association: where a moving point falls into the fixed grid, the point there is its partner."""
    arm = moving.points @ T[:3, :3].T
    there = arm + T[:3, 3]
    seen = apply(fixed.T_camera_base, there)
    camera = fixed.grid.camera
    z = np.maximum(seen[:, 2], 1e-6)
    column = np.rint(camera.fx_px * seen[:, 0] / z + camera.cx_px).astype(np.int64)
    row = np.rint(camera.fy_px * seen[:, 1] / z + camera.cy_px).astype(np.int64)
    inside = (seen[:, 2] > 0.1) & (column >= 0) & (column < camera.width_px) & (row >= 0) & (row < camera.height_px)
    number = np.full(len(there), -1, dtype=np.int64)
    number[inside] = fixed.number[row[inside], column[inside]]
    m = np.flatnonzero(number >= 0)
    f = number[m]
    offset = there[m] - fixed.points[f]
    residual = np.einsum("ij,ij->i", fixed.normals[f], offset)
    reach = config.max_distance_m + 3.0 * (fixed.sigma_m[f] + moving.sigma_m[m])
    turned = moving.normals[m] @ T[:3, :3].T
    alike = np.einsum("ij,ij->i", turned, fixed.normals[f]) > np.cos(np.deg2rad(config.max_normal_deg))
    keep = (np.abs(residual) < reach) & alike & (np.einsum("ij,ij->i", offset, offset) < (2.0 * reach) ** 2)
    return _Pairing(f[keep], m[keep], arm[m[keep]], residual[keep], len(m))


def _normal_equations(
    fixed: Surface, moving: Surface, pairing: _Pairing, T: Array, pairs: PointPairs | None, scale: float | None = None
) -> tuple[Array, Array]:
    """H (6, 6) and b (6,) of the data; with `scale` weights are not robust and information is divided by it."""
    normal = fixed.normals[pairing.fixed]
    J = np.concatenate([normal, cross(pairing.arm, normal)], axis=1)
    variance = fixed.sigma_m[pairing.fixed] ** 2 + moving.sigma_m[pairing.moving] ** 2
    dulled = variance + pairing.residual**2 / 4.0 if scale is None else variance * scale
    weight = 1.0 / dulled
    weighted = J * weight[:, None]
    H, b = weighted.T @ J, -weighted.T @ pairing.residual
    if pairs is not None:
        H_pairs, b_pairs = _pair_terms(pairs, T)
        H, b = H + H_pairs, b + b_pairs
    return H, b


def _pair_terms(pairs: PointPairs, T: Array) -> tuple[Array, Array]:
    """Point-to-point terms of the keypoints, with Cauchy weights."""
    arm = pairs.moving @ T[:3, :3].T
    error = arm + T[:3, 3] - pairs.fixed
    J = np.zeros((len(arm), 3, 6))
    J[:, :, :3] = np.eye(3)
    J[:, 0, 4], J[:, 0, 5] = arm[:, 2], -arm[:, 1]
    J[:, 1, 3], J[:, 1, 5] = -arm[:, 2], arm[:, 0]
    J[:, 2, 3], J[:, 2, 4] = arm[:, 1], -arm[:, 0]
    squared = np.einsum("ki,kij,kj->k", error, pairs.information, error)
    W = pairs.information / (1.0 + squared / 9.0)[:, None, None]
    WJ = W @ J
    return np.einsum("kij,kil->jl", J, WJ), -np.einsum("kij,ki->j", WJ, error)


def _prior_terms(T: Array, prior: _PlanarPrior | None, floor: _FloorPrior) -> tuple[Array, Array]:
    flat = to_floor(T)
    tilt_x, tilt_y = -T[1, 2], T[0, 2]
    H, b = np.zeros((6, 6)), np.zeros(6)
    H[OUT_OF_PLANE, OUT_OF_PLANE] = floor.information
    b[OUT_OF_PLANE] = -floor.information * np.array([flat.height_m, tilt_x, tilt_y])
    if prior is not None:
        error = flat.delta - prior.delta
        error[2] = (error[2] + np.pi) % (2.0 * np.pi) - np.pi
        H[np.ix_(PLANAR, PLANAR)] += prior.information
        b[PLANAR] -= prior.information @ error
    return H, b


def _planar_covariance(H: Array, arm: Array, yaw: float, floor: _FloorPrior) -> Array:
    """Covariance of x, y, yaw in the moving frame: height and tilt are marginalised under their prior.

    The point whose position counts is the one at the camera's height (`arm` above the origin): bases are levelled
    afterwards, and a tilt turns about the camera.
    """
    about = np.eye(6)
    about[:3, 3:] = [[0.0, -arm[2], arm[1]], [arm[2], 0.0, -arm[0]], [-arm[1], arm[0], 0.0]]
    full = about.T @ H @ about
    full[OUT_OF_PLANE, OUT_OF_PLANE] += floor.information
    full[PLANAR, PLANAR] += LOOSE
    covariance = np.linalg.inv(full)[np.ix_(PLANAR, PLANAR)]
    cos, sin = np.cos(yaw), np.sin(yaw)
    axes = np.array([[cos, sin, 0.0], [-sin, cos, 0.0], [0.0, 0.0, 1.0]])
    turned = axes @ covariance @ axes.T
    return np.asarray(0.5 * (turned + turned.T))


def with_floor(relative: RelativePose, translation_m: float, rotation_deg: float) -> RelativePose:
    """The same measurement with a floor under its standard deviations: real edges err more than their Hessian says."""
    floor = np.diag([translation_m**2, translation_m**2, np.deg2rad(rotation_deg) ** 2])
    return RelativePose(relative.delta, relative.covariance + floor)
