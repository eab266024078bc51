"""The RGB-D camera as a kind of sensor: its frames, reading them from a bag, and keyframes in the map file."""

from __future__ import annotations

import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any, ClassVar

import numpy as np
from numpy.typing import NDArray

from hybridmap.config.inputs import SensorsConfig
from hybridmap.errors import StreamError
from hybridmap.geometry import Array
from hybridmap.streams.bagindex import TRANSPORT
from hybridmap.streams.base import InBag, Keyframe, Observation, Planned, Rig, Seen, SensorKind, SensorPlan
from hybridmap.streams.cameras import (
    Calibration,
    DepthRegistration,
    calibration_of,
    check_size,
    clean_depth,
    decode_color,
    decode_depth,
    from_intrinsics,
    mounted,
)
from hybridmap.streams.order import sorted_order
from hybridmap.streams.pairing import PairGatherer, pair_nearest

if TYPE_CHECKING:
    from hybridmap.streams.bagindex import BagIndex, TopicChooser

_IMAGE = ("sensor_msgs/msg/Image", "sensor_msgs/msg/CompressedImage")
_CAMERA_INFO = ("sensor_msgs/msg/CameraInfo",)
_NO_COLOR = re.compile(r"depth|infra|(^|[/_])ir([/_]|$)|mask|label|disparity|confidence|segment", re.IGNORECASE)
_DEPTH = re.compile(r"depth", re.IGNORECASE)
_COLOR_NAMES = (r"rect_color|color/image_rect", r"(color|rgb)/image", r"color|rgb", r"image")
_DEPTH_NAMES = (r"aligned_depth|depth_registered|depth_to_color|depth_to_rgb", r"depth/image", r"image")
"""Usual names of the topics: the first pattern that fits counts; what fits none comes last."""
_REGISTERED = re.compile(r"aligned|registered|depth_to_(color|rgb)", re.IGNORECASE)
_SAME_PX = 0.5  # intrinsics closer than this are the same camera
_JUMP = 0.04
"""A depth pixel further than this share of its depth from the median of its neighbours belongs to no surface."""
_MM_PER_M = 1000.0


@dataclass(frozen=True, slots=True)
class Camera:
    """Pinhole camera of undistorted colour images, with depth registered to them.

    Attributes:
        width_px, height_px: image size.
        fx_px, fy_px, cx_px, cy_px: focal lengths and principal point, pixels; (0, 0) is the middle of the first pixel.
        T_base_camera: (4, 4) pose of the camera OPTICAL frame (x right, y down, z forward) in `base_link`, m.
    """

    width_px: int
    height_px: int
    fx_px: float
    fy_px: float
    cx_px: float
    cy_px: float
    T_base_camera: Array


@dataclass(frozen=True, slots=True)
class RgbdFrame(Observation):
    """One colour frame with its registered depth.

    Attributes:
        stamp_ns: header stamp of the colour image, ns.
        color: (H, W, 3) uint8, RGB (grey images repeat their channel).
        depth_m: (H, W) float32, m along the optical axis; 0 where invalid.
    """

    precedence: ClassVar[int] = 2
    color: NDArray[np.uint8]
    depth_m: NDArray[np.float32]


def checked_frame(frame: Observation, camera: Camera) -> RgbdFrame:
    """Return an observation as a frame of a camera.

    Raises:
        StreamError: not an RGB-D frame, or its size is not the camera's.
    """
    if not isinstance(frame, RgbdFrame):
        raise StreamError(f"vision: mapping by camera needs colour with depth, found {type(frame).__name__}")
    size = (camera.height_px, camera.width_px)
    if frame.color.shape[:2] != size or frame.depth_m.shape != size:
        found = f"colour {frame.color.shape[:2]} and depth {frame.depth_m.shape}"
        raise StreamError(f"vision: frame at {frame.stamp_ns} ns has {found}, expected {size} rows and columns")
    return frame


def pinhole(calibration: Calibration, T_base_camera: Array) -> Camera:
    """The camera of the undistorted images of a calibration; `T_base_camera` (4, 4) is its optical frame in `base_link`, m."""
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


