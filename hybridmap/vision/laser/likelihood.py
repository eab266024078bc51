"""Likelihood fields of clouds, and the search on them, coarse to fine, for where a registration starts."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from hybridmap.geometry import Array, wrap_angle
from hybridmap.vision.laser.cloud import CELL_M, Cloud

REACH_M = 0.3
"""A point farther than this from every target point has no partner, m: a chair's width, less than a corridor's."""
FIELD_SIGMA_M = 0.12
"""Width of the likelihood field on which starts are scored, m: about a step of the grid of starts."""


@dataclass(frozen=True, slots=True)
class LikelihoodField:
    """A grid about a cloud.

    Attributes:
        low: (2,) corner of cell (0, 0), m.
        cell_m: side of a cell.
        shape: cells in x and y.
        margin: empty cells at each border, so that a clipped look-up meets nothing.
        labels: (cells,) int32, 1 + index of the nearest point of the cloud within reach, 0 for none.
        likelihood: (cells,) uint8, 255 exp(-d^2 / 2 sigma^2) of the distance d to that point.
        lines: (3, 1 + P) the line through each point: its normal, and its distance from the origin along that; 0 for none.
    """

    low: Array
    cell_m: float
    shape: tuple[int, int]
    margin: int
    labels: NDArray[np.int32]
    likelihood: NDArray[np.uint8]
    lines: Array

    def cells(self, x: Array, y: Array) -> NDArray[np.int64]:
        """Flat cell numbers of coordinates of any shape; those outside fall on the empty border."""
        nx, ny = self.shape
        column = _bounded((x - self.low[0]) * (1.0 / self.cell_m), self.margin, nx - 1 - self.margin)
        row = _bounded((y - self.low[1]) * (1.0 / self.cell_m), self.margin, ny - 1 - self.margin)
        return np.asarray(column * ny + row)


def _bounded(cells: Array, low: int, high: int) -> NDArray[np.int64]:
    np.maximum(cells, low, out=cells)
    np.minimum(cells, high, out=cells)
    return cells.astype(np.int64)


def build_field(
    cloud: Cloud,
    cell_m: float = CELL_M,
    reach_m: float = REACH_M,
    sigma_m: float = FIELD_SIGMA_M,
    search_m: float = 0.0,
) -> LikelihoodField:
    """Grow every point with a normal into its surroundings, the far cells first so that the nearest point wins.

    Args:
        cloud: P points with normals.
        cell_m: side of a cell.
        reach_m: how far a point reaches.
        sigma_m: width of the likelihood.
        search_m: largest translation of the starts that will be scored on this field.
    """
    usable = np.flatnonzero(cloud.normals[:, 0] ** 2 + cloud.normals[:, 1] ** 2 > 0.5)
    points, normals = cloud.points[usable].T, cloud.normals[usable].T
    reach, margin = int(np.ceil(reach_m / cell_m)), int(np.ceil(search_m / cell_m)) + 1
    border = reach + 2 * margin + 1
    if len(usable) == 0:
        points, normals = np.zeros((2, 1)), np.zeros((2, 1))
    low = np.array([coordinate.min() for coordinate in points]) - border * cell_m
    column, row = ((coordinate - least) / cell_m for coordinate, least in zip(points, low, strict=True))
    column, row = column.astype(np.int64), row.astype(np.int64)
    nx, ny = int(column.max()) + border + 1, int(row.max()) + border + 1
    offsets, distance_m = _disc(reach, cell_m)
    index = (column * ny + row)[None] + (offsets[:, 0] * ny + offsets[:, 1])[:, None]
    value = np.maximum(1.0, 255.0 * np.exp(-0.5 * (distance_m / sigma_m) ** 2)).astype(np.int32)
    both = np.zeros(nx * ny, np.int32)  # label and likelihood in one number: the scattered write is what costs
    both[index] = (np.arange(1, points.shape[1] + 1, dtype=np.int32) << 8)[None] | value[:, None]
    labels, likelihood = both >> 8, (both & 255).astype(np.uint8)
    lines = np.zeros((3, 1 + points.shape[1]))
    lines[:2, 1:], lines[2, 1:] = normals, normals[0] * points[0] + normals[1] * points[1]
    return LikelihoodField(low, cell_m, (nx, ny), margin, labels, likelihood, lines)


def score_poses(field: LikelihoodField, points: Array, poses: Array) -> Array:
    """Mean likelihood (N,) in [0, 1] of points (P, 2) in a moving frame at each of N poses (N, 3)."""
    cos, sin = np.cos(poses[:, 2])[:, None], np.sin(poses[:, 2])[:, None]
    x = poses[:, :1] + cos * points[:, 0] - sin * points[:, 1]
    y = poses[:, 1:2] + sin * points[:, 0] + cos * points[:, 1]
    hits = field.likelihood.take(field.cells(x, y)).sum(axis=1, dtype=np.uint32)
    return np.asarray(hits / (255.0 * max(len(points), 1)))


def ambiguity(field: LikelihoodField, points: Array, direction: Array, apart_m: float = 0.4, reach_m: float = 3.0) -> float:
    """How well points that lie right would also lie when shifted along a direction: the second mode's share of the likelihood.

    Args:
        field: the target.
        points: (P, 2) in the target's frame, registered.
        direction: (2,) unit vector.
        apart_m: least shift of a second mode.
        reach_m: largest shift looked at.
    """
    side = np.arange(apart_m, reach_m, 0.1)
    shifts = np.concatenate([[0.0, -0.1, 0.1, -0.2, 0.2], -side, side])
    x = points[:, 0] + shifts[:, None] * direction[0]
    y = points[:, 1] + shifts[:, None] * direction[1]
    mean = field.likelihood.take(field.cells(x, y)).sum(axis=1, dtype=np.uint32)
    return float(mean[5:].max() / max(float(mean[:5].max()), 1.0))


def _disc(reach: int, cell_m: float) -> tuple[NDArray[np.int64], Array]:
    """Cell offsets (O, 2) within reach and their length (O,) m, the longest first."""
    side = np.arange(-reach, reach + 1)
    offsets = np.stack(np.meshgrid(side, side, indexing="ij"), axis=-1).reshape(-1, 2)
    length = np.sqrt((offsets**2).sum(axis=1).astype(np.float64))
    order = np.argsort(-length, kind="stable")
    order = order[length[order] <= reach]
    return offsets[order], length[order] * cell_m


def score_starts(field: LikelihoodField, points: Array, center: Array, headings_rad: Array, offsets_m: Array) -> Array:
    """Mean likelihood of points at every start of a grid.

    Args:
        field: the target.
        points: (P, 2) in the moving frame.
        center: (2,) about which the starts lie, m.
        headings_rad: (H,) of the moving frame.
        offsets_m: (T, 2) translations about the centre; at most the field's `search_m`.

    Returns:
        (H, T) in [0, 1].
    """
    ny = field.shape[1]
    steps = np.round(offsets_m / field.cell_m).astype(np.int64)
    shift = steps[:, 0] * ny + steps[:, 1]
    cos, sin = np.cos(headings_rad)[:, None], np.sin(headings_rad)[:, None]
    x = center[0] + cos * points[:, 0] - sin * points[:, 1]
    y = center[1] + sin * points[:, 0] + cos * points[:, 1]
    base = field.cells(x, y)
    scores = np.empty((len(headings_rad), len(shift)))
    for h in range(len(headings_rad)):
        hits = field.likelihood.take(base[h][:, None] + shift[None])
        scores[h] = hits.sum(axis=0, dtype=np.uint32)
    return scores / (255.0 * max(len(points), 1))


STEP_M, STEP_DEG = 0.3, 2.0
"""Half a step of the wide grid of starts, m and degrees; the search about the best ones goes by it."""
SURVIVORS = 24
"""Starts of the wide grid that are looked at more closely."""
SEPARATE_M, SEPARATE_DEG = 0.8, 12.0
"""Modes are apart where they differ by more, m or degrees."""


@dataclass(frozen=True, slots=True)
class Start:
    """A pose (3,) of the moving frame in the target's, and the mean likelihood of its points there."""

    pose: Array
    score: float


