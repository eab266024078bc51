"""What a sample must be before it goes to the mapping process, so that a bad one costs itself and not the drive."""

from __future__ import annotations

import math

import numpy as np

from hybridmap.backends import registry
from hybridmap.config import Config
from hybridmap.errors import StreamError
from hybridmap.streams.base import Motion, Rig, Sample, SelfMotion, Velocity
from hybridmap.streams.laser import LaserScan
from hybridmap.streams.rgbd import RgbdFrame, checked_frame
from hybridmap.streams.sensors import SENSORS, carried, kind_of, wanted
from hybridmap.trajectory import format_stamp, stamp_ns_from_s
from hybridmap.vision import FRONT_ENDS


def used(rig: Rig, sensor: str) -> Rig:
    """The sensors of a rig that a value of `vision.sensor` maps with: for `auto`, the first kind of the table."""
    chosen = [(kind.sensor_name, one) for kind, one in carried(rig) if kind in wanted(sensor)]
    return Rig(**dict(chosen[:1] if sensor == "auto" else chosen))


def require_elsewhere(config: Config, rig: Rig) -> None:
    """Refuse sensors, front-ends and back-ends that the mapping process cannot have.

    Raises:
        ConfigError, BackendError: one is registered by a call in this program, and not by an entry point.
    """
    for name in config.backends.names:
        registry.require_elsewhere(name)
    FRONT_ENDS.require_elsewhere(config.vision.sensor)
    for kind, _ in carried(rig):
        SENSORS.require_elsewhere(kind.name)


def stamp_ns_of(stamp_s: float) -> int:
    """Nearest whole nanosecond of a stamp in seconds.

    Raises:
        StreamError: it is not finite.
    """
    if not math.isfinite(stamp_s):
        raise StreamError(f"found the stamp {stamp_s}, expected seconds")
    return stamp_ns_from_s(stamp_s)


def check_kind(sample: Sample, motion: type[Motion] | None) -> None:
    """Refuse odometry beside velocities; `motion` is the kind of self-motion so far, None before the first.

    Raises:
        StreamError: it is of the other kind.
    """
    if isinstance(sample, SelfMotion | Velocity) and motion not in (None, type(sample)):
        stamp = format_stamp(sample.stamp_ns)
        raise StreamError(f"stamp {stamp} s: odometry and velocities are mixed; expected one kind of self-motion")


def check(sample: Sample, rig: Rig) -> None:
    """Refuse a sample that the mapper with the sensors of a rig could not use.

    Raises:
        StreamError: it is not finite, has another shape or type than its sensor gives, or the rig has no such sensor.
    """
    stamp = format_stamp(sample.stamp_ns)
    if isinstance(sample, SelfMotion | Velocity):
        _check_motion(sample, stamp)
        return
    kind = kind_of(sample)
    sensor = rig.sensors.get(kind.sensor_name)
    if sensor is None:
        known = ", ".join(rig.sensors) or "none"
        raise StreamError(f"{kind.counted}: the mapper has no {kind.sensor_name} (it maps with: {known}); see vision.sensor")
    if isinstance(sample, RgbdFrame):
        checked_frame(sample, sensor)
        found = (sample.color.dtype, sample.color.shape[2:], sample.depth_m.dtype)
        if found != (np.dtype(np.uint8), (3,), np.dtype(np.float32)):
            what = f"colour {sample.color.shape} {found[0]} and depth {found[2]}"
            raise StreamError(f"frame at stamp {stamp} s: found {what}, expected RGB in uint8 and depth in float32")
    if isinstance(sample, LaserScan) and sample.ranges_m.shape != sensor.bearings_rad.shape:
        raise StreamError(
            f"scan at stamp {stamp} s: found {sample.ranges_m.shape} ranges, expected {sensor.bearings_rad.shape}"
        )


def _check_motion(sample: Motion, stamp: str) -> None:
    values = sample.pose_odom_robot if isinstance(sample, SelfMotion) else np.array([sample.v_m_s, sample.omega_rad_s])
    if isinstance(sample, SelfMotion) and values.shape != (3,):
        raise StreamError(f"odometry at stamp {stamp} s: found shape {values.shape}, expected x, y and yaw")
    if not np.isfinite(values).all():
        raise StreamError(f"odometry at stamp {stamp} s: found NaN or Inf, expected finite numbers")
