"""Poses for other tools: trajectories as TUM and KITTI, the graph as g2o, Open3D LineSet, Open3D PoseGraph."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from hybridmap.errors import ExportError
from hybridmap.export.formats import SessionView
from hybridmap.geometry import Array, RelativePose, invert_relative
from hybridmap.graph.edges import Edge, EdgeKind, Status
from hybridmap.graph.io import write_g2o
from hybridmap.metrics import Metric
from hybridmap.output import write_text
from hybridmap.trajectory import write_tum
from hybridmap.vision.rgbd.stance import from_planar

_COLORS = {
    EdgeKind.ODOMETRY: (0.30, 0.35, 0.45),
    EdgeKind.REGISTRATION: (0.15, 0.60, 0.35),
    EdgeKind.LOOP: (0.85, 0.25, 0.20),
    EdgeKind.MANUAL: (0.55, 0.25, 0.70),
}
_REJECTED_COLOR = (0.95, 0.75, 0.35)
_PLANAR = (3, 4, 2)
"""Where x, y and yaw stand in Open3D's order: three rotations, three translations."""


def write_g2o_graph(view: SessionView, path: Path) -> list[Metric]:
    """Write a g2o file with 17 significant digits: the nodes at the back-end's poses and all accepted edges.

    Edges that the back-end rejected are among them.
    """
    graph = view.experiences.pose_graph()
    write_g2o(path, graph, view.poses)
    return _counts("g2o", graph.n_nodes, graph.n_edges)


def write_lineset(view: SessionView, path: Path) -> list[Metric]:
    """Write an Open3D LineSet: nodes as points in the plane z = 0, accepted edges as lines.

    Odometry edges are grey, registration edges green, loops red, and loops that the back-end rejected yellow.

    Raises:
        ExportError: the graph has no edge; Open3D cannot read such a file.
    """
    import open3d as o3d

    edges = _accepted(view)
    if not edges:
        raise ExportError("lineset: the graph has no edge; a LineSet without lines cannot be read back")
    points = np.column_stack([view.poses[:, :2], np.zeros(len(view.poses))])
    lines = np.array([(edge.source, edge.target) for edge in edges.values()], dtype=np.int32)
    colors = [_REJECTED_COLOR if n in view.rejected else _COLORS[edge.kind] for n, edge in edges.items()]
    drawn = o3d.geometry.LineSet(o3d.utility.Vector3dVector(points), o3d.utility.Vector2iVector(lines))
    drawn.colors = o3d.utility.Vector3dVector(np.array(colors))
    if not o3d.io.write_line_set(path, drawn):
        raise ExportError(f"{path.name}: Open3D could not write the LineSet")
    return _counts("lineset", len(points), len(lines))


def write_posegraph(view: SessionView, path: Path) -> list[Metric]:
    """Write an Open3D PoseGraph: nodes hold `T_map_node`, edges the source's pose seen from the target; loops are `uncertain`.

    All accepted edges are written, those that the back-end rejected too. The information out of the plane equals the largest
    one within it, so that Open3D's optimiser stays planar.

    Raises:
        ExportError: the graph has no edge; Open3D cannot read such a file.
    """
    import open3d as o3d

    edges = _accepted(view)
    if not edges:
        raise ExportError("posegraph: the graph has no edge, and Open3D cannot read a PoseGraph without edges")
    registration = o3d.pipelines.registration
    drawn = registration.PoseGraph()
    for pose in view.poses:
        drawn.nodes.append(registration.PoseGraphNode(from_planar(pose)))
    for edge in edges.values():
        assert edge.relative is not None
        turned = invert_relative(edge.relative)
        uncertain = edge.kind is EdgeKind.LOOP
        matrix, information = from_planar(turned.delta), _spatial_information(turned)
        drawn.edges.append(registration.PoseGraphEdge(edge.source, edge.target, matrix, information, uncertain))
    o3d.io.write_pose_graph(path, drawn)
    if not path.is_file():
        raise ExportError(f"{path.name}: Open3D could not write the PoseGraph")
    return _counts("posegraph", len(drawn.nodes), len(drawn.edges))


def _spatial_information(relative: RelativePose) -> Array:
    planar = np.linalg.inv(relative.covariance)
    information = np.eye(6) * float(np.max(np.diag(planar)))
    information[np.ix_(_PLANAR, _PLANAR)] = 0.5 * (planar + planar.T)
    return information


def _accepted(view: SessionView) -> dict[int, Edge]:
    return {number: edge for number, edge in enumerate(view.experiences.edges) if edge.status is Status.ACCEPTED}


def _counts(name: str, nodes: int, edges: int) -> list[Metric]:
    return [Metric(f"nodes/{name}", nodes, "1", "nodes written"), Metric(f"edges/{name}", edges, "1", "edges written")]


def write_tum_trajectory(view: SessionView, path: Path) -> list[Metric]:
    """Write a TUM trajectory: `stamp x y z qx qy qz qw` of `base_link` in `map`, a line for every stamp; s and m."""
    write_tum(path, view.trajectory)
    return [Metric("poses/tum", len(view.trajectory), "1", "poses written")]


def write_kitti_trajectory(view: SessionView, path: Path) -> list[Metric]:
    """Write a KITTI trajectory: the upper 3x4 of `T_map_base`, row by row, one line per stamp; z points up.

    The file holds no stamps; they are those of the `tum` export of the same session.
    """
    poses = view.trajectory.poses
    cos, sin, zero, one = np.cos(poses[:, 2]), np.sin(poses[:, 2]), np.zeros(len(poses)), np.ones(len(poses))
    rows = np.stack([cos, -sin, zero, poses[:, 0], sin, cos, zero, poses[:, 1], zero, zero, one, zero], axis=1)
    write_text(path, "".join(" ".join(f"{value + 0.0:.17g}" for value in row) + "\n" for row in rows))
    return [Metric("poses/kitti", len(poses), "1", "poses written")]
