"""Experience maps of OpenRatSLAM in bags: TopologicalActions with odometry, or else the last TopologicalMap."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from hybridmap.config.inputs import SensorsConfig
from hybridmap.errors import StreamError, counted
from hybridmap.geometry import Array, between, compose, exp, inverse, wrap_angle, yaw_from_quaternion
from hybridmap.imported.recorded import Link, RecordedMap, from_links
from hybridmap.store import Track
from hybridmap.streams.bagfile import BagFile
from hybridmap.streams.bagindex import ODOMETRY, select
from hybridmap.streams.ratslam_messages import ACTION, CREATE_EDGE, CREATE_NODE, MAP, SET_NODE, is_a
from hybridmap.trajectory import FARTHEST_M, NS_PER_S


@dataclass(frozen=True, slots=True)
class Action:
    """One TopologicalAction.

    Attributes:
        sample: index of the odometry message that came last before it.
        stamp_ns: header stamp, ns.
        action: `CREATE_NODE`, `CREATE_EDGE` or `SET_NODE`.
        source, target: `src_id`, the experience that the robot leaves, and `dest_id`, the one in which it then is.
        relative_rad: heading of the robot in the frame of the target; without effect for a new experience.
    """

    sample: int
    stamp_ns: int
    action: int
    source: int
    target: int
    relative_rad: float

    @property
    def row(self) -> tuple[int | float, ...]:
        """The action as numbers, in the order of its attributes."""
        return self.sample, self.stamp_ns, self.action, self.source, self.target, self.relative_rad

    @property
    def turned(self) -> Array:
        """(3,) pose of the robot in the frame of the target, m and rad: it is at its place."""
        return np.array([0.0, 0.0, 0.0 if self.action == CREATE_NODE else self.relative_rad])


@dataclass(frozen=True, slots=True)
class _Odometry:
    """Dead reckoning: T strictly increasing stamps, poses (T, 3), and path length and turn (T,) up to each, m and rad."""

    stamps_ns: NDArray[np.int64]
    poses: Array
    travel_m: Array
    turn_rad: Array


def read_bag(path: Path, sensors: SensorsConfig) -> RecordedMap:
    """Read the experience map of a ROS 1 or ROS 2 bag: from its actions and odometry, else its last TopologicalMap.

    An action belongs to the odometry message recorded last before it, as in OpenRatSLAM, whatever its own stamp.

    Args:
        path: of the bag.
        sensors: may name the topic of the odometry (`odometry_topic`).

    Raises:
        StreamError: the bag is damaged, holds neither, or its actions are out of order or name an unknown experience.
        GraphError: the map is none; see `recorded.made_by`.
    """
    bag = BagFile(path)
    found = {kind: [topic for topic in bag.topics if is_a(topic.msgtype, kind) and topic.count] for kind in (ACTION, MAP)}
    if found[ACTION]:
        topic = max(found[ACTION], key=lambda one: one.count).name
        odometry = select(bag.topics, sensors, (), lambda _: "", str(path)).odometry
        if odometry is None:
            raise StreamError(f"{path}: {topic}: actions need odometry; expected a topic of type {ODOMETRY[0]}")
        return _from_actions(bag, topic, odometry)
    if found[MAP]:
        return read_topological_map(bag, max(found[MAP], key=lambda one: one.count).name)
    held = ", ".join(f"{topic.name} ({topic.msgtype.replace('/msg/', '/')})" for topic in bag.topics) or "none"
    raise StreamError(f"{path}: no map of OpenRatSLAM: expected TopologicalAction or TopologicalMap; topics found: {held}")


def read_topological_map(bag: BagFile, topic: str) -> RecordedMap:
    """Read the last TopologicalMap of a topic.

    Raises:
        StreamError: the bag is damaged, or experiences are not numbered from 0 without gaps.
        GraphError: the map is none; see `recorded.made_by`.
    """
    *_, message = bag.raw([topic])
    map_ = bag.decode(message)
    where = f"{bag.path}: {topic}"
    if [node.id for node in map_.node] != list(range(len(map_.node))):
        raise StreamError(f"{where}: expected experiences with the ids 0 to {len(map_.node) - 1} in order")
    poses = np.array([_planar(node.pose.position, node.pose.orientation) for node in map_.node]).reshape(-1, 3)
    links = []
    for edge in map_.edge:
        delta = _planar(edge.transform.translation, edge.transform.rotation)
        duration_s = edge.duration.sec + edge.duration.nanosec / NS_PER_S
        way_m = float(np.hypot(*delta[:2]))
        links.append(Link(int(edge.source_id), int(edge.destination_id), delta, way_m, abs(float(delta[2])), duration_s))
    unknown = np.full(len(poses), -1, dtype=np.int64)
    return from_links(bag.path.name, where, poses, unknown, links, bag.stamp_ns(message))


def _planar(position: Any, rotation: Any) -> Array:
    return np.array([position.x, position.y, yaw_from_quaternion(rotation.x, rotation.y, rotation.z, rotation.w)])


def _from_actions(bag: BagFile, topic: str, odometry_topic: str) -> RecordedMap:
    samples: list[tuple[float, ...]] = []
    actions: list[Action] = []
    where = f"{bag.path}: {topic}"
    for message in bag.raw([topic, odometry_topic]):
        decoded, stamp_ns = bag.decode(message), bag.stamp_ns(message)
        if message.topic == odometry_topic:
            if not samples or stamp_ns != samples[-1][0]:  # of equal stamps the first is kept, as everywhere
                samples.append((stamp_ns, *_sample(decoded)))
            continue
        if not samples:
            raise StreamError(f"{where}: action {len(actions) + 1} comes before any odometry; is the bag's beginning missing?")
        ends = int(decoded.src_id), int(decoded.dest_id)
        turn_rad = float(getattr(decoded, "relative_rad", 0.0))  # early versions of the message have no such field
        actions.append(Action(len(samples) - 1, stamp_ns, int(decoded.action), *ends, turn_rad))
    if not samples:
        raise StreamError(f"{bag.path}: {odometry_topic}: holds no odometry that can be read")
    odometry, remarks = _reckoned(samples, f"{bag.path}: {odometry_topic}")
    return _replayed(bag.path.name, where, actions, odometry, remarks)


def _sample(message: Any) -> tuple[float, ...]:
    """Pose (x, y, yaw; NaN where the quaternion is no rotation), forward speed and turn rate of an Odometry message."""
    pose, twist = message.pose.pose, message.twist.twist
    return (*_planar(pose.position, pose.orientation).tolist(), float(twist.linear.x), float(twist.angular.z))


def _reckoned(samples: Sequence[tuple[float, ...]], where: str) -> tuple[_Odometry, tuple[str, ...]]:
    """Dead reckoning by the poses of the messages, or, where they do not move, by their twists, as OpenRatSLAM does."""
    stamps = np.array([sample[0] for sample in samples], dtype=np.int64)
    if (np.diff(stamps) <= 0).any():
        number = int(np.argmax(np.diff(stamps) <= 0)) + 2
        raise StreamError(f"{where}: stamp of message {number} is not later than the one before; expected sorted stamps")
    values = np.array([sample[1:] for sample in samples], dtype=np.float64)
    poses, remarks = values[:, :3], tuple[str, ...]()
    if np.isnan(poses[:, 2]).any() or (np.ptp(poses, axis=0) == 0.0).all():
        remarks = ("odometry without moving poses: its twists are integrated",)
        ways = values[1:, 3:] * (np.diff(stamps) / NS_PER_S)[:, None]
        poses = np.zeros((len(stamps), 3))
        for k, step in enumerate(exp(np.column_stack([ways[:, 0], np.zeros(len(ways)), ways[:, 1]]))):
            poses[k + 1] = compose(poses[k], step)
    if not (np.abs(poses) <= FARTHEST_M).all():
        raise StreamError(f"{where}: found NaN, Inf or a number beyond {FARTHEST_M:g} in the odometry")
    travel = np.cumsum(np.hypot(*np.diff(poses[:, :2], axis=0, prepend=poses[:1, :2]).T))
    turn = np.cumsum(np.abs(wrap_angle(np.diff(poses[:, 2], prepend=poses[0, 2]))))
    return _Odometry(stamps, poses, travel, turn), remarks


def _replayed(name: str, where: str, actions: Sequence[Action], odometry: _Odometry, remarks: tuple[str, ...]) -> RecordedMap:
    """The map that the actions make. After an action the robot is in the experience, turned by `relative_rad` against it.

    OpenRatSLAM adds `relative_rad` to the turn of a new link, too; here a link leads to the heading of the experience.
    """
    made: list[int] = []
    links: list[Link] = []
    joined: set[frozenset[int]] = set()
    stays: list[Action] = []
    repeated = 0
    for number, action in enumerate(actions, start=1):
        at = stays[-1] if stays else None
        _check(
            action, at, len(made), actions[number - 2].stamp_ns if number > 1 else action.stamp_ns, f"{where}: action {number}"
        )
        if action.action == CREATE_NODE:
            made.append(action.sample)
        if at is not None and action.action != SET_NODE:
            pair = frozenset((at.target, action.target))
            if pair not in joined:
                links.append(_link(at, action, odometry))
            repeated += pair in joined
            joined.add(pair)
        if at is None or at.target != action.target:  # a robot that is there already stays where it is
            stays.append(action)
    if not made:
        raise StreamError(f"{where}: no action makes an experience; the map is empty")
    if repeated:
        remarks += (f"{counted(repeated, 'link')} made again: the first one counts, as in OpenRatSLAM",)
    return RecordedMap(
        name=name,
        links=tuple(links),
        stamps_ns=odometry.stamps_ns[made],
        poses_odom=odometry.poses[made],
        travel_m=odometry.travel_m[made],
        track=_track(stays, odometry),
        poses=None,
        templates=np.full(len(made), -1, dtype=np.int64),
        actions=tuple(action.row for action in actions),
        counts={"actions": len(actions), "odometry": len(odometry.poses)},
        remarks=remarks,
    )


def _check(action: Action, at: Action | None, made: int, before_ns: int, said: str) -> None:
    """Refuse an action that does not follow from those before it: `at` is the last one that moved the robot, if any."""
    kinds = {CREATE_NODE: "CREATE_NODE", CREATE_EDGE: "CREATE_EDGE", SET_NODE: "SET_NODE"}
    if action.action not in kinds:
        raise StreamError(
            f"{said}: unknown action {action.action}; expected {', '.join(f'{k} ({v})' for k, v in kinds.items())}"
        )
    said = f"{said} ({kinds[action.action]} {action.source} -> {action.target})"
    if action.stamp_ns < before_ns:
        raise StreamError(f"{said}: its stamp is earlier than that of the action before; are actions out of order?")
    if action.action == CREATE_NODE and action.target != made:
        raise StreamError(f"{said}: expected the new experience {made}; are actions missing or out of order?")
    if action.action != CREATE_NODE and not max(action.source, action.target) < made:
        raise StreamError(f"{said}: names an unknown experience; {counted(made, 'experience')} made so far")
    if action.action == CREATE_EDGE and action.source == action.target:
        raise StreamError(f"{said}: a link from an experience to itself")
    if at is not None and action.source != at.target:
        raise StreamError(f"{said}: the robot is in experience {at.target}; are actions missing or out of order?")
    if not abs(action.relative_rad) <= FARTHEST_M:
        raise StreamError(f"{said}: found relative_rad {action.relative_rad}, expected a finite angle")


def _link(at: Action, action: Action, odometry: _Odometry) -> Link:
    """The way from where the robot is to the experience of an action, by odometry."""
    start, end = at.sample, action.sample
    moved = compose(at.turned, between(odometry.poses[start], odometry.poses[end]))
    travel_m, turn_rad = (float(values[end] - values[start]) for values in (odometry.travel_m, odometry.turn_rad))
    duration_s = float(odometry.stamps_ns[end] - odometry.stamps_ns[start]) / NS_PER_S
    return Link(at.target, action.target, compose(moved, inverse(action.turned)), travel_m, turn_rad, duration_s)


def _track(stays: Sequence[Action], odometry: _Odometry) -> Track:
    """Where the robot was at every odometry message, seen from the experience that it was in."""
    starts = np.array([stay.sample for stay in stays])
    at = np.maximum(np.searchsorted(starts, np.arange(len(odometry.poses)), side="right") - 1, 0)
    turned = np.array([stay.turned for stay in stays])
    deltas = compose(turned[at], between(odometry.poses[starts[at]], odometry.poses))
    nodes = np.array([stay.target for stay in stays], dtype=np.int64)[at]
    return Track(odometry.stamps_ns, nodes, deltas, odometry.poses)