def _find(chooser: TopicChooser) -> dict[str, str]:
    depth = chooser.named("depth_topic", _IMAGE) or chooser.best(
        _IMAGE, _DEPTH_NAMES, keep=lambda name: _DEPTH.search(name) is not None
    )
    colors = [t.name for t in chooser.of(_IMAGE) if _NO_COLOR.search(t.name) is None and t.name != depth]
    beside = [name for name in colors if depth is not None and _namespace(name) == _namespace(depth)]
    color = chooser.named("color_topic", _IMAGE) or chooser.best(
        _IMAGE, _COLOR_NAMES, keep=lambda name: name in (beside or colors)
    )
    infos = [topic.name for topic in chooser.of(_CAMERA_INFO)]
    color_info = chooser.named("camera_info_topic", _CAMERA_INFO) or _info_of(color, infos, alone_is_enough=True)
    depth_info = chooser.named("depth_info_topic", _CAMERA_INFO) or _info_of(depth, infos, alone_is_enough=False)
    if color is None and depth is None:
        return {}
    roles = {"color": color, "depth": depth, "color_info": color_info, "depth_info": depth_info}
    return {role: topic for role, topic in roles.items() if topic is not None}


def _namespace(topic: str) -> str:
    """First part of a topic's name, which usually names the camera."""
    return topic.strip("/").split("/")[0]


def _info_of(image: str | None, infos: Sequence[str], *, alone_is_enough: bool) -> str | None:
    """The CameraInfo topic of an image topic, by the convention of image_transport."""
    if image is None:
        return None
    plain = TRANSPORT.sub("", image)
    parent = plain.rsplit("/", 1)[0]
    for name in (f"{parent}/camera_info", f"{plain}/camera_info"):
        if name in infos:
            return name
    others = [name for name in infos if alone_is_enough and not _DEPTH.search(name)]
    return others[0] if len(others) == 1 else infos[0] if alone_is_enough and len(infos) == 1 else None


def _plan(topics: Mapping[str, str], index: BagIndex, base_frame: str, config: SensorsConfig, source: str) -> SensorPlan:
    """Every pair of colour and depth images.

    Raises:
        StreamError: colour, depth, calibration or mounting is missing, sizes contradict each other, or no stamps match.
    """
    color, depth = topics.get("color"), topics.get("depth")
    if color is None or depth is None:
        missing, given = ("colour", "color_topic") if color is None else ("depth", "depth_topic")
        raise StreamError(
            f"{source}: no {missing} pictures: expected a topic of type sensor_msgs/Image or CompressedImage; "
            f"name it as sensors.{given}, or set vision.sensor to none for dead reckoning"
        )
    decoder = FrameDecoder(topics, index, base_frame, config, source)
    color_ns, depth_ns = (np.asarray(index.stamps_ns[topic], dtype=np.int64) for topic in (color, depth))
    color_order, depth_order = sorted_order(color_ns, f"{source}: {color}"), sorted_order(depth_ns, f"{source}: {depth}")
    pairs = pair_nearest(color_ns[color_order], depth_ns[depth_order], config.sync_tolerance_s)
    if not len(pairs.color):
        raise StreamError(
            f"{source}: no picture of {color} has one of {depth} within sensors.sync_tolerance_s = {config.sync_tolerance_s} s"
        )
    numbers = zip(color_order[pairs.color], depth_order[pairs.depth], strict=True)
    planned = [Planned(int(color_ns[i]), ((color, int(i)), (depth, int(j)))) for i, j in numbers]
    losses = {"unmatched color": pairs.unmatched_color, "unmatched depth": pairs.unmatched_depth}
    return SensorPlan(Rig(camera=decoder.camera), planned, decoder, losses, decoder.remarks)


