"""Settings of the streams: topics, mounting, calibration, synchronisation."""

from __future__ import annotations

from pydantic import Field

from hybridmap.config.section import Section


class LaserMounting(Section):
    """Where the laser sits on the base; takes the place of the recording's transforms."""

    x_m: float = 0.0
    """Forward of the base's origin, m."""
    y_m: float = 0.0
    """To the left of the base's origin, m."""
    yaw_rad: float = 0.0
    """Direction of the laser's x axis seen from the base, rad."""
    upside_down: bool = False
    """Whether the laser hangs upside down (its beams then turn the other way)."""


class CameraMounting(Section):
    """Where the camera's OPTICAL frame (x right, y down, z forward) sits on the base; takes the place of the recording's."""

    translation_m: tuple[float, float, float]
    """Origin of the optical frame in the base, m."""
    quaternion_xyzw: tuple[float, float, float, float] = (-0.5, 0.5, -0.5, 0.5)
    """Rotation of the optical frame in the base; the default looks forward and level."""


class CameraIntrinsics(Section):
    """Calibration of the colour camera; takes the place of the recording's."""

    width_px: int = Field(gt=0)
    """Image width, pixels."""
    height_px: int = Field(gt=0)
    """Image height, pixels."""
    fx_px: float = Field(gt=0)
    """Focal length along x, pixels."""
    fy_px: float = Field(gt=0)
    """Focal length along y, pixels."""
    cx_px: float
    """Principal point, x, pixels."""
    cy_px: float
    """Principal point, y, pixels."""
    distortion: tuple[float, ...] = ()
    """Lens distortion k1, k2, p1, p2[, k3[, k4, k5, k6]]; empty: none."""


class SensorsConfig(Section):
    """Where the sensor data come from; None means: find it."""

    odometry_topic: str | None = None
    """Topic of nav_msgs/Odometry, or a tf2_msgs/TFMessage topic to take `odom_frame` -> base from."""
    scan_topic: str | None = None
    """Topic of sensor_msgs/LaserScan."""
    color_topic: str | None = None
    """Topic of the colour pictures, sensor_msgs/Image or CompressedImage."""
    depth_topic: str | None = None
    """Topic of the depth pictures, sensor_msgs/Image or CompressedImage."""
    camera_info_topic: str | None = None
    """Topic of the colour camera's sensor_msgs/CameraInfo."""
    depth_info_topic: str | None = None
    """Topic of the depth camera's sensor_msgs/CameraInfo."""
    groundtruth_topic: str | None = None
    """Topic of nav_msgs/Odometry that holds the true pose of the base."""
    odometry_file: str | None = None
    """File of a TUM folder with the odometry; None: `odometry.txt`."""
    odom_frame: str = "odom"
    """Frame that /tf odometry starts from, where there is no Odometry topic."""
    base_frame: str | None = None
    """Frame of the robot that is mapped; None: the child frame of the odometry."""
    laser_mounting: LaserMounting | None = None
    """Mounting of the laser; None: from the recording's transforms."""
    camera_mounting: CameraMounting | None = None
    """Mounting of the camera; None: from the recording's transforms or camera.yaml."""
    camera_intrinsics: CameraIntrinsics | None = None
    """Calibration of the colour camera; None: from CameraInfo or camera.yaml."""
    depth_scale: float | None = Field(default=None, gt=0)
    """Units of a 16 bit depth value per metre; None: 1000 in bags, camera.yaml in a TUM folder."""
    sync_tolerance_s: float = Field(default=0.02, ge=0)
    """Colour and depth belong together when their stamps differ by no more than this, s."""
    latency_s: float = Field(default=0.0, ge=0)
    """Live input: how long samples wait to be sorted by stamp, s; 0 for recordings, which are sorted by their reader."""
    odometry_delay_s: float = Field(default=0.0, ge=-1, le=1)
    """Added to the stamps of self-motion: how much later views are stamped than odometry, s (`hybridmap calibrate` finds it).
    Updates of a live robot come later by as much."""
    range_min_m: float | None = Field(default=None, ge=0)
    """Laser returns nearer than this are dropped, m; None: the recording's limit alone."""
    range_max_m: float | None = Field(default=None, gt=0)
    """Laser returns at or beyond this are dropped, m; None: the recording's limit alone."""
    depth_min_m: float | None = Field(default=None, ge=0)
    """Depth nearer than this is dropped, m; None: keep."""
    depth_max_m: float | None = Field(default=None, gt=0)
    """Depth beyond this is dropped, m; None: keep."""
