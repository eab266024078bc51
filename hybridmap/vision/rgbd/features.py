"""Keypoints of a keyframe with their points in space, and mutual matching of two keyframes."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from hybridmap.geometry import Array
from hybridmap.streams.base import Camera

MAX_SPREAD = 0.05
"""A keypoint on a depth edge (neighbouring depths differ by more than this share) has no point in space."""


@dataclass(frozen=True, slots=True)
class Features:
    """ORB keypoints.

    Attributes:
        pixels: (F, 2) float64, column and row at the working width.
        descriptors: (F, 32) uint8.
        points: (F, 3) float64 in the optical frame, m; NaN where there is no depth.
    """

    pixels: Array
    descriptors: NDArray[np.uint8]
    points: Array


@dataclass(frozen=True, slots=True)
class Correspondences:
    """Indices of mutually best matches, (M,) each."""

    first: NDArray[np.int64]
    second: NDArray[np.int64]


def detect(grey: NDArray[np.uint8], depth_m: NDArray[np.float32], camera: Camera, count: int, fast_threshold: int) -> Features:
    """Find keypoints and give each its point in space.

    Args:
        grey: (H, W) uint8.
        depth_m: (H, W) float32, m; 0 where invalid.
        camera: pinhole of both.
        count: largest number of keypoints.
        fast_threshold: contrast of a FAST corner, grey levels.
    """
    import cv2

    orb = cv2.ORB.create(nfeatures=count, fastThreshold=fast_threshold)
    keypoints, descriptors = orb.detectAndCompute(grey, None)
    if descriptors is None or len(keypoints) == 0:
        return Features(np.zeros((0, 2)), np.zeros((0, 32), dtype=np.uint8), np.zeros((0, 3)))
    pixels = np.array([k.pt for k in keypoints], dtype=np.float64)
    return Features(pixels, descriptors, _points_at(pixels, depth_m, camera))


def match(a: Features, b: Features, ratio: float) -> Correspondences:
    """Mutually best descriptors that also pass Lowe's ratio from a to b."""
    import cv2

    none = np.zeros(0, dtype=np.int64)
    if len(a.descriptors) < 2 or len(b.descriptors) < 2:
        return Correspondences(none, none)
    distance, nearest = cv2.batchDistance(a.descriptors, b.descriptors, cv2.CV_32S, normType=cv2.NORM_HAMMING, K=2)
    _, back = cv2.batchDistance(b.descriptors, a.descriptors, cv2.CV_32S, normType=cv2.NORM_HAMMING, K=1)
    best = nearest[:, 0]
    own = np.arange(len(best))
    keep = (back[best, 0] == own) & (distance[:, 0] < ratio * distance[:, 1])
    return Correspondences(own[keep].astype(np.int64), best[keep].astype(np.int64))


def _points_at(pixels: Array, depth_m: NDArray[np.float32], camera: Camera) -> Array:
    height, width = depth_m.shape
    column = np.clip(np.rint(pixels[:, 0]).astype(int), 1, width - 2)
    row = np.clip(np.rint(pixels[:, 1]).astype(int), 1, height - 2)
    around = np.stack([depth_m[row + i, column + j] for i in (-1, 0, 1) for j in (-1, 0, 1)]).astype(np.float64)
    valid = around > 0
    n = valid.sum(axis=0)
    z = np.where(valid, around, 0.0).sum(axis=0) / np.maximum(n, 1)
    spread = around.max(axis=0) - np.where(valid, around, np.inf).min(axis=0)
    good = (n >= 5) & (spread < MAX_SPREAD * z)
    x = (pixels[:, 0] - camera.cx_px) / camera.fx_px
    y = (pixels[:, 1] - camera.cy_px) / camera.fy_px
    points = np.stack([x * z, y * z, z], axis=1)
    points[~good] = np.nan
    return points
