"""The camera's pose in a level base at one keyframe, and rigid transforms in space."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np

from hybridmap.geometry import Array

_IDENTITY = np.eye(4)


@dataclass(frozen=True, slots=True)
class Stance:
    """Pose of the camera on the robot at one keyframe.

    Attributes:
        T_base_camera: (4, 4) the camera in the robot's base, the base being level.
        tilt_sigma_rad, height_sigma_m: standard deviations of roll and pitch (each), and of the height.
        held: whether tilt and height were estimated at this keyframe (hand-held camera) and not taken from the mounting.
    """

    T_base_camera: Array
    tilt_sigma_rad: float
    height_sigma_m: float
    held: bool


@dataclass(frozen=True, slots=True)
class LevelPair:
    """The pose between two bases after both are levelled by one vertical.

    Attributes:
        delta: (3,) moving base in the fixed one, m and rad.
        T_base_camera_moving: (4, 4) the moving camera in its levelled base.
    """

    delta: Array
    T_base_camera_moving: Array


def camera_on(up: Array, height_m: float, T_base_camera_nominal: Array) -> Array:
    """Pose (4, 4) of a camera in a level base, given its tilt and height; position and heading are the nominal ones.

    The heading is that of the optical axis; of the image's x axis for a camera that looks straight up or down.

    Args:
        up: (3,) the vertical in the optical frame, unit length.
        height_m: height of the camera above the floor.
        T_base_camera_nominal: (4, 4) mounting, or the pose at another keyframe.
    """
    nominal = T_base_camera_nominal[:3, :3]
    axis = 2 if abs(nominal[2, 2]) < 0.9 else 0
    forward = -up[axis] * up
    forward[axis] += 1.0
    x, y, z = (forward / math.sqrt(forward @ forward)).tolist()
    ux, uy, uz = up.tolist()
    heading = math.atan2(nominal[1, axis], nominal[0, axis])
    cos, sin = math.cos(heading), math.sin(heading)
    left = (uy * z - uz * y, uz * x - ux * z, ux * y - uy * x)
    out = _IDENTITY.copy()
    out[0, :3] = cos * x - sin * left[0], cos * y - sin * left[1], cos * z - sin * left[2]
    out[1, :3] = sin * x + cos * left[0], sin * y + cos * left[1], sin * z + cos * left[2]
    out[2, :3] = up
    out[:2, 3] = T_base_camera_nominal[:2, 3]
    out[2, 3] = height_m
    return out


def level_pair(T_fixed_moving: Array, fixed: Stance, moving: Stance) -> LevelPair:
    """Level a measured transform between two bases, so that it becomes a planar pose with one vertical for both cameras.

    The measured pose between the cameras is kept. The vertical is the mean of the stances', weighted by inverse variances.

    Args:
        T_fixed_moving: (4, 4) moving base in the fixed one, the bases as their stances have them.
        fixed, moving: the cameras' poses in either base, with their uncertainty.
    """
    T_cameras = inverse_rigid(fixed.T_base_camera) @ T_fixed_moving @ moving.T_base_camera
    weight_fixed, weight_moving = fixed.tilt_sigma_rad**-2, moving.tilt_sigma_rad**-2
    up = weight_fixed * fixed.T_base_camera[2, :3] + weight_moving * T_cameras[:3, :3] @ moving.T_base_camera[2, :3]
    up /= np.linalg.norm(up)
    T_fixed = camera_on(up, float(fixed.T_base_camera[2, 3]), fixed.T_base_camera)
    trust = fixed.height_sigma_m**-2 / (fixed.height_sigma_m**-2 + moving.height_sigma_m**-2)
    height = trust * (T_fixed @ T_cameras)[2, 3] + (1.0 - trust) * moving.T_base_camera[2, 3]
    T_moving = camera_on(T_cameras[:3, :3].T @ up, float(height), moving.T_base_camera)
    return LevelPair(to_floor(T_fixed @ T_cameras @ inverse_rigid(T_moving)).delta, T_moving)


@dataclass(frozen=True, slots=True)
class FloorPose:
    """A transform between two bases, split into its planar part, and height and tilt, which should be 0.

    Attributes:
        delta: (3,) x, y in m and yaw in rad.
        height_m: difference of the heights.
        tilt_rad: angle between the two vertical axes.
    """

    delta: Array
    height_m: float
    tilt_rad: float


def inverse_rigid(T_a_b: Array) -> Array:
    """Return T_b_a (4, 4), the inverse of a rigid transform."""
    out = _IDENTITY.copy()
    out[:3, :3] = T_a_b[:3, :3].T
    out[:3, 3] = -T_a_b[:3, :3].T @ T_a_b[:3, 3]
    return out


def from_planar(pose: Array) -> Array:
    """Lift a planar pose (3,), m and rad, to (4, 4)."""
    cos, sin = np.cos(pose[2]), np.sin(pose[2])
    out = _IDENTITY.copy()
    out[:2, :2] = [[cos, -sin], [sin, cos]]
    out[:2, 3] = pose[:2]
    return out


def to_floor(T_a_b: Array) -> FloorPose:
    """Split the pose (4, 4) of base b in base a into planar pose, height and tilt."""
    yaw = math.atan2(T_a_b[1, 0] - T_a_b[0, 1], T_a_b[0, 0] + T_a_b[1, 1])
    tilt = math.acos(min(max(float(T_a_b[2, 2]), -1.0), 1.0))
    return FloorPose(np.array([T_a_b[0, 3], T_a_b[1, 3], yaw]), float(T_a_b[2, 3]), tilt)


def rotation_of(rotvec: Array) -> Array:
    """Rotation matrix (3, 3) of a rotation vector (3,), rad (Rodrigues)."""
    x, y, z = rotvec.tolist()
    angle = math.hypot(x, y, z)
    K = np.array([[0.0, -z, y], [z, 0.0, -x], [-y, x, 0.0]])
    if angle < 1e-9:
        return np.asarray(_IDENTITY[:3, :3] + K)
    return np.asarray(_IDENTITY[:3, :3] + math.sin(angle) / angle * K + (1.0 - math.cos(angle)) / angle**2 * K @ K)


def wrenches(arm: Array, direction: Array) -> Array:
    """Stack directions (3, N) and their moments about the origin, (6, N).

    Each column is the derivative of the displacement of a point at `arm` (3, N) along its direction, by a shift (3) and a small
    turn (3).
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
