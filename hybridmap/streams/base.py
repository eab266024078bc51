"""What a sensor stream is: samples in time order, the mounting of the sensors, and what was lost on the way."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, field
from typing import Protocol

import numpy as np
from numpy.typing import NDArray

from hybridmap.geometry import Array
from hybridmap.trajectory import NS_PER_S, Trajectory


@dataclass(frozen=True, slots=True)
class SelfMotion:
    """One odometry message: pose of `base_link` in `odom`.

    Attributes:
        stamp_ns: header stamp, ns.
        pose_odom_robot: (3,) float64, m and rad.
    """

    stamp_ns: int
    pose_odom_robot: Array


@dataclass(frozen=True, slots=True)
class Velocity:
    """One velocity command or wheel-speed reading; it holds until the next one (zero-order hold)."""

    stamp_ns: int
    v_m_s: float
    omega_rad_s: float


@dataclass(frozen=True, slots=True)
class LaserScan:
    """One planar scan.

    Attributes:
        stamp_ns: header stamp, ns.
        ranges_m: (B,) float32; NaN where there is no valid return (REP-117 and the range limits are applied by the reader).
    """

    stamp_ns: int
    ranges_m: NDArray[np.float32]


@dataclass(frozen=True, slots=True)
class RgbdFrame:
    """One colour frame with its registered depth.

    Attributes:
        stamp_ns: header stamp of the colour image, ns.
        color: (H, W, 3) uint8, RGB (grey images repeat their channel).
        depth_m: (H, W) float32, m along the optical axis; 0 where invalid.
    """

    stamp_ns: int
    color: NDArray[np.uint8]
    depth_m: NDArray[np.float32]


Motion = SelfMotion | Velocity
Observation = LaserScan | RgbdFrame
Sample = Motion | Observation


@dataclass(frozen=True, slots=True)
class Camera:
    """Pinhole camera of undistorted, registered frames.

    Attributes:
        width_px, height_px: image size.
        fx_px, fy_px, cx_px, cy_px: intrinsics.
        T_base_camera: (4, 4) pose of the camera OPTICAL frame (x right, y down, z forward) in `base_link`, m.
    """

    width_px: int
    height_px: int
    fx_px: float
    fy_px: float
    cx_px: float
    cy_px: float
    T_base_camera: Array


@dataclass(frozen=True, slots=True)
class Laser:
    """Planar range finder.

    Attributes:
        bearings_rad: (B,) float64, bearing of each beam in the laser's frame, counter-clockwise positive.
        range_min_m, range_max_m: valid ranges lie between them.
        pose_base_laser: (3,) mounting in `base_link`, m and rad (a laser mounted upside down has its bearings negated).
    """

    bearings_rad: Array
    range_min_m: float
    range_max_m: float
    pose_base_laser: Array


@dataclass(frozen=True, slots=True)
class Rig:
    """Which exteroceptive sensors a stream has, and where they sit; None where there is none."""

    camera: Camera | None = None
    laser: Laser | None = None


@dataclass(slots=True)
class StreamReport:
    """What a stream met while it was read: counts by name (`odometry`, `frames`, `unmatched color`, ...) and remarks."""

    counts: dict[str, int] = field(default_factory=dict)
    remarks: list[str] = field(default_factory=list)

    def count(self, name: str, increment: int = 1) -> None:
        """Add to a named count."""
        self.counts[name] = self.counts.get(name, 0) + increment


class Stream(Protocol):
    """A source of samples, in order of stamp; at equal stamps motion comes before observations.

    A stream can be iterated more than once and gives the same samples each time.
    """

    @property
    def name(self) -> str:
        """What to call it in a report: file name or world."""

    @property
    def rig(self) -> Rig:
        """The sensors; known before the first sample."""

    @property
    def groundtruth(self) -> Trajectory | None:
        """True poses of `base_link`, where they are known."""

    @property
    def expected_observations(self) -> int | None:
        """How many scans or frames will come, for a progress bar; None where unknown."""

    @property
    def report(self) -> StreamReport:
        """What the last iteration met."""

    def __iter__(self) -> Iterator[Sample]:
        """Yield the samples.

        Raises:
            StreamError: the source is damaged; the message says where.
        """


def stamp_s(sample: Sample) -> float:
    """Stamp in seconds."""
    return sample.stamp_ns / NS_PER_S
