"""Pose of the camera in a level base at each keyframe: as mounted, or from the floor plane in its depth image."""

from __future__ import annotations

from collections import deque
from dataclasses import dataclass
from typing import Literal

import numpy as np
from numpy.typing import NDArray

from hybridmap.geometry import Array
from hybridmap.vision.rgbd.depth_grid import DepthGrid
from hybridmap.vision.rgbd.features import Features, match
from hybridmap.vision.rgbd.keyframe import Keyframe
from hybridmap.vision.rgbd.pnp import PnpSolver
from hybridmap.vision.rgbd.stance import Stance, camera_on, inverse_rigid, rotation_of

ON_FLOOR_M = (0.05, 0.03, 0.03)
"""Cells this near to a plane are on it, m beside the noise of depth: in each of three fits."""
ALIKE_COS, FLOOR_COS = 0.97, 0.94
"""Least cosine between the normals of cells of one hypothesis of a floor, and between a normal and the floor's."""
BELOW_M, BELOW_SIGMAS = 0.1, 3.0
"""A cell is below the floor where it lies deeper, m and standard deviations of depth."""
STRUCTURE_DEG = (15.0, 10.0, 7.0, 5.0, 5.0)
"""A normal belongs to an upright or flat surface within this angle: in each of five fits."""
AGREE_TILT_RAD = float(np.deg2rad(2.0))
AGREE_HEIGHT_M = 0.06
"""A floor seen within this of the mounting does not contradict it."""
FIRST_TOLERANCE_M = 0.3
LATER_TOLERANCE_M = 0.12
"""Largest difference of height from the mounting's, and from that of the last floors once there are some, m."""
REMEMBERED_FLOORS = 15
MIN_FLOORS = 3
TRUSTED_FLOORS, RELAXED_EVERY = 20, 5
"""After so many floors that agree with the mounting, one keyframe in so many is looked at."""
MIN_FLOOR_CELLS = 40
MOUNTED = (float(np.deg2rad(0.2)), 0.004)
ON_FLOOR = (float(np.deg2rad(0.5)), 0.02)
PROPAGATED = (float(np.deg2rad(3.0)), 0.06)
"""Standard deviations of tilt (rad) and height (m): as mounted on a robot, measured on the floor, propagated."""
NODS_DEG = (0.0, 8.0, -8.0, 16.0, -16.0, 24.0, -24.0, 32.0, -32.0)
"""Changes of pitch that are tried where features do not give the turn, degrees."""
MIN_FOLLOWED = 15
"""Least number of features that agree on the camera's turn since the last keyframe."""


class Posture:
    """Estimates the camera's pose on a level robot (its stance) at each keyframe.

    Args:
        mode: see the setting `vision.rgbd.tilt`.
        T_base_camera: (4, 4) mounting.
        solver: gives the camera's turn since the keyframe before, where no floor is in view.
    """

    def __init__(self, mode: Literal["auto", "level", "floor"], T_base_camera: Array, solver: PnpSolver) -> None:
        self._mounting = T_base_camera
        self._as_mounted = Stance(T_base_camera, *MOUNTED, False)
        self._held = mode == "floor"
        self._watching = mode == "auto"
        self._solver = solver
        self._heights: deque[float] = deque(maxlen=REMEMBERED_FLOORS)
        self._agreed = 0
        self._unwatched = 0

    def stance(self, grid: DepthGrid, features: Features, last: Keyframe | None) -> Stance:
        """Estimate the camera's stance at a new keyframe. Call it once for each, in order: floors seen before count.

        In the mode `level` the stance is as mounted; in `auto` too, until a floor contradicts the mounting.

        Args:
            grid: depth of the new keyframe.
            features: its keypoints.
            last: the keyframe before it; None at the first.
        """
        if not self._held and not self._looks():
            return self._as_mounted
        found = self._on_floor(grid)
        if self._watching and found is not None:
            if self._contradicts(found):
                self._held, self._watching = True, False
            self._agreed += 1
        if not self._held:
            return self._as_mounted
        if found is None:
            return Stance(self._propagated(grid, features, last), *PROPAGATED, True)
        return Stance(found, *ON_FLOOR, True)

    def _looks(self) -> bool:
        """Whether to look for the floor: at every keyframe, later at one in some, once many agreed with the mounting."""
        self._unwatched += 1
        if not self._watching or (self._agreed >= TRUSTED_FLOORS and self._unwatched < RELAXED_EVERY):
            return False
        self._unwatched = 0
        return True

    def _on_floor(self, grid: DepthGrid) -> Array | None:
        up, mounted_m = self._mounting[2, :3], float(self._mounting[2, 3])
        known = len(self._heights) >= MIN_FLOORS
        height = float(np.median(self._heights)) if known else mounted_m
        tolerance = min(LATER_TOLERANCE_M if known else FIRST_TOLERANCE_M, 0.5 * mounted_m)
        floor = find_floor(grid, up, height, tolerance, MIN_FLOOR_CELLS)
        if floor is None:
            return None
        self._heights.append(floor.height_m)
        return camera_on(floor.up, floor.height_m, self._mounting)

    def _contradicts(self, T_base_camera: Array) -> bool:
        cosine = float(T_base_camera[2, :3] @ self._mounting[2, :3])
        tilted = np.arccos(np.clip(cosine, -1.0, 1.0)) > AGREE_TILT_RAD
        return bool(tilted or abs(T_base_camera[2, 3] - self._mounting[2, 3]) > AGREE_HEIGHT_M)

    def _propagated(self, grid: DepthGrid, features: Features, last: Keyframe | None) -> Array:
        """Without a floor in view: the last pose, turned by features, then levelled by walls and flat surfaces."""
        before = self._mounting if last is None else last.surface.stance.T_base_camera
        followed = None if last is None else self._followed(last, features)
        guess = before if followed is None else followed
        nods = (0.0,) if followed is not None else NODS_DEG
        guesses = np.stack([rotation_of(np.array([np.deg2rad(nod), 0.0, 0.0])) @ guess[2, :3] for nod in nods])
        up = vertical_of_structure(grid.normals[grid.valid], guesses)
        usual = float(np.median(self._heights)) if self._heights else float(self._mounting[2, 3])
        height = np.clip(guess[2, 3], usual - LATER_TOLERANCE_M, usual + LATER_TOLERANCE_M)
        return camera_on(up, float(height), self._mounting)

    def _followed(self, last: Keyframe, features: Features) -> Array | None:
        """The camera's pose by its turn since the last keyframe, where enough features agree on it."""
        pairs = match(last.features, features)
        pose = self._solver.solve(last.features, features, pairs.first, pairs.second)
        if pose is None or len(pose.inliers) < MIN_FOLLOWED:
            return None
        return np.asarray(last.surface.stance.T_base_camera @ inverse_rigid(pose.T_image_points))


