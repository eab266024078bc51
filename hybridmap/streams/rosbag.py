"""A bag as a stream: two passes, the first over stamps and self-motion, the second over scans or pictures."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from hybridmap.config.root import Config
from hybridmap.errors import StreamError
from hybridmap.streams.bagfile import BagFile
from hybridmap.streams.bagindex import PoseTrack, build_index, fixed_pose
from hybridmap.streams.base import Observation, Rig, Sample, SelfMotion, StreamReport
from hybridmap.streams.mounting import clean_frame, laser_pose
from hybridmap.streams.order import Window, merge, sorted_order
from hybridmap.streams.scans import ScanDecoder
from hybridmap.streams.topics import CAMERA_INFO, IMAGE, ODOMETRY, SCAN, TRANSFORM, select
from hybridmap.trajectory import Trajectory

_READ = ODOMETRY + SCAN + IMAGE + CAMERA_INFO + TRANSFORM

_Key = tuple[str, int]


@dataclass(frozen=True, slots=True)
class _Planned:
    """An observation that is to come: its stamp, and the messages it is made of."""

    stamp_ns: int
    needs: tuple[_Key, ...]
    decode: Callable[[int, tuple[Any, ...]], Observation]


class BagStream:
    """ROS 1 bag, ROS 2 folder, `.mcap` or `.db3` file.

    Samples carry header stamps. The rig holds the sensor that is mapped with: `vision.sensor`, or with `auto` the laser
    if the bag has one, else the camera.
    """

    def __init__(self, path: Path, config: Config, window: Window | None = None) -> None:
        """Index the bag.

        Raises:
            StreamError: the bag is damaged, or lacks what mapping needs; the message says what.
        """
        self._bag = BagFile(path)
        self._config, self._sensors = config, config.sensors
        self.name = path.name
        self._index = build_index(
            self._bag, (topic.name for topic in self._bag.topics if topic.msgtype in _READ), self._sensors.odom_frame
        )
        self.selection = select(self._bag.topics, self._sensors, self._index.frame_of, str(path))
        self._fixed_remarks = list(self.selection.remarks)
        track, what = self._self_motion()
        self._base_frame = clean_frame(self._sensors.base_frame or track.child or "base_link")
        carry = fixed_pose(self._index.transforms, track.child, self._base_frame)
        self._motion_ns, self._motion_poses = track.sorted(what, carry)
        self._scan_decoder: ScanDecoder | None = None
        self._planned, self._losses = self._plan_observations()
        self.rig = self._rig()
        self._apply(window or Window())
        self.report = StreamReport()

    @property
    def groundtruth(self) -> Trajectory | None:
        """True poses of the base, from an Odometry topic that says so."""
        topic = self.selection.groundtruth
        return None if topic is None else self._index.odometry[topic].trajectory(f"{self._bag.path}: {topic}")

    @property
    def expected_observations(self) -> int | None:
        """Number of scans or frames within the window."""
        return len(self._planned)

    def __iter__(self) -> Iterator[Sample]:
        """Yield self-motion and observations in order of header stamp.

        Raises:
            StreamError: a message is damaged; the message names topic and place.
        """
        self.report = StreamReport(dict(self._losses), list(self._fixed_remarks))
        for sample in merge(self._motions(), self._observations()):
            self.report.count("odometry" if isinstance(sample, SelfMotion) else "observations")
            yield sample
        if self._scan_decoder is not None and self._scan_decoder.resampled:
            self.report.counts["scans with other beams"] = self._scan_decoder.resampled

    def _motions(self) -> Iterator[Sample]:
        for stamp, pose in zip(self._motion_ns, self._motion_poses, strict=True):
            yield SelfMotion(int(stamp), pose)

    def _observations(self) -> Iterator[Sample]:
        """Second pass: read on until the messages of the next planned observation have come."""
        needed = {key for planned in self._planned for key in planned.needs}
        waiting: dict[_Key, Any] = {}
        upcoming = iter(self._planned)
        planned = next(upcoming, None)
        if planned is None:
            return
        for message in self._bag.raw(sorted({topic for topic, _ in needed})):
            key = (message.topic, message.number)
            if key in needed:
                waiting[key] = message
            while planned is not None and all(key in waiting for key in planned.needs):
                parts = tuple(self._bag.decode(waiting.pop(key)) for key in planned.needs)
                yield planned.decode(planned.stamp_ns, parts)
                planned = next(upcoming, None)
            if planned is None:
                return
        raise StreamError(f"{self._bag.path}: holds fewer messages than at the first reading; was it changed meanwhile?")

    def _self_motion(self) -> tuple[PoseTrack, str]:
        chosen = self.selection
        if chosen.odometry is not None:
            return self._index.odometry[chosen.odometry], f"{self._bag.path}: {chosen.odometry}"
        odom = clean_frame(self._sensors.odom_frame)
        tracks = [self._index.tf_tracks[key] for key in sorted(self._index.tf_tracks)] if chosen.odometry_tf else []
        if not tracks:
            types = ", ".join(f"{topic.name} ({topic.msgtype.replace('/msg/', '/')})" for topic in self._bag.topics) or "none"
            raise StreamError(
                f"{self._bag.path}: no odometry: expected a topic of type nav_msgs/Odometry or the transform "
                f"{odom!r} -> base on /tf; topics found: {types}"
            )
        self._fixed_remarks.append(f"no Odometry topic: self-motion from the transform {tracks[0].parent} -> {tracks[0].child}")
        return tracks[0], f"{self._bag.path}: transform {tracks[0].parent} -> {tracks[0].child}"

    def _plan_observations(self) -> tuple[list[_Planned], dict[str, int]]:
        wanted = self._config.vision.sensor
        if wanted == "none":
            return [], {}
        if self.selection.scan is not None and wanted in ("laser", "auto"):
            return self._plan_scans(self.selection.scan), {}
        if wanted == "laser":
            raise StreamError(f"{self._bag.path}: no laser: expected a topic of type sensor_msgs/LaserScan")
        return [], {}

    def _plan_scans(self, topic: str) -> list[_Planned]:
        what = f"{self._bag.path}: {topic}"
        mounting = self._sensors.laser_mounting
        if mounting is not None:
            pose, upside_down = np.array([mounting.x_m, mounting.y_m, mounting.yaw_rad]), mounting.upside_down
        else:
            T = self._index.transforms.require(self._base_frame, self._index.frame_of(topic), what, "sensors.laser_mounting")
            pose, upside_down = laser_pose(T, what)
        decoder = ScanDecoder(self._index.first[topic], pose, upside_down, self._sensors, what)
        self._scan_decoder = decoder
        stamps = np.asarray(self._index.stamps_ns[topic], dtype=np.int64)
        return [
            _Planned(int(stamps[i]), ((topic, int(i)),), lambda stamp, parts: decoder(parts[0], stamp))
            for i in sorted_order(stamps, what)
        ]

    def _rig(self) -> Rig:
        return Rig(laser=None if self._scan_decoder is None else self._scan_decoder.laser)

    def _apply(self, window: Window) -> None:
        starts = [int(self._motion_ns[0])] + [planned.stamp_ns for planned in self._planned[:1]]
        low, high = window.limits_ns(min(starts))
        inside = (self._motion_ns >= low) & (self._motion_ns <= high)
        self._motion_ns, self._motion_poses = self._motion_ns[inside], self._motion_poses[inside]
        self._planned = [planned for planned in self._planned if low <= planned.stamp_ns <= high]
        if not inside.any():
            raise StreamError(f"{self._bag.path}: no odometry between --start and --end")