def survivors(wide: LikelihoodField, points: Array, offsets_m: Array, headings_rad: Array) -> list[Start]:
    """The best starts of a grid, whether separated or not, the best first.

    Args:
        wide: the target's field with a likelihood as wide as the steps of the grid.
        points: (P, 2) in the moving frame.
        offsets_m: (T, 2) positions of the grid, twice `STEP_M` apart.
        headings_rad: (H,) headings of the grid, twice `STEP_DEG` apart.
    """
    scores = score_starts(wide, points, np.zeros(2), headings_rad, offsets_m)
    best = np.argsort(-scores, axis=None, kind="stable")[:SURVIVORS]
    h, t = np.unravel_index(best, scores.shape)
    poses = np.column_stack([offsets_m[t], headings_rad[h]])
    return [Start(pose, float(score)) for pose, score in zip(poses, scores[h, t], strict=True)]


def sharpened(sharp: LikelihoodField, points: Array, starts: list[Start], count: int) -> list[Start]:
    """The best separated poses about some starts.

    Args:
        sharp: the target's field with half the width of that which found the starts.
        points: (P, 2) in the moving frame.
        starts: what is left of the grid.
        count: how many at most.
    """
    poses = (np.array([start.pose for start in starts])[:, None] + _star()[None]).reshape(-1, 3)
    return separated(poses, score_poses(sharp, points, poses), count)


def separated(poses: Array, scores: Array, count: int) -> list[Start]:
    """The best of scored poses (N, 3), each apart from those before it."""
    left, out = scores.copy(), []
    for _ in range(count):
        i = int(np.argmax(left))
        if left[i] <= 0.0:
            break
        out.append(Start(poses[i], float(left[i])))
        near_m = np.hypot(*(poses[:, :2] - poses[i, :2]).T) < SEPARATE_M
        near_rad = np.abs(wrap_angle(poses[:, 2] - poses[i, 2])) < np.deg2rad(SEPARATE_DEG)
        left[near_m & near_rad] = 0.0
    return out


def spaced(half: float, step: float) -> Array:
    """Numbers from -half to half, at most `step` apart, 0 among them."""
    count = int(np.ceil(half / step))
    return np.linspace(-half, half, 2 * count + 1)


def square(half_m: float, step_m: float) -> Array:
    """(T, 2) translations on a square grid."""
    side = spaced(half_m, step_m)
    return np.stack(np.meshgrid(side, side, indexing="ij"), axis=-1).reshape(-1, 2)


def _star() -> Array:
    """(15, 3) a step aside in x or y or none, at each of three headings."""
    moves = np.array([[0.0, 0.0], [STEP_M, 0.0], [-STEP_M, 0.0], [0.0, STEP_M], [0.0, -STEP_M]])
    turns: NDArray[np.float64] = np.deg2rad(np.array([-STEP_DEG, 0.0, STEP_DEG]))
    return np.column_stack([np.tile(moves, (3, 1)), np.repeat(turns, len(moves))])
