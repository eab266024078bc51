"""A client of `hybridmap ros2`: moves it through its lifecycle, plays a bag, listens, calls every service; prints JSON."""

from __future__ import annotations

import json
import sys
import time
from pathlib import Path
from typing import Any

import numpy as np
from lifecycle_msgs.msg import Transition
from lifecycle_msgs.srv import ChangeState, GetState
from nav_msgs.srv import GetMap
from rclpy.qos import DurabilityPolicy, QoSProfile
from ros2_play import Player
from std_srvs.srv import Empty, SetBool, Trigger

from hybridmap.geometry import compose
from hybridmap.ros.ros2_types import endpoint, serialised
from hybridmap.streams.bagfile import BagFile
from hybridmap.streams.messages import Messages, RawMessage

LATCHED = {
    "/floor": "nav_msgs/msg/OccupancyGrid",
    "/map_metadata": "nav_msgs/msg/MapMetaData",
    "/hybridmap/path": "nav_msgs/msg/Path",
    "/hybridmap/graph": "visualization_msgs/msg/MarkerArray",
}


def planar(position: Any, q: Any) -> np.ndarray:
    return np.array([position.x, position.y, 2 * np.arctan2(q.z, q.w)])


class Client:
    """Plays the bag, and keeps what it hears."""

    def __init__(self, bag: Path) -> None:
        self.player = Player(bag)
        self.node = self.player.node
        self.messages = Messages("node", False, "of another type")
        self.heard: dict[str, list[Any]] = {}
        own = BagFile(bag)
        odometry = [own.decode(message) for message in own.raw(["/odom"])]
        self.odometry = {
            one.header.stamp.sec * 10**9 + one.header.stamp.nanosec: planar(one.pose.pose.position, one.pose.pose.orientation)
            for one in odometry
        }
        self.listen("/tf", "tf2_msgs/msg/TFMessage")
        self.listen("/hybridmap/map_to_odom", "geometry_msgs/msg/TransformStamped")
        self.listen("/hybridmap/pose", "geometry_msgs/msg/PoseWithCovarianceStamped")
        self.listen("/diagnostics", "diagnostic_msgs/msg/DiagnosticArray")

    def listen(self, topic: str, msgtype: str, *, latched: bool = False) -> None:
        self.messages.define(topic, msgtype)
        quality = QoSProfile(depth=1000)
        if latched:
            quality = QoSProfile(depth=1, durability=DurabilityPolicy.TRANSIENT_LOCAL)
        kept = self.heard[topic] = []
        endpoint(
            self.node.create_subscription,
            msgtype,
            topic,
            lambda data: kept.append(self.messages.decode(RawMessage(topic, 0, data))),
            quality,
            raw=True,
        )

    def wait_for(self, there: Any) -> None:
        until_s = time.monotonic() + 90.0
        while not there():
            if time.monotonic() > until_s:
                sys.exit(f"waited in vain; heard { {name: len(kept) for name, kept in self.heard.items()} }")
            time.sleep(0.1)

    def call(self, name: str, kind: Any, **fields: Any) -> Any:
        client = self.node.create_client(kind, name)
        assert client.wait_for_service(60.0), name
        answer = client.call_async(kind.Request(**fields))
        self.wait_for(answer.done)
        return answer.result()

    def move(self, transition: int) -> str:
        """The state after a transition."""
        moved = self.call("/hybridmap/change_state", ChangeState, transition=Transition(id=transition)).success
        state: str = self.call("/hybridmap/get_state", GetState).current_state.label
        return state if moved else f"still {state}"

    def say_initial_pose(self) -> None:
        """As rviz does."""
        msgtype, contents = "geometry_msgs/msg/PoseWithCovarianceStamped", {"header": {"frame_id": "moon"}}
        publisher = endpoint(self.node.create_publisher, msgtype, "/initialpose", 10)
        self.wait_for(publisher.get_subscription_count)
        publisher.publish(serialised(msgtype, contents))

    def services(self) -> dict[str, Any]:
        answers: dict[str, Any] = {}
        for name in ("save_map", "serialize_map", "deserialize_map"):
            answer = self.call(f"/hybridmap/{name}", Trigger)
            answers[name] = [answer.success, answer.message]
        answer = self.call("/hybridmap/set_localization_mode", SetBool, data=True)
        answers["set_localization_mode"] = [answer.success, answer.message]
        for name in ("pause", "resume"):
            self.call(f"/hybridmap/{name}", Empty)
            answers[name] = "done"
        cells = list(self.call("/dynamic_map", GetMap).map.data)
        answers["dynamic_map"] = [len(cells), cells.count(100), cells.count(0)]
        return answers

    def off_m(self) -> float:
        """Median distance between a pose and the nearest of odometry composed with a correction, m."""
        corrections = [
            planar(one.transform.translation, one.transform.rotation) for one in self.heard["/hybridmap/map_to_odom"]
        ]
        poses = [(one.header.stamp, one.pose.pose) for one in self.heard["/hybridmap/pose"]]
        placed = {stamp.sec * 10**9 + stamp.nanosec: planar(pose.position, pose.orientation) for stamp, pose in poses}
        return float(
            np.median(
                [
                    min(np.hypot(*(compose(correction, self.odometry[stamp_ns]) - pose)[:2]) for correction in corrections)
                    for stamp_ns, pose in placed.items()
                ]
            )
        )


