"""What the front-ends by scanline take of a frame, by camera or laser: a profile, and how far things are column by column."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any, Protocol

import numpy as np
from numpy.typing import NDArray

from hybridmap.config.vision import VisionConfig
from hybridmap.errors import ConfigError, StreamError
from hybridmap.geometry import Array, wrap_angle
from hybridmap.streams.base import Observation, Rig
from hybridmap.streams.laser import LASER, Laser, LaserScan
from hybridmap.streams.rgbd import RGBD, Camera, checked_frame
from hybridmap.vision.profile import Profile, image_profile, laser_profile

Indices = NDArray[np.int64]
_HORIZON_ROWS = 0.045
"""Rows above and below the horizon, as a share of the height of the image, whose depth is looked at: higher or lower rows see
floor and ceiling, which come no nearer as the robot drives."""
_UPRIGHT_COS = 0.5
"""A camera may be mounted with its columns up to 60 deg from upright: beyond, they are no columns of what is around."""
_CAMERA_REACH_M, _LASER_REACH_M = 4.5, 10.0
"""Distance up to which depth of a camera (whose noise grows with the square) and ranges of a laser (which hit or miss by chance
beyond) are looked at, m."""


@dataclass(frozen=True, slots=True)
class Glance:
    """What is kept of a frame.

    Attributes:
        profile: (bands, width) float32, z-normalised.
        ahead_m: (columns,) float32 distance along the robot's heading of what is seen at the height of the sensor, m, in the
            order of `Retina.bearings_rad`; NaN where nothing is.
    """

    profile: Profile
    ahead_m: NDArray[np.float32]


class Retina(Protocol):
    """One kind of sensor, as the scanline front-end uses it."""

    @property
    def reach_m(self) -> float:
        """Distance up to which `Glance.ahead_m` is exact to some centimetres, m."""

    @property
    def bearings_rad(self) -> Array:
        """(columns,) bearings of `Glance.ahead_m`, counter-clockwise from the robot's heading, rad in [-pi, pi), descending."""

    def glance(self, frame: Observation) -> Glance:
        """Take a frame in.

        Raises:
            StreamError: the frame is of another sensor, or has another size.
        """

    def yaw_rad(self, shift: float) -> float:
        """Heading of an older view seen from a newer one, rad, whose profile is shifted by so many columns against it."""

    def compact(self, frame: Observation) -> dict[str, NDArray[Any]]:
        """What the map file keeps of a frame."""


class CameraRetina:
    """The retina of an RGB-D camera; its profile is that of the whole image, left edge first.

    The camera is taken to stay as it is mounted. Where it does not look ahead, nothing tells the way ahead.

    Raises:
        ConfigError: the camera is not mounted upright.
    """

    def __init__(self, config: VisionConfig, camera: Camera) -> None:
        self._settings = config.profile
        self._camera = camera
        self.reach_m = _CAMERA_REACH_M
        turned = camera.T_base_camera[:3, :3]
        if -turned[2, 1] < _UPRIGHT_COS:
            tilt_deg = np.rad2deg(np.arccos(np.clip(-turned[2, 1], -1.0, 1.0)))
            raise ConfigError(
                f"vision.closing.by is {config.closing.by}: expected a camera upright to 60 deg, found one tilted by "
                f"{tilt_deg:.0f} deg"
            )
        x = (np.arange(camera.width_px) - camera.cx_px) / camera.fx_px
        y = -(turned[2, 0] * x + turned[2, 2]) / turned[2, 1]
        level = turned[:2] @ np.stack([x, y, np.ones_like(x)])
        self._horizon_row = camera.cy_px + camera.fy_px * y
        self._order, self.bearings_rad = _from_left(np.arctan2(level[1], level[0]))
        self._ahead_per_depth = level[0].astype(np.float32)

    def glance(self, frame: Observation) -> Glance:
        """Take in an RGB-D frame; see `Retina.glance`."""
        import cv2

        seen, settings = checked_frame(frame, self._camera), self._settings
        grey = np.asarray(cv2.cvtColor(seen.color, cv2.COLOR_RGB2GRAY), dtype=np.uint8)
        depth = np.nan_to_num(seen.depth_m, posinf=0.0)
        profile = image_profile(grey, depth, settings.width, settings.bands, settings.normalise)
        return Glance(profile, (_horizon(depth, self._horizon_row) * self._ahead_per_depth)[self._order])

    def yaw_rad(self, shift: float) -> float:
        """Things farther right in the newer view mean that it looks farther left; see `Retina.yaw_rad`."""
        return -float(np.arctan2(shift * self._camera.width_px / self._settings.width, self._camera.fx_px))

    def compact(self, frame: Observation) -> dict[str, NDArray[Any]]:
        """The images, and how the camera is mounted."""
        return {**RGBD.compact(frame), "T_base_camera": self._camera.T_base_camera}


