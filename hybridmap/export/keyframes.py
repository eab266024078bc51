"""Point clouds and occupancy grids (for `map_server`), merged from the keyframes at the poses of a back-end.

The grid has log-odds as in S. Thrun, W. Burgard, D. Fox, "Probabilistic Robotics", 2005, section 9.2; its files are as
documented by `map_server` (trinary mode).
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from hybridmap.errors import ExportError
from hybridmap.export.carving import swept
from hybridmap.export.costs import costs
from hybridmap.export.formats import ExportOptions, SessionView
from hybridmap.geometry import Array, compose, transform_points
from hybridmap.metrics import Metric
from hybridmap.output import write_text
from hybridmap.streams.base import Seen
from hybridmap.streams.sensors import see
from hybridmap.vision.rgbd.stance import from_planar

_HIT, _MISS, _LIMIT = 0.9, -0.4, 4.0
"""Log-odds that a return adds to its cell, that a beam passing adds, and where they saturate."""

_OCCUPIED, _FREE, _UNKNOWN = 0, 254, 205
_OCCUPIED_THRESHOLD, _FREE_THRESHOLD = 0.65, 0.1
"""Of `map_server`. An unknown pixel reads as 0.196; with nav2's usual 0.25 as the second limit it would be free."""
_MARGIN_CELLS = 10
_SHIFT = 4
"""Fractional bits of OpenCV's polygon corners."""
_BEAM_GAP_RAD = np.radians(5.0)
_MAX_CELLS = 400_000_000
_COVERED_SHARE = 0.1
"""Of the occupied cells, which a robot of the given size may have driven over; of real drives it is at most 0.02."""
_MERGE_EVERY = 50
"""Keyframes after which the cloud is thinned anew."""


@dataclass(frozen=True, slots=True)
class OccupancyGrid:
    """An occupancy grid.

    Attributes:
        log_odds: (H, W) float32; positive is occupied, negative free, zero unknown; row 0 has the smallest y.
        origin_m: (2,) position in `map` of the lower left corner of cell (0, 0).
        resolution_m: side of a cell.
    """

    log_odds: NDArray[np.float32]
    origin_m: Array
    resolution_m: float

    @property
    def occupied(self) -> NDArray[np.bool_]:
        """(H, W) cells that are occupied, by `map_server`'s threshold."""
        return 1.0 / (1.0 + np.exp(-self.log_odds)) > _OCCUPIED_THRESHOLD

    @property
    def free(self) -> NDArray[np.bool_]:
        """(H, W) cells that are free; the others are unknown."""
        return 1.0 / (1.0 + np.exp(-self.log_odds)) < 1.0 - _OCCUPIED_THRESHOLD


@dataclass(frozen=True, slots=True)
class _Fan:
    """Beams of one keyframe in `map`: where they start (2,), where they return (K, 2), and the bearing of each (K,)."""

    origin: Array
    ends: Array
    bearings: Array


def write_grid(view: SessionView, path: Path) -> list[Metric]:
    """Write an occupancy grid: `path` (yaml) and a picture of the same name beside it (pgm); returns its size and areas.

    Pixels are 0 for occupied, 254 for free, 205 for unknown; the top row has the largest y. If the options ask for an
    inflation, the pixels are costs (see `costs`).

    Raises:
        ExportError: the session's keyframes hold no obstacle, or the grid would be too large.
    """
    grid, options = build_grid(view), view.options
    if options.inflation_m is None:
        return write_picture(grid, path)
    pixels = costs(grid.occupied, grid.free, grid.resolution_m, options.footprint.radius_m, options.inflation_m)
    return _write(grid, pixels, "raw", path)


def write_picture(grid: OccupancyGrid, path: Path) -> list[Metric]:
    """Write a grid as `write_grid` does without costs."""
    picture: NDArray[np.uint8] = np.full(grid.log_odds.shape, _UNKNOWN, dtype=np.uint8)
    picture[grid.occupied] = _OCCUPIED
    picture[grid.free] = _FREE
    return _write(grid, picture, "trinary", path)


