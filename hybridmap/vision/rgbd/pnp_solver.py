"""Pose of one camera from points of another: PnP with RANSAC, deterministic."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from hybridmap.geometry import Array
from hybridmap.streams.rgbd import Camera
from hybridmap.vision.rgbd.features import Features

ITERATIONS = 200
"""RANSAC draws at most: enough for 30 % of inliers with certainty of 99 %."""
REPROJECTION_PX = 3.0
"""An inlier's largest reprojection error, pixels at the working width."""


@dataclass(frozen=True, slots=True)
class Pnp:
    """A pose and its support.

    Attributes:
        T_image_points: (4, 4) the camera that gave the points, seen from the camera that gave the image.
        inliers: which matches agree.
    """

    T_image_points: Array
    inliers: NDArray[np.int64]


class PnpSolver:
    """PnP-RANSAC for one camera; its random draws are seeded anew for every call."""

    def __init__(self, camera: Camera, min_inliers: int, seed: int) -> None:
        self._matrix = np.array([[camera.fx_px, 0, camera.cx_px], [0, camera.fy_px, camera.cy_px], [0, 0, 1.0]])
        self._min_inliers = min_inliers
        self._seed = seed % 2**31

    def solve(self, points: Features, image: Features, of_points: NDArray[np.int64], of_image: NDArray[np.int64]) -> Pnp | None:
        """Points of one keyframe in the image of another; None without enough support.

        Args:
            points, image: features of the two keyframes.
            of_points, of_image: (M,) which keypoints match.
        """
        import cv2

        if len(of_points) < self._min_inliers:
            return None
        space, pixels = points.points[of_points], image.pixels[of_image]
        cv2.setRNGSeed(self._seed)
        ok, rotation, translation, inliers = cv2.solvePnPRansac(
            space,
            pixels,
            self._matrix,
            None,
            iterationsCount=ITERATIONS,
            reprojectionError=REPROJECTION_PX,
            confidence=0.999,
            flags=cv2.SOLVEPNP_AP3P,
        )
        if not ok or inliers is None or len(inliers) < 4:
            return None
        kept = inliers.ravel()
        rotation, translation = cv2.solvePnPRefineLM(space[kept], pixels[kept], self._matrix, None, rotation, translation)
        T = np.eye(4)
        T[:3, :3] = cv2.Rodrigues(rotation)[0]
        T[:3, 3] = np.ravel(translation)
        return Pnp(T, kept.astype(np.int64))
