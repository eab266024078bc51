"""Scanline profiles (eq. 11): what an image or a scan looks like along its columns.

A profile is `(bands, width)` float32, each band normalised by itself. Intensity bands come first, depth bands after them;
a laser scan has one band. Column 0 is the left edge of an image, and the smallest bearing of a scan.
"""

from __future__ import annotations

from itertools import pairwise
from typing import Literal

import numpy as np
from numpy.typing import NDArray

from hybridmap.geometry import Array
from hybridmap.streams.base import Rig
from hybridmap.streams.laser import LASER

FULL_CIRCLE_RAD = float(np.deg2rad(355.0))
Profile = NDArray[np.float32]
Normalise = Literal["z", "mean"]


def image_profile(
    grey: NDArray[np.uint8],
    depth_m: NDArray[np.float32],
    width: int,
    bands: int = 1,
    normalise: Normalise = "z",
) -> Profile:
    """Profile of an RGB-D frame: column sums of intensity and column means of the valid depth pixels, for each row band.

    With `bands=1` it is the paper's profile, with `bands=4` the four-band profile.

    Args:
        grey: (H, W) uint8 intensity.
        depth_m: (H, W) float32, m; 0 where invalid.
        width: columns of the profile (b in the paper).
        bands: number of row bands of equal height, top first.
        normalise: see `normalised`.

    Returns:
        (2 * bands, width) float32: intensity bands, then depth bands. Columns without any depth take the band's mean.
    """
    intensity = _cell_means(grey, width, bands)
    share = _cell_means((depth_m > 0).view(np.uint8), width, bands)
    depth = _cell_means(depth_m, width, bands)
    seen = share > 1e-6
    mean = np.where(seen, depth / np.where(seen, share, 1.0), 0.0)
    return np.concatenate([normalised(intensity, normalise), normalised(_fill_with_mean(mean, seen), normalise)]).astype(
        np.float32
    )


def laser_profile(ranges_m: NDArray[np.float32], bearings_rad: Array, width: int, normalise: Normalise = "z") -> Profile:
    """Profile of a scan: its ranges, averaged over `width` equal columns of bearing.

    Args:
        ranges_m: (B,) float32, NaN where invalid.
        bearings_rad: (B,) bearings, monotonic in either direction.
        width: columns of the profile (b in the paper).
        normalise: see `normalised`.

    Returns:
        (1, width) float32, columns by increasing bearing. Columns without any return take the mean.
    """
    low, high = float(bearings_rad.min()), float(bearings_rad.max())
    scale = width / max(high - low, 1e-9)
    column = np.clip(((bearings_rad - low) * scale).astype(np.int64), 0, width - 1)
    valid = np.isfinite(ranges_m)
    count = np.bincount(column[valid], minlength=width)
    total = np.bincount(column[valid], weights=ranges_m[valid].astype(np.float64), minlength=width)
    seen = count > 0
    mean = np.where(seen, total / np.maximum(count, 1), 0.0)[None]
    return normalised(_fill_with_mean(mean, seen[None]), normalise).astype(np.float32)


FARTHEST_M, UNIT_M = 20.0, 2.0
"""Distance beyond which nothing counts in a panoramic profile, and the one whose logarithm is 0 there, m."""


def panoramic_profile(points: Array, width: int) -> Profile:
    """Profile of all surroundings of a robot: the distance of the nearest and of the farthest point in each column of bearing.

    Distances are logarithms, so that ratios count. They are not normalised: a laser measures metres, and a wide corridor is
    another place than a narrow one.

    Args:
        points: (P, 2) what the scans around saw, in the robot's frame, m.
        width: columns, which divide the full circle, beginning behind the robot.

    Returns:
        (2, width) float32: nearest, farthest. Columns without any point have the largest distance in both.
    """
    away = np.clip(np.hypot(points[:, 0], points[:, 1]), 0.1 * UNIT_M, FARTHEST_M)
    turn = np.arctan2(points[:, 1], points[:, 0]) + np.pi
    column = (turn * (width / (2.0 * np.pi))).astype(np.int64) % width
    out = np.full((2, width), FARTHEST_M)
    out[1, column] = 0.0
    np.minimum.at(out[0], column, away)
    np.maximum.at(out[1], column, away)
    return np.log(out / UNIT_M).astype(np.float32)


def normalised(bands: NDArray[np.floating], how: Normalise) -> NDArray[np.floating]:
    """Normalise each row of `(bands, width)`: `z` to mean 0 and standard deviation 1, `mean` to mean 1; flat rows stay flat."""
    mean = bands.mean(axis=1, keepdims=True)
    if how == "mean":
        return np.asarray(bands / np.where(np.abs(mean) > 1e-9, mean, 1.0))
    centred = bands - mean
    deviation = centred.std(axis=1, keepdims=True)
    return np.asarray(centred / np.where(deviation > 1e-6, deviation, 1.0))


def _fill_with_mean(bands: NDArray[np.floating], seen: NDArray[np.bool_]) -> NDArray[np.floating]:
    count = np.maximum(seen.sum(axis=1, keepdims=True), 1)
    mean = np.where(seen, bands, 0.0).sum(axis=1, keepdims=True) / count
    return np.where(seen, bands, mean)


def _cell_means(image: NDArray[np.generic], width: int, bands: int) -> NDArray[np.float64]:
    """Mean of each cell of a `bands` x `width` grid laid over an image; whole columns when they do not divide evenly."""
    import cv2

    height = image.shape[0]
    edges = [round(height * band / bands) for band in range(bands + 1)]
    rows = [cv2.reduce(image[a:b], 0, cv2.REDUCE_AVG, dtype=cv2.CV_32F) for a, b in pairwise(edges)]
    return np.asarray(cv2.resize(np.concatenate(rows), (width, bands), interpolation=cv2.INTER_AREA), dtype=np.float64)


def sees_all_around(rig: Rig) -> bool:
    """Whether the source has a laser whose field of view is a full circle (at least 355 degrees)."""
    laser = rig.sensors.get(LASER.sensor_name)
    if laser is None:
        return False
    span = float(np.ptp(laser.bearings_rad))
    return span + span / max(len(laser.bearings_rad) - 1, 1) >= FULL_CIRCLE_RAD
