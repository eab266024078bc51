"""Where the camera was in a level base at each keyframe: as mounted, or as the floor in its depth image says."""

from __future__ import annotations

from collections import deque
from dataclasses import dataclass
from typing import Literal

import numpy as np

from hybridmap.geometry import Array
from hybridmap.vision.rgbd.depth_grid import DepthGrid
from hybridmap.vision.rgbd.features import Features, match
from hybridmap.vision.rgbd.pnp_solver import PnpSolver
from hybridmap.vision.rgbd.spatial import inverse_rigid
from hybridmap.vision.rgbd.tilt import camera_on, find_floor, vertical_of_structure

AGREE_TILT_RAD = float(np.deg2rad(2.0))
AGREE_HEIGHT_M = 0.06
"""A floor seen within this of the mounting does not contradict it."""
FIRST_TOLERANCE_M = 0.3
LATER_TOLERANCE_M = 0.12
"""How far the height may be from the mounting's, and from that of the last floors once some have been seen."""
REMEMBERED_FLOORS = 15
MIN_FLOORS = 3
MIN_FLOOR_CELLS = 40
MIN_FOLLOWED = 15
"""Features that must agree before the camera's turn since the last keyframe is believed."""


@dataclass(frozen=True, slots=True)
class Stance:
    """Pose (4, 4) of the camera in the base at one keyframe, and whether it was measured there."""

    T_base_camera: Array
    measured: bool


@dataclass(frozen=True, slots=True)
class _Last:
    """The keyframe before: its features and its camera's pose."""

    features: Features
    T_base_camera: Array


class Posture:
    """Decides how the camera is held, keyframe by keyframe."""

    def __init__(self, mode: Literal["auto", "level", "floor"], T_base_camera: Array, solver: PnpSolver, ratio: float) -> None:
        self._mounting = T_base_camera
        self._held = mode == "floor"
        self._watching = mode == "auto"
        self._solver = solver
        self._ratio = ratio
        self._last: _Last | None = None
        self._heights: deque[float] = deque(maxlen=REMEMBERED_FLOORS)

    def stance(self, grid: DepthGrid, features: Features) -> Stance:
        """The camera's pose at the next keyframe."""
        if not self._held and not self._watching:
            return Stance(self._mounting, False)
        found = self._on_floor(grid)
        if self._watching and found is not None and self._contradicts(found):
            self._held, self._watching = True, False
        if not self._held:
            return Stance(self._mounting, False)
        if found is None:
            found = self._carried(grid, features)
        self._last = _Last(features, found)
        return Stance(found, True)

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

    def _carried(self, grid: DepthGrid, features: Features) -> Array:
        """No floor in view: the last posture, turned by what the features say, then set upright by walls and tables."""
        guess = self._mounting if self._last is None else self._followed(self._last, features)
        up = vertical_of_structure(grid.normals[grid.valid], guess[2, :3])
        usual = float(np.median(self._heights)) if self._heights else float(self._mounting[2, 3])
        height = np.clip(guess[2, 3], usual - LATER_TOLERANCE_M, usual + LATER_TOLERANCE_M)
        return camera_on(up, float(height), self._mounting)

    def _followed(self, last: _Last, features: Features) -> Array:
        pairs = match(last.features, features, self._ratio)
        pose = self._solver.solve(last.features, features, pairs.first, pairs.second)
        if pose is None or len(pose.inliers) < MIN_FOLLOWED:
            return last.T_base_camera
        return np.asarray(last.T_base_camera @ inverse_rigid(pose.T_image_points))
