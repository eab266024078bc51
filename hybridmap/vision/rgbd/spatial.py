"""Rigid transforms in space, (4, 4), and what of them lies in the plane of the floor."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np

from hybridmap.geometry import Array


@dataclass(frozen=True, slots=True)
class FloorPose:
    """A rigid transform between two bases, split into its planar part and what should be nothing.

    Attributes:
        delta: (3,) x, y in m and yaw in rad.
        height_m: dz.
        tilt_rad: angle between the two vertical axes.
    """

    delta: Array
    height_m: float
    tilt_rad: float


def inverse_rigid(T_a_b: Array) -> Array:
    """Return T_b_a (4, 4)."""
    out = np.eye(4)
    out[:3, :3] = T_a_b[:3, :3].T
    out[:3, 3] = -T_a_b[:3, :3].T @ T_a_b[:3, 3]
    return out


def from_planar(pose: Array) -> Array:
    """Lift (x, y, yaw) to (4, 4)."""
    cos, sin = np.cos(pose[2]), np.sin(pose[2])
    out = np.eye(4)
    out[:2, :2] = [[cos, -sin], [sin, cos]]
    out[:2, 3] = pose[:2]
    return out


def to_floor(T_a_b: Array) -> FloorPose:
    """Split a transform (4, 4) between two bases into planar pose, height and tilt."""
    yaw = math.atan2(T_a_b[1, 0] - T_a_b[0, 1], T_a_b[0, 0] + T_a_b[1, 1])
    tilt = math.acos(min(max(float(T_a_b[2, 2]), -1.0), 1.0))
    return FloorPose(np.array([T_a_b[0, 3], T_a_b[1, 3], yaw]), float(T_a_b[2, 3]), tilt)


def rotation_of(rotvec: Array) -> Array:
    """Rotation matrix (3, 3) of a rotation vector (3,), rad (Rodrigues)."""
    x, y, z = rotvec.tolist()
    angle = math.hypot(x, y, z)
    K = np.array([[0.0, -z, y], [z, 0.0, -x], [-y, x, 0.0]])
    if angle < 1e-9:
        return np.asarray(np.eye(3) + K)
    return np.asarray(np.eye(3) + math.sin(angle) / angle * K + (1.0 - math.cos(angle)) / angle**2 * K @ K)


def small_rotvec(R: Array) -> Array:
    """Rotation vector (3,) of a rotation well below half a turn."""
    twice_sin = np.array([R[2, 1] - R[1, 2], R[0, 2] - R[2, 0], R[1, 0] - R[0, 1]])
    sin = 0.5 * float(np.linalg.norm(twice_sin))
    if sin < 1e-9:
        return np.asarray(0.5 * twice_sin)
    angle = np.arctan2(sin, 0.5 * (float(np.trace(R)) - 1.0))
    return np.asarray(0.5 * twice_sin * angle / sin)


def wrenches(arm: Array, direction: Array) -> Array:
    """Directions (3, N) over their moments (numpy's own cross product is several times slower): (6, N).

    So the distance of a point at `arm` (3, N) along its direction changes with a shift and with a turn about the origin.
    """
    out = np.empty((6, arm.shape[1]))
    ax, ay, az = arm
    bx, by, bz = direction
    out[:3] = direction
    out[3] = ay * bz - az * by
    out[4] = az * bx - ax * bz
    out[5] = ax * by - ay * bx
    return out


def apply(T_a_b: Array, points_b: Array) -> Array:
    """Bring points (N, 3) from frame b to frame a."""
    return np.asarray(points_b @ T_a_b[:3, :3].T + T_a_b[:3, 3])
