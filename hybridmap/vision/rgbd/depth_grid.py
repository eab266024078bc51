"""A depth image boiled down to a coarse grid of points with normals, and that grid placed in the robot's frame."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from hybridmap.geometry import Array
from hybridmap.streams.base import Camera
from hybridmap.vision.rgbd.spatial import apply, inverse_rigid

MAX_JUMP = 0.05
"""Neighbours whose depths differ by more than this share of the depth are not one surface."""


def reduced(camera: Camera, factor: int) -> Camera:
    """The same camera with pixels `factor` times as large."""
    return replace(
        camera,
        width_px=camera.width_px // factor,
        height_px=camera.height_px // factor,
        fx_px=camera.fx_px / factor,
        fy_px=camera.fy_px / factor,
        cx_px=(camera.cx_px + 0.5) / factor - 0.5,
        cy_px=(camera.cy_px + 0.5) / factor - 0.5,
    )


@dataclass(frozen=True, slots=True)
class DepthGrid:
    """Points and normals in the camera's optical frame.

    Attributes:
        camera: pinhole of the grid: one pixel a cell.
        points: (R, C, 3) float64, m; where not `valid`, meaningless but finite.
        normals: (R, C, 3) float64, unit, towards the camera.
        valid: (R, C) a point with a normal.
        sigma_m: (R, C) standard deviation along the normal.
    """

    camera: Camera
    points: Array
    normals: Array
    valid: NDArray[np.bool_]
    sigma_m: Array


@dataclass(frozen=True, slots=True)
class Surface:
    """A depth grid in the robot's frame.

    Attributes:
        grid: where it comes from.
        T_base_camera: (4, 4) pose of the camera as it was at that keyframe.
        T_camera_base: its inverse.
        points, normals: (N, 3) valid points in `base_link`, m.
        sigma_m: (N,) their noise.
        number: (R, C) int32, index of a cell's point; -1 for none.
    """

    grid: DepthGrid
    T_base_camera: Array
    T_camera_base: Array
    points: Array
    normals: Array
    sigma_m: Array
    number: NDArray[np.int32]


def make_grid(depth_m: NDArray[np.float32], camera: Camera, cell_px: int, depth_sigma: float) -> DepthGrid:
    """Average depth over cells and take normals from neighbouring cells.

    Args:
        depth_m: (H, W) float32, m along the optical axis; 0 where invalid.
        camera: its pinhole.
        cell_px: side of a cell.
        depth_sigma: noise of one pixel at 1 m, m; it grows with the square of the distance.
    """
    coarse = reduced(camera, cell_px)
    depth, known = _cell_depth(depth_m, coarse.height_px, coarse.width_px, cell_px)
    u = (np.arange(coarse.width_px) - coarse.cx_px) / coarse.fx_px
    v = (np.arange(coarse.height_px) - coarse.cy_px) / coarse.fy_px
    rays = np.stack(np.broadcast_arrays(u[None, :], v[:, None], 1.0), axis=-1)
    points = rays * depth[..., None]
    normals, flat = _normals(points, depth, known)
    sigma = 0.001 + 0.5 * depth_sigma * depth**2
    return DepthGrid(coarse, points, normals, flat, sigma)


def place(grid: DepthGrid, T_base_camera: Array) -> Surface:
    """Put a grid into the robot's frame, with the camera as it was at that keyframe."""
    valid = grid.valid
    number = np.full(valid.shape, -1, dtype=np.int32)
    number[valid] = np.arange(int(valid.sum()), dtype=np.int32)
    return Surface(
        grid,
        T_base_camera,
        inverse_rigid(T_base_camera),
        apply(T_base_camera, grid.points[valid]),
        grid.normals[valid] @ T_base_camera[:3, :3].T,
        grid.sigma_m[valid],
        number,
    )


def _cell_depth(depth_m: NDArray[np.float32], rows: int, columns: int, cell_px: int) -> tuple[Array, NDArray[np.bool_]]:
    """Mean of the valid depths of each cell; known where most pixels are valid and lie on one surface."""
    import cv2

    cut = np.ascontiguousarray(depth_m[: rows * cell_px, : columns * cell_px])
    stack = cv2.merge([cut, cut * cut, (cut > 0).astype(np.float32)])
    mean, square, share = np.moveaxis(
        cv2.resize(stack, (columns, rows), interpolation=cv2.INTER_AREA).astype(np.float64), -1, 0
    )
    safe = np.maximum(share, 1e-6)
    depth = mean / safe
    spread = np.sqrt(np.maximum(square / safe - depth**2, 0.0))
    known = (share > 0.6) & (spread < 0.5 * MAX_JUMP * depth)
    return np.where(known, depth, 1.0), known


def _normals(points: Array, depth: Array, known: NDArray[np.bool_]) -> tuple[Array, NDArray[np.bool_]]:
    across = np.zeros_like(points)
    down = np.zeros_like(points)
    across[:, 1:-1] = points[:, 2:] - points[:, :-2]
    down[1:-1] = points[2:] - points[:-2]
    normal = np.cross(down, across)
    length = np.linalg.norm(normal, axis=-1)
    normal /= np.maximum(length, 1e-12)[..., None]
    towards = -np.sign(np.einsum("rcx,rcx->rc", normal, points))
    jump = MAX_JUMP * 2.0 * depth
    ok = known & (length > 1e-12)
    ok[[0, -1]] = False
    ok[:, [0, -1]] = False
    for axis in (0, 1):
        for step in (-1, 1):
            ok &= np.roll(known, step, axis) & (np.abs(np.roll(depth, step, axis) - depth) < jump)
    return normal * np.where(towards == 0, 1.0, towards)[..., None], ok
