"""Point-to-plane registration of two depth grids, optionally with pairs of keypoints, in all six degrees of freedom.

The robot stays on the floor: height and tilt have a tight prior, and only x, y and yaw leave this module. A perturbation is
a shift of the moving robot's origin and a turn about it, both along the axes of the fixed robot.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from hybridmap.config.rgbd import RegistrationConfig
from hybridmap.geometry import Array, RelativePose
from hybridmap.vision.rgbd.depth_grid import Surface
from hybridmap.vision.rgbd.pairing import Pairing, associate
from hybridmap.vision.rgbd.spatial import cross_into, from_planar, rotation_of, to_floor
from hybridmap.vision.rgbd.stance import LevelPair, Stance, level_pair

PLANAR = np.array([0, 1, 5])
OUT_OF_PLANE = np.array([2, 3, 4])
COARSE_POINTS = 400
NEARLY_SETTLED, SETTLED = 4e-3, 2e-4
"""While steps (m, rad) exceed the first, about so many points do; it ends with all of them and a step below the second."""
LEAST_UNIT_VARIANCE = 0.1
"""Residuals are never held for better than this share of the variance that the sensor's model gives."""
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
        relative: planar part of it, with the covariance that the residuals alone give (the prior is taken out), each point
            erring by itself; see `noise_level` for what it really is.
        slack_m: standard deviation in the loosest direction if `correlation` points counted as one: says whether the surfaces
            hold each other, whatever the noise.
        points: matched points.
        inliers: share of the points in common view that fit.
        residual_m: root mean square point-to-plane distance of the inliers.
        overlap: share of the moving points that are in the fixed frame's view.
        height_m, tilt_rad: what is left out of the plane.
    """

    T_fixed_moving: Array
    level: LevelPair
    relative: RelativePose
    slack_m: float
    points: int
    inliers: float
    residual_m: float
    overlap: float
    height_m: float
    tilt_rad: float


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
    stride = max(1, len(moving.points) // COARSE_POINTS)
    settled: Pairing | None = None
    for _ in range(config.iterations):
        pairing = associate(fixed, moving, T, config, stride)
        if len(pairing) * stride < config.min_points:
            return None
        H, b = _normal_equations(pairing, T, pairs)
        H_prior, b_prior = _prior_terms(T, wheels, floor)
        step = np.asarray(np.linalg.solve(H + H_prior, b + b_prior), dtype=np.float64)
        T[:3, 3] += step[:3]
        T[:3, :3] = rotation_of(step[3:]) @ T[:3, :3]
        largest = float(np.abs(step).max())
        if stride == 1 and largest < SETTLED:
            settled = pairing
            break
        if largest < NEARLY_SETTLED:
            stride = 1
    return _summarise(
        fixed, moving, T, associate(fixed, moving, T, config) if settled is None else settled, floor, config, pairs
    )


def _summarise(
    fixed: Surface,
    moving: Surface,
    T: Array,
    pairing: Pairing,
    floor: _FloorPrior,
    config: RegistrationConfig,
    pairs: PointPairs | None,
) -> Registration | None:
    if len(pairing) < config.min_points:
        return None
    H_depth = _information(pairing)
    H_pairs = np.zeros((6, 6)) if pairs is None else _pair_terms(pairs, T)[0]
    flat, level = to_floor(T), level_pair(T, fixed.stance, moving.stance)
    arm = moving.stance.T_base_camera[2, 3] * T[:3, 2]
    covariance = _planar_covariance(H_depth + H_pairs, arm, level.delta[2], floor)
    dulled = _planar_covariance(H_depth / config.correlation + H_pairs, arm, level.delta[2], floor)
    return Registration(
        T,
        level,
        RelativePose(level.delta, covariance),
        float(np.sqrt(np.linalg.eigvalsh(dulled[:2, :2])[-1])),
        len(pairing),
        len(pairing) / max(pairing.in_view, 1),
        float(np.sqrt(np.mean(pairing.residual**2))),
        pairing.in_view / max(pairing.looked_at, 1),
        flat.height_m,
        flat.tilt_rad,
    )


def _information(pairing: Pairing) -> Array:
    """Information (6, 6) of the matched points, each with the variance that the residuals show.

    Normals are noisy, and squared noise passes for information: a bare wall would seem to hold the slide along itself. The
    product of either point's own normal has no such bias, since they err independently; what comes out below nothing is
    nothing.
    """
    unit = max(float(np.mean(pairing.residual**2 / pairing.variance)), LEAST_UNIT_VARIANCE)
    J_fixed, J_moving = _jacobian(pairing.arm, pairing.normal), _jacobian(pairing.arm, pairing.turned)
    weighted = J_fixed / (unit * pairing.variance)[:, None]
    both, biased = weighted.T @ J_moving, weighted.T @ J_fixed
    root = np.linalg.cholesky(biased + 1e-9 * np.trace(biased) * np.eye(6))
    share = np.linalg.solve(root, np.linalg.solve(root, 0.5 * (both + both.T)).T)
    values, vectors = np.linalg.eigh(0.5 * (share + share.T))
    base = root @ vectors
    return np.asarray((base * np.maximum(values, 1e-4)) @ base.T)


def _normal_equations(pairing: Pairing, T: Array, pairs: PointPairs | None) -> tuple[Array, Array]:
    """H (6, 6) and b (6,) of the data, with Cauchy weights."""
    J = _jacobian(pairing.arm, pairing.normal)
    weighted = J / (pairing.variance + pairing.residual**2 / 4.0)[:, None]
    H, b = weighted.T @ J, -weighted.T @ pairing.residual
    if pairs is not None:
        H_pairs, b_pairs = _pair_terms(pairs, T)
        H, b = H + H_pairs, b + b_pairs
    return H, b


def _jacobian(arm: Array, normal: Array) -> Array:
    """(n, 6) change of point-to-plane distances with a shift of the moving base and a turn about it."""
    J = np.empty((len(normal), 6))
    J[:, :3] = normal
    cross_into(J[:, 3:], arm, normal)
    return J


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
