"""The simulated sensors: an RGB-D camera with the noise, holes and limits of structured light, and a planar laser."""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray

from hybridmap.config.inputs import CameraConfig, LaserScannerConfig
from hybridmap.geometry import Array, rotation_from_quaternion
from hybridmap.simulation.paints import smooth_noise
from hybridmap.simulation.scene import Hits, Scene
from hybridmap.streams.laser import Laser, LaserScan
from hybridmap.streams.rgbd import Camera, RgbdFrame

OPTICAL_QUATERNION_XYZW: tuple[float, float, float, float] = (-0.5, 0.5, -0.5, 0.5)
"""A level camera that looks along x of `base_link`: optical frame with x right, y down, z forward."""
CAMERA_FORWARD_M = 0.1
"""The camera stands this far in front of `base_link`, as on the head of a small robot."""
CAMERA_HEIGHT_M = 1.0
"""Height above the floor, m: furniture and pictures on the walls are both in view."""
CAMERA_RANGE_MIN_M, CAMERA_RANGE_MAX_M = 0.4, 5.0
"""No depth nearer or farther than this, m along the optical axis: the limits of a structured-light camera."""
DEPTH_NOISE_M, DEPTH_NOISE_PER_M = 0.0012, 0.0019
"""Standard deviation of depth at 0.4 m, and its growth with the square of the distance beyond (Nguyen et al. 2012)."""
DEPTH_NOISE_WIDTH_PX = 1.0
"""Pixels (one sigma) over which the noise of depth is alike, as matching windows make it; 0: each pixel its own."""
HOLE_FRACTION = 0.01
"""Share of the image that patches without depth cover: dark and shiny spots of a usual room."""
EXPOSURE_CHANGE = 0.12
"""Relative slow change of brightness, as an automatic exposure makes it."""
COLOR_NOISE = 1.5
"""Standard deviation of a colour value, of 255: a camera in room light."""
_MM_PER_M = 1000.0
_GRAZING_COSINE = 0.14
_EDGE_JUMP = 0.06
_SKY = 205.0


def camera_of(config: CameraConfig) -> Camera:
    """Intrinsics of the simulated RGB-D camera, and its mounting on the robot."""
    focal = 0.5 * config.width_px / float(np.tan(np.deg2rad(0.5 * config.field_of_view_deg)))
    mounting = np.eye(4)
    mounting[:3, :3] = rotation_from_quaternion(OPTICAL_QUATERNION_XYZW)
    mounting[:3, 3] = CAMERA_FORWARD_M, 0.0, CAMERA_HEIGHT_M
    center = 0.5 * (config.width_px - 1), 0.5 * (config.height_px - 1)
    return Camera(config.width_px, config.height_px, focal, focal, *center, mounting)


@dataclass(frozen=True, slots=True)
class _Exposure:
    """Slow change of brightness: a sum of sines drawn once, so that any frame can be rendered independently."""

    amplitude: float
    frequencies_hz: Array
    phases: Array

    def at(self, time_s: float) -> float:
        wave = np.sin(2.0 * np.pi * self.frequencies_hz * time_s + self.phases).mean()
        return float(np.exp(1.6 * self.amplitude * wave))


