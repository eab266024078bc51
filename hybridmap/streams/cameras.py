"""Calibration: lens distortion taken out, depth brought to the colour camera, depth limits applied."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property
from typing import Any

import numpy as np
from numpy.typing import NDArray

from hybridmap.config.inputs import CameraIntrinsics, CameraMounting, SensorsConfig
from hybridmap.errors import StreamError
from hybridmap.geometry import Array
from hybridmap.streams.base import Camera
from hybridmap.streams.mounting import matrix

DepthImage = NDArray[np.float32]
ColorImage = NDArray[np.uint8]


@dataclass(frozen=True)
class Calibration:
    """One camera: pinhole and lens.

    Attributes:
        width_px, height_px: image size.
        K: (3, 3) intrinsics.
        distortion: (D,) coefficients of OpenCV's order; empty: none.
        fisheye: whether they are of the equidistant model.
    """

    width_px: int
    height_px: int
    K: Array
    distortion: tuple[float, ...] = ()
    fisheye: bool = False

    @property
    def is_distorted(self) -> bool:
        """Whether there is any distortion to take out."""
        return any(self.distortion)

    @cached_property
    def _maps(self) -> tuple[Any, Any]:
        import cv2

        size, D = (self.width_px, self.height_px), np.asarray(self.distortion, dtype=np.float64)
        if self.fisheye:
            return cv2.fisheye.initUndistortRectifyMap(self.K, D[:4], np.eye(3), self.K, size, cv2.CV_32FC1)
        return cv2.initUndistortRectifyMap(self.K, D, np.eye(3), self.K, size, cv2.CV_32FC1)

    def undistort_color(self, color: ColorImage) -> ColorImage:
        """(H, W, 3) picture as the pinhole alone would see it; unchanged where there is no distortion."""
        if not self.is_distorted:
            return color
        import cv2

        return np.asarray(cv2.remap(color, *self._maps, interpolation=cv2.INTER_LINEAR), dtype=np.uint8)

    def undistort_depth(self, depth_m: DepthImage) -> DepthImage:
        """(H, W) depth as the pinhole alone would see it, nearest pixel; 0 where nothing is seen."""
        if not self.is_distorted:
            return depth_m
        import cv2

        return np.asarray(cv2.remap(depth_m, *self._maps, interpolation=cv2.INTER_NEAREST), dtype=np.float32)


def from_intrinsics(given: CameraIntrinsics) -> Calibration:
    """Calibration of the configuration."""
    K = np.array([[given.fx_px, 0.0, given.cx_px], [0.0, given.fy_px, given.cy_px], [0.0, 0.0, 1.0]])
    return Calibration(given.width_px, given.height_px, K, given.distortion)


def pinhole(calibration: Calibration, T_base_camera: Array) -> Camera:
    """The camera of the undistorted frames."""
    K = calibration.K
    return Camera(
        calibration.width_px,
        calibration.height_px,
        float(K[0, 0]),
        float(K[1, 1]),
        float(K[0, 2]),
        float(K[1, 2]),
        T_base_camera,
    )


def mounted(mounting: CameraMounting) -> Array:
    """(4, 4) pose of the optical frame in the base, of the configuration."""
    return matrix(mounting.translation_m, mounting.quaternion_xyzw)


def clean_depth(depth_m: DepthImage, config: SensorsConfig) -> DepthImage:
    """Depth with every value that is not finite, not positive or outside the configured limits set to 0."""
    with np.errstate(invalid="ignore"):
        valid = np.isfinite(depth_m) & (depth_m > 0)
        if config.depth_min_m is not None:
            valid &= depth_m >= config.depth_min_m
        if config.depth_max_m is not None:
            valid &= depth_m <= config.depth_max_m
    return np.where(valid, depth_m, np.float32(0.0))


def depth_from_units(values: NDArray[np.uint16], units_per_m: float) -> DepthImage:
    """(H, W) depth in m, float32 of the exact quotient; 0 stays 0."""
    return (values.astype(np.float64) / units_per_m).astype(np.float32)


class DepthRegistration:
    """Moves depth from the depth camera into the colour camera's pixels.

    Every depth pixel becomes a point, is carried over by the extrinsics and projected; the nearest of the points that fall on
    one pixel wins. Where the colour camera has the finer pixels, each depth pixel is first split, so that no holes appear.
    """

    def __init__(self, depth: Calibration, color: Calibration, T_color_depth: Array) -> None:
        """Prepare the rays of the depth pixels.

        Args:
            depth, color: calibrations of undistorted pictures.
            T_color_depth: (4, 4) pose of the depth camera in the colour camera's optical frame, m.
        """
        self._color, self._T = color, T_color_depth
        finer = max(color.K[0, 0] / depth.K[0, 0], color.K[1, 1] / depth.K[1, 1])
        self._split = max(1, int(np.ceil(finer - 1e-6)))
        offsets = (np.arange(self._split) + 0.5) / self._split - 0.5
        u = (np.arange(depth.width_px)[:, None] + offsets).ravel()
        v = (np.arange(depth.height_px)[:, None] + offsets).ravel()
        x = (u - depth.K[0, 2]) / depth.K[0, 0]
        y = (v - depth.K[1, 2]) / depth.K[1, 1]
        self._rays = np.stack([*np.meshgrid(x, y), np.ones((len(y), len(x)))], axis=-1)

    def __call__(self, depth_m: DepthImage) -> DepthImage:
        """(H, W) depth in the colour camera, m; 0 where nothing falls."""
        fine = depth_m.repeat(self._split, axis=0).repeat(self._split, axis=1).astype(np.float64)
        valid = fine > 0
        points = self._rays[valid] * fine[valid][:, None] @ self._T[:3, :3].T + self._T[:3, 3]
        points = points[points[:, 2] > 0]
        K = self._color.K
        u = np.rint(points[:, 0] / points[:, 2] * K[0, 0] + K[0, 2]).astype(np.int64)
        v = np.rint(points[:, 1] / points[:, 2] * K[1, 1] + K[1, 2]).astype(np.int64)
        inside = (u >= 0) & (u < self._color.width_px) & (v >= 0) & (v < self._color.height_px)
        flat = np.full(self._color.height_px * self._color.width_px, np.inf)
        np.minimum.at(flat, v[inside] * self._color.width_px + u[inside], points[inside, 2])
        flat[np.isinf(flat)] = 0.0
        return flat.reshape(self._color.height_px, self._color.width_px).astype(np.float32)


def check_size(picture: NDArray[Any], calibration: Calibration, what: str) -> None:
    """Refuse a picture that is not of its calibration's size.

    Raises:
        StreamError: naming both sizes.
    """
    height, width = picture.shape[:2]
    if (width, height) != (calibration.width_px, calibration.height_px):
        raise StreamError(
            f"{what}: the picture is {width}x{height}, its calibration is for "
            f"{calibration.width_px}x{calibration.height_px}; give sensors.camera_intrinsics for the pictures' size"
        )
