"""The odometry of a live robot as received, and the correction of the map, smoothed for a planner."""

from __future__ import annotations

from bisect import bisect_left
from dataclasses import dataclass

import numpy as np

from hybridmap.errors import StreamError
from hybridmap.geometry import IDENTITY, Array, between, compose, exp, interpolate, inverse
from hybridmap.streams.base import Motion, Sample, SelfMotion, Velocity
from hybridmap.trajectory import NS_PER_S, format_stamp

_SAME = 1e-9
"""Two poses are the same that differ by no more than this, m or rad."""
_TURN_M, _STANDING_M_S = 1.0, 0.01
"""A turn by a radian shows a sensor as much that is new as this way; of views from one place, newer ones are better."""
_KEPT = 4000
"""Poses that are kept, for poses at stamps of the last minute or more."""


class ReceivedOdometry:
    """Poses of the robot in `odom` as the robot gives them; velocities are integrated from the identity.

    One thread adds; any thread may read meanwhile, without waiting.

    Attributes:
        kind: the kind of self-motion; None before the first.
        first: (3,) the first pose, m and rad; the identity before it.
    """

    def __init__(self) -> None:
        self._poses: tuple[list[int], list[Array]] = ([], [])
        self._velocity: Velocity | None = None
        self.kind: type[Motion] | None = None
        self.first: Array = IDENTITY

    def add(self, sample: Motion) -> None:
        """Take in a motion; one that is not newer than the newest is left out."""
        self.kind = type(sample)
        stamps, poses = self._poses
        if stamps and sample.stamp_ns <= stamps[-1]:
            return
        pose = sample.pose_odom_robot if isinstance(sample, SelfMotion) else self._held(sample.stamp_ns)
        self._velocity = sample if isinstance(sample, Velocity) else None
        if len(stamps) >= 2 * _KEPT:
            stamps, poses = self._poses = stamps[-_KEPT:], poses[-_KEPT:]
        if not stamps:
            self.first = pose
        poses.append(pose)
        stamps.append(sample.stamp_ns)

    @property
    def newest(self) -> Array:
        """(3,) the newest pose, m and rad; the identity before the first."""
        poses = self._poses[1]
        return poses[-1] if poses else IDENTITY

    def at(self, stamp_ns: int) -> Array:
        """(3,) the pose at a stamp, interpolated; the newest one for a later stamp.

        Raises:
            StreamError: the stamp lies before the first pose that is kept.
        """
        stamps, poses = self._poses
        after = bisect_left(stamps, stamp_ns)
        if after == len(stamps):
            return self.newest
        if stamps[after] == stamp_ns:
            return poses[after]
        if after == 0:
            raise StreamError(
                f"no odometry is kept at stamp {format_stamp(stamp_ns)} s; expected {format_stamp(stamps[0])} s or later"
            )
        fraction = (stamp_ns - stamps[after - 1]) / (stamps[after] - stamps[after - 1])
        return interpolate(poses[after - 1], poses[after], fraction)

    def _held(self, stamp_ns: int) -> Array:
        """The pose at a stamp, with the last velocity held since it came: an exact arc."""
        if self._velocity is None:
            return IDENTITY
        dt_s = (stamp_ns - self._velocity.stamp_ns) / NS_PER_S
        return compose(self.newest, exp(np.array([self._velocity.v_m_s * dt_s, 0.0, self._velocity.omega_rad_s * dt_s])))


class Odometer:
    """How far the robot has moved, with turns, by samples in order; where it stands, time goes on slowly."""

    def __init__(self) -> None:
        self._way = 0.0
        self._last: Motion | None = None
        self._stamp_ns: int | None = None

    def way(self, sample: Sample) -> float:
        """The way up to a sample, in metres: `_TURN_M` for a radian, and `_STANDING_M_S` for a second."""
        dt_s = 0.0 if self._stamp_ns is None else (sample.stamp_ns - self._stamp_ns) / NS_PER_S
        self._way += _STANDING_M_S * dt_s
        self._stamp_ns = sample.stamp_ns
        last = self._last
        if isinstance(last, Velocity):
            self._way += (abs(last.v_m_s) + _TURN_M * abs(last.omega_rad_s)) * dt_s
        elif isinstance(last, SelfMotion) and isinstance(sample, SelfMotion):
            step = between(last.pose_odom_robot, sample.pose_odom_robot)
            self._way += float(np.hypot(step[0], step[1]) + _TURN_M * abs(step[2]))
        self._last = sample if isinstance(sample, SelfMotion | Velocity) else last
        return self._way


@dataclass(frozen=True, slots=True)
class SmoothedCorrection:
    """The correction `map -> odom` for a planner, which a loop closure must not throw.

    Attributes:
        pose_map_odom: (3,) the smoothed correction, m and rad.
        off_m, off_rad: how far it puts the robot from where the raw correction has it.
    """

    pose_map_odom: Array
    off_m: float
    off_rad: float


class Smoother:
    """Follows the raw correction so slowly that the robot is never moved on the map faster than the limits allow.

    What is limited is the motion of the robot on the map, and not of the origin of `odom`, which may be far away.
    """

    def __init__(self, m_s: float, rad_s: float) -> None:
        """Start at the first raw correction; the limits are a speed, m/s, and a turn rate, rad/s."""
        self._m_s, self._rad_s = m_s, rad_s
        self._last: tuple[float, Array] | None = None

    def step(self, now_s: float, pose_map_odom: Array, pose_odom_robot: Array) -> SmoothedCorrection:
        """The smoothed correction at a time, s, given the raw one (3,), and the robot (3,) in `odom`."""
        before_s, smoothed = self._last or (now_s, pose_map_odom)
        dt_s = max(now_s - before_s, 0.0)
        shown, wanted = compose(smoothed, pose_odom_robot), compose(pose_map_odom, pose_odom_robot)
        way = between(shown, wanted)
        length, turn = float(np.hypot(way[0], way[1])), float(way[2])
        reach_m, reach_rad = self._m_s * dt_s + _SAME, self._rad_s * dt_s + _SAME
        if length <= reach_m and abs(turn) <= reach_rad:
            self._last = now_s, pose_map_odom
            return SmoothedCorrection(pose_map_odom, 0.0, 0.0)
        share, turned = min(1.0, reach_m / max(length, _SAME)), float(np.clip(turn, -reach_rad, reach_rad))
        robot = compose(shown, np.array([share * way[0], share * way[1], turned]))
        smoothed = compose(robot, inverse(pose_odom_robot))
        self._last = now_s, smoothed
        return SmoothedCorrection(smoothed, (1.0 - share) * length, abs(turn - turned))
