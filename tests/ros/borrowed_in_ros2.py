"""Sends a message by a borrowed class to a subscription of the real one, and the other way round; prints what came."""

from __future__ import annotations

import json
import sys
import time

import rclpy
from nav_msgs.msg import Path
from rclpy.node import Node

from hybridmap.ros.ros2_types import borrowed_class, serialised

TYPE = "nav_msgs/msg/Path"
CONTENTS = {"header": {"frame_id": "map"}, "poses": [{"pose": {"position": {"x": 3.0}}}] * 50}


def main() -> None:
    rclpy.init()
    node = Node("borrower")
    came: dict[str, list[float]] = {"real": [], "borrowed": []}
    borrowed = borrowed_class(TYPE)
    node.create_subscription(Path, "a", lambda message: came["real"].append(message.poses[-1].pose.position.x), 10)
    node.create_subscription(borrowed, "b", lambda data: came["borrowed"].append(len(data)), 10, raw=True)
    senders = node.create_publisher(borrowed, "a", 10), node.create_publisher(Path, "b", 10)
    data = serialised(TYPE, CONTENTS)
    until_s = time.monotonic() + 20.0
    while not all(came.values()) and time.monotonic() < until_s:
        for sender in senders:
            sender.publish(data)
        rclpy.spin_once(node, timeout_sec=0.1)
    others = [str(one.topic_type_hash) for topic in ("a", "b") for one in node.get_publishers_info_by_topic(f"/{topic}")]
    sys.stdout.write(json.dumps({"x": came["real"][-1:], "bytes": came["borrowed"][-1:], "sent": len(data), "hashes": others}))


if __name__ == "__main__":
    main()
