"""Settings of the simulated worlds and drives."""

from __future__ import annotations

from typing import Literal

from pydantic import Field

from hybridmap.config.section import Section


class WheelErrorConfig(Section):
    """How wrong the wheel odometry is."""

    scale_bias: float = Field(default=0.02, gt=-1)
    """Relative error of every distance (0.02: reports 2 % too much)."""
    turn_bias: float = Field(default=0.01, gt=-1)
    """Relative error of every turn."""
    heading_bias_deg_per_m: float = 0.16
    """Pull to the left, degrees per metre driven."""
    translation_m_per_sqrt_m: float = Field(default=0.006, ge=0)
    """White noise of the distance, m per sqrt(m)."""
    rotation_deg_per_sqrt_m: float = Field(default=0.6, ge=0)
    """White noise of the heading, degrees per sqrt(m) driven."""
    rotation_per_turn: float = Field(default=0.012, ge=0)
    """White noise of the heading, radians per sqrt(radian) turned."""
    slips_per_m: float = Field(default=0.02, ge=0)
    """Slips a metre driven, on average."""
    slip_m: float = Field(default=0.02, ge=0)
    """Standard deviation of the distance lost by a slip, m."""
    slip_deg: float = Field(default=1.0, ge=0)
    """Standard deviation of the heading lost by a slip, degrees."""


class CameraConfig(Section):
    """The simulated RGB-D camera."""

    width_px: int = Field(default=240, ge=16, le=1920)
    """Image width, pixels."""
    height_px: int = Field(default=180, ge=12, le=1080)
    """Image height, pixels."""
    field_of_view_deg: float = Field(default=62.0, gt=10, lt=150)
    """Horizontal field of view, degrees."""
    rate_hz: float = Field(default=5.0, gt=0, le=60)
    """Frames a second."""
    height_m: float = Field(default=1.0, gt=0)
    """Height of the level camera above the floor, m."""
    forward_m: float = 0.1
    """Distance of the camera in front of `base_link`, m."""
    range_min_m: float = Field(default=0.4, ge=0)
    """No depth nearer than this, m along the optical axis."""
    range_max_m: float = Field(default=5.0, gt=0, lt=13)
    """No depth beyond this, m along the optical axis."""
    depth_noise_m: float = Field(default=0.0012, ge=0)
    """Standard deviation of depth at 0.4 m, m."""
    depth_noise_per_m: float = Field(default=0.0019, ge=0)
    """Growth of that standard deviation with the square of the distance beyond 0.4 m, 1/m."""
    depth_noise_width_px: float = Field(default=1.0, ge=0)
    """Pixels (one sigma) over which the noise of depth is alike, as matching windows make it; 0: each pixel its own."""
    hole_fraction: float = Field(default=0.01, ge=0, lt=1)
    """Share of the image that patches without depth cover."""
    exposure_change: float = Field(default=0.12, ge=0, lt=1)
    """Relative slow change of brightness."""
    color_noise: float = Field(default=1.5, ge=0)
    """Standard deviation of a colour value, of 255."""


class LaserScannerConfig(Section):
    """The simulated planar laser."""

    beams: int = Field(default=180, ge=8, le=4096)
    """Beams a scan."""
    field_of_view_deg: float = Field(default=180.0, gt=1, le=360)
    """Angle between the first and the last beam, degrees; 360 leaves out the last, which is the first again."""
    rate_hz: float = Field(default=5.0, gt=0, le=60)
    """Scans a second."""
    height_m: float = Field(default=0.3, gt=0)
    """Height of the scanning plane, m."""
    forward_m: float = 0.15
    """Distance of the laser in front of `base_link`, m."""
    range_min_m: float = Field(default=0.05, ge=0)
    """No return nearer than this, m."""
    range_max_m: float = Field(default=12.0, gt=0)
    """No return beyond this, m."""
    noise_m: float = Field(default=0.01, ge=0)
    """Standard deviation of a range, m."""
    drop_fraction: float = Field(default=0.002, ge=0, lt=1)
    """Share of beams without a return."""


class SimulationConfig(Section):
    """World, drive, sensors and their noise."""

    world: str = "lab"
    """Name of the world and its drive."""
    sensors: Literal["rgbd", "laser", "both"] = "rgbd"
    """What the robot carries besides its wheels."""
    duration_s: float | None = Field(default=None, gt=0)
    """Stop the drive after so many seconds; nothing: drive to its end."""
    carried_m: float | None = Field(default=None, gt=0)
    """Pick the robot up in the middle of its drive and put it down unseen in a known place so far away, m; the wheels feel
    nothing and there are no frames. Where the world is smaller: as far away as there is one. Nothing: never."""
    speed_m_s: float = Field(default=0.5, gt=0.05, le=2)
    """Cruising speed, m/s."""
    turn_rate_rad_s: float = Field(default=0.8, gt=0.05, le=3)
    """Fastest turn, rad/s."""
    odometry_rate_hz: float = Field(default=30.0, ge=5, le=200)
    """Odometry messages a second."""
    wheels: WheelErrorConfig = WheelErrorConfig()
    """Errors of the wheel odometry."""
    camera: CameraConfig = CameraConfig()
    """RGB-D camera."""
    laser: LaserScannerConfig = LaserScannerConfig()
    """Planar laser."""