class LaserRetina:
    """The retina of a planar laser; its profile is the ranges by bearing, the smallest bearing first."""

    def __init__(self, config: VisionConfig, laser: Laser) -> None:
        self._laser = laser
        self._width = config.profile.width
        self._span = float(np.ptp(laser.bearings_rad))
        self.reach_m = _LASER_REACH_M
        self._order, self.bearings_rad = _from_left(laser.bearings_rad + laser.pose_base_laser[2])

    def glance(self, frame: Observation) -> Glance:
        """Take in a scan; see `Retina.glance`."""
        if not isinstance(frame, LaserScan):
            raise StreamError(f"vision: scanline by laser needs a LaserScan, found {type(frame).__name__}")
        bearings = self._laser.bearings_rad
        if frame.ranges_m.shape != bearings.shape:
            raise StreamError(
                f"laser: scan at {frame.stamp_ns} ns: expected {len(bearings)} ranges, found {frame.ranges_m.shape}"
            )
        profile = laser_profile(np.minimum(frame.ranges_m, np.float32(self.reach_m)), bearings, self._width)
        return Glance(profile, frame.ranges_m[self._order] * np.cos(self.bearings_rad).astype(np.float32))

    def yaw_rad(self, shift: float) -> float:
        """Things at larger bearings in the newer view mean that it looks farther right; see `Retina.yaw_rad`."""
        return shift * self._span / self._width

    def compact(self, frame: Observation) -> dict[str, NDArray[Any]]:
        """The ranges."""
        return LASER.compact(frame)


def retina_of(config: VisionConfig, rig: Rig) -> Retina:
    """Make the retina of the sensor that `vision.sensor` names, or of the first of the rig that has one.

    Raises:
        ConfigError: the rig has neither laser nor camera of that name.
    """
    for kind in (LASER, RGBD):
        sensor = rig.sensors.get(kind.sensor_name)
        if sensor is not None and config.sensor in ("auto", kind.name):
            return LaserRetina(config, sensor) if kind is LASER else CameraRetina(config, sensor)
    raise ConfigError(
        f"vision.closing.by is {config.closing.by}: expected a laser or an RGB-D camera, found vision.sensor {config.sensor}"
    )


def _from_left(bearings_rad: Array) -> tuple[Indices, Array]:
    """Order (columns,) by which columns go from left to right, and their bearings in this order, rad in [-pi, pi)."""
    wrapped = wrap_angle(bearings_rad)
    order = np.argsort(-wrapped, kind="stable")
    return order, wrapped[order]


def _horizon(depth_m: NDArray[np.float32], rows: Array) -> NDArray[np.float32]:
    """(W,) median of the valid depth of an image (H, W) around one row of each column, m; NaN where there is none.

    Args:
        depth_m: (H, W), 0 where invalid.
        rows: (W,) row of the horizon in each column; it may lie outside the image.
    """
    height = len(depth_m)
    half = max(round(_HORIZON_ROWS * height), 1)
    middle = np.clip(np.round(rows), half, height - half).astype(np.int64)
    columns = np.arange(len(rows))
    depth = depth_m[middle + np.arange(-half, half)[:, None], columns]
    depth = np.sort(np.where((depth > 0.0) & (rows > -0.5) & (rows < height - 0.5), depth, np.inf), axis=0)
    seen = np.isfinite(depth).sum(axis=0)
    median = 0.5 * (depth[np.maximum(seen - 1, 0) // 2, columns] + depth[np.minimum(seen // 2, 2 * half - 1), columns])
    return np.where(seen > 0, median, np.nan).astype(np.float32)
