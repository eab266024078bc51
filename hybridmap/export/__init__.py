"""Export of sessions: trajectories, graphs, clouds, grids. The formats are listed here; `formats` writes them."""

from __future__ import annotations

from dataclasses import dataclass


@dataclass(frozen=True, slots=True)
class Format:
    """An export format.

    Attributes:
        writer: `module:function` below this package: (view, path) -> metrics of the file that it writes.
        suffix: usual suffix of the file.
        description: one line for people.
        companion: suffix of a second file of the same name that the writer writes beside it; None if there is only one.
        by_suffix: whether Open3D needs this suffix to read the file; another suffix is then refused.
        of_pieces: whether a map in pieces that are not joined can be written without looking like one map: it shows the newest
            session alone, or says which nodes are joined.
    """

    writer: str
    suffix: str
    description: str
    companion: str | None = None
    by_suffix: bool = False
    of_pieces: bool = False


FORMATS: dict[str, Format] = {
    "tum": Format("poses:write_tum_trajectory", ".tum", "trajectory: stamp, position, quaternion per line", of_pieces=True),
    "kitti": Format(
        "poses:write_kitti_trajectory", ".txt", "trajectory: the 12 numbers of a 3x4 pose per line", of_pieces=True
    ),
    "g2o": Format("poses:write_g2o_graph", ".g2o", "pose graph: VERTEX_SE2, EDGE_SE2", of_pieces=True),
    "lineset": Format("poses:write_lineset", ".ply", "graph as an Open3D LineSet, edges coloured by kind", by_suffix=True),
    "posegraph": Format("poses:write_posegraph", ".json", "graph as an Open3D PoseGraph", by_suffix=True),
    "ratslam": Format(
        "ratslam_bag:write_ratslam", ".bag", "graph as OpenRatSLAM's TopologicalMap in a bag (.bag, .mcap, .db3)"
    ),
    "ply": Format("keyframes:write_cloud", ".ply", "merged point cloud, PLY", by_suffix=True),
    "pcd": Format("keyframes:write_cloud", ".pcd", "merged point cloud, PCD", by_suffix=True),
    "grid": Format("keyframes:write_grid", ".yaml", "occupancy grid for map_server, yaml and pgm", ".pgm"),
}
"""A new format is a row here and its writer. The command line reads it without loading what writes."""
