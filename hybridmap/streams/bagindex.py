"""Index of a bag, and the choice of topics: those in the configuration, else found by type and usual name.

A first pass reads every header stamp, all self-motion and transforms, and the first message of each sensor. It decodes no
images, so it is cheap, and it finds damage, NaN and disorder before mapping starts.
"""

from __future__ import annotations

import re
from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass, field
from typing import Any

import numpy as np
from numpy.typing import NDArray

from hybridmap.config.inputs import SensorsConfig
from hybridmap.errors import StreamError, counted
from hybridmap.geometry import Array, compose, yaw_from_quaternion
from hybridmap.streams.bagfile import BagFile
from hybridmap.streams.base import Rig, SensorKind
from hybridmap.streams.messages import TRANSFORM, Messages, RawMessage, Topic
from hybridmap.streams.mounting import TransformTree, clean_frame, matrix
from hybridmap.streams.order import sorted_order
from hybridmap.trajectory import FARTHEST_M, NS_PER_S, Trajectory, format_stamp

ODOMETRY = ("nav_msgs/msg/Odometry",)

_TRUTH = re.compile(r"ground_?truth|(^|[/_])(gt|truth|mocap|vicon)([/_]|$)", re.IGNORECASE)
TRANSPORT = re.compile(r"/(compressed|compressedDepth)$")
"""What image_transport adds to the name of a topic."""

_ODOMETRY_NAMES = (r"^/odom$", r"^/(odometry|wheel_odom|wheel_odometry)$", r"wheel", r"/odom$", r"odom")
"""The first pattern that fits counts; what fits none comes last."""


def planar_pose(stamp_ns: int, position: Any, orientation: Any, what: str) -> tuple[float, float, float]:
    """The planar part (x m, y m, yaw rad) of a pose with a ROS position and orientation.

    Args:
        stamp_ns: its stamp, ns, for errors.
        position, orientation: with x, y, z and x, y, z, w.
        what: file and topic, for errors.

    Raises:
        StreamError: NaN or Inf, a position too far away, or a quaternion of length 0 or infinity.
    """
    q = (orientation.x, orientation.y, orientation.z, orientation.w)
    pose = (float(position.x), float(position.y), float(yaw_from_quaternion(*q)))
    if not np.isfinite((*pose[:2], *q)).all():
        raise StreamError(f"{what}: found NaN or Inf in the pose at stamp {format_stamp(stamp_ns)} s; expected finite numbers")
    if max(abs(pose[0]), abs(pose[1])) > FARTHEST_M:
        at = f"({pose[0]:g}, {pose[1]:g}) m at stamp {format_stamp(stamp_ns)} s"
        raise StreamError(f"{what}: found the position {at}; expected at most {FARTHEST_M:g} m")
    if np.isnan(pose[2]):
        raise StreamError(
            f"{what}: found a quaternion of length 0 or infinity at stamp {format_stamp(stamp_ns)} s; expected a rotation"
        )
    return pose


@dataclass(slots=True)
class PoseTrack:
    """Poses of one frame in another, in recorded order.

    Attributes:
        parent, child: names of the frames, without leading slash; poses are those of the child in the parent.
        stamps_ns: header stamps, ns.
        poses: planar poses (x m, y m, yaw rad).
    """

    parent: str
    child: str
    stamps_ns: list[int] = field(default_factory=list)
    poses: list[tuple[float, float, float]] = field(default_factory=list)

    def add(self, stamp_ns: int, position: Any, orientation: Any, what: str) -> None:
        """Append a pose, given and refused as by `planar_pose`."""
        self.poses.append(planar_pose(stamp_ns, position, orientation, what))
        self.stamps_ns.append(stamp_ns)

    def sorted(self, what: str, pose_child_base: Array | None = None) -> tuple[NDArray[np.int64], Array]:
        """Stamps (N,) ns and poses (N, 3), m and rad, in order of time.

        Args:
            what: file and topic, for errors.
            pose_child_base: (3,) pose in the child frame of a frame fixed to it; if given, the poses are those of that frame.

        Raises:
            StreamError: the stamps are out of order by more than one message, or all equal.
        """
        stamps = np.asarray(self.stamps_ns, dtype=np.int64)
        order = sorted_order(stamps, what)
        poses = np.asarray(self.poses, dtype=np.float64).reshape(-1, 3)[order]
        return stamps[order], poses if pose_child_base is None else compose(poses, pose_child_base)

    def trajectory(self, what: str) -> Trajectory:
        """The poses as a trajectory in order of time; of poses with equal stamps the first is kept.

        Raises:
            StreamError: the stamps are out of order by more than one message, or all equal.
        """
        stamps, poses = self.sorted(what)
        first = np.concatenate([[True], np.diff(stamps) > 0])
        return Trajectory(stamps[first], poses[first])


