"""How a camera is held at one keyframe: its pose in a level base, and how sure that is."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np

from hybridmap.geometry import Array
from hybridmap.vision.rgbd.spatial import inverse_rigid, to_floor


@dataclass(frozen=True, slots=True)
class Stance:
    """The camera in the base.

    Attributes:
        T_base_camera: (4, 4), the base being level.
        tilt_sigma_rad, height_sigma_m: standard deviations of roll and pitch, and of the height.
        held: measured at this keyframe (hand-held) and not taken from the mounting.
    """

    T_base_camera: Array
    tilt_sigma_rad: float
    height_sigma_m: float
    held: bool


@dataclass(frozen=True, slots=True)
class LevelPair:
    """Two stances made consistent with the measured pose between the two cameras.

    Attributes:
        delta: (3,) moving base in the fixed one, m and rad.
        T_base_camera_fixed, T_base_camera_moving: (4, 4) the cameras in the levelled bases.
    """

    delta: Array
    T_base_camera_fixed: Array
    T_base_camera_moving: Array


def camera_on(up: Array, height_m: float, T_base_camera_nominal: Array) -> Array:
    """Pose (4, 4) of the camera in a level base: nominal place and heading of the optical axis, given tilt and height.

    A camera that looks straight up or down has no heading of its axis; there the image's right-hand axis takes its place.

    Args:
        up: (3,) the vertical in the optical frame, unit length.
        height_m: of the camera above the floor.
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
    out = np.eye(4)
    out[0, :3] = cos * x - sin * left[0], cos * y - sin * left[1], cos * z - sin * left[2]
    out[1, :3] = sin * x + cos * left[0], sin * y + cos * left[1], sin * z + cos * left[2]
    out[2, :3] = up
    out[:2, 3] = T_base_camera_nominal[:2, 3]
    out[2, 3] = height_m
    return out


def level_pair(T_fixed_moving: Array, fixed: Stance, moving: Stance) -> LevelPair:
    """Split a measured transform between two bases into a planar pose, by one vertical for both cameras.

    The pose between the *cameras* is what was measured; each stance says where up is, and the surer one says it louder.

    Args:
        T_fixed_moving: (4, 4) between the bases as the stances had them.
        fixed, moving: the stances.
    """
    T_cameras = inverse_rigid(fixed.T_base_camera) @ T_fixed_moving @ moving.T_base_camera
    weight_fixed, weight_moving = fixed.tilt_sigma_rad**-2, moving.tilt_sigma_rad**-2
    up = weight_fixed * fixed.T_base_camera[2, :3] + weight_moving * T_cameras[:3, :3] @ moving.T_base_camera[2, :3]
    up /= np.linalg.norm(up)
    T_fixed = camera_on(up, float(fixed.T_base_camera[2, 3]), fixed.T_base_camera)
    trust = fixed.height_sigma_m**-2 / (fixed.height_sigma_m**-2 + moving.height_sigma_m**-2)
    height = trust * (T_fixed @ T_cameras)[2, 3] + (1.0 - trust) * moving.T_base_camera[2, 3]
    T_moving = camera_on(T_cameras[:3, :3].T @ up, float(height), moving.T_base_camera)
    return LevelPair(to_floor(T_fixed @ T_cameras @ inverse_rigid(T_moving)).delta, T_fixed, T_moving)
