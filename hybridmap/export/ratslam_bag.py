"""A session as OpenRatSLAM records it: a TopologicalMap, and the TopologicalActions with odometry that it was imported from."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np

from hybridmap.errors import ExportError
from hybridmap.export.formats import SessionView
from hybridmap.geometry import Array, quaternion_from_yaw
from hybridmap.graph.edges import Edge, Status
from hybridmap.metrics import Metric
from hybridmap.store.schema import DURATION_S, RATSLAM_ACTIONS
from hybridmap.streams.ratslam_messages import ACTION, MAP, register
from hybridmap.trajectory import NS_PER_S

MAP_TOPIC, ACTION_TOPIC, ODOMETRY_TOPIC = "/ExperienceMap/Map", "/PoseCell/TopologicalAction", "/odom"
_ODOMETRY = "nav_msgs/msg/Odometry"
_PLUGINS = {".mcap": "MCAP", ".db3": "SQLITE3"}
_Written = tuple[str, str, int, Any]


def write_ratslam(view: SessionView, path: Path) -> list[Metric]:
    """Write a ROS 1 bag (`.bag`) or a file of a ROS 2 bag (`.mcap`, `.db3`) with the map as the last message.

    Experiences have the numbers and poses of the nodes, edges those of all accepted edges. The duration of an edge is the one
    that was imported, else the time between its nodes. A session that was imported from actions has these and its odometry,
    too, so that an import of the bag gives the same graph.

    Raises:
        ExportError: the path ends in none of the three.
    """
    from rosbags.typesys import Stores, get_typestore

    ros1 = path.suffix == ".bag"
    if not ros1 and path.suffix not in _PLUGINS:
        raise ExportError(f"{path.name}: a bag ends in .bag (ROS 1), {' or '.join(_PLUGINS)} (ROS 2)")
    store = get_typestore(Stores.ROS1_NOETIC if ros1 else Stores.ROS2_HUMBLE)
    register(store)
    make = _Messages(store, ros1=ros1)
    edges = [edge for edge in view.experiences.edges if edge.status is Status.ACCEPTED]
    stamp_ns = view.experiences.node(len(view.experiences) - 1).stamp_ns
    message = make.map(stamp_ns, view.poses, [(edge, _duration_ns(view, edge)) for edge in edges])
    actions = view.store.info(RATSLAM_ACTIONS) or []
    driven = list(_driven(view, make, actions)) if actions else []
    last_ns = max([stamp_ns, *(written[2] for written in driven)])
    _write(path, store, [*driven, (MAP_TOPIC, MAP, last_ns, message)])
    counts = {"nodes": len(view.poses), "edges": len(edges)} | ({"actions": len(actions)} if actions else {})
    return [Metric(f"{name}/ratslam", count, "1", f"{name} written") for name, count in counts.items()]


def _duration_ns(view: SessionView, edge: Edge) -> int:
    if DURATION_S in edge.figures:
        return round(edge.figures[DURATION_S] * NS_PER_S)
    return abs(view.experiences.node(edge.target).stamp_ns - view.experiences.node(edge.source).stamp_ns)


def _driven(view: SessionView, make: _Messages, actions: list[list[Any]]) -> Iterator[_Written]:
    """The odometry of the session, and each action after the message that it came after."""
    track = view.track
    waiting = list(reversed(actions))
    for sample, (stamp_ns, pose) in enumerate(zip(track.stamps_ns.tolist(), track.poses_odom, strict=True)):
        yield ODOMETRY_TOPIC, _ODOMETRY, stamp_ns, make.odometry(stamp_ns, pose)
        after_ns = stamp_ns
        while waiting and waiting[-1][0] <= sample:
            after_ns += 1  # readers sort by time
            yield ACTION_TOPIC, ACTION, after_ns, make.action(*waiting.pop()[1:])


class _Messages:
    """Makes messages of one type store."""

    def __init__(self, store: Any, *, ros1: bool) -> None:
        self._types, self._ros1 = store.types, ros1

    def map(self, stamp_ns: int, poses: Array, edges: list[tuple[Edge, int]]) -> Any:
        """The TopologicalMap of poses (N, 3), m and rad, and edges with their durations, ns."""
        node, edge_of = self._types["ratslam_ros/msg/TopologicalNode"], self._types["ratslam_ros/msg/TopologicalEdge"]
        transform, duration = self._types["geometry_msgs/msg/Transform"], self._types["builtin_interfaces/msg/Duration"]
        made = []
        for number, (edge, lasts_ns) in enumerate(edges):
            assert edge.relative is not None
            delta = edge.relative.delta
            moved = transform(translation=self._vector(delta[0], delta[1]), rotation=self._rotation(delta[2]))
            lasts = duration(sec=lasts_ns // NS_PER_S, nanosec=lasts_ns % NS_PER_S)
            made.append(edge_of(id=number, source_id=edge.source, destination_id=edge.target, duration=lasts, transform=moved))
        nodes = [node(id=number, pose=self._pose(pose)) for number, pose in enumerate(poses)]
        header = self._header(stamp_ns, "map")
        return self._types[MAP](header=header, node_count=len(nodes), node=nodes, edge_count=len(made), edge=made)

    def action(self, stamp_ns: int, action: int, source: int, target: int, relative_rad: float) -> Any:
        """The TopologicalAction of these values."""
        ends = {"src_id": source, "dest_id": target}
        return self._types[ACTION](header=self._header(stamp_ns, ""), action=action, relative_rad=relative_rad, **ends)

    def odometry(self, stamp_ns: int, pose: Array) -> Any:
        """The Odometry message of a pose (3,), m and rad, with a twist of zero."""
        t, zero = self._types, self._vector(0.0, 0.0)
        twist = t["geometry_msgs/msg/Twist"](linear=zero, angular=zero)
        return t[_ODOMETRY](
            header=self._header(stamp_ns, "odom"),
            child_frame_id="base_link",
            pose=t["geometry_msgs/msg/PoseWithCovariance"](pose=self._pose(pose), covariance=np.zeros(36)),
            twist=t["geometry_msgs/msg/TwistWithCovariance"](twist=twist, covariance=np.zeros(36)),
        )

    def _header(self, stamp_ns: int, frame: str) -> Any:
        stamp = self._types["builtin_interfaces/msg/Time"](sec=stamp_ns // NS_PER_S, nanosec=stamp_ns % NS_PER_S)
        return self._types["std_msgs/msg/Header"](**({"seq": 0} if self._ros1 else {}), stamp=stamp, frame_id=frame)

    def _vector(self, x: float, y: float) -> Any:
        return self._types["geometry_msgs/msg/Vector3"](x=float(x), y=float(y), z=0.0)

    def _rotation(self, yaw_rad: float) -> Any:
        return self._types["geometry_msgs/msg/Quaternion"](*quaternion_from_yaw(yaw_rad).tolist())

    def _pose(self, pose: Array) -> Any:
        point = self._types["geometry_msgs/msg/Point"](x=float(pose[0]), y=float(pose[1]), z=0.0)
        return self._types["geometry_msgs/msg/Pose"](position=point, orientation=self._rotation(pose[2]))


def _write(path: Path, store: Any, messages: list[_Written]) -> None:
    """Write messages (topic, type, time of recording in ns, message) in their order."""
    from rosbags import rosbag1, rosbag2

    ros1, folder = path.suffix == ".bag", path.with_name(f".{path.stem}")
    if ros1:
        opened: Any = rosbag1.Writer(path)
    else:
        opened = rosbag2.Writer(folder, version=8, storage_plugin=rosbag2.StoragePlugin[_PLUGINS[path.suffix]])
    serialize = store.serialize_ros1 if ros1 else store.serialize_cdr
    with opened as writer:
        connections: dict[str, Any] = {}
        for topic, msgtype, stamp_ns, message in messages:
            if topic not in connections:
                connections[topic] = writer.add_connection(topic, msgtype, typestore=store)
            writer.write(connections[topic], stamp_ns, serialize(message, msgtype))
    if not ros1:
        next(folder.glob(f"*{path.suffix}")).rename(path)
