"""A depth image boiled down to a coarse grid of points with normals, and that grid placed in the robot's frame."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from hybridmap.geometry import Array
from hybridmap.streams.rgbd import Camera
from hybridmap.vision.rgbd.stance import Stance, inverse_rigid

GRID_PX, GRID_COLUMNS = 5, 48
"""Depth is averaged over, and sampled at, cells of so many pixels; smaller ones where a picture is too narrow for so many
columns of them."""
MAX_JUMP = 0.05
MAX_BEND = 0.015
MIN_SHARE = 0.2
"""Neighbouring cells are one surface where inverse depth differs by less than a share, or bends by less than a share of itself;
a cell is known where this share of its pixels is."""


def cell_px(width_px: int) -> int:
    """Side of a grid cell, in pixels, for images of a given width (the working width)."""
    return max(2, min(GRID_PX, width_px // GRID_COLUMNS))


def reduced(camera: Camera, factor: int) -> Camera:
    """The pinhole of an image reduced by a whole factor: pixels are `factor` times as large, the mounting is the same."""
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
    """Points and normals on a coarse grid over a depth image, in the camera's optical frame.

    Attributes:
        camera: pinhole of the grid: one pixel is one cell.
        points: (R, C, 3) float64, m; where not `valid`, meaningless but finite.
        normals: (R, C, 3) float64, unit, towards the camera.
        valid: (R, C) whether the cell has a point with a normal.
        sigma_m: (R, C) standard deviation of the point along its normal, m.
    """

    camera: Camera
    points: Array
    normals: Array
    valid: NDArray[np.bool_]
    sigma_m: Array


@dataclass(frozen=True, slots=True)
class Surface:
    """The points of a depth grid in the robot's frame.

    Attributes:
        grid: the grid that the points come from.
        stance: pose of the camera in the level `base_link` at that keyframe (its tilt and height may change), with its
            uncertainty.
        T_camera_base: (4, 4) `base_link` in the camera's optical frame: the inverse of the stance's pose.
        rows: (7, N) of the valid points: position in `base_link` (m), normal, standard deviation along the normal (m).
        number: (R, C) int32, index of a cell's point; -1 for none.
    """

    grid: DepthGrid
    stance: Stance
    T_camera_base: Array
    rows: Array
    number: NDArray[np.int32]

    @property
    def points(self) -> Array:
        """(N, 3) in `base_link`, m."""
        return self.rows[:3].T

    @property
    def normals(self) -> Array:
        """(N, 3) in `base_link`, unit length."""
        return self.rows[3:6].T

    @property
    def sigma_m(self) -> Array:
        """(N,) standard deviation along the normals, m."""
        return np.asarray(self.rows[6])


def make_grid(depth_m: NDArray[np.float32], camera: Camera, cell_px: int, depth_sigma: float) -> DepthGrid:
    """Average a depth image over cells, and take normals from neighbouring cells.

    Args:
        depth_m: (H, W) float32, m along the optical axis; 0 where invalid.
        camera: pinhole of the image.
        cell_px: side of a cell, pixels; what is left over at the right and at the bottom is cut off.
        depth_sigma: noise of one pixel at 1 m, m; it grows with the square of the distance.
    """
    coarse = reduced(camera, cell_px)
    cells = _average(depth_m, coarse.height_px, coarse.width_px, cell_px)
    depth = 1.0 / cells.inverse
    points = np.empty((*depth.shape, 3))
    points[..., 0] = (cells.column - coarse.cx_px) * depth / coarse.fx_px
    points[..., 1] = (cells.row - coarse.cy_px) * depth / coarse.fy_px
    points[..., 2] = depth
    sigma = 0.001 + 0.5 * depth_sigma * depth**2 / np.sqrt(cells.share)
    return DepthGrid(coarse, points, _normals(points), _on_one_surface(cells), sigma)


def place(grid: DepthGrid, stance: Stance) -> Surface:
    """Put the valid points of a depth grid into the level `base_link`.

    `stance` is the pose of the camera in `base_link` at that keyframe: as mounted, or measured if the camera is hand-held.
    """
    valid, T_base_camera = grid.valid, stance.T_base_camera
    number = np.full(valid.shape, -1, dtype=np.int32)
    rows = np.empty((7, np.count_nonzero(valid)))
    number[valid] = np.arange(rows.shape[1], dtype=np.int32)
    rows[:3] = T_base_camera[:3, :3] @ grid.points[valid].T + T_base_camera[:3, 3:]
    rows[3:6] = T_base_camera[:3, :3] @ grid.normals[valid].T
    rows[6] = grid.sigma_m[valid]
    return Surface(grid, stance, inverse_rigid(T_base_camera), rows, number)


@dataclass(frozen=True, slots=True)
class _Cells:
    """Cells of a depth image, each array (R, C).

    Attributes:
        inverse, spread: mean inverse depth of the valid pixels, and its standard deviation within the cell, 1/m.
        column, row: where the middle of these pixels lies, cells.
        share: of the pixels that are valid.
        known: that is enough.
    """

    inverse: Array
    spread: Array
    column: Array
    row: Array
    share: Array
    known: NDArray[np.bool_]


def _average(depth_m: NDArray[np.float32], rows: int, columns: int, cell_px: int) -> _Cells:
    """Average *inverse* depth: on a plane it is linear over the image, so that a mean belongs to the middle of its pixels."""
    import cv2

    cut = np.ascontiguousarray(depth_m[: rows * cell_px, : columns * cell_px])
    seen = (cut > 0).astype(np.float32)
    inverse = np.divide(np.float32(1.0), cut, out=np.zeros_like(cut), where=cut > 0)
    u = (np.arange(columns * cell_px, dtype=np.float32) + np.float32(0.5)) / np.float32(cell_px) - np.float32(0.5)
    v = (np.arange(rows * cell_px, dtype=np.float32)[:, None] + np.float32(0.5)) / np.float32(cell_px) - np.float32(0.5)
    share, mean, square, column, row = (
        cv2.resize(layer, (columns, rows), interpolation=cv2.INTER_AREA).astype(np.float64)
        for layer in (seen, inverse, inverse * inverse, seen * u, seen * v)
    )
    known = share > MIN_SHARE
    share = np.maximum(share, 1e-6)
    mean, column, row = mean / share, column / share, row / share
    spread = np.sqrt(np.maximum(square / share - mean**2, 0.0))
    return _Cells(np.where(known, mean, 1.0), spread, column, row, share, known)


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
