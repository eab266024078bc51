"""Search for starts of a registration: a wide likelihood field first, then the neighbourhood of the best on a sharper one."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from hybridmap.geometry import Array, wrap_angle
from hybridmap.vision.laser.likelihood import LikelihoodField, score_poses, score_starts

STEP_M = 0.3
STEP_DEG = 2.0
SURVIVORS = 24
SEPARATE_M = 0.8
SEPARATE_DEG = 12.0


@dataclass(frozen=True, slots=True)
class Start:
    """A pose (3,) of the moving frame in the target's, and the mean likelihood of its points there."""

    pose: Array
    score: float


def search(
    wide: LikelihoodField, sharp: LikelihoodField, points: Array, offsets_m: Array, headings_rad: Array, count: int
) -> list[Start]:
    """The best separated starts of a grid.

    Args:
        wide: the target's field with a likelihood as wide as the steps of the grid.
        sharp: the target's field with half that width.
        points: (P, 2) in the moving frame.
        offsets_m: (T, 2) positions of the grid, twice `STEP_M` apart.
        headings_rad: (H,) headings of the grid, twice `STEP_DEG` apart.
        count: how many at most.
    """
    rough = score_starts(wide, points[::2], np.zeros(2), headings_rad, offsets_m)
    best = np.argsort(-rough, axis=None, kind="stable")[:SURVIVORS]
    h, t = np.unravel_index(best, rough.shape)
    poses = np.column_stack([offsets_m[t], headings_rad[h]])
    poses = (poses[:, None] + _star()[None]).reshape(-1, 3)
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