@dataclass(slots=True)
class BagIndex:
    """Result of the first pass over a bag.

    Attributes:
        counts: topic -> number of messages read; 0 if none of them can be decoded.
        stamps_ns: topic -> header stamps in recorded order, ns.
        first: topic -> its first message, decoded.
        odometry: nav_msgs/Odometry topic -> its poses.
        unusable_transforms: names of transforms with invalid numbers, in order of appearance (a dict keeps the order).
        transforms: tree of all transforms, for the mountings of sensors.
        tf_tracks: (parent, child) -> poses, for the moving transforms that may be the odometry.
    """

    counts: dict[str, int] = field(default_factory=dict)
    stamps_ns: dict[str, list[int]] = field(default_factory=dict)
    first: dict[str, Any] = field(default_factory=dict)
    odometry: dict[str, PoseTrack] = field(default_factory=dict)
    unusable_transforms: dict[str, None] = field(default_factory=dict)
    transforms: TransformTree = field(default_factory=TransformTree)
    tf_tracks: dict[tuple[str, str], PoseTrack] = field(default_factory=dict)

    def frame_of(self, topic: str) -> str:
        """Frame in the header of the first message of a topic; empty if it has none."""
        return clean_frame(self.first[topic].header.frame_id) if topic in self.first else ""


def build_index(bag: BagFile, names: Iterable[str], odom_frame: str, *, skip_damaged: bool = False) -> BagIndex:
    """Read the named topics once.

    Args:
        bag: the bag.
        names: topics whose messages have a header or are transforms.
        odom_frame: transforms from this frame are kept as tracks of poses, since they may be the odometry.
        skip_damaged: take the first message of a sensor that can be decoded for its first one, instead of ending with an error.

    Raises:
        StreamError: the bag is damaged, or a pose has invalid numbers.
    """
    indexer = Indexer(bag, odom_frame, skip_damaged=skip_damaged)
    for message in bag.raw(sorted(set(names))):
        indexer.take(message)
    index = indexer.index
    index.counts |= dict.fromkeys(index.stamps_ns.keys() - index.first.keys(), 0)  # none of their messages can be decoded
    return index