class FrameDecoder:
    """Makes one frame from a colour and a depth message: undistorted, depth registered to the colour image and limited.

    Attributes:
        camera: the camera of the frames.
        remarks: assumptions that were made, for the user.
        counts: irregularities; always empty.
    """

    def __init__(self, topics: Mapping[str, str], index: BagIndex, base_frame: str, config: SensorsConfig, source: str) -> None:
        """Read sizes, calibration and mounting from the first messages.

        Args:
            topics: role -> topic: `color` and `depth`, and `color_info` and `depth_info` where there are such.
            index: of the bag.
            base_frame: frame of the robot.
            config: what replaces calibration and mounting; limits of depth.
            source: path of the bag, for errors.

        Raises:
            StreamError: calibration or mounting is missing, or sizes contradict each other.
        """
        self._config = config
        self._what_color, self._what_depth = f"{source}: {topics['color']}", f"{source}: {topics['depth']}"
        self.remarks: list[str] = []
        self.counts: dict[str, int] = {}
        color = decode_color(index.first[topics["color"]], self._what_color)
        depth = self._depth_m(index.first[topics["depth"]])
        self._color = self._color_calibration(topics, index, source)
        check_size(color, self._color, self._what_color)
        self._depth, self._registration = self._depth_calibration(topics, index, depth.shape)
        check_size(depth, self._depth, self._what_depth)
        if config.camera_mounting is not None:
            T = mounted(config.camera_mounting)
        else:
            frame = index.frame_of(topics["color"])
            T = index.transforms.require(base_frame, frame, self._what_color, "sensors.camera_mounting")
            if T[2, 2] > 0.9:
                self.remarks.append(f"the camera looks straight up: is {frame!r} its optical frame? (sensors.camera_mounting)")
        self.camera = pinhole(self._color, T)

    def __call__(self, stamp_ns: int, parts: tuple[Any, ...]) -> RgbdFrame:
        """Decode one pair, `parts` being the colour and the depth message.

        Raises:
            StreamError: a picture is damaged, or of another size than its calibration.
        """
        color = decode_color(parts[0], self._what_color)
        depth = self._depth_m(parts[1])
        check_size(color, self._color, self._what_color)
        check_size(depth, self._depth, self._what_depth)
        depth = self._depth.undistort_depth(depth)
        if self._registration is not None:
            depth = self._registration(depth)
        return RgbdFrame(stamp_ns, self._color.undistort_color(color), clean_depth(depth, self._config))

    def _depth_m(self, message: Any) -> NDArray[np.float32]:
        units_per_m = self._config.depth_scale or 1000.0
        depth = decode_depth(message, units_per_m, self._what_depth)
        return np.where(np.isfinite(depth), depth, np.float32(0.0))

    def _color_calibration(self, topics: Mapping[str, str], index: BagIndex, source: str) -> Calibration:
        if self._config.camera_intrinsics is not None:
            return from_intrinsics(self._config.camera_intrinsics)
        if "color_info" not in topics:
            raise StreamError(
                f"{self._what_color}: no calibration: expected a topic of type sensor_msgs/CameraInfo beside it; "
                "name it as sensors.camera_info_topic or give sensors.camera_intrinsics"
            )
        info = index.first[topics["color_info"]]
        return calibration_of(info, topics["color"], f"{source}: {topics['color_info']}")

    def _depth_calibration(
        self, topics: Mapping[str, str], index: BagIndex, size: tuple[int, ...]
    ) -> tuple[Calibration, DepthRegistration | None]:
        """Calibration of the depth images, and their registration to colour; None if they are registered already."""
        color, color_topic, depth_topic = self._color, topics["color"], topics["depth"]
        same_size = size == (color.height_px, color.width_px)
        if same_size and (_REGISTERED.search(depth_topic) or "depth_info" not in topics):
            return color, None
        if "depth_info" not in topics:
            raise StreamError(
                f"{self._what_depth}: depth is {size[1]}x{size[0]}, colour {color.width_px}x{color.height_px}, and there is no "
                "CameraInfo of the depth camera to register it with; name it as sensors.depth_info_topic"
            )
        depth = calibration_of(index.first[topics["depth_info"]], depth_topic, f"{self._what_depth}: camera info")
        T = self._extrinsics(index, index.frame_of(color_topic), index.frame_of(depth_topic), same_size)
        same_camera = same_size and T is None and np.abs(depth.K - color.K).max() < _SAME_PX
        if same_camera:
            return color, None
        self.remarks.append(f"depth of {topics['depth']} is registered to {topics['color']}")
        return depth, DepthRegistration(depth, color, np.eye(4) if T is None else T)

    def _extrinsics(self, index: BagIndex, color_frame: str, depth_frame: str, same_size: bool) -> Array | None:
        """(4, 4) pose of the depth camera in the colour camera; None if both are the same camera."""
        if color_frame == depth_frame:
            return None
        T = index.transforms.between(color_frame, depth_frame)
        if T is None and not same_size:
            raise StreamError(
                f"{self._what_depth}: depth is of another size than colour, and no transform "
                f"{color_frame!r} -> {depth_frame!r} in /tf_static or /tf says how to register it"
            )
        if T is None:
            self.remarks.append(f"no transform {color_frame!r} -> {depth_frame!r}: depth is taken as registered to colour")
        return None if T is None or np.allclose(T, np.eye(4), atol=1e-6) else T


