"""A robot without ROS: a middleware that plays a bag, and keeps what the node publishes."""

from __future__ import annotations

import threading
import time
from collections import defaultdict
from collections.abc import Callable, Sequence
from pathlib import Path

from hybridmap.ros.contents import Contents
from hybridmap.ros.middleware import Output, Service
from hybridmap.streams.bagfile import BagFile
from hybridmap.streams.messages import Topic


class PlayedRobot:
    """A middleware whose topics are those of a bag."""

    def __init__(self, bag: Path) -> None:
        self.bag = BagFile(bag)
        self.source, self.is_ros1 = "played robot", self.bag.is_ros1
        self.takers: dict[str, Callable[[bytes, str | None], None]] = {}
        self.published: dict[str, list[Contents]] = defaultdict(list)
        self.services: dict[str, Service] = {}
        self.warnings: list[str] = []
        self.told = threading.Condition()

    def topics(self) -> list[Topic]:
        return [Topic(topic.name, topic.msgtype, 1) for topic in self.bag.topics]

    def subscribe(self, topic: str, msgtype: str, take: Callable[[bytes, str | None], None]) -> None:
        self.takers[topic] = take

    def publish(self, output: Output, contents: Contents) -> None:
        with self.told:
            self.published[output.topic].append(contents)
            self.told.notify_all()

    def offer(self, services: Sequence[Service]) -> None:
        self.services = {service.name: service for service in services}

    def warn(self, text: str) -> None:
        with self.told:
            self.warnings.append(text)
            self.told.notify_all()

    def inform(self, text: str) -> None:
        """Say nothing."""

    def when_stopped(self, call: Callable[[], None]) -> None:
        """It does not stop by itself."""

    def stop(self) -> None:
        """Nothing to leave."""

    def wait_for(self, there: Callable[[], bool], timeout_s: float = 30.0) -> None:
        """Wait until the node has published what makes `there` true."""
        with self.told:
            assert self.told.wait_for(there, timeout_s)

    def play(self, times_real_time: float, from_s: float = -1e9, until_s: float = 1e9) -> None:
        """Send the messages of the bag that are stamped between two times after its first, in order of their recording."""
        began_s, first_ns = time.monotonic(), None
        for message in self.bag.raw(set(self.takers) & set(self.bag.types)):
            if message.topic.endswith("tf_static"):
                self.takers[message.topic](message.data, None)
                continue
            stamp_ns = self.bag.stamp_ns(message)
            first_ns = stamp_ns if first_ns is None else first_ns
            after_s = (stamp_ns - first_ns) / 1e9
            if from_s < after_s <= until_s:
                time.sleep(max(0.0, (after_s - max(from_s, 0.0)) / times_real_time - (time.monotonic() - began_s)))
                self.takers[message.topic](message.data, None)
