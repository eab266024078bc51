"""A bag as a stream, read in two passes: first stamps and self-motion, then scans or images."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np

from hybridmap.config.root import Config
from hybridmap.errors import StreamError
from hybridmap.geometry import Array
from hybridmap.streams.bagfile import TRANSFORM, BagFile, RawMessage
from hybridmap.streams.bagindex import ODOMETRY, PoseTrack, build_index, select
from hybridmap.streams.base import MessageKey, Observation, Sample, SelfMotion, SensorPlan, StreamReport
from hybridmap.streams.mounting import clean_frame, planar
from hybridmap.streams.order import Window, check_overlap, merge
from hybridmap.streams.sensors import kind_of, kinds, message_types, wanted
from hybridmap.trajectory import Trajectory


class BagStream:
    """ROS 1 bag, ROS 2 folder, `.mcap` or `.db3` file.

    Samples have header stamps. The rig holds the sensor to map with: `vision.sensor`, or, for `auto`, the first kind of the
    table that the bag has.
    """

    def __init__(self, path: Path, config: Config, window: Window | None = None) -> None:
        """Index the bag.

        Raises:
            StreamError: the bag is damaged, or lacks data that mapping needs; the message names them.
        """
        self._bag = BagFile(path)
        self._config, self._sensors = config, config.sensors
        self.name = path.name
        read = ODOMETRY + TRANSFORM + message_types()
        named = (topic.name for topic in self._bag.topics if topic.msgtype in read)
        self._index = build_index(self._bag, named, self._sensors.odom_frame)
        topics = [replace(topic, count=self._index.counts.get(topic.name, 0)) for topic in self._bag.topics]
        self.selection = select(topics, self._sensors, kinds(), self._index.frame_of, str(path))
        self.remarks = list(self.selection.remarks)
        self.remarks += [f"transform {name} holds NaN or no rotation: ignored" for name in self._index.unusable_transforms]
        track, what = self._self_motion()
        self._base_frame = self._choose_base(track)
        carry = self._carry(track, what)
        self._motion_ns, self._motion_poses = track.sorted(what, carry)
        self._plan_made = self._plan()
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
        """True poses of the base, from an Odometry topic whose name suggests ground truth; None if there is none."""
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
        self.report = StreamReport(dict(self.losses), list(self.remarks), self.lost)
        for sample in merge(self._motions(), self._observations()):
            self.report.count(kind_of(sample).counted if isinstance(sample, Observation) else "odometry")
            yield sample
        if self._plan_made.decode is not None:
            self.report.counts |= self._plan_made.decode.counts

    def _motions(self) -> Iterator[Sample]:
        for stamp, pose in zip(self._motion_ns, self._motion_poses, strict=True):
            yield SelfMotion(int(stamp), pose)

    def _observations(self) -> Iterator[Sample]:
        """Second pass: read until all messages of the next planned observation are there."""
        needed = {key for planned in self._planned for key in planned.needs}
        waiting: dict[MessageKey, Any] = {}
        upcoming = iter(self._planned)
        planned, decode = next(upcoming, None), self._plan_made.decode
        if planned is None or decode is None:
            return
        decode.counts.clear()
        for message in self._bag.raw(sorted({topic for topic, _ in needed})):
            key = (message.topic, message.number)
            if key in needed:
                self._check_unchanged(message)
                waiting[key] = message
            while planned is not None and all(key in waiting for key in planned.needs):
                parts = tuple(self._bag.decode(waiting.pop(key)) for key in planned.needs)
                yield decode(planned.stamp_ns, parts)
                planned = next(upcoming, None)
            if planned is None:
                return
        raise StreamError(f"{self._bag.path}: holds fewer messages than at the first reading; was it changed meanwhile?")

    def _check_unchanged(self, message: RawMessage) -> None:
        if self._bag.stamp_ns(message) != self._index.stamps_ns[message.topic][message.number]:
            raise StreamError(f"{self._bag.path}: {message.topic}: other messages than at the first reading; was it changed?")

    def _self_motion(self) -> tuple[PoseTrack, str]:
        chosen = self.selection
        if chosen.odometry is not None:
            return self._index.odometry[chosen.odometry], f"{self._bag.path}: {chosen.odometry}"
        odom = clean_frame(self._sensors.odom_frame)
        known = self._index.tf_tracks.values() if chosen.odometry_tf else ()
        base = clean_frame(self._sensors.base_frame or "")
        tracks = sorted(known, key=lambda track: (track.child != base, -len(track.stamps_ns), track.child))
        if not tracks:
            types = ", ".join(f"{topic.name} ({topic.msgtype.replace('/msg/', '/')})" for topic in self._bag.topics) or "none"
            raise StreamError(
                f"{self._bag.path}: no odometry: expected a topic of type nav_msgs/Odometry or the transform "
                f"{odom!r} -> base on /tf; topics found: {types}"
            )
        self.remarks.append(f"no Odometry topic: self-motion from the transform {tracks[0].parent} -> {tracks[0].child}")
        return tracks[0], f"{self._bag.path}: transform {tracks[0].parent} -> {tracks[0].child}"

    def _lost_messages(self) -> dict[str, tuple[int, int]]:
        """Topic -> (messages that cannot be read, messages that the bag states), for the used topics that lack some."""
        read, used = self._index.counts, frozenset(self.uses.values())
        lacking = {topic.name: (topic.count - read.get(topic.name, 0), topic.count) for topic in self._bag.topics}
        return {name: (gone, stated) for name, (gone, stated) in lacking.items() if gone > 0 and name in used}

    def _choose_base(self, track: PoseTrack) -> str:
        """The frame to map: the configured one, else the child frame of the odometry, else a usual name."""
        named = clean_frame(self._sensors.base_frame or "") or track.child
        usual = (frame for frame in ("base_link", "base_footprint") if frame in self._index.transforms.frames)
        return named or next(usual, "base_link")

    def _carry(self, track: PoseTrack, what: str) -> Array | None:
        """(3,) pose of the base in the child frame of the odometry; None if they are the same."""
        if track.child in ("", self._base_frame):
            return None
        T = self._index.transforms.require(track.child, self._base_frame, what, "another sensors.base_frame")
        return planar(T)

    def _plan(self) -> SensorPlan:
        looked_for, source = wanted(self._config.vision.sensor), str(self._bag.path)
        for kind in looked_for:
            topics = self.selection.sensors.get(kind.sensor_name, {})
            if kind.in_bag is not None and (topics or len(looked_for) == 1):
                return kind.in_bag.plan(topics, self._index, self._base_frame, self._sensors, source)
        if not looked_for:
            return SensorPlan()
        lacking = " and no ".join(kind.needs for kind in looked_for if kind.in_bag is not None)
        return SensorPlan(remarks=[f"no {lacking}: self-motion alone"])

    def _apply(self, window: Window) -> None:
        starts = [int(self._motion_ns[0])] + [planned.stamp_ns for planned in self._planned[:1]]
        low, high = window.limits_ns(min(starts))
        inside = (self._motion_ns >= low) & (self._motion_ns <= high)
        self._motion_ns, self._motion_poses = self._motion_ns[inside], self._motion_poses[inside]
        self._planned = [planned for planned in self._planned if low <= planned.stamp_ns <= high]
        if not inside.any():
            raise StreamError(f"{self._bag.path}: no odometry between --start and --end; choose times within the recording")
