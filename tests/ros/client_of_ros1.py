"""A client of `hybridmap ros1`: publishes a bag, listens, calls every service, and prints what it found as JSON."""

from __future__ import annotations

import json
import sys
import threading
import time
from pathlib import Path
from typing import Any

import numpy as np
import rospy
from geometry_msgs.msg import PoseWithCovarianceStamped, TransformStamped
from nav_msgs.msg import OccupancyGrid, Odometry
from nav_msgs.msg import Path as PathMessage
from nav_msgs.srv import GetMap
from sensor_msgs.msg import LaserScan
from std_srvs.srv import Empty, SetBool, Trigger
from tf2_msgs.msg import TFMessage
from visualization_msgs.msg import MarkerArray

from hybridmap.geometry import compose
from hybridmap.streams.bagfile import BagFile

CLASSES = {"nav_msgs/msg/Odometry": Odometry, "sensor_msgs/msg/LaserScan": LaserScan, "tf2_msgs/msg/TFMessage": TFMessage}


def planar(position: Any, q: Any) -> np.ndarray:
    return np.array([position.x, position.y, 2 * np.arctan2(q.z, q.w)])


class Client:
    """Publishes the bag, and keeps what it hears."""

    def __init__(self, bag: Path) -> None:
        self.bag = BagFile(bag)
        self.publishers = {
            topic.name: rospy.Publisher(topic.name, CLASSES[topic.msgtype], queue_size=1000, latch=topic.name == "/tf_static")
            for topic in self.bag.topics
        }
        self.last: dict[str, Any] = {}
        self.frames: set[tuple[str, str]] = set()
        self.corrections: list[np.ndarray] = []
        self.odometry: dict[int, np.ndarray] = {}
        self.poses: dict[int, np.ndarray] = {}
        rospy.Subscriber("/tf", TFMessage, self.heard_tf)
        rospy.Subscriber("/hybridmap/map_to_odom", TransformStamped, self.heard_correction)
        rospy.Subscriber("/hybridmap/pose", PoseWithCovarianceStamped, self.heard_pose)
        for name, kind in (("/floor", OccupancyGrid), ("/hybridmap/path", PathMessage), ("/hybridmap/graph", MarkerArray)):
            rospy.Subscriber(name, kind, lambda message, name=name: self.last.__setitem__(name, message))

    def heard_tf(self, message: TFMessage) -> None:
        for one in message.transforms:
            self.frames.add((one.header.frame_id, one.child_frame_id))

    def heard_correction(self, message: TransformStamped) -> None:
        self.corrections.append(planar(message.transform.translation, message.transform.rotation))

    def heard_pose(self, message: PoseWithCovarianceStamped) -> None:
        self.poses[message.header.stamp.to_nsec()] = planar(message.pose.pose.position, message.pose.pose.orientation)

    def play(self, times_real_time: float, from_s: float = -1.0, until_s: float = 1e9) -> None:
        began_s, first_ns = time.monotonic(), None
        for raw in self.bag.raw(self.publishers):
            message = CLASSES[self.bag.types[raw.topic]]().deserialize(raw.data)
            if raw.topic != "/tf_static":
                stamp_ns = message.header.stamp.to_nsec()
                first_ns = stamp_ns if first_ns is None else first_ns
                after_s = (stamp_ns - first_ns) / 1e9
                if not from_s < after_s <= until_s:
                    continue
                time.sleep(max(0.0, (after_s - max(from_s, 0.0)) / times_real_time - (time.monotonic() - began_s)))
            if raw.topic == "/odom":
                self.odometry[stamp_ns] = planar(message.pose.pose.position, message.pose.pose.orientation)
            self.publishers[raw.topic].publish(message)

    def wait_for(self, there: Any) -> None:
        until_s = time.monotonic() + 90.0
        while not there():
            if time.monotonic() > until_s:
                sys.exit(f"waited in vain; heard {sorted(self.last)}, {len(self.poses)} poses")
            time.sleep(0.1)


def call(name: str, kind: Any, *arguments: Any) -> Any:
    rospy.wait_for_service(name, 30.0)
    return rospy.ServiceProxy(name, kind)(*arguments)


def services() -> dict[str, Any]:
    answers: dict[str, Any] = {}
    for name in ("save_map", "serialize_map", "deserialize_map"):
        answer = call(f"/hybridmap/{name}", Trigger)
        answers[name] = [answer.success, answer.message]
    answer = call("/hybridmap/set_localization_mode", SetBool, True)
    answers["set_localization_mode"] = [answer.success, answer.message]
    for name in ("pause", "resume"):
        call(f"/hybridmap/{name}", Empty)
        answers[name] = "done"
    cells = call("/dynamic_map", GetMap).map.data
    answers["dynamic_map"] = [len(cells), cells.count(100), cells.count(0)]
    return answers


def main() -> None:
    rospy.init_node("client", disable_signals=True)
    client = Client(Path(sys.argv[1]))
    client.wait_for(lambda: all(client.publishers[name].get_num_connections() for name in ("/odom", "/scan")))
    threading.Event().wait(0.5)
    client.play(4.0, until_s=8.0)
    client.wait_for(lambda: client.poses)
    client.play(4.0, from_s=8.0)
    client.wait_for(lambda: {"/floor", "/hybridmap/path", "/hybridmap/graph"} <= set(client.last) and client.poses)
    time.sleep(1.0)
    off = [
        min(np.hypot(*(compose(correction, client.odometry[stamp]) - pose)[:2]) for correction in client.corrections)
        for stamp, pose in client.poses.items()
    ]
    found = {
        "tf_frames": sorted(client.frames),
        "poses": len(client.poses),
        "pose_from_correction_median_m": float(np.median(off)),
        "path_nodes": len(client.last["/hybridmap/path"].poses),
        "graph_markers": len(client.last["/hybridmap/graph"].markers),
        "map": [len(client.last["/floor"].data), client.last["/floor"].info.width],
        "services": services(),
    }
    sys.stdout.write(json.dumps(found))


if __name__ == "__main__":
    main()
