"""SE(2) on arrays: a pose is `(x_m, y_m, yaw_rad)`, many poses are `(N, 3)` float64.

Every function broadcasts over leading axes. Frames follow REP-103 (x forward, y left, right-handed);
`pose_a_b` is frame b seen from frame a, `delta_i_j` is the pose of j in the frame of i.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike, NDArray

Array = NDArray[np.float64]
_ROUNDED = 1e-3  # a unit quaternion with four decimals has a squared length this far from 1 at most

MAD_TO_SIGMA = 1.4826
"""Standard deviation of a normal distribution over its median absolute deviation."""
IDENTITY: Array = np.zeros(3)
IDENTITY.setflags(write=False)


@dataclass(frozen=True, slots=True)
class RelativePose:
    """A measured relative pose with its uncertainty, or many of them.

    Attributes:
        delta: (..., 3) pose of the target in the frame of the source, m and rad.
        covariance: (..., 3, 3) of the right perturbation `delta * exp(xi)`, i.e. in the target's frame, m^2 and rad^2.
    """

    delta: Array
    covariance: Array


def robust_sigma(errors: Array) -> Array:
    """Standard deviation (...) of errors (N, ...) about zero by their median absolute value; half of them may be outliers."""
    return np.asarray(MAD_TO_SIGMA * np.median(np.abs(errors), axis=0))


def wrap_angle(angle_rad: ArrayLike) -> Array:
    """Wrap angles to [-pi, pi)."""
    angle = np.asarray(angle_rad, dtype=np.float64)
    return np.asarray((angle + np.pi) % (2.0 * np.pi) - np.pi)


def compose(pose_a_b: ArrayLike, pose_b_c: ArrayLike) -> Array:
    """Return `pose_a_c`, yaw wrapped to [-pi, pi); shapes `(..., 3)` broadcast against each other."""
    a, b = np.asarray(pose_a_b, dtype=np.float64), np.asarray(pose_b_c, dtype=np.float64)
    if a.ndim == 1 and b.ndim == 1:
        return _compose_one(a, b)
    cos, sin = np.cos(a[..., 2]), np.sin(a[..., 2])
    x = a[..., 0] + cos * b[..., 0] - sin * b[..., 1]
    y = a[..., 1] + sin * b[..., 0] + cos * b[..., 1]
    return _stacked(x, y, wrap_angle(a[..., 2] + b[..., 2]))


def inverse(pose_a_b: ArrayLike) -> Array:
    """Return `pose_b_a`, yaw wrapped to [-pi, pi); shape `(..., 3)`."""
    a = np.asarray(pose_a_b, dtype=np.float64)
    if a.ndim == 1:
        return _inverse_one(a)
    cos, sin = np.cos(a[..., 2]), np.sin(a[..., 2])
    x = -cos * a[..., 0] - sin * a[..., 1]
    y = sin * a[..., 0] - cos * a[..., 1]
    return _stacked(x, y, wrap_angle(-a[..., 2]))


def _compose_one(a: Array, b: Array) -> Array:
    """`compose` of two single poses, which are most of the calls: ten times as fast without arrays."""
    ax, ay, a_yaw = a.tolist()
    bx, by, b_yaw = b.tolist()
    cos, sin = _cos_sin(a_yaw)
    return np.array([ax + cos * bx - sin * by, ay + sin * bx + cos * by, _wrapped(a_yaw + b_yaw)])


def _inverse_one(a: Array) -> Array:
    x, y, yaw = a.tolist()
    cos, sin = _cos_sin(yaw)
    return np.array([-cos * x - sin * y, sin * x - cos * y, _wrapped(-yaw)])


def _cos_sin(angle_rad: float) -> tuple[float, float]:
    if math.isinf(angle_rad):
        return math.nan, math.nan
    return math.cos(angle_rad), math.sin(angle_rad)


def _wrapped(angle_rad: float) -> float:
    return (angle_rad + math.pi) % (2.0 * math.pi) - math.pi if math.isfinite(angle_rad) else math.nan


def _stacked(x: Array, y: Array, yaw: Array) -> Array:
    out = np.empty((*x.shape, 3))
    out[..., 0], out[..., 1], out[..., 2] = x, y, yaw
    return out


def between(pose_a_i: ArrayLike, pose_a_j: ArrayLike) -> Array:
    """Return `delta_i_j`, the pose of j in the frame of i, yaw wrapped to [-pi, pi); shapes `(..., 3)` broadcast."""
    return compose(inverse(pose_a_i), pose_a_j)


def log(pose: ArrayLike) -> Array:
    """Return the SE(2) logarithm `(..., 3)`: the twist (m, m, rad) whose exponential is `pose`."""
    p = np.asarray(pose, dtype=np.float64)
    yaw = wrap_angle(p[..., 2])
    half = 0.5 * yaw
    small = np.abs(half) < 1e-6
    safe = np.where(small, 1.0, half)
    a = np.where(small, 1.0 - half * half / 3.0, safe / np.tan(safe))
    x = a * p[..., 0] + half * p[..., 1]
    y = -half * p[..., 0] + a * p[..., 1]
    return _stacked(x, y, yaw)


def exp(twist: ArrayLike) -> Array:
    """Return the SE(2) exponential `(..., 3)` of a twist (m, m, rad): a pose, yaw wrapped to [-pi, pi)."""
    t = np.asarray(twist, dtype=np.float64)
    yaw = t[..., 2]
    small = np.abs(yaw) < 1e-6
    safe = np.where(small, 1.0, yaw)
    a = np.where(small, 1.0 - yaw * yaw / 6.0, np.sin(safe) / safe)
    b = np.where(small, 0.5 * yaw, (1.0 - np.cos(safe)) / safe)
    x = a * t[..., 0] - b * t[..., 1]
    y = b * t[..., 0] + a * t[..., 1]
    return _stacked(x, y, wrap_angle(yaw))


def adjoint(pose: ArrayLike) -> Array:
    """Return the adjoint `(..., 3, 3)`: `pose * exp(xi) = exp(adjoint(pose) xi) * pose`."""
    p = np.asarray(pose, dtype=np.float64)
    cos, sin = np.cos(p[..., 2]), np.sin(p[..., 2])
    out = np.zeros((*p.shape[:-1], 3, 3))
    out[..., 0, 0], out[..., 0, 1], out[..., 0, 2] = cos, -sin, p[..., 1]
    out[..., 1, 0], out[..., 1, 1], out[..., 1, 2] = sin, cos, -p[..., 0]
    out[..., 2, 2] = 1.0
    return out


def compose_relative(first: RelativePose, second: RelativePose) -> RelativePose:
    """Chain two independent relative poses, of b seen from a and of c seen from b, to that of c seen from a."""
    carry = adjoint(inverse(second.delta))
    return RelativePose(
        compose(first.delta, second.delta),
        carry @ first.covariance @ np.swapaxes(carry, -1, -2) + second.covariance,
    )


def invert_relative(relative: RelativePose) -> RelativePose:
    """Invert a relative pose: the source seen from the target, with its covariance."""
    carry = adjoint(relative.delta)
    return RelativePose(inverse(relative.delta), carry @ relative.covariance @ np.swapaxes(carry, -1, -2))


def transform_points(pose_a_b: ArrayLike, points_b: ArrayLike) -> Array:
    """Bring points `(N, 2)` from frame b to frame a by one pose `(3,)`."""
    p, q = np.asarray(pose_a_b, dtype=np.float64), np.asarray(points_b, dtype=np.float64)
    cos, sin = np.cos(p[2]), np.sin(p[2])
    return np.asarray(q @ np.array([[cos, sin], [-sin, cos]]) + p[:2])


def interpolate(pose_a_i: ArrayLike, pose_a_j: ArrayLike, fraction: ArrayLike) -> Array:
    """Interpolate between poses (..., 3) along the SE(2) geodesic; `fraction` (...) 0 gives i, 1 gives j; shapes broadcast.

    A fraction below 0 or above 1 extrapolates.
    """
    step = log(between(pose_a_i, pose_a_j))
    return compose(pose_a_i, exp(np.asarray(fraction, dtype=np.float64)[..., None] * step))


def yaw_from_quaternion(x: ArrayLike, y: ArrayLike, z: ArrayLike, w: ArrayLike) -> Array:
    """Heading of a quaternion about the z axis, rad; NaN if it is no rotation. The one conversion that every reader uses.

    A quaternion that is not of length 1, by more than rounding, is normalised first. One of length 0 or infinity is no
    rotation.
    """
    if (
        isinstance(x, float)
        and isinstance(y, float)
        and isinstance(z, float)
        and isinstance(w, float)
        and abs(x * x + y * y + z * z + w * w - 1.0) <= _ROUNDED
    ):  # of a message: a recording has many, and this takes a quarter of the time
        return np.asarray(np.arctan2(2.0 * (w * z + x * y), 1.0 - 2.0 * (y * y + z * z)))
    qx, qy, qz, qw = (np.asarray(q, dtype=np.float64) for q in (x, y, z, w))
    with np.errstate(over="ignore", invalid="ignore", divide="ignore"):
        squared = qx * qx + qy * qy + qz * qz + qw * qw
        usable = (squared > 0.0) & np.isfinite(squared)
        scale = np.where(np.abs(squared - 1.0) <= _ROUNDED, 1.0, np.where(usable, 1.0 / squared, np.nan))
        return np.asarray(np.arctan2(scale * (2.0 * (qw * qz + qx * qy)), 1.0 - scale * (2.0 * (qy * qy + qz * qz))))


def quaternion_from_yaw(yaw_rad: ArrayLike) -> Array:
    """Unit quaternions `(..., 4)` in the order x, y, z, w."""
    half = 0.5 * np.asarray(yaw_rad, dtype=np.float64)
    zero = np.zeros_like(half)
    return np.stack([zero, zero, np.sin(half), np.cos(half)], axis=-1)


def rotation_from_quaternion(quaternion_xyzw: ArrayLike) -> Array:
    """Rotation matrix (3, 3) of a quaternion (4,) in the order x, y, z, w; normalised first."""
    q = np.asarray(quaternion_xyzw, dtype=np.float64)
    x, y, z, w = q / np.linalg.norm(q)
    return np.array(
        [
            [1 - 2 * (y * y + z * z), 2 * (x * y - z * w), 2 * (x * z + y * w)],
            [2 * (x * y + z * w), 1 - 2 * (x * x + z * z), 2 * (y * z - x * w)],
            [2 * (x * z - y * w), 2 * (y * z + x * w), 1 - 2 * (x * x + y * y)],
        ]
    )


def align(poses_a: ArrayLike, poses_b: ArrayLike) -> Array:
    """Best SE(2) transform `pose_a_b` (3,) in the least-squares sense over positions (Horn/Umeyama without scale).

    Args:
        poses_a: (N, 2 or 3) positions in frame a, m; headings are not used.
        poses_b: (N, 2 or 3) the same points, row by row, in frame b.
    """
    a = np.asarray(poses_a, dtype=np.float64)[:, :2]
    b = np.asarray(poses_b, dtype=np.float64)[:, :2]
    mean_a, mean_b = a.mean(axis=0), b.mean(axis=0)
    u, v = b - mean_b, a - mean_a
    yaw = np.arctan2(np.sum(u[:, 0] * v[:, 1] - u[:, 1] * v[:, 0]), np.sum(u * v))
    rotated = transform_points(np.array([0.0, 0.0, yaw]), mean_b[None])[0]
    return np.array([*(mean_a - rotated), yaw])


def apart_m(poses_a: ArrayLike, poses_b: ArrayLike) -> float:
    """RMS distance in m between positions (N, 2 or 3) and the same points (N, 2 or 3), after the best SE(2) alignment."""
    a, b = np.asarray(poses_a, dtype=np.float64)[:, :2], np.asarray(poses_b, dtype=np.float64)[:, :2]
    off = a - transform_points(align(a, b), b)
    return float(np.sqrt(np.mean(np.sum(off**2, axis=1))))


def squared_distance(error: Array, covariance: Array) -> Array:
    """Squared Mahalanobis distance (E,) of errors (E, k) with covariances (E, k, k), all finite.

    Where a covariance is singular, as the numbers of a file may make it, directions that are certain beyond the precision of
    its numbers are left out.
    """
    try:
        solved = np.linalg.solve(covariance, error[..., None])[..., 0]
    except np.linalg.LinAlgError:
        scale = np.sqrt(np.maximum(np.diagonal(covariance, axis1=-2, axis2=-1), np.finfo(np.float64).tiny))
        correlation = np.nan_to_num(covariance / scale[..., :, None] / scale[..., None, :])
        inverse_of = np.linalg.pinv(correlation, hermitian=True)
        solved = np.einsum("...ij,...j->...i", inverse_of, error / scale) / scale
    return np.asarray(np.einsum("...i,...i->...", error, solved))


def loosest_direction(covariance: Array) -> tuple[float, float]:
    """Largest standard deviation (m) of the position of a planar pose, and its direction: an axis in [-pi/2, pi/2) rad from x.

    `covariance` is (3, 3), of x, y and yaw.
    """
    values, vectors = np.linalg.eigh(covariance[:2, :2])
    angle = float(np.arctan2(vectors[1, 1], vectors[0, 1]))
    return float(np.sqrt(max(values[1], 0.0))), (angle + 0.5 * np.pi) % np.pi - 0.5 * np.pi
