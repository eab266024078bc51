"""Tilt and height of a hand-held camera from the floor plane in its depth image."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

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


def vertical_of_structure(normals: Array, guesses: Array) -> Array:
    """Vertical (3,) of an indoor scene near one of some guesses: walls stand upright, floors, tables and ceilings lie flat.

    From each guess least squares over the normals that belong to either (re-chosen a few times), with the guess as a weak
    prior; of the outcomes the one that most normals agree with, less what the guess lies farther off the first one.

    Args:
        normals: (N, 3) unit normals in the optical frame.
        guesses: (G, 3) unit vectors, the likeliest first.
    """
    outcomes = [_settle(normals, guess) for guess in guesses]
    support = [float(np.mean(_structured(normals, up, 5.0))) + 0.5 * float(up @ guesses[0]) for up in outcomes]
    return outcomes[int(np.argmax(support))]


def _structured(normals: Array, up: Array, limit_deg: float) -> NDArray[np.bool_]:
    cosine = np.abs(normals @ up)
    return np.asarray((cosine < np.sin(np.deg2rad(limit_deg))) | (cosine > np.cos(np.deg2rad(limit_deg))))


def _settle(normals: Array, guess: Array) -> Array:
    up = guess
    prior = (0.05 * len(normals) + 1.0) * np.outer(guess, guess)
    for limit_deg in (15.0, 10.0, 7.0, 5.0, 5.0):
        kept = normals[_structured(normals, up, limit_deg)]
        lies_flat = np.abs(kept @ up) > 0.5
        upright, flat = kept[~lies_flat], kept[lies_flat]
        _, vectors = np.linalg.eigh(upright.T @ upright - flat.T @ flat - prior)
        up = vectors[:, 0] * (1.0 if vectors[:, 0] @ guess > 0 else -1.0)
    return np.asarray(up)


def _fit_plane(points: Array, weight: Array, up_before: Array) -> tuple[Array, float]:
    """Weighted least-squares plane; the normal on the side of `up_before`."""
    total = weight.sum()
    mean = weight @ points / total
    centred = points - mean
    _, vectors = np.linalg.eigh((centred * weight[:, None]).T @ centred)
    up = vectors[:, 0] * (1.0 if vectors[:, 0] @ up_before > 0 else -1.0)
    return up, float(-up @ mean)
