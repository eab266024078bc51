"""What a keyframe shows from above, and many of them as one picture of the building."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from hybridmap.geometry import Array, transform_points
from hybridmap.store import MapStore
from hybridmap.streams.base import Camera, Laser, Rig

_HEIGHTS_M = (0.1, 2.0)
_DEPTH_COLUMNS = 80
_MAX_DEPTH_M = 6.0
_MAX_KEYFRAMES = 1500
_PIXELS = 900
_FAINTEST = 0.3


@dataclass(frozen=True, slots=True)
class Raster:
    """A picture of the building from above.

    Attributes:
        grey: (H, W) in [0, 1], 0 where nothing was seen; row 0 is the lowest y.
        extent: left, right, bottom, top, m.
    """

    grey: NDArray[np.float32]
    extent: tuple[float, float, float, float]


def outline(keyframe: Mapping[str, NDArray[Any]], rig: Rig) -> Array:
    """Points (M, 2) of what a node saw, in `base_link`, m; empty where it saw nothing that can be drawn."""
    if "ranges_m" in keyframe and rig.laser is not None:
        return _laser_points(keyframe["ranges_m"], rig.laser)
    if "depth_mm" in keyframe and rig.camera is not None:
        return _depth_points(keyframe["depth_mm"], rig.camera)
    return np.zeros((0, 2))


def outlines(store: MapStore, count: int) -> dict[int, Array]:
    """Node -> points in `base_link`, for `count` nodes, or for evenly spaced ones where there are very many."""
    rig = store.rig
    step = max(1, -(-count // _MAX_KEYFRAMES))
    found = {node: outline(store.keyframe(node), rig) for node in range(0, count, step)}
    return {node: points for node, points in found.items() if len(points)}


def raster(points_of: Mapping[int, Array], poses: Array) -> Raster | None:
    """Draw the points of every node at its pose (N, 3); None where there is none."""
    placed = [transform_points(poses[node], points) for node, points in points_of.items() if node < len(poses)]
    if not placed:
        return None
    points = np.concatenate(placed)
    low, high = np.percentile(points, [0.2, 99.8], axis=0)
    low, high = low - 0.5, high + 0.5
    cell_m = max(0.02, float((high - low).max()) / _PIXELS)
    bins = np.maximum(np.ceil((high - low) / cell_m).astype(int), 1)
    top = low + bins * cell_m
    counts, _, _ = np.histogram2d(points[:, 0], points[:, 1], bins=tuple(bins), range=np.stack([low, top], axis=1))
    seen = counts[counts > 0]
    full = float(np.percentile(seen, 90)) if len(seen) else 1.0
    strength = np.minimum(np.log1p(counts.T) / np.log1p(full), 1.0)
    grey = np.where(counts.T > 0, _FAINTEST + (1.0 - _FAINTEST) * strength, 0.0).astype(np.float32)
    return Raster(grey, (float(low[0]), float(top[0]), float(low[1]), float(top[1])))


def _laser_points(ranges_m: NDArray[Any], laser: Laser) -> Array:
    ranges = np.asarray(ranges_m, dtype=np.float64)
    seen = np.isfinite(ranges) & (ranges >= laser.range_min_m) & (ranges < laser.range_max_m)
    bearing, distance = laser.bearings_rad[seen], ranges[seen]
    points = np.column_stack([distance * np.cos(bearing), distance * np.sin(bearing)])
    return transform_points(laser.pose_base_laser, points)


def _depth_points(depth_mm: NDArray[Any], camera: Camera) -> Array:
    height, width = depth_mm.shape
    step = max(1, width // _DEPTH_COLUMNS)
    v, u = np.mgrid[0:height:step, 0:width:step]
    depth = depth_mm[::step, ::step].astype(np.float64) / 1000.0
    seen = (depth > 0) & (depth < _MAX_DEPTH_M)
    u, v, z = u[seen] * (camera.width_px / width), v[seen] * (camera.height_px / height), depth[seen]
    x, y = (u - camera.cx_px) / camera.fx_px * z, (v - camera.cy_px) / camera.fy_px * z
    base = np.column_stack([x, y, z]) @ camera.T_base_camera[:3, :3].T + camera.T_base_camera[:3, 3]
    return np.asarray(base[(base[:, 2] > _HEIGHTS_M[0]) & (base[:, 2] < _HEIGHTS_M[1]), :2])
