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