def _configured(config: SensorsConfig) -> Camera | None:
    """The camera of the configuration, if both its intrinsics and its mounting are set."""
    if config.camera_intrinsics is None or config.camera_mounting is None:
        return None
    return pinhole(from_intrinsics(config.camera_intrinsics), mounted(config.camera_mounting))


def _compact(frame: RgbdFrame) -> dict[str, NDArray[Any]]:
    """Colour unchanged; depth in whole millimetres (H, W) uint16, 0 if invalid."""
    millimetres = np.rint(np.nan_to_num(frame.depth_m, posinf=0.0) * _MM_PER_M)
    return {"color": frame.color, "depth_mm": np.asarray(np.clip(millimetres, 0, 65535), dtype=np.uint16)}


def _restore(keyframe: Keyframe, stamp_ns: int) -> RgbdFrame | None:
    if "color" not in keyframe or "depth_mm" not in keyframe:
        return None
    depth_m = (keyframe["depth_mm"] / np.float32(_MM_PER_M)).astype(np.float32)
    return RgbdFrame(stamp_ns, keyframe["color"], depth_m)


def _see(keyframe: Keyframe, camera: Camera, max_range_m: float) -> Seen | None:
    """Back-project the depth image of a keyframe, without pixels on depth discontinuities.

    Args:
        keyframe: with `depth_mm` (H, W) uint16, perhaps `color` (H, W, 3) uint8, and `T_base_camera` (4, 4) if the camera is
            hand-held and tilts.
        camera: of the whole image; a smaller keyframe is the same image, scaled.
        max_range_m: depth beyond this is left out.
    """
    import cv2

    if "depth_mm" not in keyframe:
        return None
    depth_mm = keyframe["depth_mm"]
    depth_m = depth_mm.astype(np.float64) / 1000.0
    smooth_m = cv2.medianBlur(depth_mm, 3).astype(np.float64) / 1000.0
    valid = (depth_m > 0) & (depth_m <= max_range_m) & (np.abs(depth_m - smooth_m) <= _JUMP * depth_m)
    v, u = np.nonzero(valid)
    z = depth_m[valid]
    scale = depth_mm.shape[1] / camera.width_px
    x = ((u + 0.5) / scale - 0.5 - camera.cx_px) / camera.fx_px * z
    y = ((v + 0.5) / scale - 0.5 - camera.cy_px) / camera.fy_px * z
    T_base_camera = np.asarray(keyframe.get("T_base_camera", camera.T_base_camera), dtype=np.float64)
    xyz = np.stack([x, y, z], axis=1) @ T_base_camera[:3, :3].T + T_base_camera[:3, 3]
    color = keyframe.get("color")
    same_size = color is not None and color.shape[:2] == depth_mm.shape
    rgb = color[valid] / 255.0 if color is not None and same_size else None
    return Seen(xyz, rgb, T_base_camera[:2, 3], column_rad=2.0 / camera.fx_px)


RGBD = SensorKind(
    name="rgbd",
    sensor_name="camera",
    sensor=Camera,
    sample=RgbdFrame,
    counted="frames",
    needs="colour with depth",
    words=lambda camera: f"RGB-D, {camera.width_px}x{camera.height_px} pixels",
    front_end="hybridmap.vision.rgbd.front_end:create",
    compact=_compact,
    restore=_restore,
    see=_see,
    in_bag=InBag(_IMAGE + _CAMERA_INFO, _find, _plan, PairGatherer),
    configured=_configured,
)
