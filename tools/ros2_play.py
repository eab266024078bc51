"""Play a bag under ROS 2 with its bytes as they are, and listen to the node that maps it; run by `tools/live_proof.py`.

The wheels of ROS 2 have no bag player. A ROS 1 bag is played, too, as the same messages in the serialisation of ROS 2.
"""

from __future__ import annotations

import argparse
import json
import sys
import threading
import time
from collections.abc import Callable, Iterator
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import rclpy
from rclpy.executors import SingleThreadedExecutor
from rclpy.qos import DurabilityPolicy, QoSProfile
from rosbags.highlevel import AnyReader

from hybridmap.ros.fastdds import provide_buffers
from hybridmap.ros.ros2_types import endpoint
from hybridmap.streams.messages import Messages, RawMessage, standard_store
from hybridmap.trajectory import NS_PER_S

_DEEP, _PICTURES = 5000, 200
_CONNECT_S = 120.0
_SETTLE_S = 1.0
_SWITCH_S = 0.0005
"""As in the node: a pose that comes while a picture is sent is not to wait for it."""


@dataclass
class Heard:
    """What was sent, and heard of the node.

    Attributes:
        sent_s: stamp of an odometry message, ns -> when it was sent.
        late_s: how long after that each pose came.
        status: last diagnostics of the node, by name.
        behind_s: by how much the player was late at the worst.
    """

    sent_s: dict[int, float] = field(default_factory=dict)
    late_s: list[float] = field(default_factory=list)
    status: dict[str, str] = field(default_factory=dict)
    behind_s: float = 0.0


class Player:
    """Publishes a bag, and listens."""

    def __init__(self, bag: Path) -> None:
        provide_buffers()
        rclpy.init()
        self.node = rclpy.create_node("bag_player")
        self.heard, self._bag = Heard(), bag
        self._messages = Messages("node", False, "the node sends another type than it says")
        self._publishers: dict[str, Any] = {}
        with AnyReader([bag]) as reader:
            for connection in reader.connections:
                self._publishers.setdefault(connection.topic, self._advertised(connection.topic, connection.msgtype))
        self._rest = self._recorded()
        self._next = next(self._rest, None)
        self._first_ns = self._next[1] if self._next is not None else 0
        self._listen("/hybridmap/pose", "geometry_msgs/msg/PoseWithCovarianceStamped", self._placed)
        self._listen("/diagnostics", "diagnostic_msgs/msg/DiagnosticArray", self._diagnosed)
        self._executor = SingleThreadedExecutor()
        self._executor.add_node(self.node)
        self._spinner = threading.Thread(target=self._executor.spin, daemon=True)
        self._spinner.start()

    def _advertised(self, topic: str, msgtype: str) -> Any:
        quality = QoSProfile(depth=_PICTURES if msgtype.endswith("Image") else _DEEP)
        if topic.endswith("tf_static"):
            quality.durability = DurabilityPolicy.TRANSIENT_LOCAL
        return endpoint(self.node.create_publisher, msgtype, topic, quality)

    def _listen(self, topic: str, msgtype: str, take: Callable[[RawMessage], None]) -> None:
        self._messages.define(topic, msgtype)

        def received(data: bytes) -> None:
            take(RawMessage(topic, 0, data))

        endpoint(self.node.create_subscription, msgtype, topic, received, _DEEP, raw=True)

    def _placed(self, message: RawMessage) -> None:
        now_s, sent_s = time.monotonic(), self.heard.sent_s.get(self._messages.stamp_ns(message))
        if sent_s is not None:
            self.heard.late_s.append(now_s - sent_s)

    def _diagnosed(self, message: RawMessage) -> None:
        self.heard.status = {one.key: one.value for one in self._messages.decode(message).status[0].values}

    def stop(self) -> None:
        """Leave."""
        self._executor.shutdown()
        self._spinner.join()
        rclpy.try_shutdown()

    def wait_for_node(self, topic: str) -> None:
        """Wait until somebody takes a topic."""
        self._wait(lambda: self._publishers[topic].get_subscription_count() > 0, f"nobody subscribes to {topic}")
        time.sleep(_SETTLE_S)

    def _wait(self, there: Callable[[], bool], otherwise: str) -> None:
        until_s = time.monotonic() + _CONNECT_S
        while not there():
            if time.monotonic() > until_s:
                sys.exit(f"ros2_play: {otherwise}")
            time.sleep(0.05)

    def play(self, rate: float, odometry: str, until_s: float = float("inf")) -> None:
        """Publish what was recorded up to a time after the first message and is not yet published, as many times faster.

        Args:
            rate: times real time.
            odometry: topic whose messages are noted.
            until_s: time after the first message, s.
        """
        began: tuple[float, int] | None = None
        while self._next is not None and self._next[1] - self._first_ns <= until_s * NS_PER_S:
            topic, at_ns, data = self._next
            began = began or (time.monotonic(), at_ns)
            wait_s = began[0] + (at_ns - began[1]) / NS_PER_S / rate - time.monotonic()
            self.heard.behind_s = max(self.heard.behind_s, -wait_s)
            if wait_s > 0.0:
                time.sleep(wait_s)
            if topic == odometry:
                self.heard.sent_s[self._messages.stamp_ns(RawMessage(topic, 0, data))] = time.monotonic()
            self._publishers[topic].publish(data)
            self._next = next(self._rest, None)

    def _recorded(self) -> Iterator[tuple[str, int, bytes]]:
        ros2 = standard_store(is_ros1=False)
        with AnyReader([self._bag]) as reader:
            for connection, at_ns, data in reader.messages():
                if not reader.is2:
                    data = ros2.ros1_to_cdr(data, connection.msgtype)
                yield connection.topic, at_ns, bytes(data)


def main() -> None:
    """Play, and print what was heard."""
    sys.setswitchinterval(_SWITCH_S)
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("bag", type=Path)
    parser.add_argument("--rate", type=float, default=1.0)
    parser.add_argument("--odometry", required=True, help="topic of the odometry")
    parser.add_argument("--after", type=float, default=3.0, help="seconds to listen after the last message")
    given = parser.parse_args()
    player = Player(given.bag)
    player.wait_for_node(given.odometry)
    player.play(given.rate, given.odometry)
    time.sleep(given.after)
    player.stop()
    heard = player.heard
    print(json.dumps({"late_s": heard.late_s, "status": heard.status, "behind_s": heard.behind_s}))


if __name__ == "__main__":
    main()
