"""Point-to-line registration of clouds to a likelihood field, several starts at once, with a covariance from the Hessian."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from hybridmap.config.laser import RegistrationConfig
from hybridmap.geometry import Array, between, compose
from hybridmap.vision.laser.cloud import Cloud
from hybridmap.vision.laser.likelihood import LikelihoodField

CONVERGED = 2e-4


@dataclass(frozen=True, slots=True)
class Prior:
    """Where the moving frame is expected in the target's: pose (3,) and information (3,) of x, y, yaw in the moving frame."""

    pose: Array
    information: Array


@dataclass(frozen=True, slots=True)
class Alignment:
    """K registrations.

    Attributes:
        poses: (K, 3) of the moving frame in the target's.
        hessian: (K, 3, 3) of the points alone (no prior), per squared metre of residual, right perturbation.
        near: (K,) share of points that have a partner.
        inliers: (K,) share of points whose residual is small.
        fit: (K,) share of inliers among the points that have a partner.
        rms_m: (K,) of the inliers' residuals.
    """

    poses: Array
    hessian: Array
    near: Array
    inliers: Array
    fit: Array
    rms_m: Array

    def covariance(self, k: int, config: RegistrationConfig, floor_m: float, floor_rad: float) -> Array:
        """Covariance (3, 3) of registration k in the moving frame: loose along a bare corridor, never below the floors."""
        variance = max(config.sigma_m, float(self.rms_m[k])) ** 2 * config.correlation
        weakest = np.diag([1.0, 1.0, 4.0])
        covariance = np.linalg.inv(self.hessian[k] / variance + weakest)
        floor = np.diag([floor_m**2, floor_m**2, floor_rad**2])
        return np.asarray(0.5 * (covariance + covariance.T) + floor)


@dataclass(frozen=True, slots=True)
class _Partners:
    """Residuals (K, P) m, body-frame Jacobians (3, K, P) and whether each point has a partner (K, P)."""

    residual: Array
    jacobian: Array
    has: NDArray[np.bool_]


def align(
    field: LikelihoodField, cloud: Cloud, starts: Array, config: RegistrationConfig, prior: Prior | None = None
) -> Alignment:
    """Register a cloud from K starts: Gauss-Newton on point-to-line residuals with Cauchy weights.

    Args:
        field: the target.
        cloud: P points in the moving frame.
        starts: (K, 3) poses of the moving frame in the target's.
        config: scale, iterations, inlier limit.
        prior: holds the pose where the walls leave it free; it is no part of `hessian`.
    """
    poses = np.array(starts, dtype=np.float64)
    scale = 2.0 * config.cauchy_scale_m
    for iteration in range(config.iterations):
        partners = _partners(field, cloud, poses)
        hessian, gradient = _normal_equations(partners, scale)
        if prior is not None:
            _add_prior(hessian, gradient, poses, prior)
        hessian[:, [0, 1, 2], [0, 1, 2]] += 1e-6
        step = -np.linalg.solve(hessian, gradient[..., None])[..., 0]
        poses = compose(poses, step.clip(-0.3, 0.3))
        if iteration >= 2:
            scale = config.cauchy_scale_m
            if np.abs(step).max() < CONVERGED:
                break
    return _judge(_partners(field, cloud, poses), poses, config)


def _partners(field: LikelihoodField, cloud: Cloud, poses: Array) -> _Partners:
    px, py = cloud.points[:, 0], cloud.points[:, 1]
    mx, my = cloud.normals[:, 0], cloud.normals[:, 1]
    cos, sin = np.cos(poses[:, 2])[:, None], np.sin(poses[:, 2])[:, None]
    x = poses[:, :1] + cos * px - sin * py
    y = poses[:, 1:2] + sin * px + cos * py
    label = field.labels.take(field.cells(x, y))
    target, normal = field.points.take(label, axis=0), field.normals.take(label, axis=0)
    nx, ny = normal[..., 0], normal[..., 1]
    bx, by = cos * nx + sin * ny, cos * ny - sin * nx
    facing = bx * mx + by * my
    has = (label > 0) & (facing > -0.1)
    residual = nx * (x - target[..., 0]) + ny * (y - target[..., 1])
    return _Partners(residual, np.stack([bx, by, by * px - bx * py]), has)


def _normal_equations(partners: _Partners, scale: float) -> tuple[Array, Array]:
    w = partners.has / (1.0 + (partners.residual / scale) ** 2)
    weighted = partners.jacobian * w
    hessian = np.einsum("akp,bkp->kab", weighted, partners.jacobian)
    gradient = np.einsum("akp,kp->ka", weighted, partners.residual)
    return hessian / scale**2, gradient / scale**2


def _add_prior(hessian: Array, gradient: Array, poses: Array, prior: Prior) -> None:
    error = between(prior.pose, poses)
    cos, sin = np.cos(error[:, 2]), np.sin(error[:, 2])
    jacobian = np.zeros_like(hessian)
    jacobian[:, 0, 0], jacobian[:, 0, 1], jacobian[:, 1, 0], jacobian[:, 1, 1] = cos, -sin, sin, cos
    jacobian[:, 2, 2] = 1.0
    weighted = jacobian * prior.information[None, :, None]
    hessian += jacobian.transpose(0, 2, 1) @ weighted
    gradient += np.einsum("kji,kj->ki", weighted, error)


def _judge(partners: _Partners, poses: Array, config: RegistrationConfig) -> Alignment:
    inlier = partners.has & (np.abs(partners.residual) < config.inlier_m)
    count, near = inlier.sum(axis=1), partners.has.sum(axis=1)
    n = max(partners.has.shape[1], 1)
    jacobian = partners.jacobian * inlier
    return Alignment(
        poses=poses,
        hessian=np.einsum("akp,bkp->kab", jacobian, partners.jacobian),
        near=near / n,
        inliers=count / n,
        fit=count / np.maximum(near, 1),
        rms_m=np.sqrt((partners.residual**2 * inlier).sum(axis=1) / np.maximum(count, 1)),
    )
