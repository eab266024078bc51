"""A trajectory: planar poses at whole-nanosecond stamps, and the TUM text format that carries it."""

from __future__ import annotations

from dataclasses import dataclass
from decimal import Decimal, InvalidOperation
from pathlib import Path

import numpy as np
from numpy.typing import ArrayLike, NDArray

from hybridmap.errors import GeometryError, StreamError, quoted
from hybridmap.geometry import Array, between, compose, interpolate, quaternion_from_yaw, yaw_from_quaternion
from hybridmap.output import write_text

NS_PER_S = 1_000_000_000
FARTHEST_M = 1e9
"""Coordinates of a pose, m, beyond which they have no millionths left; no map of the earth has them."""
MAX_GAP_S = 1.0
"""A reference is interpolated between two of its poses only if they are no further apart than this."""


LATEST_S = 9_000_000_000
"""The year 2255. Later stamps do not fit into 64 bits of nanoseconds; those of other units than seconds are far beyond."""
_UNITS = {"milliseconds": 10**3, "microseconds": 10**6, "nanoseconds": 10**9}
_MOST_DIGITS = 40
"""Characters of a stamp: 10 digits of seconds, a point and 9 decimals are 20. A number of 10^999990 takes half a minute."""


def read_stamp_ns(text: str) -> int:
    """Nearest whole nanosecond of a stamp in seconds, as files have it.

    Raises:
        ValueError: no number, or one that is no time in seconds; the message says what was found and what was expected.
    """
    try:
        stamp_s = Decimal(text) if len(text) <= _MOST_DIGITS else None
    except InvalidOperation:
        stamp_s = None
    if stamp_s is None or not stamp_s.is_finite():
        raise ValueError(f"expected a stamp in seconds, found {quoted(text)}")
    if abs(stamp_s) > LATEST_S:
        unit = next((name for name, per_s in _UNITS.items() if abs(stamp_s) <= LATEST_S * per_s), None)
        guess = f", which would be the year {_year(stamp_s / _UNITS[unit])} in {unit}" if unit else ""
        raise ValueError(f"expected a stamp in seconds, found {quoted(text)}{guess}; convert it to seconds")
    return int((stamp_s * NS_PER_S).to_integral_value())


def _year(stamp_s: Decimal) -> int:
    return 1970 + int(stamp_s / 31_556_952)  # seconds of a year, on average


def stamp_ns_from_s(stamp_s: float) -> int:
    """Nearest whole nanosecond of a stamp in seconds."""
    return round(stamp_s * NS_PER_S)


@dataclass(frozen=True, slots=True)
class Trajectory:
    """Poses in one frame over time, sorted by stamp.

    Attributes:
        stamps_ns: (N,) int64, nanoseconds, strictly increasing.
        poses: (N, 3) float64, x and y in m, yaw in rad.
    """

    stamps_ns: NDArray[np.int64]
    poses: Array

    def __post_init__(self) -> None:
        if self.poses.shape != (len(self.stamps_ns), 3):
            raise GeometryError(
                f"trajectory: found poses {self.poses.shape}, expected ({len(self.stamps_ns)}, 3), one for each stamp"
            )
        if not np.isfinite(self.poses).all():
            raise GeometryError("trajectory: found NaN or Inf in its poses, expected finite numbers")
        if np.any(np.diff(self.stamps_ns) <= 0):
            raise GeometryError("trajectory: found stamps that do not strictly increase; sort them and drop duplicates")

    def __len__(self) -> int:
        return len(self.stamps_ns)

    @property
    def stamps_s(self) -> Array:
        """(N,) float64, seconds."""
        return self.stamps_ns / NS_PER_S

    def at(self, stamps_ns: ArrayLike) -> Array:
        """Poses `(M, 3)` at given stamps `(M,)`, ns, by interpolation on SE(2); held constant beyond either end.

        Gaps are bridged, however long: see `known_at`.
        """
        wanted = np.asarray(stamps_ns, dtype=np.int64)
        if len(self) == 1:
            return np.repeat(self.poses, len(wanted), axis=0)
        right = np.clip(np.searchsorted(self.stamps_ns, wanted), 1, len(self) - 1)
        t0, t1 = self.stamps_ns[right - 1], self.stamps_ns[right]
        fraction = np.clip((wanted - t0) / (t1 - t0), 0.0, 1.0)
        return interpolate(self.poses[right - 1], self.poses[right], fraction)

    def covers(self, stamps_ns: ArrayLike, slack_ns: int = 0) -> NDArray[np.bool_]:
        """Which of the stamps `(M,)`, ns, lie within the trajectory's span, `slack_ns` wider on either side."""
        wanted = np.asarray(stamps_ns, dtype=np.int64)
        return np.asarray((wanted >= self.stamps_ns[0] - slack_ns) & (wanted <= self.stamps_ns[-1] + slack_ns))


def known_at(trajectory: Trajectory, stamps_ns: NDArray[np.int64], max_gap_s: float = MAX_GAP_S) -> NDArray[np.bool_]:
    """At which (M,) of the stamps (M,), ns, a trajectory is known: inside its span, and not inside a gap beyond `max_gap_s`."""
    if len(trajectory) == 0:
        return np.zeros(len(stamps_ns), dtype=np.bool_)
    times = trajectory.stamps_ns
    right = np.searchsorted(times, stamps_ns, side="left")
    exact = times[np.minimum(right, len(times) - 1)] == stamps_ns
    inside = (right > 0) & (right < len(times))
    after, before = times[np.minimum(right, len(times) - 1)], times[np.maximum(right - 1, 0)]
    return np.asarray(exact | (inside & (after - before <= max_gap_s * NS_PER_S)))


