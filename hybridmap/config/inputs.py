"""Settings of the input: the sensors of a recording or robot, and the simulated world with its sensors."""

from __future__ import annotations

from math import hypot
from typing import Literal

from pydantic import Field, field_validator

from hybridmap.config.section import Section

DISTORTIONS = (4, 5, 8, 12, 14)
"""How many coefficients of a lens OpenCV takes."""
_LEAST_NORM = 1e-3
_FARTHEST_M = 1000.0


class LaserMounting(Section):
    """Pose of the laser on the robot's base; replaces the pose in the recording's transforms."""

    x_m: float = Field(default=0.0, ge=-1000, le=1000)
    """Position forward of the base's origin, m."""
    y_m: float = Field(default=0.0, ge=-1000, le=1000)
    """Position to the left of the base's origin, m."""
    yaw_rad: float = Field(default=0.0, ge=-10, le=10)
    """Direction of the laser's x axis in the base frame, rad."""
    upside_down: bool = False
    """Whether the laser hangs upside down: its beams then turn the other way."""


class CameraMounting(Section):
    """Pose of the camera's OPTICAL frame (x right, y down, z forward) on the robot's base; replaces the recording's pose."""

    translation_m: tuple[float, float, float]
    """Origin x, y, z of the optical frame in the base, m."""
    quaternion_xyzw: tuple[float, float, float, float] = (-0.5, 0.5, -0.5, 0.5)
    """Rotation of the optical frame in the base, quaternion x, y, z, w; the default looks forward and level.

    Watch: an error of 1 degree in the tilt makes the floor look like a ramp."""

    @field_validator("translation_m")
    @classmethod
    def _near(cls, translation: tuple[float, float, float]) -> tuple[float, float, float]:
        if max(map(abs, translation)) > _FARTHEST_M:
            raise ValueError(f"expected x, y, z of at most {_FARTHEST_M:g} m, found {max(map(abs, translation)):g} m")
        return translation

    @field_validator("quaternion_xyzw")
    @classmethod
    def _rotates(cls, quaternion: tuple[float, float, float, float]) -> tuple[float, float, float, float]:
        length = hypot(*quaternion)
        if not _LEAST_NORM <= length <= 1.0 / _LEAST_NORM:
            advice = "; divide it by its length" if length > 0.0 else ""
            raise ValueError(f"expected a quaternion x, y, z, w of length 1, found length {length:g}{advice}")
        return quaternion


class CameraIntrinsics(Section):
    """Intrinsic calibration of the colour camera; replaces the one in the recording."""

    width_px: int = Field(gt=0, le=16_384)
    """Image width, pixels."""
    height_px: int = Field(gt=0, le=16_384)
    """Image height, pixels."""
    fx_px: float = Field(gt=0, le=1e6)
    """Focal length along x, pixels."""
    fy_px: float = Field(gt=0, le=1e6)
    """Focal length along y, pixels."""
    cx_px: float = Field(ge=-1e6, le=1e6)
    """Principal point, x, pixels."""
    cy_px: float = Field(ge=-1e6, le=1e6)
    """Principal point, y, pixels."""
    distortion: tuple[float, ...] = ()
    """Lens distortion k1, k2, p1, p2[, k3[, k4, k5, k6]], or 12 or 14 coefficients, in OpenCV's order; empty: none."""

    @field_validator("distortion")
    @classmethod
    def _of_a_lens(cls, distortion: tuple[float, ...]) -> tuple[float, ...]:
        if any(distortion) and len(distortion) not in DISTORTIONS:
            raise ValueError(f"expected {', '.join(map(str, DISTORTIONS))} coefficients or none, found {len(distortion)}")
        return distortion


