"""Images and calibrations: decoding (REP-118), undistortion, and registration of depth to the colour camera."""

from __future__ import annotations

import re
from dataclasses import dataclass
from functools import cached_property
from typing import Any

import numpy as np
from numpy.typing import NDArray

from hybridmap.config.inputs import DISTORTIONS, CameraIntrinsics, CameraMounting, SensorsConfig
from hybridmap.errors import StreamError, quoted
from hybridmap.geometry import Array
from hybridmap.streams.mounting import matrix

DepthImage = NDArray[np.float32]
ColorImage = NDArray[np.uint8]

_RECTIFIED = re.compile(r"rect[^/]*(/compressed(Depth)?)?$", re.IGNORECASE)  # image_rect, image_rect_color, ...

_PNG, _JPEG = b"\x89PNG\r\n\x1a\n", b"\xff\xd8"
_FRAMES = frozenset(range(0xC0, 0xD0)) - {0xC4, 0xC8, 0xCC}
"""Markers of a JPEG's segments that hold its size."""
MOST_PIXELS = 1 << 26
"""Pixels of a picture, 8192 x 8192. A header can claim 4 billion, for which memory would be taken before any are read."""
_LARGEST_PX = 1e6
"""Focal length or principal point, pixels; a camera with this focal length sees a millionth of what lies before it."""
_FINEST = 16
"""How many times finer than the depth camera's the colour camera's pixels may be: a depth pixel is split by as much."""
_DEPTH_HEADER_BYTES = 12  # compressedDepth: int32 format, float32 A, float32 B


@dataclass(frozen=True, slots=True)
class _Layout:
    """Storage of a pixel: type, channels, and the indices of red, green and blue."""

    dtype: str
    channels: int
    rgb: tuple[int, int, int] = (0, 1, 2)


_COLOR = {
    "rgb8": _Layout("u1", 3),
    "bgr8": _Layout("u1", 3, (2, 1, 0)),
    "8uc3": _Layout("u1", 3, (2, 1, 0)),
    "rgba8": _Layout("u1", 4),
    "bgra8": _Layout("u1", 4, (2, 1, 0)),
    "8uc4": _Layout("u1", 4, (2, 1, 0)),
    "mono8": _Layout("u1", 1, (0, 0, 0)),
    "8uc1": _Layout("u1", 1, (0, 0, 0)),
}
_DEPTH = {"16uc1": _Layout("u2", 1), "mono16": _Layout("u2", 1), "32fc1": _Layout("f4", 1)}


@dataclass(frozen=True)
class Calibration:
    """Intrinsic calibration of one camera: a pinhole with a lens.

    Attributes:
        width_px, height_px: image size.
        K: (3, 3) camera matrix, pixels.
        distortion: (D,) coefficients in OpenCV's order; empty: no distortion.
        fisheye: whether the coefficients are those of the equidistant model.
    """

    width_px: int
    height_px: int
    K: Array
    distortion: tuple[float, ...] = ()
    fisheye: bool = False

    @property
    def is_distorted(self) -> bool:
        """Whether the lens has distortion."""
        return any(self.distortion)

    @cached_property
    def _maps(self) -> tuple[Any, Any]:
        import cv2

        size, D = (self.width_px, self.height_px), np.asarray(self.distortion, dtype=np.float64)
        if self.fisheye:
            return cv2.fisheye.initUndistortRectifyMap(self.K, D[:4], np.eye(3), self.K, size, cv2.CV_32FC1)
        return cv2.initUndistortRectifyMap(self.K, D, np.eye(3), self.K, size, cv2.CV_32FC1)

    def undistort_color(self, color: ColorImage) -> ColorImage:
        """The image (H, W, 3) that an ideal pinhole would give; unchanged without distortion."""
        if not self.is_distorted:
            return color
        import cv2

        return np.asarray(cv2.remap(color, *self._maps, interpolation=cv2.INTER_LINEAR), dtype=np.uint8)

    def undistort_depth(self, depth_m: DepthImage) -> DepthImage:
        """The depth (H, W) that an ideal pinhole would give, m, by the nearest pixel; 0 for pixels outside the image."""
        if not self.is_distorted:
            return depth_m
        import cv2

        return np.asarray(cv2.remap(depth_m, *self._maps, interpolation=cv2.INTER_NEAREST), dtype=np.float32)


