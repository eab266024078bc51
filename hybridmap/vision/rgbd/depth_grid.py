"""A depth image boiled down to a coarse grid of points with normals, and that grid placed in the robot's frame."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from hybridmap.geometry import Array
from hybridmap.streams.base import Camera
from hybridmap.vision.rgbd.spatial import apply, inverse_rigid
from hybridmap.vision.rgbd.stance import Stance

MAX_JUMP = 0.05
MAX_BEND = 0.015
MIN_SHARE = 0.6
"""Neighbouring cells are one surface where inverse depth differs by less than a share, or bends by less than a share of itself;
a cell is known where this share of its pixels is."""


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
        stance: how the camera was held at that keyframe.
        T_camera_base: (4, 4) inverse of its pose.
        points, normals: (N, 3) valid points in `base_link`, m.
        sigma_m: (N,) their noise.
        number: (R, C) int32, index of a cell's point; -1 for none.
    """

    grid: DepthGrid
    stance: Stance
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
    cells = _average(depth_m, coarse.height_px, coarse.width_px, cell_px)
    depth = 1.0 / cells.inverse
    u = (np.arange(coarse.width_px) - coarse.cx_px) / coarse.fx_px
    v = (np.arange(coarse.height_px) - coarse.cy_px) / coarse.fy_px
    rays = np.stack(np.broadcast_arrays(u[None, :], v[:, None], 1.0), axis=-1)
    points = rays * depth[..., None]
    sigma = 0.001 + 0.5 * depth_sigma * depth**2
    return DepthGrid(coarse, points, _normals(points), _on_one_surface(cells), sigma)


def place(grid: DepthGrid, stance: Stance) -> Surface:
    """Put a grid into the robot's frame, with the camera as it was at that keyframe."""
    valid, T_base_camera = grid.valid, stance.T_base_camera
    number = np.full(valid.shape, -1, dtype=np.int32)
    number[valid] = np.arange(int(valid.sum()), dtype=np.int32)
    return Surface(
        grid,
        stance,
        inverse_rigid(T_base_camera),
        apply(T_base_camera, grid.points[valid]),
        grid.normals[valid] @ T_base_camera[:3, :3].T,
        grid.sigma_m[valid],
        number,
    )


@dataclass(frozen=True, slots=True)
class _Cells:
    """Cells of a depth image: mean inverse depth (R, C), its spread within the cell, and where most pixels are valid."""

    inverse: Array
    spread: Array
    known: NDArray[np.bool_]


def _average(depth_m: NDArray[np.float32], rows: int, columns: int, cell_px: int) -> _Cells:
    """Average *inverse* depth: on a plane it is linear over the image, however grazing the view."""
    import cv2

    cut = np.ascontiguousarray(depth_m[: rows * cell_px, : columns * cell_px])
    seen = cut > 0
    inverse = np.divide(np.float32(1.0), cut, out=np.zeros_like(cut), where=seen)
    stack = cv2.merge([inverse, inverse * inverse, seen.astype(np.float32)])
    small = cv2.resize(stack, (columns, rows), interpolation=cv2.INTER_AREA).astype(np.float64)
    share = np.maximum(small[..., 2], 1e-6)
    mean = small[..., 0] / share
    known = small[..., 2] > MIN_SHARE
    spread = np.sqrt(np.maximum(small[..., 1] / share - mean**2, 0.0))
    return _Cells(np.where(known, mean, 1.0), spread, known)


def _on_one_surface(cells: _Cells) -> NDArray[np.bool_]:
    """Cells that no depth edge touches: their neighbours are near in depth, or in line with them (a grazing plane)."""
    inverse, known = cells.inverse, cells.known
    near = known & (cells.spread < 0.5 * MAX_JUMP * inverse)
    straight = known.copy()
    for axis in (0, 1):
        before, after = np.roll(inverse, 1, axis), np.roll(inverse, -1, axis)
        both = np.roll(known, 1, axis) & np.roll(known, -1, axis)
        near &= both & (np.maximum(np.abs(before - inverse), np.abs(after - inverse)) < MAX_JUMP * inverse)
        bend = both & (np.abs(before + after - 2.0 * inverse) < MAX_BEND * inverse)
        straight &= bend & np.roll(bend, 1, axis) & np.roll(bend, -1, axis)
    ok = near | straight
    ok[[0, -1]] = False
    ok[:, [0, -1]] = False
    return ok


def _normals(points: Array) -> Array:
    """Unit normals (R, C, 3) towards the camera, from central differences."""
    across = np.zeros_like(points)
    down = np.zeros_like(points)
    across[:, 1:-1] = points[:, 2:] - points[:, :-2]
    down[1:-1] = points[2:] - points[:-2]
    normal = np.cross(down, across)
    normal /= np.maximum(np.linalg.norm(normal, axis=-1), 1e-12)[..., None]
    away = np.einsum("rcx,rcx->rc", normal, points) > 0
    return np.where(away[..., None], -normal, normal)