@dataclass(frozen=True, slots=True)
class Anchors:
    """Poses of frames between nodes that were registered to the final map, seen from the node before and from the node after.

    On the map of the registration both give the same pose; on the map of another back-end they are blended.

    Attributes:
        stamps_ns: (S,) int64, increasing.
        nodes, next_nodes: (S,) int64, the node before and the node after (the same at the last node).
        deltas, next_deltas: (S, 3) pose of the robot in the frame of either, m and rad.
    """

    stamps_ns: NDArray[np.int64]
    nodes: NDArray[np.int64]
    next_nodes: NDArray[np.int64]
    deltas: Array
    next_deltas: Array

    def __len__(self) -> int:
        return len(self.stamps_ns)


def anchors_on(poses: Array, stamps_ns: NDArray[np.int64], nodes: NDArray[np.int64], deltas: Array) -> Anchors:
    """Tie robot poses, measured on a map, to the nodes before and after each, so that they move with these nodes.

    Args:
        poses: (N, 3) of the map's nodes at the time of the measurement, m and rad.
        stamps_ns: (S,) int64, of the robot poses, increasing.
        nodes: (S,) int64, number of the last node before each stamp.
        deltas: (S, 3) pose of the robot in the frame of that node, m and rad.
    """
    after = np.minimum(nodes + 1, len(poses) - 1)
    return Anchors(stamps_ns, nodes, after, deltas, between(poses[after], compose(poses[nodes], deltas)))


NO_ANCHORS = anchors_on(np.zeros((1, 3)), np.zeros(0, np.int64), np.zeros(0, np.int64), np.zeros((0, 3)))


def read_tum(path: Path) -> Trajectory:
    """Read a file of lines `stamp x y z qx qy qz qw` (seconds, m) as planar poses: z, roll and pitch are dropped.

    Of lines with equal stamps the first is kept.

    Raises:
        StreamError: the file is missing or empty, or a line is damaged, not finite or earlier than the one before.
    """
    if not path.is_file():
        raise StreamError(f"{path}: no such trajectory file; expected one in the TUM format")
    stamps: list[int] = []
    rows: list[list[float]] = []
    for number, line in enumerate(path.read_text(encoding="utf-8", errors="replace").splitlines(), start=1):
        text = line.split("#", 1)[0].replace(",", " ").split()
        if not text:
            continue
        try:
            row = [float(field) for field in text[1:]]
        except ValueError:
            raise StreamError(f"{path}:{number}: expected numbers, found {quoted(line)}") from None
        try:
            stamp_ns = read_stamp_ns(text[0])
        except ValueError as error:
            raise StreamError(f"{path}:{number}: {error}") from None
        if len(row) != 7 or not np.isfinite(row).all():
            raise StreamError(
                f"{path}:{number}: expected 8 finite numbers `stamp x y z qx qy qz qw`, found {len(text)}"
                if len(row) != 7
                else f"{path}:{number}: found NaN or Inf, expected finite numbers"
            )
        if max(map(abs, row[:3])) > FARTHEST_M:
            raise StreamError(f"{path}:{number}: found the position {quoted(' '.join(text[1:4]))}, expected metres below 1e9")
        if np.isnan(yaw_from_quaternion(*row[3:])):
            raise StreamError(f"{path}:{number}: found the quaternion {quoted(' '.join(text[4:]))}, expected a rotation")
        if stamps and stamp_ns < stamps[-1]:
            raise StreamError(f"{path}:{number}: stamp {text[0]} goes back behind the line before; expected sorted stamps")
        if stamps and stamp_ns == stamps[-1]:
            continue
        stamps.append(stamp_ns)
        rows.append(row)
    if not stamps:
        raise StreamError(f"{path}: holds no pose; expected lines `stamp x y z qx qy qz qw`")
    table = np.asarray(rows)
    yaw = yaw_from_quaternion(table[:, 3], table[:, 4], table[:, 5], table[:, 6])
    return Trajectory(np.asarray(stamps, dtype=np.int64), np.column_stack([table[:, :2], yaw]))


def format_stamp(stamp_ns: int) -> str:
    """The stamp in seconds with 9 decimals, exact."""
    return f"{stamp_ns // NS_PER_S}.{stamp_ns % NS_PER_S:09d}"


def format_motion(moved_m: float, turned_deg: float) -> str:
    """A distance and a turn in words: "0.123 m and 4.5 deg"."""
    return f"{moved_m:.3f} m and {turned_deg:.1f} deg"


def write_tum(path: Path, trajectory: Trajectory) -> None:
    """Write a TUM file: stamps with 9 decimals, poses with 17 significant digits. The file appears at once when complete.

    Raises:
        OutputError: the file cannot be written.
    """
    quaternions = quaternion_from_yaw(trajectory.poses[:, 2])
    lines = [
        f"{format_stamp(int(stamp))} {pose[0]:.17g} {pose[1]:.17g} 0 0 0 {q[2]:.17g} {q[3]:.17g}\n"
        for stamp, pose, q in zip(trajectory.stamps_ns, trajectory.poses, quaternions, strict=True)
    ]
    write_text(path, "".join(lines))
