"""`sensor_msgs/LaserScan` -> `LaserScan`: either beam order, either side up, range limits, scans of uneven length."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

from hybridmap.config.inputs import SensorsConfig
from hybridmap.errors import StreamError
from hybridmap.geometry import Array
from hybridmap.streams.base import Laser, LaserScan


class ScanDecoder:
    """Brings every scan of a topic to the beams of its first one, counter-clockwise in the base."""

    def __init__(self, first: Any, pose_base_laser: Array, upside_down: bool, config: SensorsConfig, what: str) -> None:
        """Learn the beams from the first message.

        Args:
            first: message with the fields of sensor_msgs/LaserScan.
            pose_base_laser: (3,) mounting, m and rad.
            upside_down: whether the beams turn the other way in the base.
            config: range limits.
            what: file and topic, for errors.

        Raises:
            StreamError: the scan has no beams or no angular step.
        """
        self._config, self._upside_down, self._what = config, upside_down, what
        bearings = self._bearings(first)
        if len(bearings) < 2 or not np.isfinite(bearings).all() or bearings[0] == bearings[-1]:
            raise StreamError(
                f"{what}: found {len(first.ranges)} beams in steps of {first.angle_increment} rad; expected at least 2 apart"
            )
        self._reversed = bool(bearings[-1] < bearings[0])
        self._shape = self._layout(first)
        low, high = self._limits(first)
        self.laser = Laser(bearings[::-1].copy() if self._reversed else bearings, low, high, pose_base_laser)
        self.counts: dict[str, int] = {}

    def __call__(self, stamp_ns: int, parts: tuple[Any, ...]) -> LaserScan:
        """Decode one message; beams without a valid return become NaN."""
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
        """Nearest beam within half a step of each of the first scan's bearings."""
        self.counts["scans with other beams"] = self.counts.get("scans with other beams", 0) + 1
        out = np.full(len(self.laser.bearings_rad), np.nan, dtype=np.float32)
        bearings = self._bearings(message)
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
