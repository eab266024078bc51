"""Where the robot was between nodes, and how node poses become a trajectory."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from hybridmap.errors import StoreError
from hybridmap.geometry import Array, between, compose, interpolate, wrap_angle
from hybridmap.trajectory import NO_ANCHORS, Anchors, Trajectory

_TURN_AS_TRAVEL_M = 0.3
"""Metres of travel that a turn of one radian counts for when a residual is spread over the way."""


@dataclass(frozen=True, slots=True)
class Track:
    """Where the robot was at each distinct stamp, seen from a node.

    Attributes:
        stamps_ns: (T,) int64, strictly increasing.
        nodes: (T,) int64, the node from which the robot is seen: the one made last, or the one it was re-anchored to.
        deltas: (T, 3) pose of the robot in the frame of that node, m and rad.
        poses_odom: (T, 3) pose of the robot in `odom`, m and rad.
        anchors: poses of frames between nodes that were registered to the final map, at stamps of the track.
    """

    stamps_ns: NDArray[np.int64]
    nodes: NDArray[np.int64]
    deltas: Array
    poses_odom: Array
    anchors: Anchors = NO_ANCHORS

    def __len__(self) -> int:
        return len(self.stamps_ns)

    @property
    def odometry(self) -> Trajectory:
        """The poses in `odom` as a trajectory: dead reckoning over the whole recording."""
        return Trajectory(self.stamps_ns, self.poses_odom)


def trajectory_of(track: Track, poses: Array) -> Trajectory:
    """Poses of the robot in `map` at every stamp of the track, given those of the nodes.

    Poses are known at nodes and anchors. Between two of these, the pose propagated from the first and that propagated back
    from the second are blended along the SE(2) geodesic by the share of the way, so that the trajectory is continuous. Where
    they differ by more than this way, the odometry did not see the motion, and they are blended by the share of the time.

    Args:
        track: where the robot was, seen from nodes.
        poses: (N, 3) pose of each node in `map`, m and rad.

    Raises:
        StoreError: the track is empty or names a node beyond `poses`.
    """
    if len(track) == 0:
        raise StoreError("track: holds no pose; nothing was mapped")
    unknown = track.nodes[(track.nodes >= len(poses)) | (track.nodes < 0)]
    if len(unknown):
        raise StoreError(f"track: names node {int(unknown.max())}, expected 0 to {len(poses) - 1}")
    made = np.flatnonzero(np.diff(track.nodes, prepend=track.nodes[0] - 1))
    at, anchored = _anchored(track, poses, made)
    knots = np.union1d(made, at)
    known = compose(poses[track.nodes[knots]], track.deltas[knots])
    known[np.searchsorted(knots, at)] = anchored
    before, after = _neighbours(knots, len(track))
    start, end = knots[before], knots[after]
    forward = compose(known[before], between(track.poses_odom[start], track.poses_odom))
    backward = compose(known[after], between(track.poses_odom[end], track.poses_odom))
    off = between(compose(known[before], between(track.poses_odom[start], track.poses_odom[end])), known[after])
    way = _way(track)
    unseen = _length(off) > way[end] - way[start]
    share = np.where(unseen, _share_of_time(track, start, end), _share_of_way(track, start, end))
    return Trajectory(track.stamps_ns, interpolate(forward, backward, share))


def _anchored(track: Track, poses: Array, made: NDArray[np.int64]) -> tuple[NDArray[np.int64], Array]:
    """Rows of the track at which there are anchors, and the poses (A, 3) there on a map of given node poses."""
    _, rows, chosen = np.intersect1d(track.stamps_ns, track.anchors.stamps_ns, assume_unique=True, return_indices=True)
    a = track.anchors
    from_before = compose(poses[a.nodes[chosen]], a.deltas[chosen])
    from_after = compose(poses[a.next_nodes[chosen]], a.next_deltas[chosen])
    before, after = _neighbours(made, len(track))
    share = _share_of_way(track, made[before], made[after])
    return rows, interpolate(from_before, from_after, share[rows])


def _neighbours(knots: NDArray[np.int64], count: int) -> tuple[NDArray[np.int64], NDArray[np.int64]]:
    """Position of the knot at or before each of `count` rows, and of the one after (the same beyond the last)."""
    before = np.searchsorted(knots, np.arange(count), side="right") - 1
    return before, np.minimum(before + 1, len(knots) - 1)


def _share_of_way(track: Track, start: NDArray[np.int64], end: NDArray[np.int64]) -> Array:
    """(T,) how much of the way from `start` to `end` is done: by travel and turn, by time where the robot stood still."""
    way = _way(track)
    done, total = way - way[start], way[end] - way[start]
    moved = total > 1e-6
    return np.asarray(np.where(moved, done / np.where(moved, total, 1.0), _share_of_time(track, start, end)))


def _share_of_time(track: Track, start: NDArray[np.int64], end: NDArray[np.int64]) -> Array:
    """(T,) how much of the time from `start` to `end` is over; 0 where they are one."""
    stamps = track.stamps_ns
    return np.asarray(np.where(end > start, (stamps - stamps[start]) / np.maximum(stamps[end] - stamps[start], 1), 0.0))


def _way(track: Track) -> Array:
    """(T,) length of the way up to each pose by the odometry, m."""
    return np.asarray(np.cumsum(_length(np.diff(track.poses_odom, axis=0, prepend=track.poses_odom[:1]))))


def _length(motion: Array) -> Array:
    """(T,) length of motions (T, 3), m, with turns counted in."""
    return np.asarray(np.hypot(motion[:, 0], motion[:, 1]) + _TURN_AS_TRAVEL_M * np.abs(wrap_angle(motion[:, 2])))