def _write(grid: OccupancyGrid, pixels: NDArray[np.uint8], mode: str, path: Path) -> list[Metric]:
    """Write pixels (H, W) of a grid and what they mean, as `map_server` reads them in that mode."""
    height, width = pixels.shape
    image = path.with_suffix(".pgm")
    image.write_bytes(f"P5\n{width} {height}\n255\n".encode() + pixels[::-1].tobytes())
    write_text(
        path,
        f"image: {image.name}\n"
        f"mode: {mode}\n"
        f"resolution: {grid.resolution_m:.17g}\n"
        f"origin: [{grid.origin_m[0]:.17g}, {grid.origin_m[1]:.17g}, 0.0]\n"
        f"negate: 0\n"
        f"occupied_thresh: {_OCCUPIED_THRESHOLD}\n"
        f"free_thresh: {_FREE_THRESHOLD}\n",
    )
    cell = grid.resolution_m**2
    return [
        Metric("size/grid", width * height, "1", f"cells, {width} x {height} of {grid.resolution_m} m"),
        Metric("occupied/grid", float(np.count_nonzero(grid.occupied)) * cell, "m^2", "area found occupied"),
        Metric("free/grid", float(np.count_nonzero(grid.free)) * cell, "m^2", "area found free"),
    ]


def build_grid(view: SessionView) -> OccupancyGrid:
    """Build an occupancy grid in `map`. Nothing is written.

    Every keyframe is ray-cast, at the pose of its node, into log-odds. Then the cells that the robot drove over are free.

    Raises:
        ExportError: the session's keyframes hold no obstacle within the limits of the options, the grid would be too large, or
            the robot's footprint covers much of what is occupied.
    """
    fans = list(_fans(view))
    if not fans:
        raise ExportError(f"grid: the session's keyframes hold no obstacle{_far(view.options)}")
    resolution = view.options.resolution_m
    footprint, ways = view.options.footprint, np.concatenate(view.driven)[:, :2]
    around = [ways.min(axis=0) - footprint.reach_m, ways.max(axis=0) + footprint.reach_m]
    corners = np.concatenate([around, *(np.vstack([fan.origin[None], fan.ends]) for fan in fans)])
    low = np.floor(corners.min(axis=0) / resolution).astype(np.int64) - _MARGIN_CELLS
    size = np.floor(corners.max(axis=0) / resolution).astype(np.int64) + _MARGIN_CELLS + 1 - low
    if size[0] * size[1] > _MAX_CELLS:
        raise ExportError(f"grid: {size[0]} x {size[1]} cells of {resolution} m are too many; give a coarser --resolution")
    log_odds = np.zeros((int(size[1]), int(size[0])), np.float32)
    for fan in fans:
        _cast(log_odds, fan, low, resolution)
    grid = OccupancyGrid(log_odds, low * resolution, resolution)
    covered = swept(log_odds.shape, low * resolution, resolution, view.driven, footprint)
    occupied, against = np.count_nonzero(grid.occupied), np.count_nonzero(grid.occupied & covered)
    if against > _COVERED_SHARE * occupied:
        raise ExportError(
            f"footprint: a robot that reaches {footprint.reach_m:.3g} m from base_link would have driven over {against} of the"
            f" {occupied} occupied cells; expected its true size, in m, which covers hardly any"
        )
    log_odds[covered] = -_LIMIT
    return grid


def _far(options: ExportOptions) -> str:
    """What to do where no keyframe has a point."""
    return f" up to {options.max_depth_m:g} m; map with a laser or a depth camera, or give a larger --max-depth"


def _cast(log_odds: NDArray[np.float32], fan: _Fan, low: NDArray[np.int64], resolution: float) -> None:
    """Add one keyframe: cells with a return gain, cells that a beam passes lose."""
    import cv2

    origin = fan.origin / resolution - low
    ends = fan.ends / resolution - low
    cells = np.floor(ends).astype(np.int64)
    window = np.floor(np.vstack([ends, origin[None]])).astype(np.int64)
    first, last = window.min(axis=0) - 1, window.max(axis=0) + 2
    passed = np.zeros((int(last[1] - first[1]), int(last[0] - first[0])), np.uint8)
    corners = np.rint((_wedges(origin, ends, fan.bearings) - first - 0.5) * (1 << _SHIFT)).astype(np.int32)
    if len(corners):
        cv2.fillPoly(passed, [corners], 1, shift=_SHIFT)
    hit = np.zeros_like(passed)
    hit[cells[:, 1] - first[1], cells[:, 0] - first[0]] = 1
    part = log_odds[first[1] : last[1], first[0] : last[0]]
    part += np.where(hit > 0, np.float32(_HIT), np.where(passed > 0, np.float32(_MISS), np.float32(0.0)))
    np.clip(part, -_LIMIT, _LIMIT, out=part)