class CameraModel:
    """Renders frames of a simulated RGB-D camera in one scene."""

    def __init__(self, scene: Scene, config: CameraConfig, rng: np.random.Generator, noise: float = 1.0) -> None:
        """Prepare the rays of the pixels, and draw how the exposure changes over the drive.

        Args:
            scene: the surfaces in view.
            config: image size and field of view.
            rng: random generator for the exposure alone.
            noise: factor on the noise of depth and colour, the holes and the change of exposure. With 0 there is none of these,
                but depth is still lost at random at edges and on surfaces seen at a grazing angle.
        """
        self._scene = scene
        self._config = config
        self._level = noise
        self.camera = camera_of(config)
        columns, rows = np.meshgrid(np.arange(config.width_px), np.arange(config.height_px))
        c = self.camera
        ray = np.stack([(columns - c.cx_px) / c.fx_px, (rows - c.cy_px) / c.fy_px, np.ones(columns.shape)], axis=-1)
        self._rays_base = ray @ c.T_base_camera[:3, :3].T
        self._ray_length = np.linalg.norm(ray, axis=-1).astype(np.float32)
        self._exposure = _Exposure(noise * EXPOSURE_CHANGE, rng.uniform(0.02, 0.25, 4), rng.uniform(0, 2 * np.pi, 4))

    def frame(self, stamp_ns: int, time_s: float, pose_world_base: Array, rng: np.random.Generator) -> RgbdFrame:
        """Render the camera's frame at a pose.

        Args:
            stamp_ns: stamp of the frame, ns.
            time_s: time since the drive began, s; the exposure depends on it.
            pose_world_base: (3,) true pose of the robot, m and rad.
            rng: random generator for the noise of this frame.
        """
        cos, sin = np.cos(pose_world_base[2]), np.sin(pose_world_base[2])
        turn = np.array([[cos, -sin, 0.0], [sin, cos, 0.0], [0.0, 0.0, 1.0]])
        origin = turn @ self.camera.T_base_camera[:3, 3] + [pose_world_base[0], pose_world_base[1], 0.0]
        rays = (self._rays_base @ turn.T).astype(np.float32)
        hits = self._scene.cast(origin, rays)
        normals = self._scene.normals[hits.surface]
        cosine = np.abs(np.einsum("hwc,hwc->hw", normals, rays)) / self._ray_length
        color = self._color(hits, cosine, self._exposure.at(time_s), rng)
        return RgbdFrame(stamp_ns, color, self._depth(hits, cosine, rng))

    def _color(self, hits: Hits, cosine: NDArray[np.float32], gain: float, rng: np.random.Generator) -> NDArray[np.uint8]:
        depth = np.where(hits.hit, hits.length, np.float32(CAMERA_RANGE_MAX_M))
        # between the widths of the pixel's footprint along and across the slant
        slant = 1.0 / np.sqrt(np.maximum(cosine, np.float32(0.03)))
        footprint = (self._scene.px_per_m[hits.surface] * depth * slant / self.camera.fx_px).astype(np.float32)
        seen = self._scene.atlas.sample(hits.surface, hits.across, hits.down, footprint)
        seen[~hits.hit] = _SKY
        seen *= np.float32(gain)
        seen += np.float32(self._level * COLOR_NOISE) * rng.standard_normal(seen.shape, dtype=np.float32)
        return np.asarray(np.clip(seen + np.float32(0.5), 0, 255), dtype=np.uint8)

    def _depth(self, hits: Hits, cosine: NDArray[np.float32], rng: np.random.Generator) -> NDArray[np.float32]:
        """Depth (H, W) float32 in whole millimetres; axial noise after Nguyen et al. 2012, growing with z^2."""
        z = np.where(hits.hit, hits.length, np.float32(99.0))
        sigma = self._level * (DEPTH_NOISE_M + DEPTH_NOISE_PER_M * (z - 0.4) ** 2)
        noisy = z + sigma.astype(np.float32) * self._noise(z.shape, rng)
        lost = (
            ~hits.hit
            | ~self._scene.in_depth[hits.surface]
            | (cosine < _GRAZING_COSINE * rng.random(z.shape, dtype=np.float32) ** 0.5)
        )
        lost |= self._shadow(z, rng) | self._patches(z.shape, rng)
        lost |= (noisy < CAMERA_RANGE_MIN_M) | (noisy > CAMERA_RANGE_MAX_M)
        millimetres = np.where(lost, 0.0, np.rint(noisy.astype(np.float64) * _MM_PER_M))
        return (millimetres / _MM_PER_M).astype(np.float32)

    def _noise(self, shape: tuple[int, ...], rng: np.random.Generator) -> NDArray[np.float32]:
        """Noise (H, W) of unit deviation, correlated between neighbouring pixels as they share most of a matching window."""
        white = rng.standard_normal(shape, dtype=np.float32)
        width = DEPTH_NOISE_WIDTH_PX
        if width <= 0.0:
            return white
        kernel = cv2.getGaussianKernel(2 * int(np.ceil(3.0 * width)) + 1, width, cv2.CV_32F)
        kernel /= np.linalg.norm(kernel)
        return np.asarray(cv2.sepFilter2D(white, -1, kernel, kernel), dtype=np.float32)

    def _shadow(self, z: NDArray[np.float32], rng: np.random.Generator) -> NDArray[np.bool_]:
        """Pixels next to a depth discontinuity, which the projected pattern does not reach."""
        low = cv2.erode(z, np.ones((3, 3), np.uint8))
        torn = (z - low) > _EDGE_JUMP * z
        return np.asarray(torn & (rng.random(z.shape, dtype=np.float32) < 0.75))

    def _patches(self, shape: tuple[int, ...], rng: np.random.Generator) -> NDArray[np.bool_]:
        """Blobs without depth, as on dark or shiny spots."""
        share = self._level * HOLE_FRACTION
        if share <= 0.0:
            return np.zeros(shape, dtype=np.bool_)
        field = smooth_noise(rng, (shape[0], shape[1]), shape[1] / 28.0)
        return np.asarray(field > np.quantile(field, 1.0 - share))


