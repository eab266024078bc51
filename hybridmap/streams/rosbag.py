"""A bag as a stream, read in two passes: first stamps and self-motion, then scans or images."""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Mapping
from contextlib import suppress
from dataclasses import dataclass, replace
from itertools import islice
from pathlib import Path
from typing import Any, ClassVar

import numpy as np

from hybridmap.config.root import Config
from hybridmap.errors import StreamError
from hybridmap.streams.bagfile import BagFile
from hybridmap.streams.bagindex import ODOMETRY, build_index, select
from hybridmap.streams.base import (
    Decoder,
    InBag,
    MessageKey,
    Observation,
    Sample,
    SelfMotion,
    SensorPlan,
    StreamReport,
)
from hybridmap.streams.layout import plan_sensor, self_motion
from hybridmap.streams.messages import TRANSFORM, RawMessage
from hybridmap.streams.order import Window, check_overlap, first_of, merge
from hybridmap.streams.sensors import kind_of, kinds, message_types
from hybridmap.trajectory import Trajectory

_MOST_DAMAGED_FIRST = 10
"""How many damaged messages at the beginning of a topic are skipped until its layout is known."""


@dataclass(frozen=True, slots=True)
class _Due:
    """An observation whose messages are read and not yet decoded."""

    precedence: ClassVar[int] = Observation.precedence
    stamp_ns: int
    messages: list[RawMessage]


