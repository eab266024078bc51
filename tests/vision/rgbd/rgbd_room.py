"""A textured rectangular room with a cupboard, rendered by ray casting in numpy."""

from __future__ import annotations

import numpy as np

from hybridmap.streams.rgbd import Camera, RgbdFrame
from hybridmap.vision.rgbd.stance import from_planar

LOW, HIGH = np.array([-3.0, -2.0, 0.0]), np.array([3.0, 2.0, 2.4])
CUPBOARD = np.array([1.0, 0.6, 0.0]), np.array([1.9, 1.5, 1.2])
LEVEL_AXES = np.array([[0.0, 0.0, 1.0], [-1.0, 0.0, 0.0], [0.0, -1.0, 0.0]])


def camera(height_m=0.6, pitch_deg=0.0, roll_deg=0.0, width=160):
    T = np.eye(4)
    pitch, roll = np.deg2rad(-pitch_deg), np.deg2rad(roll_deg)
    nod = np.array([[1, 0, 0], [0, np.cos(pitch), np.sin(pitch)], [0, -np.sin(pitch), np.cos(pitch)]])
    lean = np.array([[np.cos(roll), -np.sin(roll), 0], [np.sin(roll), np.cos(roll), 0], [0, 0, 1]])
    T[:3, :3] = LEVEL_AXES @ nod @ lean
    T[:3, 3] = [0.1, 0.0, height_m]
    f = 0.82 * width
    height = width * 3 // 4
    return Camera(width, height, f, f, (width - 1) / 2, (height - 1) / 2, T)


def textures(seed=0):
    return np.random.default_rng(seed).integers(30, 226, (7, 64, 64))


def render(view, pose, table=None, stamp_ns=0, noise=0.0, rng=None):
    """Render the frame of a camera on a robot at `pose` (3,)."""
    table = textures() if table is None else table
    v, u = np.mgrid[0 : view.height_px, 0 : view.width_px]
    rays = np.stack([(u - view.cx_px) / view.fx_px, (v - view.cy_px) / view.fy_px, np.ones_like(u, float)], axis=-1)
    T = from_planar(np.asarray(pose, dtype=float)) @ view.T_base_camera
    direction, origin = rays @ T[:3, :3].T, T[:3, 3]
    with np.errstate(divide="ignore", invalid="ignore"):
        wall = np.where(direction > 0, (HIGH - origin) / direction, (LOW - origin) / direction)
        near, far = (CUPBOARD[0] - origin) / direction, (CUPBOARD[1] - origin) / direction
    axis = np.argmin(wall, axis=-1)
    depth = wall.min(axis=-1)
    entry, leave = np.minimum(near, far), np.maximum(near, far).min(axis=-1)
    front = entry.max(axis=-1)
    hit = (front < leave) & (front > 0)
    depth = np.where(hit, front, depth)
    face = np.where(hit, 6, 2 * axis + (np.take_along_axis(direction, axis[..., None], -1)[..., 0] > 0))
    axis = np.where(hit, np.argmax(entry, axis=-1), axis)
    point = origin + direction * depth[..., None]
    across = np.stack([np.where(axis == 0, point[..., 1], point[..., 0]), np.where(axis == 2, point[..., 1], point[..., 2])])
    fine = table[face, *(np.floor(across * 7.0).astype(int) % 64)]
    coarse = table[face, *(np.floor(across * 2.3 + 17).astype(int) % 64)]
    grey = (0.6 * fine + 0.4 * coarse).astype(np.uint8)
    if noise and rng is not None:
        depth = depth + noise * depth**2 * rng.normal(size=depth.shape)
    return RgbdFrame(stamp_ns, np.repeat(grey[..., None], 3, axis=-1), depth.astype(np.float32))