LASER_FORWARD_M = 0.15
"""The laser stands this far in front of `base_link`, m."""
LASER_HEIGHT_M = 0.3
"""Height of the scanning plane, m: it meets the legs of tables and the fronts of cupboards."""
LASER_RANGE_MIN_M = 0.05
"""No return nearer than this, m."""
LASER_NOISE_M = 0.01
"""Standard deviation of a range, m: that of the small scanners of indoor robots."""
DROP_FRACTION = 0.002
"""Share of beams without a return."""


def laser_of(config: LaserScannerConfig) -> Laser:
    """Beam directions and mounting of the simulated laser; angles have the 32-bit precision of a LaserScan message."""
    field = np.deg2rad(config.field_of_view_deg)
    steps = config.beams if config.field_of_view_deg >= 360.0 else config.beams - 1
    first, step = float(np.float32(-0.5 * field)), float(np.float32(field / steps))
    bearings = first + np.arange(config.beams, dtype=np.float64) * step
    low, high = (float(np.float32(value)) for value in (LASER_RANGE_MIN_M, config.range_max_m))
    return Laser(bearings, low, high, np.array([LASER_FORWARD_M, 0.0, 0.0]))


class LaserModel:
    """Simulates scans of a planar laser in one scene, in a plane parallel to the floor."""

    def __init__(self, scene: Scene, config: LaserScannerConfig, noise: float = 1.0) -> None:
        """Take a scene and a laser; `noise` is a factor on the noise of ranges and on the lost beams, 0: none."""
        self._scene = scene
        self._noise = noise
        self.laser = laser_of(config)

    def scan(self, stamp_ns: int, time_s: float, pose_world_base: Array, rng: np.random.Generator) -> LaserScan:
        """Simulate one scan; its beams are all measured at once.

        Args:
            stamp_ns: stamp of the scan, ns.
            time_s: time since the drive began, s; where people walk depends on it.
            pose_world_base: (3,) true pose of the robot, m and rad.
            rng: random generator for the noise of this scan.
        """
        x, y, yaw = pose_world_base
        angle = self.laser.bearings_rad + yaw
        rays = np.column_stack([np.cos(angle), np.sin(angle), np.zeros(len(angle))]).astype(np.float32)
        origin = np.array([x + LASER_FORWARD_M * np.cos(yaw), y + LASER_FORWARD_M * np.sin(yaw), LASER_HEIGHT_M])
        hits = self._scene.cast(origin, rays)
        ranges = np.where(hits.hit, hits.length, np.inf).astype(np.float64)
        ranges = np.minimum(ranges + self._foliage(hits, rng), self._people(origin[:2], rays[:, :2], time_s))
        ranges = ranges + self._noise * LASER_NOISE_M * rng.standard_normal(len(ranges))
        dropped = rng.random(len(ranges)) < self._noise * DROP_FRACTION
        return LaserScan(stamp_ns, self._valid(ranges.astype(np.float32), dropped))

    def _foliage(self, hits: Hits, rng: np.random.Generator) -> Array:
        """How far (B,), m, each beam goes on between leaves: any way up to the depth of what it meets."""
        most = np.where(hits.hit, self._scene.foliage_m[hits.surface], 0.0)
        return np.asarray(most * rng.random(len(most))) if most.any() else most

    def _people(self, origin: Array, directions: NDArray[np.float32], time_s: float) -> Array:
        """Distance (B,), m, at which each beam meets a person; infinite if it meets none."""
        nearest = np.full(len(directions), np.inf)
        for walker in self._scene.walkers:
            away = walker.at(time_s) - origin
            along = directions @ away
            depth2 = walker.radius_m**2 - (away @ away - along**2)
            met = (along > 0.0) & (depth2 > 0.0)
            nearest[met] = np.minimum(nearest[met], along[met] - np.sqrt(depth2[met]))
        return nearest

    def _valid(self, ranges: NDArray[np.float32], dropped: NDArray[np.bool_]) -> NDArray[np.float32]:
        inside = (ranges >= np.float32(self.laser.range_min_m)) & (ranges < np.float32(self.laser.range_max_m))
        return np.where(inside & ~dropped, ranges, np.float32(np.nan))