class BagStream:
    """ROS 1 bag, ROS 2 folder, `.mcap` or `.db3` file.

    Samples have header stamps. The rig holds the sensor to map with: `vision.sensor`, or, for `auto`, the first kind of the
    table that the bag has.

    Attributes:
        selection: topics that were chosen.
        remarks: choices and assumptions, for the user.
        losses: name -> number of messages that no observation uses (`unmatched color`).
        lost: topic -> (messages that cannot be read, messages that the bag states), without those skipped while iterating.
    """

    def __init__(self, path: Path, config: Config, window: Window | None = None, *, skip_damaged: bool = False) -> None:
        """Index the bag.

        Args:
            path: of the bag.
            config: topics, mounting, sensor.
            window: the part to use.
            skip_damaged: leave out scans and pictures that are damaged, and count them, instead of ending with an error.

        Raises:
            StreamError: the bag is damaged, or lacks data that mapping needs; the message names them.
        """
        self._bag = BagFile(path)
        self._config, self._sensors, self._skip_damaged = config, config.sensors, skip_damaged
        self.name = path.name
        read = ODOMETRY + TRANSFORM + message_types()
        self._known = [topic.name for topic in self._bag.topics if topic.msgtype in read]
        self._index = build_index(self._bag, self._known, self._sensors.odom_frame, skip_damaged=skip_damaged)
        topics = [replace(topic, count=self._index.counts.get(topic.name, 0)) for topic in self._bag.topics]
        self.selection = select(topics, self._sensors, kinds(), self._index.frame_of, str(path))
        self.remarks = list(self.selection.remarks)
        self.remarks += [f"transform {name} holds NaN or no rotation: ignored" for name in self._index.unusable_transforms]
        motion = self_motion(self._index, self.selection, self._sensors, self._bag)
        self.remarks += motion.remarks
        self._base_frame = motion.base_frame
        self._motion_ns, self._motion_poses = motion.track.sorted(motion.what, motion.pose_child_base)
        self._plan_made = plan_sensor(self._config.vision.sensor, self.selection, self._planned_by)
        self._planned, self.rig, self.losses = self._plan_made.planned, self._plan_made.rig, self._plan_made.losses
        self.remarks += self._plan_made.remarks
        self.lost = self._lost_messages()
        observation_ns = np.array([planned.stamp_ns for planned in self._planned], dtype=np.int64)
        check_overlap(self._motion_ns, observation_ns, str(path))
        self._apply(window or Window())
        self.report = StreamReport()

    @property
    def uses(self) -> dict[str, str]:
        """Role (such as `odometry`, `color`) -> topic that the samples come from."""
        return self.selection.uses(self.rig)

    @property
    def groundtruth(self) -> Trajectory | None:
        """True poses of `sensors.groundtruth_topic`, else of an Odometry topic whose name or frame suggests them; else None."""
        topic = self.selection.groundtruth
        return None if topic is None else self._index.odometry[topic].trajectory(f"{self._bag.path}: {topic}")

    @property
    def expected_observations(self) -> int | None:
        """Number of observations in the part of the bag that is used."""
        return len(self._planned)

    def __iter__(self) -> Iterator[Sample]:
        """Yield self-motion and observations in order of header stamp.

        Raises:
            StreamError: a message is damaged; the message names topic and place.
        """
        return self.onward(0, StreamReport(dict(self.losses), list(self.remarks), dict(self.lost)))

    def first_stamps(self, count: int) -> tuple[int, ...]:
        """Stamps of the first samples, ns; see `SeekableStream`."""
        return first_of(count, self._motion_ns, (planned.stamp_ns for planned in self._planned))

    def onward(self, taken: int, report: StreamReport) -> Iterator[Sample]:
        """Iterate without the first `taken` samples, whose messages are read and not decoded; see `SeekableStream`.

        Raises:
            StreamError: a message is damaged; the message names topic and place.
        """
        self.report, decode = report, self._plan_made.decode
        if decode is not None:
            decode.counts.clear()
            decode.counts.update(report.irregular)
            report.irregular = decode.counts
        due: Iterator[SelfMotion | _Due] = merge(self._motions(), self._observations())
        for item in islice(due, taken + len(report.skipped), None):
            sample = self._decoded(item, decode) if isinstance(item, _Due) and decode is not None else item
            if isinstance(sample, _Due | None):
                continue
            report.count(kind_of(sample).counted if isinstance(sample, Observation) else "odometry")
            yield sample
        report.counts |= report.irregular
        report.remarks += [f"{name}: {number} of {len(self._planned)}" for name, number in report.irregular.items() if number]

    def _motions(self) -> Iterator[SelfMotion]:
        for stamp, pose in zip(self._motion_ns, self._motion_poses, strict=True):
            yield SelfMotion(int(stamp), pose)

    def _observations(self) -> Iterator[_Due]:
        """Second pass: read until all messages of the next planned observation are there."""
        needed = {key for planned in self._planned for key in planned.needs}
        waiting: dict[MessageKey, Any] = {}
        upcoming = iter(self._planned)
        planned = next(upcoming, None)
        if planned is None or self._plan_made.decode is None:
            return
        for message in self._bag.raw(sorted({topic for topic, _ in needed})):
            key = (message.topic, message.number)
            if key in needed:
                self._check_unchanged(message)
                waiting[key] = message
            while planned is not None and all(key in waiting for key in planned.needs):
                yield _Due(planned.stamp_ns, [waiting.pop(key) for key in planned.needs])
                planned = next(upcoming, None)
            if planned is None:
                return
        raise StreamError(f"{self._bag.path}: holds fewer messages than at the first reading; was it changed meanwhile?")

    def _decoded(self, due: _Due, decode: Decoder) -> Observation | None:
        """The observation; None if it is damaged and damaged ones are skipped."""
        try:
            return decode(due.stamp_ns, tuple(self._bag.decode(message) for message in due.messages))
        except StreamError as error:
            if not self._skip_damaged:
                raise
            topic, why = due.messages[0].topic, str(error).removeprefix(f"{self._bag.path}: ")
            self.report.skip(topic, len(self._index.stamps_ns[topic]), due.stamp_ns, why)
            return None

    def _check_unchanged(self, message: RawMessage) -> None:
        if self._bag.stamp_ns(message) != self._index.stamps_ns[message.topic][message.number]:
            raise StreamError(f"{self._bag.path}: {message.topic}: other messages than at the first reading; was it changed?")

    def _lost_messages(self) -> dict[str, tuple[int, int]]:
        """Topic -> (messages that cannot be read, messages that the bag states), for topics that are used or wholly lost."""
        read, used = self._index.counts, frozenset(self.uses.values())
        known = [topic for topic in self._bag.topics if topic.name in self._known]
        lacking = {topic.name: (topic.count - read.get(topic.name, 0), topic.count) for topic in known}
        return {name: (gone, all_) for name, (gone, all_) in lacking.items() if gone > 0 and (name in used or gone == all_)}

    def _planned_by(self, kind: InBag, topics: Mapping[str, str]) -> SensorPlan:
        """Plan the observations. Where damaged ones are skipped, the layout is that of the first messages that are sound."""
        for number in range(1, _MOST_DAMAGED_FIRST + 1):
            try:
                return kind.plan(topics, self._index, self._base_frame, self._sensors, str(self._bag.path))
            except StreamError:
                later = self._messages(topics.values(), number) if self._skip_damaged else {}
                if not later:
                    raise
                self._index.first |= later
        return kind.plan(topics, self._index, self._base_frame, self._sensors, str(self._bag.path))

    def _messages(self, names: Iterable[str], number: int) -> dict[str, Any]:
        """The decoded message of a number, of each of the topics that have it and of which it is sound."""
        found: dict[str, Any] = {}
        wanted = {name for name in names if self._index.counts.get(name, 0) > number}
        for message in self._bag.raw(wanted):
            if message.number == number:
                wanted.discard(message.topic)
                with suppress(StreamError):
                    found[message.topic] = self._bag.decode(message)
            if not wanted:
                break
        return found

    def _apply(self, window: Window) -> None:
        starts = [int(self._motion_ns[0])] + [planned.stamp_ns for planned in self._planned[:1]]
        low, high = window.limits_over(self._motion_ns, min(starts), str(self._bag.path))
        inside = (self._motion_ns >= low) & (self._motion_ns <= high)
        self._motion_ns, self._motion_poses = self._motion_ns[inside], self._motion_poses[inside]
        self._planned = [planned for planned in self._planned if low <= planned.stamp_ns <= high]