class Indexer:
    """Makes the index, message by message; of a bag, or of a robot whose messages come in.

    Attributes:
        index: what was taken in so far.
    """

    def __init__(self, messages: Messages, odom_frame: str, *, skip_damaged: bool = False) -> None:
        """Start with an empty index; `odom_frame` and `skip_damaged` are those of `build_index`."""
        self.index = BagIndex()
        self._messages, self._odom_frame, self._skip_damaged = messages, clean_frame(odom_frame), skip_damaged

    def take(self, message: RawMessage) -> None:
        """Take in the next message of a topic, which has a header or holds transforms.

        Raises:
            StreamError: it is damaged, or a pose has invalid numbers.
        """
        index, topic = self.index, message.topic
        index.counts[topic] = message.number + 1
        if self._messages.types[topic] in TRANSFORM:
            self._take_transforms(message)
            return
        stamp_ns = self._messages.stamp_ns(message)
        index.stamps_ns.setdefault(topic, []).append(stamp_ns)
        is_odometry = self._messages.types[topic] in ODOMETRY
        if is_odometry or topic not in index.first:
            try:
                decoded = self._messages.decode(message)
            except StreamError:
                if is_odometry or not self._skip_damaged:
                    raise
                return
            index.first.setdefault(topic, decoded)
            if is_odometry:
                self._take_odometry(topic, decoded, stamp_ns)

    def _take_odometry(self, topic: str, message: Any, stamp_ns: int) -> None:
        if topic not in self.index.odometry:
            self.index.odometry[topic] = PoseTrack(clean_frame(message.header.frame_id), clean_frame(message.child_frame_id))
        pose = message.pose.pose
        self.index.odometry[topic].add(stamp_ns, pose.position, pose.orientation, f"{self._messages.source}: {topic}")

    def _take_transforms(self, message: RawMessage) -> None:
        index = self.index
        for transform in self._messages.decode(message).transforms:
            parent, child = clean_frame(transform.header.frame_id), clean_frame(transform.child_frame_id)
            p, q = transform.transform.translation, transform.transform.rotation
            what = f"{self._messages.source}: {message.topic}: {parent} -> {child}"
            stamp = transform.header.stamp
            stamp_ns = int(stamp.sec) * NS_PER_S + int(stamp.nanosec)
            if parent == self._odom_frame and not is_static(message.topic):
                track = index.tf_tracks.setdefault((parent, child), PoseTrack(parent, child))
                if not track.stamps_ns or track.stamps_ns[-1] != stamp_ns:  # tf is published again and again
                    track.add(stamp_ns, p, q, what)
            values = (p.x, p.y, p.z, q.x, q.y, q.z, q.w)
            if not (np.abs(values) <= FARTHEST_M).all() or np.isnan(yaw_from_quaternion(*values[3:])):
                index.unusable_transforms[f"{parent} -> {child}"] = None
                continue
            T = matrix((p.x, p.y, p.z), (q.x, q.y, q.z, q.w))
            index.transforms.add(parent, child, T, static=is_static(message.topic))


@dataclass(slots=True)
class Selection:
    """The topics to use; None for a missing one.

    Attributes:
        odometry: nav_msgs/Odometry topic.
        odometry_tf: whether self-motion comes from transforms instead.
        groundtruth: nav_msgs/Odometry topic with the true pose.
        sensors: name of a sensor in the rig -> its topics by role (such as `color`, `depth`).
        transforms: all topics with transforms.
        remarks: choices that the user may want to know.
    """

    odometry: str | None = None
    odometry_tf: bool = False
    groundtruth: str | None = None
    sensors: dict[str, dict[str, str]] = field(default_factory=dict)
    transforms: tuple[str, ...] = ()
    remarks: list[str] = field(default_factory=list)

    def uses(self, rig: Rig) -> dict[str, str]:
        """Role (such as `odometry`, `color`) -> topic, for self-motion and the sensors of a rig."""
        motion = ", ".join(self.transforms) if self.odometry_tf else self.odometry
        found = {} if motion is None else {"odometry": motion}
        for name in rig.sensors:
            found |= self.sensors.get(name, {})
        return found | ({} if self.groundtruth is None else {"groundtruth": self.groundtruth})


def is_static(topic: str) -> bool:
    """Whether a topic of transforms holds static ones (`/tf_static`)."""
    return topic.endswith("tf_static")