def from_intrinsics(given: CameraIntrinsics) -> Calibration:
    """Calibration from the intrinsics in the configuration."""
    K = np.array([[given.fx_px, 0.0, given.cx_px], [0.0, given.fy_px, given.cy_px], [0.0, 0.0, 1.0]])
    return Calibration(given.width_px, given.height_px, K, given.distortion)


def mounted(mounting: CameraMounting) -> Array:
    """(4, 4) pose of the camera's optical frame in `base_link`, m, from the mounting in the configuration."""
    return matrix(mounting.translation_m, mounting.quaternion_xyzw)


def clean_depth(depth_m: DepthImage, config: SensorsConfig) -> DepthImage:
    """A copy of depth (H, W), m, with every value not finite, not positive or outside the configured limits set to 0."""
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
    """Projects depth from the depth camera into the colour camera's pixels.

    Every depth pixel becomes a point, is transformed by the extrinsics and projected; if several points fall on one pixel, the
    nearest is kept. If the colour camera has finer pixels, each depth pixel is split first, so that no holes appear.
    """

    def __init__(self, depth: Calibration, color: Calibration, T_color_depth: Array) -> None:
        """Prepare the rays of the depth pixels.

        Args:
            depth, color: calibrations of undistorted images.
            T_color_depth: (4, 4) pose of the depth camera in the colour camera's optical frame, m.

        Raises:
            StreamError: the colour camera's pixels are so much finer that one of the calibrations must be wrong.
        """
        self._color, self._T = color, T_color_depth
        finer = max(color.K[0, 0] / depth.K[0, 0], color.K[1, 1] / depth.K[1, 1])
        if not finer <= _FINEST:
            raise StreamError(
                f"depth cannot be registered to colour: the focal lengths are {color.K[0, 0]:g} px and {depth.K[0, 0]:g} px, "
                f"expected no more than {_FINEST} times as much for colour; check both calibrations"
            )
        self._split = max(1, int(np.ceil(finer - 1e-6)))
        offsets = (np.arange(self._split) + 0.5) / self._split - 0.5
        u = (np.arange(depth.width_px)[:, None] + offsets).ravel()
        v = (np.arange(depth.height_px)[:, None] + offsets).ravel()
        x = (u - depth.K[0, 2]) / depth.K[0, 0]
        y = (v - depth.K[1, 2]) / depth.K[1, 1]
        self._rays = np.stack([*np.meshgrid(x, y), np.ones((len(y), len(x)))], axis=-1)

    def __call__(self, depth_m: DepthImage) -> DepthImage:
        """From depth (H, W) in the depth camera to depth (H, W) of the colour camera's size, m; 0 for pixels without depth."""
        fine = depth_m.repeat(self._split, axis=0).repeat(self._split, axis=1).astype(np.float64)
        valid = fine > 0
        points = self._rays[valid] * fine[valid][:, None] @ self._T[:3, :3].T + self._T[:3, 3]
        points = points[points[:, 2] > 0]
        K = self._color.K
        u = np.rint(points[:, 0] / points[:, 2] * K[0, 0] + K[0, 2])
        v = np.rint(points[:, 1] / points[:, 2] * K[1, 1] + K[1, 2])
        inside = (u >= 0) & (u < self._color.width_px) & (v >= 0) & (v < self._color.height_px)
        flat = np.full(self._color.height_px * self._color.width_px, np.inf)
        at = v[inside].astype(np.int64) * self._color.width_px + u[inside].astype(np.int64)
        np.minimum.at(flat, at, points[inside, 2])
        flat[np.isinf(flat)] = 0.0
        return flat.reshape(self._color.height_px, self._color.width_px).astype(np.float32)


def check_size(picture: NDArray[Any], calibration: Calibration, what: str) -> None:
    """Check that an image has the size of its calibration; `what` (file and topic) names it in the error.

    Raises:
        StreamError: the sizes differ; the message names both.
    """
    height, width = picture.shape[:2]
    if (width, height) != (calibration.width_px, calibration.height_px):
        raise StreamError(
            f"{what}: the picture is {width}x{height}, its calibration is for "
            f"{calibration.width_px}x{calibration.height_px}; give sensors.camera_intrinsics for the pictures' size"
        )


