"""The merged point cloud: what every keyframe saw, at the pose that a back-end gives it."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path
from typing import Any

from hybridmap.errors import ExportError
from hybridmap.export.graphs import planar_matrix
from hybridmap.export.view import SessionView
from hybridmap.metrics import Metric
from hybridmap.streams.sensors import see

_MERGE_EVERY = 50


def write_cloud(view: SessionView, path: Path) -> list[Metric]:
    """Thin the points of all keyframes to one a voxel and write PLY or PCD, by the suffix.

    Raises:
        ExportError: the session's keyframes hold no point.
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
        raise ExportError("cloud: the session's keyframes hold no point; map with a sensor that measures distances")
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
        yield cloud.transform(planar_matrix(pose))