def main() -> None:
    client = Client(Path(sys.argv[1]))
    states = [client.call("/hybridmap/get_state", GetState).current_state.label]
    states += [client.move(Transition.TRANSITION_ACTIVATE), client.move(Transition.TRANSITION_CONFIGURE)]
    states.append(client.move(Transition.TRANSITION_ACTIVATE))
    client.player.wait_for_node("/odom")
    client.player.play(4.0, "/odom", until_s=8.0)
    client.wait_for(lambda: client.heard["/hybridmap/pose"])
    client.player.play(4.0, "/odom")
    for topic, msgtype in LATCHED.items():
        client.listen(topic, msgtype, latched=True)  # late: the last message is kept for it
    client.wait_for(lambda: all(client.heard[topic] for topic in LATCHED))
    time.sleep(1.5)
    frames = {(one.header.frame_id, one.child_frame_id) for message in client.heard["/tf"] for one in message.transforms}
    (status,) = client.heard["/diagnostics"][-1].status
    found: dict[str, Any] = {
        "tf_frames": sorted(frames),
        "poses": len(client.heard["/hybridmap/pose"]),
        "pose_from_correction_median_m": client.off_m(),
        "path_nodes": len(client.heard["/hybridmap/path"][-1].poses),
        "graph_markers": len(client.heard["/hybridmap/graph"][-1].markers),
        "map": [
            len(client.heard["/floor"][-1].data),
            client.heard["/floor"][-1].info.width * client.heard["/floor"][-1].info.height,
        ],
        "diagnostics": {one.key: one.value for one in status.values},
        "services": client.services(),
    }
    client.say_initial_pose()
    states.append(client.move(Transition.TRANSITION_DEACTIVATE))
    time.sleep(1.0)
    before = len(client.heard["/diagnostics"])
    time.sleep(1.5)
    found["heard_while_inactive"] = len(client.heard["/diagnostics"]) - before
    states.append(client.move(Transition.TRANSITION_ACTIVATE))
    client.wait_for(lambda: len(client.heard["/diagnostics"]) > before)
    states += [client.move(Transition.TRANSITION_DEACTIVATE), client.move(Transition.TRANSITION_CLEANUP)]
    found["states"] = states
    client.call("/hybridmap/change_state", ChangeState, transition=Transition(id=Transition.TRANSITION_UNCONFIGURED_SHUTDOWN))
    client.player.stop()
    sys.stdout.write(json.dumps(found))


if __name__ == "__main__":
    main()
