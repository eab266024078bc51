"""What a bag's scans or pictures become: which messages make an observation, and how they are decoded."""

from __future__ import annotations

import re
from dataclasses import dataclass, field
from typing import Any, Protocol

import numpy as np
from numpy.typing import NDArray

from hybridmap.config.inputs import SensorsConfig
from hybridmap.errors import StreamError
from hybridmap.geometry import Array
from hybridmap.streams.bagindex import BagIndex
from hybridmap.streams.base import Observation, RgbdFrame, Rig
from hybridmap.streams.cameras import (
    Calibration,
    DepthRegistration,
    check_size,
    clean_depth,
    from_intrinsics,
    mounted,
    pinhole,
)
from hybridmap.streams.images import decode_color, decode_depth
from hybridmap.streams.mounting import laser_pose
from hybridmap.streams.order import pair_nearest, sorted_order
from hybridmap.streams.scans import ScanDecoder
from hybridmap.streams.topics import Selection

MessageKey = tuple[str, int]

_RECTIFIED = re.compile(r"rect[^/]*(/compressed(Depth)?)?$", re.IGNORECASE)  # image_rect, image_rect_color, ...
_REGISTERED = re.compile(r"aligned|registered|depth_to_(color|rgb)", re.IGNORECASE)
_SAME_PX = 0.5  # intrinsics closer than this are the same camera


@dataclass(frozen=True, slots=True)
class Planned:
    """An observation that is to come: its stamp, and the messages (topic, number) that it is made of."""

    stamp_ns: int
    needs: tuple[MessageKey, ...]


class Decoder(Protocol):
    """Makes an observation of the messages that it needs; counts what was odd about them."""

    counts: dict[str, int]

    def __call__(self, stamp_ns: int, parts: tuple[Any, ...]) -> Observation:
        """Decode the messages of one observation."""


@dataclass(slots=True)
class SensorPlan:
    """All observations of a bag.

    Attributes:
        rig: the sensor, with its mounting.
        planned: in order of stamp.
        decode: makes an observation of a stamp and the decoded messages.
        losses: counts of what found no partner.
        remarks: what was assumed.
    """

    rig: Rig = field(default_factory=Rig)
    planned: list[Planned] = field(default_factory=list)
    decode: Decoder | None = None
    losses: dict[str, int] = field(default_factory=dict)
    remarks: list[str] = field(default_factory=list)


def plan_scans(topic: str, index: BagIndex, base_frame: str, config: SensorsConfig, source: str) -> SensorPlan:
    """Every scan of a topic.

    Raises:
        StreamError: no mounting, a leaning laser, no beams, or stamps that go back.
    """
    what = f"{source}: {topic}"
    mounting = config.laser_mounting
    if mounting is not None:
        pose, upside_down = np.array([mounting.x_m, mounting.y_m, mounting.yaw_rad]), mounting.upside_down
    else:
        T = index.transforms.require(base_frame, index.frame_of(topic), what, "sensors.laser_mounting")
        pose, upside_down = laser_pose(T, what)
    decoder = ScanDecoder(index.first[topic], pose, upside_down, config, what)
    stamps = np.asarray(index.stamps_ns[topic], dtype=np.int64)
    planned = [Planned(int(stamps[i]), ((topic, int(i)),)) for i in sorted_order(stamps, what)]
    return SensorPlan(Rig(laser=decoder.laser), planned, decoder)