MAX_TILT_COS = 0.64
"""A floor's normal is within 50 degrees of the nominal vertical."""
HYPOTHESES = 200
MIN_SHARE_BELOW = 0.03


@dataclass(frozen=True, slots=True)
class Floor:
    """The floor plane in the camera's optical frame.

    Attributes:
        up: (3,) unit vector, the vertical.
        height_m: height of the camera above the floor.
        cells: number of grid cells that lie on the floor.
    """

    up: Array
    height_m: float
    cells: int


def find_floor(grid: DepthGrid, up_nominal: Array, height_nominal_m: float, tolerance_m: float, min_cells: int) -> Floor | None:
    """Find the floor: the plane with most grid cells that faces up at about the nominal height, with few points below it.

    Hypotheses are the planes of evenly spread grid cells; nothing is random.

    Args:
        grid: depth of the frame.
        up_nominal: (3,) the vertical in the optical frame if the camera sat as mounted, unit length.
        height_nominal_m: expected height of the camera above the floor.
        tolerance_m: largest difference from that height.
        min_cells: least number of cells of a floor.

    Returns:
        None if no plane has these properties.
    """
    points, normals = grid.points[grid.valid], grid.normals[grid.valid]
    sigma = grid.sigma_m[grid.valid]
    distance = -np.einsum("ij,ij->i", normals, points)
    eligible = np.flatnonzero((normals @ up_nominal > MAX_TILT_COS) & (np.abs(distance - height_nominal_m) < tolerance_m))
    if len(eligible) < min_cells:
        return None
    chosen = eligible[np.linspace(0, len(eligible) - 1, min(HYPOTHESES, len(eligible))).astype(int)]
    ups, heights = normals[chosen], distance[chosen]
    off = np.abs(points[eligible] @ ups.T + heights) < ON_FLOOR_M[-1] + sigma[eligible, None]
    alike = normals[eligible] @ ups.T > ALIKE_COS
    best = int(np.argmax((off & alike).sum(axis=0)))
    up, height = ups[best], float(heights[best])
    for reach in ON_FLOOR_M:
        on = (np.abs(points @ up + height) < reach + sigma) & (normals @ up > FLOOR_COS)
        if on.sum() < min_cells:
            return None
        up, height = _fit_plane(points[on], 1.0 / sigma[on] ** 2, up)
    below = points @ up + height < -(BELOW_M + BELOW_SIGMAS * sigma)
    if below.mean() > MIN_SHARE_BELOW or abs(height - height_nominal_m) > tolerance_m:
        return None
    return Floor(up, height, int(on.sum()))


def vertical_of_structure(normals: Array, guesses: Array) -> Array:
    """Vertical (3,), unit, of an indoor scene from the normals of its walls and level surfaces, near one of some guesses.

    Each guess is refined by least squares over the normals of such surfaces. The result with most agreeing normals wins, less
    a penalty for guesses far from the first.

    Args:
        normals: (N, 3) unit normals in the optical frame.
        guesses: (G, 3) unit vectors, the likeliest first.
    """
    outcomes = [_settle(normals, guess) for guess in guesses]
    support = [float(np.mean(_structured(normals, up, STRUCTURE_DEG[-1]))) + 0.5 * float(up @ guesses[0]) for up in outcomes]
    return outcomes[int(np.argmax(support))]


def _structured(normals: Array, up: Array, limit_deg: float) -> NDArray[np.bool_]:
    cosine = np.abs(normals @ up)
    return np.asarray((cosine < np.sin(np.deg2rad(limit_deg))) | (cosine > np.cos(np.deg2rad(limit_deg))))


def _settle(normals: Array, guess: Array) -> Array:
    up = guess
    prior = (0.05 * len(normals) + 1.0) * np.outer(guess, guess)
    for limit_deg in STRUCTURE_DEG:
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
