"""What the first messages of a bag or a robot say of it: where its self-motion comes from, its base, and its sensors."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass

from hybridmap.config.inputs import SensorsConfig
from hybridmap.errors import StreamError
from hybridmap.geometry import Array
from hybridmap.streams.bagindex import BagIndex, PoseTrack, Selection
from hybridmap.streams.base import InBag, SensorPlan
from hybridmap.streams.messages import Messages
from hybridmap.streams.mounting import clean_frame, planar
from hybridmap.streams.sensors import wanted


@dataclass(frozen=True, slots=True)
class MotionSource:
    """Where the self-motion comes from.

    Attributes:
        track: its poses so far, of the frame `track.child`.
        what: source and topic, for errors.
        base_frame: the frame to map.
        pose_child_base: (3,) pose of the base in `track.child`, m and rad; None if they are the same.
        remarks: for the user.
    """

    track: PoseTrack
    what: str
    base_frame: str
    pose_child_base: Array | None
    remarks: tuple[str, ...] = ()


def self_motion(index: BagIndex, selection: Selection, sensors: SensorsConfig, messages: Messages) -> MotionSource:
    """Find the self-motion: the chosen Odometry topic, else the transform from the frame `sensors.odom_frame`.

    Raises:
        StreamError: there is none so far, or the transform from its frame to the base is not known.
    """
    track, what, remarks = _track(index, selection, sensors, messages)
    usual = (frame for frame in ("base_link", "base_footprint") if frame in index.transforms.frames)
    base_frame = clean_frame(sensors.base_frame or "") or track.child or next(usual, "base_link")
    carry = None
    if track.child not in ("", base_frame):
        carry = planar(index.transforms.require(track.child, base_frame, what, "another sensors.base_frame"))
    return MotionSource(track, what, base_frame, carry, remarks)


def _track(
    index: BagIndex, selection: Selection, sensors: SensorsConfig, messages: Messages
) -> tuple[PoseTrack, str, tuple[str, ...]]:
    if selection.odometry is not None and selection.odometry in index.odometry:
        return index.odometry[selection.odometry], f"{messages.source}: {selection.odometry}", ()
    odom = clean_frame(sensors.odom_frame)
    known = index.tf_tracks.values() if selection.odometry_tf else ()
    base = clean_frame(sensors.base_frame or "")
    tracks = sorted(known, key=lambda track: (track.child != base, -len(track.stamps_ns), track.child))
    if not tracks:
        types = ", ".join(f"{name} ({kind.replace('/msg/', '/')})" for name, kind in sorted(messages.types.items())) or "none"
        raise StreamError(
            f"{messages.source}: no odometry: expected a topic of type nav_msgs/Odometry or the transform "
            f"{odom!r} -> base on /tf; topics found: {types}"
        )
    name = f"{tracks[0].parent} -> {tracks[0].child}"
    remark = f"no Odometry topic: self-motion from the transform {name}"
    return tracks[0], f"{messages.source}: transform {name}", (remark,)


def plan_sensor(sensor: str, selection: Selection, plan: Callable[[InBag, Mapping[str, str]], SensorPlan]) -> SensorPlan:
    """Plan the observations of the sensor to map with: that of `vision.sensor`, or for `auto` the first that has topics.

    Args:
        sensor: value of `vision.sensor`.
        selection: the topics.
        plan: (kind, its topics by role) -> its observations.

    Raises:
        StreamError: by `plan`.
    """
    looked_for = wanted(sensor)
    for kind in looked_for:
        topics = selection.sensors.get(kind.sensor_name, {})
        if kind.in_bag is not None and (topics or len(looked_for) == 1):
            return plan(kind.in_bag, topics)
    if not looked_for:
        return SensorPlan()
    lacking = " and no ".join(kind.needs for kind in looked_for if kind.in_bag is not None)
    return SensorPlan(remarks=[f"no {lacking}: self-motion alone"])