def plan_frames(selection: Selection, index: BagIndex, base_frame: str, config: SensorsConfig, source: str) -> SensorPlan:
    """Every pair of colour and depth pictures.

    Raises:
        StreamError: colour, depth, calibration or mounting is missing, sizes contradict each other, or nothing fits in time.
    """
    color, depth = selection.color, selection.depth
    if color is None or depth is None:
        missing, given = ("colour", "color_topic") if color is None else ("depth", "depth_topic")
        raise StreamError(
            f"{source}: no {missing} pictures: expected a topic of type sensor_msgs/Image or CompressedImage; "
            f"name it as sensors.{given}, or set vision.sensor to none for dead reckoning"
        )
    decoder = FrameDecoder(selection, index, base_frame, config, source)
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
    """A colour and a depth message -> one frame: undistorted, depth in the colour camera's pixels, limits applied."""

    def __init__(self, selection: Selection, index: BagIndex, base_frame: str, config: SensorsConfig, source: str) -> None:
        """Learn sizes, calibration and mounting from the first messages."""
        assert selection.color is not None
        assert selection.depth is not None
        self._config = config
        self._what_color, self._what_depth = f"{source}: {selection.color}", f"{source}: {selection.depth}"
        self.remarks: list[str] = []
        self.counts: dict[str, int] = {}
        color = decode_color(index.first[selection.color], self._what_color)
        depth = self._depth_m(index.first[selection.depth])
        self._color = self._color_calibration(selection, index, source)
        check_size(color, self._color, self._what_color)
        self._depth, self._registration = self._depth_calibration(selection, index, depth.shape)
        check_size(depth, self._depth, self._what_depth)
        if config.camera_mounting is not None:
            T = mounted(config.camera_mounting)
        else:
            frame = index.frame_of(selection.color)
            T = index.transforms.require(base_frame, frame, self._what_color, "sensors.camera_mounting")
            if T[2, 2] > 0.9:
                self.remarks.append(f"the camera looks straight up: is {frame!r} its optical frame? (sensors.camera_mounting)")
        self.camera = pinhole(self._color, T)

    def __call__(self, stamp_ns: int, parts: tuple[Any, ...]) -> RgbdFrame:
        """Decode one pair."""
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

    def _color_calibration(self, selection: Selection, index: BagIndex, source: str) -> Calibration:
        if self._config.camera_intrinsics is not None:
            return from_intrinsics(self._config.camera_intrinsics)
        if selection.color_info is None:
            raise StreamError(
                f"{self._what_color}: no calibration: expected a topic of type sensor_msgs/CameraInfo beside it; "
                "name it as sensors.camera_info_topic or give sensors.camera_intrinsics"
            )
        info = index.first[selection.color_info]
        return calibration_of(info, str(selection.color), f"{source}: {selection.color_info}")

    def _depth_calibration(
        self, selection: Selection, index: BagIndex, size: tuple[int, ...]
    ) -> tuple[Calibration, DepthRegistration | None]:
        """Calibration of the depth pictures, and how they come to the colour camera; None where they are there already."""
        assert selection.color is not None
        assert selection.depth is not None
        color = self._color
        same_size = size == (color.height_px, color.width_px)
        if same_size and (_REGISTERED.search(selection.depth) or selection.depth_info is None):
            return color, None
        if selection.depth_info is None:
            raise StreamError(
                f"{self._what_depth}: depth is {size[1]}x{size[0]}, colour {color.width_px}x{color.height_px}, and there is no "
                "CameraInfo of the depth camera to register it with; name it as sensors.depth_info_topic"
            )
        depth = calibration_of(index.first[selection.depth_info], selection.depth, f"{self._what_depth}: camera info")
        T = self._extrinsics(index, index.frame_of(selection.color), index.frame_of(selection.depth), same_size)
        same_camera = same_size and T is None and np.abs(depth.K - color.K).max() < _SAME_PX
        if same_camera:
            return color, None
        self.remarks.append(f"depth of {selection.depth} is registered to {selection.color}")
        return depth, DepthRegistration(depth, color, np.eye(4) if T is None else T)

    def _extrinsics(self, index: BagIndex, color_frame: str, depth_frame: str, same_size: bool) -> Array | None:
        """(4, 4) pose of the depth camera in the colour camera; None where they are one."""
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


def calibration_of(info: Any, image_topic: str, what: str) -> Calibration:
    """Calibration of a CameraInfo message; a rectified picture has its projection matrix and no distortion.

    Raises:
        StreamError: the camera is not calibrated, or its distortion model is unknown.
    """
    K = np.asarray(_field(info, "k"), dtype=np.float64).reshape(3, 3)
    P = np.asarray(_field(info, "p"), dtype=np.float64).reshape(3, 4)
    distortion = tuple(float(value) for value in _field(info, "d"))
    model = info.distortion_model.strip().lower()
    if _RECTIFIED.search(image_topic) and P[0, 0] > 0:
        K, distortion = P[:, :3], ()
    if not (K[0, 0] > 0 and K[1, 1] > 0 and np.isfinite(K).all()):
        raise StreamError(f"{what}: found focal lengths {K[0, 0]}, {K[1, 1]}; the camera is not calibrated")
    if any(distortion) and model not in ("plumb_bob", "rational_polynomial", "equidistant", "fisheye", ""):
        raise StreamError(f"{what}: found distortion model {model!r}, expected plumb_bob, rational_polynomial or equidistant")
    bin_x, bin_y = max(int(info.binning_x), 1), max(int(info.binning_y), 1)
    K = np.diag([1.0 / bin_x, 1.0 / bin_y, 1.0]) @ K if bin_x > 1 or bin_y > 1 else K.copy()
    fisheye = model in ("equidistant", "fisheye")
    return Calibration(int(info.width) // bin_x, int(info.height) // bin_y, K, distortion, fisheye)


def _field(info: Any, name: str) -> Any:
    """A CameraInfo field, which ROS 1 writes large and ROS 2 small."""
    return getattr(info, name) if hasattr(info, name) else getattr(info, name.upper())