class SensorsConfig(Section):
    """Where the sensor data come from. None means: found automatically in the recording."""

    odometry_topic: str | None = None
    """Topic of nav_msgs/Odometry, or of tf2_msgs/TFMessage with the transform `odom_frame` -> base."""
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
    """Name of the file with the odometry in a TUM folder; None: `odometry.txt`."""
    odom_frame: str = "odom"
    """Parent frame of the odometry in /tf, used if there is no Odometry topic."""
    base_frame: str | None = None
    """Frame of the robot that is mapped; None: the child frame of the odometry."""
    laser_mounting: LaserMounting | None = None
    """Mounting of the laser; None: from the recording's transforms."""
    camera_mounting: CameraMounting | None = None
    """Mounting of the camera; None: from the recording's transforms or camera.yaml."""
    camera_intrinsics: CameraIntrinsics | None = None
    """Calibration of the colour camera; None: from CameraInfo or camera.yaml."""
    depth_scale: float | None = Field(default=None, ge=0.001, le=1e6)
    """Units of a 16 bit depth value per metre; None: 1000 in bags, camera.yaml in a TUM folder.

    Watch: TUM recordings of a Kinect have 5000; a wrong factor scales every depth."""
    sync_tolerance_s: float = Field(default=0.02, ge=0, le=10)
    """Colour and depth belong together when their stamps differ by no more than this, s.

    Watch: while the robot turns, a pair this far apart shows two different views."""
    latency_s: float = Field(default=0.0, ge=0, le=3600)
    """Live input: time for which samples are held back to be sorted by stamp, s. Recordings are sorted by their reader.

    Watch: the pose is delayed by this time.
    """
    odometry_delay_s: float | None = Field(default=None, ge=-1, le=1)
    """Time added to the stamps of odometry, s: how much later scans and images are stamped than odometry of the same moment.
    None: estimated while driving, and corrected if it matters. A number, 0 too, is taken as it is.

    Watch: updates of a live robot are delayed by this time.
    """
    range_min_m: float | None = Field(default=None, ge=0, le=1e6)
    """Laser returns nearer than this are dropped, m; None: only the recording's limit applies.

    Watch: set it if the laser sees the robot itself.
    """
    range_max_m: float | None = Field(default=None, gt=0, le=1e6)
    """Laser returns at or beyond this are dropped, m; None: only the recording's limit applies.

    Watch: in a long hall a low limit removes the far walls, which hold the heading and position along it.
    """
    depth_min_m: float | None = Field(default=None, ge=0, le=1e6)
    """Depth nearer than this is dropped, m; None: all depth is kept.

    Watch: many cameras give wrong depth below 0.3 m."""
    depth_max_m: float | None = Field(default=None, gt=0, le=1e6)
    """Depth beyond this is dropped, m; None: all depth is kept.

    Watch: the noise of depth grows with the square of the distance."""


class WheelErrorConfig(Section):
    """Errors of the simulated wheel odometry."""

    scale_bias: float = Field(default=0.02, gt=-1, le=10)
    """Relative error of every distance; 0.02 reports 2 % too much."""
    turn_bias: float = Field(default=0.01, gt=-1, le=10)
    """Relative error of every turn."""
    heading_bias_deg_per_m: float = Field(default=0.16, ge=-360, le=360)
    """Pull to the left, degrees per metre driven.

    Watch: it bends a map more than any other error of wheels."""
    noise: float = Field(default=1.0, ge=0, le=100)
    """Factor on the white noise and on the number and size of slips; 0: none.

    Watch: the noise assumed for odometry edges (section `edges`) does not change with it.
    """


class CameraConfig(Section):
    """Image size, field of view and rate of the simulated RGB-D camera."""

    width_px: int = Field(default=240, ge=16, le=1920)
    """Image width, pixels.

    Watch: rendering costs time in proportion to the pixels."""
    height_px: int = Field(default=180, ge=12, le=1080)
    """Image height, pixels."""
    field_of_view_deg: float = Field(default=62.0, gt=10, lt=150)
    """Horizontal field of view, degrees."""
    rate_hz: float = Field(default=5.0, gt=0, le=60)
    """Frames a second."""


class LaserScannerConfig(Section):
    """Beams, field of view, rate and range of the simulated planar laser."""

    beams: int = Field(default=180, ge=8, le=4096)
    """Beams a scan."""
    field_of_view_deg: float = Field(default=180.0, gt=1, le=360)
    """Angle between the first and the last beam, degrees. With 360 the last beam is left out, as it would repeat the first."""
    rate_hz: float = Field(default=5.0, gt=0, le=60)
    """Scans a second."""
    range_max_m: float = Field(default=12.0, gt=0, le=1000)
    """No return beyond this, m."""


class SimulationConfig(Section):
    """The simulated world and drive, the robot's sensors, and their noise."""

    world: str = "lab"
    """Name of the world and drive: `lab`, `office`, `corridor`, `corridor-landmarks` or `campus` (outdoors; laser only)."""
    sensors: Literal["rgbd", "laser", "both"] = "rgbd"
    """Sensors of the robot besides its wheels."""
    noise: float = Field(default=1.0, ge=0, le=10)
    """Factor on the noise of camera and laser: depth, colour, ranges, holes, lost beams and exposure changes; 0: none."""
    duration_s: float | None = Field(default=None, gt=0, le=1e6)
    """Stop the drive after this many seconds; None: drive to the end."""
    weave_m: float = Field(default=0.0, ge=0, le=1)
    """How far the robot weaves from side to side of its path, m, in each lap at other places; 0: laps retrace each other.

    Watch: a path near walls and furniture leaves about 0.2 m; the robot drives through what stands in its way.
    """
    carried_m: float | None = Field(default=None, gt=0)
    """Kidnap the robot in the middle of the drive: carry it about this far, m, to a place that it has visited. Meanwhile the
    odometry reports no motion and there are no frames. None: never.

    Watch: in a smaller world the distance is that of the farthest visited place.
    """
    clock_offset_s: float = Field(default=0.0, ge=-60, le=60)
    """How much later scans and frames are stamped than odometry of the same moment, s; negative: earlier.

    Watch: the ground truth has the clock of scans and frames.
    """
    wheels: WheelErrorConfig = WheelErrorConfig()
    """Errors of the wheel odometry."""
    camera: CameraConfig = CameraConfig()
    """RGB-D camera."""
    laser: LaserScannerConfig = LaserScannerConfig()
    """Planar laser."""
