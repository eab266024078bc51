"""What the node publishes, as plain fields: the same for ROS 1 and ROS 2, and testable without either.

A message is a dictionary of its fields, a stamp a `Stamp`, and a list of messages a list of dictionaries.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from hybridmap.export.keyframes import OccupancyGrid
from hybridmap.geometry import Array, yaw_from_quaternion
from hybridmap.graph.edges import EdgeKind
from hybridmap.live import LiveReport, Snapshot
from hybridmap.trajectory import NS_PER_S

Contents = Mapping[str, Any]

OCCUPIED, FREE, UNKNOWN = 100, 0, -1
"""Cells of nav_msgs/OccupancyGrid."""
_COLORS = {
    EdgeKind.ODOMETRY: (0.5, 0.5, 0.5),
    EdgeKind.REGISTRATION: (0.2, 0.4, 1.0),
    EdgeKind.LOOP: (1.0, 0.3, 0.1),
    EdgeKind.MANUAL: (1.0, 0.0, 1.0),
}
_NODE_COLOR = (0.1, 0.8, 0.2)
_NODE_M, _LINE_M = 0.1, 0.03
_POINTS, _LINE_LIST, _ADD = 8, 5, 0
_OK, _WARN, _ERROR = 0, 1, 2


@dataclass(frozen=True, slots=True)
class Stamp:
    """A time of ROS, ns."""

    ns: int

    @property
    def parts(self) -> tuple[int, int]:
        """Whole seconds, and nanoseconds."""
        return divmod(self.ns, NS_PER_S)


def header(stamp_ns: int, frame: str) -> Contents:
    """std_msgs/Header."""
    return {"stamp": Stamp(stamp_ns), "frame_id": frame}


def _pose(pose: Array) -> Contents:
    """geometry_msgs/Pose of a planar pose (3,)."""
    return {"position": {"x": float(pose[0]), "y": float(pose[1])}, "orientation": _quaternion(float(pose[2]))}


def _quaternion(yaw_rad: float) -> Contents:
    return {"z": float(np.sin(yaw_rad / 2)), "w": float(np.cos(yaw_rad / 2))}


def transform(stamp_ns: int, parent: str, child: str, pose_parent_child: Array) -> Contents:
    """geometry_msgs/TransformStamped of a planar pose (3,), m and rad."""
    x, y, yaw_rad = (float(value) for value in pose_parent_child)
    return {
        "header": header(stamp_ns, parent),
        "child_frame_id": child,
        "transform": {"translation": {"x": x, "y": y}, "rotation": _quaternion(yaw_rad)},
    }


def pose_with_covariance(stamp_ns: int, frame: str, pose: Array, covariance: Array | None) -> Contents:
    """geometry_msgs/PoseWithCovarianceStamped.

    Args:
        stamp_ns, frame: of the header.
        pose: (3,) in the frame, m and rad.
        covariance: (3, 3) of x, y and heading in the robot's own frame, m^2 and rad^2; None if unknown: zeros.
    """
    full = np.zeros((6, 6))
    if covariance is not None:
        c, s = np.cos(pose[2]), np.sin(pose[2])
        R = np.array([[c, -s, 0.0], [s, c, 0.0], [0.0, 0.0, 1.0]])
        full[np.ix_((0, 1, 5), (0, 1, 5))] = R @ covariance @ R.T
    return {"header": header(stamp_ns, frame), "pose": {"pose": _pose(pose), "covariance": full.ravel().tolist()}}


def path(frame: str, snapshot: Snapshot) -> Contents:
    """nav_msgs/Path: the nodes of the map in order of the drive."""
    stamped = zip(snapshot.stamps_ns.tolist(), snapshot.poses, strict=True)
    poses = [{"header": header(stamp_ns, frame), "pose": _pose(pose)} for stamp_ns, pose in stamped]
    return {"header": header(snapshot.stamp_ns, frame), "poses": poses}


def graph(frame: str, snapshot: Snapshot) -> Contents:
    """visualization_msgs/MarkerArray: the nodes as points, and the edges of each kind as lines of one colour."""
    head = header(snapshot.stamp_ns, frame)
    markers = [_marker(head, "nodes", _POINTS, _NODE_M, _NODE_COLOR, snapshot.poses[:, :2])]
    for kind, color in _COLORS.items():
        ends = snapshot.edges[snapshot.kinds == kind]
        points = snapshot.poses[ends.ravel(), :2]
        markers.append(_marker(head, f"{kind.name.lower()} edges", _LINE_LIST, _LINE_M, color, points))
    return {"markers": markers}


def _marker(head: Contents, name: str, kind: int, size_m: float, rgb: Sequence[float], points: Array) -> Contents:
    return {
        "header": head,
        "ns": name,
        "type": kind,
        "action": _ADD,
        "pose": _pose(np.zeros(3)),
        "scale": {"x": size_m, "y": size_m},
        "color": dict(zip("rgba", (*rgb, 1.0), strict=True)),
        "points": [{"x": x, "y": y} for x, y in points.tolist()],
    }


def metadata(stamp_ns: int, grid: OccupancyGrid) -> Contents:
    """nav_msgs/MapMetaData."""
    height, width = grid.log_odds.shape
    return {
        "map_load_time": Stamp(stamp_ns),
        "resolution": grid.resolution_m,
        "width": width,
        "height": height,
        "origin": _pose(np.array([*grid.origin_m, 0.0])),
    }


def occupancy(stamp_ns: int, frame: str, grid: OccupancyGrid) -> Contents:
    """nav_msgs/OccupancyGrid: 100 occupied, 0 free, -1 unknown, by the thresholds of the files of `map_server`."""
    cells = np.full(grid.log_odds.shape, UNKNOWN, dtype=np.int8)
    cells[grid.occupied] = OCCUPIED
    cells[grid.free] = FREE
    return {"header": header(stamp_ns, frame), "info": metadata(stamp_ns, grid), "data": cells.ravel()}


def diagnostics(stamp_ns: int, name: str, report: LiveReport | None, sentences: Sequence[str]) -> Contents:
    """diagnostic_msgs/DiagnosticArray of one status: what is wrong, in sentences, and figures.

    Args:
        stamp_ns: of the header.
        name: of the node.
        report: of the mapper; None before it has begun.
        sentences: what is wrong; empty if nothing.
    """
    state = "waiting" if report is None else report.state
    level = _ERROR if state == "failed" else _WARN if sentences or report is None else _OK
    figures: dict[str, Any] = {"state": state}
    if report is not None:
        figures |= {"nodes": report.nodes, "lag, s": f"{report.lag_s:.3f}", "largest lag, s": f"{report.largest_lag_s:.3f}"}
        figures |= {"waiting for odometry, s": f"{report.waiting_s:.3f}"}
        figures |= {f"samples of {source}": count for source, count in report.samples.items()}
        left_out = ((source, why, count) for source, reasons in report.dropped.items() for why, count in reasons.items())
        figures |= {f"left out of {source}: {why}": count for source, why, count in left_out}
    values = [{"key": key, "value": str(value)} for key, value in figures.items()]
    status = {"level": level, "name": name, "message": "; ".join(sentences) or state, "hardware_id": "", "values": values}
    return {"header": header(stamp_ns, ""), "status": [status]}


def pose_in(message: Any) -> Array:
    """(3,) x, y and heading of the pose in a geometry_msgs/PoseWithCovarianceStamped, m and rad."""
    position, q = message.pose.pose.position, message.pose.pose.orientation
    return np.array([position.x, position.y, float(yaw_from_quaternion(q.x, q.y, q.z, q.w))])