def select(
    topics: Sequence[Topic],
    config: SensorsConfig,
    kinds: Iterable[SensorKind],
    frame_of: Callable[[str], str],
    source: str,
) -> Selection:
    """Choose the topics of a bag to use; those without messages are left out.

    Args:
        topics: all topics of the bag.
        config: topics that the user named, if any.
        kinds: kinds of sensors to look for.
        frame_of: topic -> the frame in the header of its first message.
        source: path of the bag, for errors.

    Raises:
        StreamError: a topic that the user named does not exist or is of the wrong type; the message lists the possible ones.
    """
    chooser = TopicChooser([topic for topic in topics if topic.count], config, source)
    chosen = Selection(transforms=tuple(topic.name for topic in chooser.of(TRANSFORM)), remarks=chooser.remarks)
    _select_odometry(chooser, chosen, frame_of)
    for kind in kinds:
        if kind.in_bag is not None and kind.sensor_name not in chosen.sensors:
            chosen.sensors[kind.sensor_name] = kind.in_bag.find(chooser)
    return chosen


class TopicChooser:
    """Chooses topics of a bag by type and name.

    Attributes:
        remarks: choices that the user may want to know.
    """

    def __init__(self, topics: Sequence[Topic], config: SensorsConfig, source: str) -> None:
        self._topics, self._config, self._source = topics, config, source
        self.remarks: list[str] = []

    def of(self, types: Iterable[str]) -> list[Topic]:
        """All topics of the given message types, in the order of the bag's."""
        return [topic for topic in self._topics if topic.msgtype in types]

    def named(self, setting: str, types: tuple[str, ...]) -> str | None:
        """The topic that a setting of the section `sensors` names, with or without its first `/`; None if it is not set.

        Raises:
            StreamError: there is no such topic of these types with messages.
        """
        wanted = getattr(self._config, setting)
        if wanted is None:
            return None
        candidates = [topic.name for topic in self.of(types)]
        for name in (wanted, "/" + wanted):
            if name in candidates:
                return str(name)
        kinds = " or ".join(kind.replace("/msg/", "/") for kind in types)
        listed = ", ".join(candidates) or "none"
        raise StreamError(
            f"{self._source}: sensors.{setting}: no topic {wanted!r} of type {kinds} with messages; found: {listed}"
        )

    def best(self, types: tuple[str, ...], names: Sequence[str], keep: Callable[[str], bool] = lambda _: True) -> str | None:
        """The most likely topic of these types; None if there is none.

        The order of the usual `names` (regular expressions) counts first, then the number of messages, then the order of
        `types`. `keep` tells by its name whether a topic may be chosen. A choice among several adds a remark.
        """
        candidates = [topic for topic in self.of(types) if keep(topic.name)]
        if not candidates:
            return None

        def preference(topic: Topic) -> tuple[int, int, int, str]:
            plain = TRANSPORT.sub("", topic.name)
            rank = next((i for i, pattern in enumerate(names) if re.search(pattern, plain, re.IGNORECASE)), len(names))
            return rank, -topic.count, types.index(topic.msgtype), topic.name

        ranked = sorted(candidates, key=preference)
        if len(ranked) > 1:
            others = ", ".join(topic.name for topic in ranked[1:])
            self.remarks.append(f"took {ranked[0].name} ({counted(ranked[0].count, 'message')}) rather than {others}")
        return ranked[0].name


def _select_odometry(chooser: TopicChooser, chosen: Selection, frame_of: Callable[[str], str]) -> None:
    wanted = chooser.named("odometry_topic", ODOMETRY + TRANSFORM)
    if wanted in chosen.transforms:
        chosen.odometry_tf, wanted = True, None
    chosen.odometry = wanted
    truths = [
        topic
        for topic in chooser.of(ODOMETRY)
        if topic.name != wanted and (_TRUTH.search(topic.name) or frame_of(topic.name) == "world")
    ]
    chosen.groundtruth = chooser.named("groundtruth_topic", ODOMETRY) or (truths[0].name if truths else None)
    hidden = {topic.name for topic in truths} | {chosen.groundtruth}
    if wanted is None and not chosen.odometry_tf:
        chosen.odometry = chooser.best(ODOMETRY, _ODOMETRY_NAMES, keep=lambda name: name not in hidden)
        chosen.odometry_tf = chosen.odometry is None and any(not is_static(name) for name in chosen.transforms)
