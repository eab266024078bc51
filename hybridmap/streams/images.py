"""`sensor_msgs/Image` and `CompressedImage` -> RGB pictures and depth in metres (REP-118)."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from hybridmap.errors import StreamError
from hybridmap.streams.cameras import ColorImage, DepthImage, depth_from_units

_PNG = b"\x89PNG\r\n\x1a\n"
_DEPTH_HEADER_BYTES = 12  # compressedDepth: int32 format, float32 A, float32 B


@dataclass(frozen=True, slots=True)
class _Layout:
    """How a pixel is stored: type, channels, and which of them are red, green, blue."""

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


def decode_color(message: Any, what: str) -> ColorImage:
    """(H, W, 3) uint8 RGB of an Image or CompressedImage message; grey pictures repeat their channel.

    Raises:
        StreamError: an encoding that is no colour, or data that are cut off.
    """
    if hasattr(message, "encoding"):
        layout = _layout_of(message.encoding, _COLOR, "colour", what)
        return np.ascontiguousarray(_pixels(message, layout, what)[..., list(layout.rgb)], dtype=np.uint8)
    import cv2

    picture = _decompress(bytes(message.data), cv2.IMREAD_COLOR, what)
    return np.ascontiguousarray(picture[..., ::-1], dtype=np.uint8)


def decode_depth(message: Any, units_per_m: float, what: str) -> DepthImage:
    """(H, W) float32 depth in m of an Image or CompressedImage message; may still hold NaN.

    Args:
        message: 16UC1, mono16 or 32FC1; or a 16 bit PNG, or `compressedDepth` of either encoding.
        units_per_m: units of a 16 bit value per metre, 1000 by REP-118.
        what: file and topic, for errors.

    Raises:
        StreamError: an encoding that is no depth, or data that are cut off.
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
    step = int(message.step) or row_bytes
    data = np.asarray(message.data, dtype=np.uint8)
    needed = step * (height - 1) + row_bytes
    if height < 1 or width < 1 or step < row_bytes or len(data) < needed:
        raise StreamError(
            f"{what}: a {width}x{height} picture with rows of {step} bytes holds {len(data)} bytes, expected {max(needed, 1)}"
        )
    rows = np.zeros((height, step), dtype=np.uint8)
    rows.ravel()[: min(len(data), step * height)] = data[: step * height]
    packed = np.ascontiguousarray(rows[:, :row_bytes]).view(dtype)
    return packed.reshape(height, width, layout.channels)


def _decompress(data: bytes, flags: int, what: str) -> NDArray[Any]:
    import cv2

    picture = cv2.imdecode(np.frombuffer(data, dtype=np.uint8), flags) if data else None
    if picture is None:
        raise StreamError(
            f"{what}: a compressed picture of {len(data)} bytes cannot be decoded: damaged, or of an unknown kind"
        )
    return np.asarray(picture)


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