def decode_color(message: Any, what: str) -> ColorImage:
    """(H, W, 3) uint8 RGB of an Image or CompressedImage message; grey images repeat their channel.

    Raises:
        StreamError: an encoding without colour, or truncated data; `what` (file and topic) names it.
    """
    if hasattr(message, "encoding"):
        layout = _layout_of(message.encoding, _COLOR, "colour", what)
        return np.ascontiguousarray(_pixels(message, layout, what)[..., list(layout.rgb)], dtype=np.uint8)
    import cv2

    picture = _decompress(bytes(message.data), cv2.IMREAD_COLOR, what)
    return np.ascontiguousarray(picture[..., ::-1], dtype=np.uint8)


def decode_depth(message: Any, units_per_m: float, what: str) -> DepthImage:
    """(H, W) float32 depth in m of an Image or CompressedImage message; may contain NaN.

    Args:
        message: 16UC1, mono16 or 32FC1; or a 16 bit PNG, or `compressedDepth` of either encoding.
        units_per_m: units of a 16 bit value per metre, 1000 by REP-118.
        what: file and topic, for errors.

    Raises:
        StreamError: an encoding without depth, or truncated data.
    """
    if hasattr(message, "encoding"):
        layout = _layout_of(message.encoding, _DEPTH, "depth", what)
        values = _pixels(message, layout, what)[..., 0]
        return depth_from_units(values, units_per_m) if layout.dtype == "u2" else values.astype(np.float32)
    return _decompress_depth(message, units_per_m, what)


def _layout_of(encoding: str, known: dict[str, _Layout], kind: str, what: str) -> _Layout:
    layout = known.get(encoding.strip().lower())
    if layout is None:
        raise StreamError(f"{what}: found encoding {encoding!r}, expected {kind}: {', '.join(known)}")
    return layout


def _pixels(message: Any, layout: _Layout, what: str) -> NDArray[Any]:
    """(H, W, C) view of the pixels, rows `step` bytes apart, of either byte order."""
    height, width = int(message.height), int(message.width)
    dtype = np.dtype((">" if message.is_bigendian else "<") + layout.dtype)
    row_bytes = width * layout.channels * dtype.itemsize
    step = (int(message.step) if height > 1 else 0) or row_bytes
    data = np.asarray(message.data, dtype=np.uint8)
    needed = step * (height - 1) + row_bytes
    if height < 1 or width < 1:
        raise StreamError(f"{what}: found a picture of {width}x{height} pixels, expected at least 1x1")
    if step < row_bytes:
        raise StreamError(f"{what}: a {width}x{height} picture has rows of {step} bytes, expected at least {row_bytes}")
    if len(data) < needed:
        raise StreamError(f"{what}: a {width}x{height} picture holds {len(data)} bytes, expected at least {needed}")
    rows = np.zeros((height, step), dtype=np.uint8)
    rows.ravel()[: min(len(data), step * height)] = data[: step * height]
    packed = np.ascontiguousarray(rows[:, :row_bytes]).view(dtype)
    return packed.reshape(height, width, layout.channels)


def decode_picture(data: bytes, flags: int) -> NDArray[Any]:
    """Decode a compressed picture.

    Args:
        data: PNG, JPEG or another format that OpenCV reads.
        flags: OpenCV's, such as `cv2.IMREAD_UNCHANGED`.

    Returns:
        (H, W), or (H, W, C) with the channels in OpenCV's order, blue first.

    Raises:
        ValueError: it is empty, damaged, of an unknown kind, or its header claims more than `MOST_PIXELS`.
    """
    import cv2

    width, height = _claimed_size(data)
    if width * height > MOST_PIXELS:
        raise ValueError(f"claims a size of {width}x{height}, expected at most {MOST_PIXELS} pixels")
    try:
        picture = cv2.imdecode(np.frombuffer(data, dtype=np.uint8), flags) if data else None
    except cv2.error as error:
        raise ValueError(f"cannot be decoded ({quoted(error.err)[1:-1]})") from None
    if picture is None:
        raise ValueError("cannot be decoded: damaged, or of an unknown kind")
    return np.asarray(picture)


def _claimed_size(data: bytes) -> tuple[int, int]:
    """Width and height by the header of a PNG or JPEG; (0, 0) if it has none. Other formats are limited by OpenCV alone."""
    if data.startswith(_PNG):
        return int.from_bytes(data[16:20], "big"), int.from_bytes(data[20:24], "big")
    at = 2 if data.startswith(_JPEG) else len(data)
    while at + 9 <= len(data) and data[at] == 0xFF:
        if data[at + 1] in _FRAMES:
            return int.from_bytes(data[at + 7 : at + 9], "big"), int.from_bytes(data[at + 5 : at + 7], "big")
        at += 1 if data[at + 1] == 0xFF else 2 + int.from_bytes(data[at + 2 : at + 4], "big")
    return 0, 0


