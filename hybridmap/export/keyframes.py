"""What the keyframes of a session saw, as points in the robot's frame."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from hybridmap.geometry import Array, transform_points
from hybridmap.streams.base import Camera, Laser

_JUMP = 0.04
"""A depth pixel further than this share of its depth from the median of its neighbours belongs to no surface."""


@dataclass(frozen=True, slots=True)
class Points:
    """Points of one keyframe.

    Attributes:
        xyz: (P, 3) in `base_link`, m.
        rgb: (P, 3) in 0..1, None without colour.
    """

    xyz: Array
    rgb: Array | None


def depth_points(keyframe: Mapping[str, NDArray[Any]], camera: Camera, max_depth_m: float) -> Points:
    """Back-project the depth image of a keyframe; pixels that hang in the air between two surfaces are left out.

    Args:
        keyframe: with `depth_mm` (H, W) uint16, perhaps `color` (H, W, 3) uint8 and its own `T_base_camera` (4, 4).
        camera: of the whole picture; a smaller keyframe is taken as the same picture scaled.
        max_depth_m: depth beyond this is left out.
    """
    import cv2

    depth_mm = keyframe["depth_mm"]
    depth_m = depth_mm.astype(np.float64) / 1000.0
    smooth_m = cv2.medianBlur(depth_mm, 3).astype(np.float64) / 1000.0
    valid = (depth_m > 0) & (depth_m <= max_depth_m) & (np.abs(depth_m - smooth_m) <= _JUMP * depth_m)
    v, u = np.nonzero(valid)
    z = depth_m[valid]
    scale = depth_mm.shape[1] / camera.width_px
    x = ((u + 0.5) / scale - 0.5 - camera.cx_px) / camera.fx_px * z
    y = ((v + 0.5) / scale - 0.5 - camera.cy_px) / camera.fy_px * z
    T_base_camera = mounting(keyframe, camera)
    xyz = np.stack([x, y, z], axis=1) @ T_base_camera[:3, :3].T + T_base_camera[:3, 3]
    color = keyframe.get("color")
    same_size = color is not None and color.shape[:2] == depth_mm.shape
    return Points(xyz, color[valid] / 255.0 if color is not None and same_size else None)


def mounting(keyframe: Mapping[str, NDArray[Any]], camera: Camera) -> Array:
    """(4, 4) pose of the camera in `base_link` at a keyframe: its own where it has one (a carried camera tilts)."""
    return np.asarray(keyframe.get("T_base_camera", camera.T_base_camera), dtype=np.float64)


def laser_points(keyframe: Mapping[str, NDArray[Any]], laser: Laser) -> tuple[Array, NDArray[np.bool_]]:
    """End points (B, 2) of a scan's beams in `base_link`, m, and (B,) which of them are returns."""
    ranges = keyframe["ranges_m"].astype(np.float64)
    valid = np.isfinite(ranges) & (ranges >= laser.range_min_m) & (ranges <= laser.range_max_m)
    reach = np.where(valid, ranges, 0.0)
    ends = np.stack([reach * np.cos(laser.bearings_rad), reach * np.sin(laser.bearings_rad)], axis=1)
    return transform_points(laser.pose_base_laser, ends), valid
