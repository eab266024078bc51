"""The messages of a running robot as samples: what a bag of them would give, while they come in."""

from __future__ import annotations

import logging
import time
from collections.abc import Callable, Iterable, Sequence
from threading import Lock
from typing import Any

import numpy as np

from hybridmap.config.root import Config
from hybridmap.errors import StreamError
from hybridmap.geometry import compose
from hybridmap.streams.bagindex import Indexer, is_static, planar_pose, select
from hybridmap.streams.base import (
    Decoder,
    Gatherer,
    MessageKey,
    Planned,
    Rig,
    Sample,
    SelfMotion,
    SensorKind,
)
from hybridmap.streams.layout import MotionSource, plan_sensor, self_motion
from hybridmap.streams.messages import TRANSFORM, Messages, RawMessage, Topic
from hybridmap.streams.mounting import clean_frame
from hybridmap.streams.sensors import kinds, wanted
from hybridmap.trajectory import NS_PER_S

log = logging.getLogger(__name__)

SETTLE_S = 0.5
"""How long transforms are waited for after the first message of every sensor, s. Publishers of `/tf_static` answer one after
the other, and which of them still comes is not known."""
_EACH = 10
"""While something is missing, every so many messages of a topic it is looked for again."""


class Incoming:
    """Turns the raw messages of a robot into samples, by the code that reads bags.

    Topics are chosen as in a bag. Messages are kept until the first of every topic and the needed transforms are there; then
    rig and mountings are known, and the samples are given out from the first message on. `take` may be called at the same
    time for different topics: decoding a picture holds up no odometry.

    Attributes:
        selection: topics that were chosen.
        kind: kind of the sensor to map with; None: self-motion alone.
        subscriptions: topic -> message type, of those to subscribe to.
        rig: the sensors with their mountings; None until they are known.
        remarks: choices and assumptions, for the user.
    """

    def __init__(
        self,
        topics: Sequence[Topic],
        config: Config,
        begin: Callable[[Rig], Callable[[Sample], None]],
        source: str,
        *,
        is_ros1: bool,
        settle_s: float = SETTLE_S,
    ) -> None:
        """Choose the topics.

        Args:
            topics: all that the robot has; `count` is not 0.
            config: topics, mountings, sensor.
            begin: called once, with the rig as soon as it is known; returns what each sample is given to, in order of a topic's
                messages.
            source: name of the robot or its middleware, for errors.
            is_ros1: whether messages are serialised as ROS 1 does it, else as ROS 2.
            settle_s: how long to wait for further transforms, s.

        Raises:
            StreamError: a topic that the user named does not exist; or there is no odometry, or no sensor.
        """
        self._config, self._source, self._settle_s = config, source, settle_s
        self._messages = Messages(source, is_ros1, "its publisher sends another type than it says")
        self.selection = select(topics, config.sensors, kinds(), lambda _: "", source)
        self.kind = self._choose_kind()
        self.subscriptions = self._wanted_of(topics)
        for topic, msgtype in self.subscriptions.items():
            self._messages.define(topic, msgtype)
        self._indexer = Indexer(self._messages, config.sensors.odom_frame)
        self._counts = dict.fromkeys(self.subscriptions, 0)
        self._locks = {topic: Lock() for topic in self.subscriptions}
        self._start, self._observe = Lock(), Lock()
        self._held: list[RawMessage] = []
        self._whole_since_s: float | None = None
        self._missing = [f"{source}: no message yet"]
        self._begin = begin
        self._give: Callable[[Sample], None] = _nowhere
        self._motion: MotionSource | None = None
        self._last_tf_ns: int | None = None
        self._decode: Decoder | None = None
        self._gatherer: Gatherer | None = None
        self._raw: dict[MessageKey, RawMessage] = {}
        self.rig: Rig | None = None
        self.remarks = list(self.selection.remarks)

    @property
    def missing(self) -> list[str]:
        """What is still waited for, in sentences; empty once the rig is known."""
        silent = [name for name, count in self._counts.items() if not count and self._needed(name)]
        named = [f"{self._source}: no message yet on {name} ({self.subscriptions[name]})" for name in silent]
        return [] if self.rig is not None else named or self._missing

    @property
    def frames(self) -> tuple[str, str]:
        """Names of the frame of the odometry and of the base, such as `odom` and `base_link`; known with the rig."""
        assert self._motion is not None
        return self._motion.track.parent or "odom", self._motion.base_frame

    @property
    def losses(self) -> dict[str, int]:
        """Name -> number of messages that no observation uses (`unmatched color`)."""
        return {} if self._gatherer is None else dict(self._gatherer.losses)

    def take(self, topic: str, data: bytes, definition: str | None = None) -> None:
        """Take in a message, and give out the samples that it completes.

        Args:
            topic: one of `subscriptions`.
            data: serialised message.
            definition: what its publisher says of its type (ROS 1); None: the standard one.

        Raises:
            StreamError: the message is damaged or holds invalid numbers. It is left out, and the next may be taken in.
        """
        with self._locks[topic]:
            number = self._counts[topic]
            if not number and definition is not None:
                self._messages.define(topic, self.subscriptions[topic], definition)
            self._counts[topic] = number + 1
            message = RawMessage(topic, number, data)
            if self.rig is None:
                with self._start:
                    if self.rig is None:
                        self._take_early(message)
                        return
            self._pass_on(message)

    def look(self) -> None:
        """Begin if everything has come meanwhile; for when no message comes after the time for further transforms."""
        with self._start:
            if self.rig is None:
                self._try_to_start()

    def begin_anew(self) -> None:
        """A new map begins: its messages may be stamped earlier than those so far. What waits for a partner is forgotten."""
        with self._observe:
            self._raw.clear()
            self._gatherer = None if self._gatherer is None else self._new_gatherer()

    def flush(self) -> None:
        """The end: give out what the messages that wait make. No transform is waited for any longer."""
        self._settle_s = 0.0
        self.look()
        with self._observe:
            if self._gatherer is not None:
                self._make(self._gatherer.flush())

    def _take_early(self, message: RawMessage) -> None:
        self._indexer.take(message)
        self._held.append(message)
        number = message.number
        if number < _EACH or number % _EACH == 0 or self._messages.types[message.topic] in TRANSFORM:
            self._try_to_start()

    def _try_to_start(self) -> None:
        """Find rig and mountings; if that succeeds, give out what was kept."""
        if any(not count and self._needed(topic) for topic, count in self._counts.items()):
            return
        now_s = time.monotonic()
        self._whole_since_s = now_s if self._whole_since_s is None else self._whole_since_s
        if now_s - self._whole_since_s < self._settle_s:
            return
        index, sensors = self._indexer.index, self._config.sensors
        try:
            motion = self_motion(index, self.selection, sensors, self._messages)
            plan = plan_sensor(
                self._config.vision.sensor,
                self.selection,
                lambda kind, topics: kind.plan(topics, index, motion.base_frame, sensors, self._source),
            )
        except StreamError as error:
            self._missing = [str(error)]
            return
        self._motion, self._decode = motion, plan.decode
        self._gatherer = self._new_gatherer()
        self.remarks += [*motion.remarks, *plan.remarks]
        self._give = self._begin(plan.rig)
        for message in self._held:
            try:
                self._pass_on(message)
            except StreamError as error:
                log.warning("%s", error)
        self._held.clear()
        self.rig = plan.rig

    def _pass_on(self, message: RawMessage) -> None:
        topic = message.topic
        if topic == self.selection.odometry:
            decoded = self._messages.decode(message)
            self._move(self._messages.stamp_ns(message), decoded.pose.pose.position, decoded.pose.pose.orientation)
        elif self._messages.types[topic] not in TRANSFORM:
            self._observe_by(message)
        elif self.selection.odometry_tf and not is_static(topic):
            self._move_by_transforms(message)

    def _move(self, stamp_ns: int, position: Any, orientation: Any) -> None:
        assert self._motion is not None
        pose = np.asarray(planar_pose(stamp_ns, position, orientation, self._motion.what), dtype=np.float64)
        carry = self._motion.pose_child_base
        self._give(SelfMotion(stamp_ns, pose if carry is None else compose(pose, carry)))

    def _move_by_transforms(self, message: RawMessage) -> None:
        assert self._motion is not None
        frames = (self._motion.track.parent, self._motion.track.child)
        for transform in self._messages.decode(message).transforms:
            if (clean_frame(transform.header.frame_id), clean_frame(transform.child_frame_id)) != frames:
                continue
            stamp = transform.header.stamp
            stamp_ns = int(stamp.sec) * NS_PER_S + int(stamp.nanosec)
            if stamp_ns != self._last_tf_ns:  # tf is published again and again
                self._last_tf_ns = stamp_ns
                self._move(stamp_ns, transform.transform.translation, transform.transform.rotation)

    def _observe_by(self, message: RawMessage) -> None:
        if self._gatherer is None:
            return
        stamp_ns = self._messages.stamp_ns(message)
        with self._observe:
            self._raw[message.topic, message.number] = message
            try:
                self._make(self._gatherer.push(message.topic, message.number, stamp_ns))
            finally:
                waiting = self._gatherer.waiting
                self._raw = {key: kept for key, kept in self._raw.items() if key in waiting}

    def _make(self, planned: Iterable[Planned]) -> None:
        assert self._decode is not None
        for one in planned:
            parts = tuple(self._messages.decode(self._raw[key]) for key in one.needs)
            self._give(self._decode(one.stamp_ns, parts))

    def _new_gatherer(self) -> Gatherer | None:
        if self.kind is None or self.kind.in_bag is None:
            return None
        return self.kind.in_bag.gather(self.selection.sensors[self.kind.sensor_name], self._config.sensors)

    def _needed(self, topic: str) -> bool:
        """Whether mapping cannot begin without a message of this topic; transforms may be missing."""
        return self._messages.types[topic] not in TRANSFORM

    def _choose_kind(self) -> SensorKind | None:
        """The kind of sensor that `layout.plan_sensor` will take; checked here, as on a robot more topics may still come."""
        if self.selection.odometry is None and not self.selection.odometry_tf:
            raise StreamError(f"{self._source}: no odometry: expected a topic of type nav_msgs/Odometry, or /tf")
        looked_for = [kind for kind in wanted(self._config.vision.sensor) if kind.in_bag is not None]
        for kind in looked_for:
            topics = self.selection.sensors.get(kind.sensor_name, {})
            if topics:
                return kind
        if not looked_for:
            return None
        needs = " or ".join(kind.needs for kind in looked_for)
        raise StreamError(f"{self._source}: no {needs}: expected a topic of them, or vision.sensor none for dead reckoning")

    def _wanted_of(self, topics: Sequence[Topic]) -> dict[str, str]:
        chosen = self.selection
        names = {*chosen.transforms, *([chosen.odometry] if chosen.odometry is not None else [])}
        if self.kind is not None:
            names |= set(chosen.sensors[self.kind.sensor_name].values())
        return {topic.name: topic.msgtype for topic in topics if topic.name in names}


def _nowhere(sample: Sample) -> None:
    """Take the samples before mapping begins; there are none."""
    raise AssertionError(sample)
