"""Tilt and height of a hand-held camera from the floor plane in its depth image."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from hybridmap.geometry import Array
from hybridmap.vision.rgbd.depth_grid import DepthGrid

MAX_TILT_COS = 0.64
"""A floor's normal is within 50 degrees of the nominal vertical."""
HYPOTHESES = 200
MIN_SHARE_BELOW = 0.03


@dataclass(frozen=True, slots=True)
class Floor:
    """The floor as the camera sees it.

    Attributes:
        up: (3,) unit vector, the vertical in the optical frame.
        height_m: of the camera above the floor.
        cells: grid cells that lie on it.
    """

    up: Array
    height_m: float
    cells: int


def find_floor(grid: DepthGrid, up_nominal: Array, height_nominal_m: float, tolerance_m: float, min_cells: int) -> Floor | None:
    """Find the floor: the best-supported plane that faces up at about the nominal height, with next to nothing below it.

    Every hypothesis is the plane of one grid cell (evenly spread, so nothing is random).

    Args:
        grid: depth of the frame.
        up_nominal: (3,) the vertical in the optical frame if the camera sat as mounted.
        height_nominal_m: mounting height.
        tolerance_m: the height may differ by this much.
        min_cells: fewest cells of a floor.
    """
    points, normals = grid.points[grid.valid], grid.normals[grid.valid]
    sigma = grid.sigma_m[grid.valid]
    distance = -np.einsum("ij,ij->i", normals, points)
    eligible = np.flatnonzero((normals @ up_nominal > MAX_TILT_COS) & (np.abs(distance - height_nominal_m) < tolerance_m))
    if len(eligible) < min_cells:
        return None
    chosen = eligible[np.linspace(0, len(eligible) - 1, min(HYPOTHESES, len(eligible))).astype(int)]
    ups, heights = normals[chosen], distance[chosen]
    off = np.abs(points[eligible] @ ups.T + heights) < 0.03 + sigma[eligible, None]
    alike = normals[eligible] @ ups.T > 0.97
    best = int(np.argmax((off & alike).sum(axis=0)))
    up, height = ups[best], float(heights[best])
    for reach in (0.05, 0.03, 0.03):
        on = (np.abs(points @ up + height) < reach + sigma) & (normals @ up > 0.94)
        if on.sum() < min_cells:
            return None
        up, height = _fit_plane(points[on], 1.0 / sigma[on] ** 2, up)
    below = points @ up + height < -(0.1 + 3.0 * sigma)
    if below.mean() > MIN_SHARE_BELOW or abs(height - height_nominal_m) > tolerance_m:
        return None
    return Floor(up, height, int(on.sum()))


def vertical_of_structure(normals: Array, up_guess: Array) -> Array:
    """Vertical (3,) of an indoor scene near a guess: walls stand upright, floors, tables and ceilings lie flat.

    Least squares over the normals that belong to either (re-chosen a few times), with the guess as a weak prior.

    Args:
        normals: (N, 3) unit normals in the optical frame.
        up_guess: (3,) unit vector.
    """
    up = up_guess
    for limit_deg in (15.0, 10.0, 7.0, 5.0, 5.0):
        cosine = np.abs(normals @ up)
        upright = normals[cosine < np.sin(np.deg2rad(limit_deg))]
        flat = normals[cosine > np.cos(np.deg2rad(limit_deg))]
        prior = 0.05 * len(normals) + 1.0
        scatter = upright.T @ upright - flat.T @ flat - prior * np.outer(up_guess, up_guess)
        _, vectors = np.linalg.eigh(scatter)
        up = vectors[:, 0] * (1.0 if vectors[:, 0] @ up_guess > 0 else -1.0)
    return np.asarray(up)


def camera_on(up: Array, height_m: float, T_base_camera_nominal: Array) -> Array:
    """Pose (4, 4) of the camera in a level base: nominal place and heading of the optical axis, given tilt and height.

    A camera that looks straight up or down has no heading of its axis; there the image's right-hand axis takes its place.
    """
    nominal = T_base_camera_nominal[:3, :3]
    axis = 2 if abs(nominal[2, 2]) < 0.9 else 0
    out = np.eye(4)
    level = _level_axes(up, axis)
    heading = np.arctan2(nominal[1, axis], nominal[0, axis])
    cos, sin = np.cos(heading), np.sin(heading)
    out[:3, :3] = np.array([[cos, -sin, 0.0], [sin, cos, 0.0], [0.0, 0.0, 1.0]]) @ level
    out[:2, 3] = T_base_camera_nominal[:2, 3]
    out[2, 3] = height_m
    return out


def _level_axes(up: Array, axis: int) -> Array:
    forward = -up[axis] * up
    forward[axis] += 1.0
    forward /= np.linalg.norm(forward)
    return np.stack([forward, np.cross(up, forward), up])


def _fit_plane(points: Array, weight: Array, up_before: Array) -> tuple[Array, float]:
    """Weighted least-squares plane; the normal on the side of `up_before`."""
    total = weight.sum()
    mean = weight @ points / total
    centred = points - mean
    _, vectors = np.linalg.eigh((centred * weight[:, None]).T @ centred)
    up = vectors[:, 0] * (1.0 if vectors[:, 0] @ up_before > 0 else -1.0)
    return up, float(-up @ mean)
