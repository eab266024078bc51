"""What a sample must be before it goes to the mapping process, so that a bad one costs itself and not the drive."""

from __future__ import annotations

import numpy as np

from hybridmap.errors import StreamError
from hybridmap.streams.base import Motion, Rig, Sample, SelfMotion, Velocity
from hybridmap.streams.laser import LaserScan
from hybridmap.streams.rgbd import RgbdFrame, checked_frame
from hybridmap.streams.sensors import carried, kind_of, wanted
from hybridmap.trajectory import format_stamp


def used(rig: Rig, sensor: str) -> Rig:
    """The sensors of a rig that a value of `vision.sensor` maps with: for `auto`, the first kind of the table."""
    chosen = [(kind.sensor_name, one) for kind, one in carried(rig) if kind in wanted(sensor)]
    return Rig(**dict(chosen[:1] if sensor == "auto" else chosen))


def check(sample: Sample, rig: Rig, motion: type[Motion] | None) -> None:
    """Refuse a sample that the mapper could not use.

    Args:
        sample: the sample.
        rig: the sensors that there are.
        motion: the kind of self-motion so far; None before the first.

    Raises:
        StreamError: it is not finite, has another shape than its sensor, the rig has no such sensor, or odometry is mixed with
            velocities.
    """
    stamp = format_stamp(sample.stamp_ns)
    if isinstance(sample, SelfMotion | Velocity):
        _check_motion(sample, motion, stamp)
        return
    kind = kind_of(sample)
    sensor = rig.sensors.get(kind.sensor_name)
    if sensor is None:
        known = ", ".join(rig.sensors) or "none"
        raise StreamError(f"{kind.counted}: the mapper has no {kind.sensor_name} (it maps with: {known}); see vision.sensor")
    if isinstance(sample, RgbdFrame):
        checked_frame(sample, sensor)
    if isinstance(sample, LaserScan) and sample.ranges_m.shape != sensor.bearings_rad.shape:
        raise StreamError(
            f"scan at stamp {stamp} s: found {sample.ranges_m.shape} ranges, expected {sensor.bearings_rad.shape}"
        )


def _check_motion(sample: Motion, motion: type[Motion] | None, stamp: str) -> None:
    if motion not in (None, type(sample)):
        raise StreamError(f"stamp {stamp} s: odometry and velocities are mixed; expected one kind of self-motion")
    values = sample.pose_odom_robot if isinstance(sample, SelfMotion) else np.array([sample.v_m_s, sample.omega_rad_s])
    if isinstance(sample, SelfMotion) and values.shape != (3,):
        raise StreamError(f"odometry at stamp {stamp} s: found shape {values.shape}, expected x, y and yaw")
    if not np.isfinite(values).all():
        raise StreamError(f"odometry at stamp {stamp} s: found NaN or Inf, expected finite numbers")
