"""The planar laser as a kind of sensor: its scans, reading them from a bag, and keyframes in the map file."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from hybridmap.config.inputs import SensorsConfig
from hybridmap.errors import StreamError, counted
from hybridmap.geometry import Array, transform_points
from hybridmap.streams.base import InBag, Keyframe, Observation, Planned, Rig, Seen, SensorKind, SensorPlan
from hybridmap.streams.mounting import planar
from hybridmap.streams.order import sorted_order

if TYPE_CHECKING:
    from hybridmap.streams.bagindex import BagIndex, TopicChooser

_TYPES = ("sensor_msgs/msg/LaserScan",)
_NAMES = (r"^/scan$", r"^/base_scan$", r"/(scan|base_scan)$", r"front|laser")
"""Usual names of its topic: the first pattern that fits counts; what fits none comes last."""
_MOST_TILT_COS = 0.9  # a planar laser may lean by 25 deg at most
_GREY = 0.25
_MOST_BEAMS = 50_000
"""Beams of a scan; the finest scanners of 2D have some 10,000."""
_RESAMPLED = "scans with other beams than the first, brought to its beams"
"""Name of the count of such scans."""


@dataclass(frozen=True, slots=True)
class Laser:
    """Planar range finder.

    Attributes:
        bearings_rad: (B,) float64, bearing of each beam in the laser's frame, counter-clockwise positive, ascending.
        range_min_m, range_max_m: limits of valid ranges.
        pose_base_laser: (3,) pose in `base_link`, m and rad (a laser mounted upside down has its bearings negated).
    """

    bearings_rad: Array
    range_min_m: float
    range_max_m: float
    pose_base_laser: Array


@dataclass(frozen=True, slots=True)
class LaserScan(Observation):
    """One planar scan.

    Attributes:
        stamp_ns: header stamp, ns.
        ranges_m: (B,) float32, in the order of `Laser.bearings_rad`; NaN without a valid return (the reader applies REP-117
            and the range limits).
    """

    ranges_m: NDArray[np.float32]


class ScanDecoder:
    """Resamples every scan of a topic to the beams of its first one, counter-clockwise in the base.

    Attributes:
        laser: beams, limits and mounting.
        counts: name of an irregularity (`_RESAMPLED`) -> number so far.
    """

    def __init__(self, first: Any, pose_base_laser: Array, upside_down: bool, config: SensorsConfig, what: str) -> None:
        """Read the beams of the first message.

        Args:
            first: message with the fields of sensor_msgs/LaserScan.
            pose_base_laser: (3,) mounting, m and rad.
            upside_down: whether the laser is mounted upside down, which reverses the order of its beams.
            config: range limits.
            what: file and topic, for errors.

        Raises:
            StreamError: the scan has no beams or no angular step.
        """
        self._config, self._upside_down, self._what = config, upside_down, what
        bearings = self._bearings(first)
        if not 2 <= len(bearings) <= _MOST_BEAMS or not np.isfinite(bearings).all() or bearings[0] == bearings[-1]:
            raise StreamError(
                f"{what}: found {counted(len(first.ranges), 'beam')} in steps of {first.angle_increment} rad; "
                f"expected 2 to {_MOST_BEAMS} beams apart"
            )
        self._reversed = bool(bearings[-1] < bearings[0])
        self._shape = self._layout(first)
        low, high = self._limits(first)
        self.laser = Laser(bearings[::-1].copy() if self._reversed else bearings, low, high, pose_base_laser)
        self.counts: dict[str, int] = {}

    def __call__(self, stamp_ns: int, parts: tuple[Any, ...]) -> LaserScan:
        """Decode one message, the only one of `parts`; beams without a valid return become NaN.

        Raises:
            StreamError: the angles of its beams are not finite.
        """
        (message,) = parts
        ranges = np.array(message.ranges, dtype=np.float32)
        low, high = self._limits(message)
        with np.errstate(invalid="ignore"):
            ranges[~(np.isfinite(ranges) & (ranges >= low) & (ranges < high))] = np.nan
        if self._layout(message) != self._shape:
            return LaserScan(stamp_ns, self._resample(message, ranges))
        return LaserScan(stamp_ns, ranges[::-1].copy() if self._reversed else ranges)

    def _bearings(self, message: Any) -> Array:
        step = np.float64(np.float32(message.angle_increment))
        with np.errstate(invalid="ignore"):
            bearings = np.float64(np.float32(message.angle_min)) + np.arange(len(message.ranges)) * step
        return -bearings if self._upside_down else bearings

    def _limits(self, message: Any) -> tuple[float, float]:
        low, high = float(message.range_min), float(message.range_max)
        if not high > max(low, 0.0):  # left empty by the driver
            high = float("inf")
        if self._config.range_min_m is not None:
            low = max(low, self._config.range_min_m)
        if self._config.range_max_m is not None:
            high = min(high, self._config.range_max_m)
        return low, high

    def _layout(self, message: Any) -> tuple[int, float, float]:
        return len(message.ranges), float(message.angle_min), float(message.angle_increment)

    def _resample(self, message: Any, ranges: NDArray[np.float32]) -> NDArray[np.float32]:
        """The nearest beam within half a step of each bearing of the first scan."""
        self.counts[_RESAMPLED] = self.counts.get(_RESAMPLED, 0) + 1
        out = np.full(len(self.laser.bearings_rad), np.nan, dtype=np.float32)
        bearings = self._bearings(message)
        if not np.isfinite(bearings).all():
            steps = f"from {message.angle_min} in steps of {message.angle_increment} rad"
            raise StreamError(f"{self._what}: a scan has beams {steps}; expected finite angles")
        if len(bearings) < 2:
            return out
        order = np.argsort(bearings)
        bearings, ranges = bearings[order], ranges[order]
        right = np.clip(np.searchsorted(bearings, self.laser.bearings_rad), 1, len(bearings) - 1)
        nearer_left = self.laser.bearings_rad - bearings[right - 1] < bearings[right] - self.laser.bearings_rad
        nearest = np.where(nearer_left, right - 1, right)
        step = max(abs(bearings[1] - bearings[0]), abs(self.laser.bearings_rad[1] - self.laser.bearings_rad[0]))
        near = np.abs(bearings[nearest] - self.laser.bearings_rad) <= 0.5 * step + 1e-9
        out[near] = ranges[nearest[near]]
        return out


def _find(chooser: TopicChooser) -> dict[str, str]:
    topic = chooser.named("scan_topic", _TYPES) or chooser.best(_TYPES, _NAMES)
    return {} if topic is None else {"scan": topic}


def _plan(topics: Mapping[str, str], index: BagIndex, base_frame: str, config: SensorsConfig, source: str) -> SensorPlan:
    """Every scan of a topic.

    Raises:
        StreamError: no scans, no mounting, a laser that is not level, no beams, or stamps out of order.
    """
    if not topics:
        raise StreamError(f"{source}: no laser: expected a topic of type sensor_msgs/LaserScan")
    topic = topics["scan"]
    what = f"{source}: {topic}"
    mounting = config.laser_mounting
    if mounting is not None:
        pose, upside_down = np.array([mounting.x_m, mounting.y_m, mounting.yaw_rad]), mounting.upside_down
    else:
        T = index.transforms.require(base_frame, index.frame_of(topic), what, "sensors.laser_mounting")
        pose, upside_down = _laser_pose(T, what)
    decoder = ScanDecoder(index.first[topic], pose, upside_down, config, what)
    stamps = np.asarray(index.stamps_ns[topic], dtype=np.int64)
    planned = [Planned(int(stamps[i]), ((topic, int(i)),)) for i in sorted_order(stamps, what)]
    return SensorPlan(Rig(laser=decoder.laser), planned, decoder)


def _laser_pose(T_base_laser: Array, what: str) -> tuple[Array, bool]:
    """Planar mounting (3,) of a laser, and whether it is upside down.

    Raises:
        StreamError: the laser is not level.
    """
    up = T_base_laser[2, 2]
    if abs(up) < _MOST_TILT_COS:
        tilt = np.degrees(np.arccos(np.clip(abs(up), 0.0, 1.0)))
        raise StreamError(
            f"{what}: by the recording's transforms the laser leans by {tilt:.0f} deg; expected a level one; "
            "if they are wrong, give sensors.laser_mounting, which replaces them"
        )
    return planar(T_base_laser), bool(up < 0)


def _restore(keyframe: Keyframe, stamp_ns: int) -> LaserScan | None:
    return LaserScan(stamp_ns, keyframe["ranges_m"]) if "ranges_m" in keyframe else None


def _see(keyframe: Keyframe, laser: Laser, max_range_m: float) -> Seen | None:
    """End points of the beams with a return; the plane of the scan is drawn at the floor."""
    del max_range_m  # a laser has limits of its own
    if "ranges_m" not in keyframe:
        return None
    ranges = keyframe["ranges_m"].astype(np.float64)
    valid = np.isfinite(ranges) & (ranges >= laser.range_min_m) & (ranges <= laser.range_max_m)
    reach = np.where(valid, ranges, 0.0)
    ends = np.stack([reach * np.cos(laser.bearings_rad), reach * np.sin(laser.bearings_rad)], axis=1)
    ends = transform_points(laser.pose_base_laser, ends)[valid]
    xyz = np.column_stack([ends, np.zeros(len(ends))])
    return Seen(xyz, np.full_like(xyz, _GREY), laser.pose_base_laser[:2], laser.bearings_rad[valid])


LASER = SensorKind(
    name="laser",
    sensor_name="laser",
    sensor=Laser,
    sample=LaserScan,
    counted="scans",
    needs="laser scans",
    words=lambda laser: f"laser, {len(laser.bearings_rad)} beams, {laser.range_max_m:.2f} m",
    front_end="hybridmap.vision.laser.front_end:create",
    compact=lambda scan: {"ranges_m": scan.ranges_m},
    restore=_restore,
    see=_see,
    seeks_every="vision.laser.probes.every_m",
    in_bag=InBag(_TYPES, _find, _plan),
)