def _wedges(origin: Array, ends: Array, bearings: Array) -> Array:
    """(3 W, 2) corners of the triangles between neighbouring beams, each as far as the shorter of its two reaches."""
    near = np.flatnonzero(np.diff(bearings) <= _BEAM_GAP_RAD)
    reach = np.maximum(np.linalg.norm(ends - origin, axis=1), 1e-9)
    shorter = np.minimum(reach[near], reach[near + 1])
    left = origin + (ends[near] - origin) * (shorter / reach[near])[:, None]
    right = origin + (ends[near + 1] - origin) * (shorter / reach[near + 1])[:, None]
    return np.stack([np.broadcast_to(origin, left.shape), left, right], axis=1).reshape(-1, 2)


def _fans(view: SessionView) -> Iterator[_Fan]:
    rig = view.store.rig
    for node, pose in enumerate(view.poses):
        seen = see(view.store.keyframe(node), rig, view.options.max_depth_m)
        if seen is None:
            continue
        fan = _fan(seen, view.options)
        if len(fan.ends):
            yield _Fan(compose(pose, [*fan.origin, 0.0])[:2], transform_points(pose, fan.ends), fan.bearings)


def _fan(seen: Seen, options: ExportOptions) -> _Fan:
    """The beams of a level sweep; of points of any height the nearest obstacle in each column of bearings."""
    if seen.bearings is not None:
        order = np.argsort(seen.bearings, kind="stable")
        return _Fan(seen.origin, seen.xyz[order, :2], seen.bearings[order])
    points, origin = seen.xyz, seen.origin
    tall = (points[:, 2] >= options.obstacle_low_m) & (points[:, 2] <= options.obstacle_high_m)
    offset = points[tall, :2] - origin
    bearing, reach = np.arctan2(offset[:, 1], offset[:, 0]), np.hypot(offset[:, 0], offset[:, 1])
    column = np.floor(bearing / seen.column_rad).astype(np.int64)
    order = np.lexsort((reach, column))
    _, first = np.unique(column[order], return_index=True)
    nearest = order[first]
    return _Fan(origin, origin + offset[nearest], bearing[nearest])


def write_cloud(view: SessionView, path: Path) -> list[Metric]:
    """Write the points of all keyframes in `map`, m, reduced to one per voxel, as PLY or PCD by the suffix of `path`.

    Raises:
        ExportError: the session's keyframes hold no point.
    """
    import open3d as o3d

    cloud = merged_cloud(view)
    if not o3d.io.write_point_cloud(path, cloud, write_ascii=False):
        raise ExportError(f"{path.name}: Open3D could not write the point cloud")
    return [Metric(f"points/{path.suffix[1:]}", len(cloud.points), "1", f"points, one a voxel of {view.options.voxel_m} m")]


def merged_cloud(view: SessionView) -> Any:
    """The points of all keyframes in `map`, reduced to one per voxel, as an `open3d.geometry.PointCloud`.

    Raises:
        ExportError: the session's keyframes hold no point.
    """
    import open3d as o3d

    merged = o3d.geometry.PointCloud()
    for number, cloud in enumerate(_clouds(view)):
        merged += cloud.voxel_down_sample(view.options.voxel_m)
        if number % _MERGE_EVERY == _MERGE_EVERY - 1:
            merged = merged.voxel_down_sample(view.options.voxel_m)
    if len(merged.points) == 0:
        raise ExportError(f"cloud: the session's keyframes hold no point{_far(view.options)}")
    return merged.voxel_down_sample(view.options.voxel_m)


def _clouds(view: SessionView) -> Iterator[Any]:
    """The points of each keyframe in `map`."""
    import open3d as o3d

    rig = view.store.rig
    for node, pose in enumerate(view.poses):
        seen = see(view.store.keyframe(node), rig, view.options.max_depth_m)
        if seen is None or len(seen.xyz) == 0:
            continue
        cloud = o3d.geometry.PointCloud(o3d.utility.Vector3dVector(seen.xyz))
        if seen.rgb is not None:
            cloud.colors = o3d.utility.Vector3dVector(seen.rgb)
        yield cloud.transform(from_planar(pose))
