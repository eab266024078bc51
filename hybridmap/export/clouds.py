"""The merged point cloud: depth or laser of every keyframe at the pose that a back-end gives it."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np

from hybridmap.errors import ExportError
from hybridmap.export.graphs import planar_matrix
from hybridmap.export.keyframes import Points, depth_points, laser_points
from hybridmap.export.view import SessionView
from hybridmap.metrics import Metric

_MERGE_EVERY = 50
_LASER_GREY = 0.25


def write_cloud(view: SessionView, path: Path) -> list[Metric]:
    """Thin the points of all keyframes to one a voxel and write PLY or PCD, by the suffix.

    Raises:
        ExportError: the session keeps neither depth nor ranges, or nothing valid in them.
    """
    import open3d as o3d

    cloud = merged_cloud(view)
    if not o3d.io.write_point_cloud(path, cloud, write_ascii=False):
        raise ExportError(f"{path.name}: Open3D could not write the point cloud")
    return [Metric(f"points/{path.suffix[1:]}", len(cloud.points), "1", f"points, one a voxel of {view.options.voxel_m} m")]


def merged_cloud(view: SessionView) -> Any:
    """The thinned cloud in `map` as an `open3d.geometry.PointCloud`.

    Raises:
        ExportError: as `write_cloud`.
    """
    import open3d as o3d

    merged = o3d.geometry.PointCloud()
    for number, cloud in enumerate(_clouds(view)):
        merged += cloud.voxel_down_sample(view.options.voxel_m)
        if number % _MERGE_EVERY == _MERGE_EVERY - 1:
            merged = merged.voxel_down_sample(view.options.voxel_m)
    if len(merged.points) == 0:
        raise ExportError("cloud: the session's keyframes hold no valid depth and no valid range; map with a camera or a laser")
    return merged.voxel_down_sample(view.options.voxel_m)


def _clouds(view: SessionView) -> Iterator[Any]:
    """The points of each keyframe in `map`."""
    import open3d as o3d

    for node, pose in enumerate(view.poses):
        points = _points(view, node)
        if points is None or len(points.xyz) == 0:
            continue
        cloud = o3d.geometry.PointCloud(o3d.utility.Vector3dVector(points.xyz))
        if points.rgb is not None:
            cloud.colors = o3d.utility.Vector3dVector(points.rgb)
        yield cloud.transform(planar_matrix(pose))


def _points(view: SessionView, node: int) -> Points | None:
    keyframe, rig = view.store.keyframe(node), view.store.rig
    if "depth_mm" in keyframe and rig.camera is not None:
        return depth_points(keyframe, rig.camera, view.options.max_depth_m)
    if "ranges_m" in keyframe and rig.laser is not None:
        ends, valid = laser_points(keyframe, rig.laser)
        xyz = np.column_stack([ends[valid], np.zeros(np.count_nonzero(valid))])
        return Points(xyz, np.full_like(xyz, _LASER_GREY))
    return None