def _decompress(data: bytes, flags: int, what: str) -> NDArray[Any]:
    try:
        return decode_picture(data, flags)
    except ValueError as error:
        raise StreamError(f"{what}: a compressed picture of {len(data)} bytes {error}") from None


def _decompress_depth(message: Any, units_per_m: float, what: str) -> DepthImage:
    import cv2

    data = bytes(message.data)
    quantised = data[_DEPTH_HEADER_BYTES : _DEPTH_HEADER_BYTES + len(_PNG)] == _PNG
    if "rvl" in message.format.lower():
        raise StreamError(f"{what}: found compressedDepth of kind RVL, expected PNG; convert it with image_transport")
    picture = _decompress(data[_DEPTH_HEADER_BYTES:] if quantised else data, cv2.IMREAD_UNCHANGED, what)
    if picture.ndim != 2 or picture.dtype != np.uint16:
        raise StreamError(
            f"{what}: found a compressed picture {picture.shape} of {picture.dtype}, expected depth as one channel of 16 bit"
        )
    if not (quantised and message.format.upper().startswith("32FC1")):
        return depth_from_units(picture, units_per_m)
    _, a, b = np.frombuffer(data[:_DEPTH_HEADER_BYTES], dtype="<i4,<f4,<f4")[0]
    with np.errstate(divide="ignore"):
        depth = np.where(picture > 0, np.float32(a) / (picture.astype(np.float32) - np.float32(b)), np.float32(0.0))
    return np.asarray(depth, dtype=np.float32)


def calibration_of(info: Any, image_topic: str, what: str) -> Calibration:
    """Calibration of a CameraInfo message; of a rectified image, the projection matrix without distortion.

    Args:
        info: CameraInfo of ROS 1 or ROS 2; its binning is taken into account.
        image_topic: topic of the images; `rect` in the last part of its name says that they are rectified.
        what: file and topic, for errors.

    Raises:
        StreamError: the camera is not calibrated, or its distortion model is unknown.
    """
    K = np.asarray(_field(info, "k"), dtype=np.float64).reshape(3, 3)
    P = np.asarray(_field(info, "p"), dtype=np.float64).reshape(3, 4)
    distortion = tuple(float(value) for value in _field(info, "d"))
    model = info.distortion_model.strip().lower()
    if _RECTIFIED.search(image_topic) and P[0, 0] > 0:
        K, distortion = P[:, :3], ()
    if not (K[0, 0] > 0 and K[1, 1] > 0 and (np.abs(K) <= _LARGEST_PX).all()):
        found = f"focal lengths {K[0, 0]:g}, {K[1, 1]:g} and principal point {K[0, 2]:g}, {K[1, 2]:g}"
        expected = f"positive focal lengths, and at most {_LARGEST_PX:g} px"
        raise StreamError(f"{what}: found {found}, expected {expected}; the camera is not calibrated")
    if any(distortion) and model not in ("plumb_bob", "rational_polynomial", "equidistant", "fisheye", ""):
        raise StreamError(f"{what}: found distortion model {model!r}, expected plumb_bob, rational_polynomial or equidistant")
    fisheye = model in ("equidistant", "fisheye")
    lengths = range(4, 15) if fisheye else DISTORTIONS
    if any(distortion) and not (np.isfinite(distortion).all() and len(distortion) in lengths):
        raise StreamError(f"{what}: found the distortion {quoted(distortion)}, expected 4, 5, 8, 12 or 14 finite numbers")
    bin_x, bin_y = max(int(info.binning_x), 1), max(int(info.binning_y), 1)
    K = np.diag([1.0 / bin_x, 1.0 / bin_y, 1.0]) @ K if bin_x > 1 or bin_y > 1 else K.copy()
    return Calibration(int(info.width) // bin_x, int(info.height) // bin_y, K, distortion, fisheye)


def _field(info: Any, name: str) -> Any:
    """A CameraInfo field, named in upper case in ROS 1 and in lower case in ROS 2."""
    return getattr(info, name) if hasattr(info, name) else getattr(info, name.upper())
