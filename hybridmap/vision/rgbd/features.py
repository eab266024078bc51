"""Keypoints of a keyframe with their points in space, and the matching of two keyframes."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from hybridmap.geometry import Array
from hybridmap.streams.rgbd import Camera

COUNT = 500
"""Largest number of ORB keypoints: what a picture of 320 x 240 holds."""
FAST_THRESHOLD = 10
"""Contrast that a FAST corner needs, grey levels: half of OpenCV's, for bare rooms."""
RATIO = 0.8
"""Lowe's ratio: the best match must be this much nearer than the second."""
MAX_SPREAD = 0.05
"""A keypoint on a depth edge (neighbouring depths differ by more than this share) has no point in space."""


@dataclass(frozen=True, slots=True)
class Features:
    """ORB keypoints that have a point in space.

    Attributes:
        pixels: (F, 2) float64, column and row at the working width.
        descriptors: (F, 32) uint8.
        points: (F, 3) float64 in the optical frame, m.
    """

    pixels: Array
    descriptors: NDArray[np.uint8]
    points: Array


@dataclass(frozen=True, slots=True)
class Correspondences:
    """Indices (M,) of matching keypoints in the `Features` of the first and of the second keyframe; none occurs twice."""

    first: NDArray[np.int64]
    second: NDArray[np.int64]


def detect(grey: NDArray[np.uint8], depth_m: NDArray[np.float32], camera: Camera) -> Features:
    """Find keypoints and their points in space; keypoints without depth, or on a depth edge, are dropped.

    Args:
        grey: (H, W) uint8.
        depth_m: (H, W) float32, m; 0 where invalid.
        camera: pinhole of both images.
    """
    import cv2

    orb = cv2.ORB.create(nfeatures=COUNT, fastThreshold=FAST_THRESHOLD)
    keypoints, descriptors = orb.detectAndCompute(grey, None)
    if descriptors is None or len(keypoints) == 0:
        return Features(np.zeros((0, 2)), np.zeros((0, 32), dtype=np.uint8), np.zeros((0, 3)))
    pixels = np.asarray(cv2.KeyPoint.convert(keypoints), dtype=np.float64)
    points, known = _points_at(pixels, depth_m, camera)
    return Features(pixels[known], descriptors[known], points[known])


def match(a: Features, b: Features) -> Correspondences:
    """Match each keypoint of a with its nearest descriptor in b, by Lowe's ratio test.

    Where several keypoints of a have the same partner in b, only the nearest one is kept. Pairs are in the order of a.
    """
    import cv2

    none = np.zeros(0, dtype=np.int64)
    if len(a.descriptors) < 2 or len(b.descriptors) < 2:
        return Correspondences(none, none)
    distance, nearest = cv2.batchDistance(a.descriptors, b.descriptors, cv2.CV_32S, normType=cv2.NORM_HAMMING, K=2)
    passed = np.flatnonzero(distance[:, 0] < RATIO * distance[:, 1])
    passed = passed[np.argsort(distance[passed, 0], kind="stable")]
    _, keeper = np.unique(nearest[passed, 0], return_index=True)
    own = np.sort(passed[keeper])
    return Correspondences(own.astype(np.int64), nearest[own, 0].astype(np.int64))


def _points_at(pixels: Array, depth_m: NDArray[np.float32], camera: Camera) -> tuple[Array, NDArray[np.bool_]]:
    """Points (F, 3) from the mean of the 3 x 3 depths around each pixel, and which of them are on one surface."""
    height, width = depth_m.shape
    column = np.clip(np.rint(pixels[:, 0]).astype(int), 1, width - 2)
    row = np.clip(np.rint(pixels[:, 1]).astype(int), 1, height - 2)
    around = np.stack([depth_m[row + i, column + j] for i in (-1, 0, 1) for j in (-1, 0, 1)]).astype(np.float64)
    valid = around > 0
    n = valid.sum(axis=0)
    z = np.where(valid, around, 0.0).sum(axis=0) / np.maximum(n, 1)
    spread = around.max(axis=0) - np.where(valid, around, np.inf).min(axis=0)
    good = (n >= 3) & (spread < MAX_SPREAD * z)
    x = (pixels[:, 0] - camera.cx_px) / camera.fx_px
    y = (pixels[:, 1] - camera.cy_px) / camera.fy_px
    return np.stack([x * z, y * z, z], axis=1), good
