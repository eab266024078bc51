"""Tiny bags for the tests. The same messages can be written as a ROS 1 bag, as mcap or as sqlite3."""

from __future__ import annotations

import shutil
from dataclasses import dataclass, field
from functools import cache
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
from rosbags.rosbag1 import Writer as Writer1
from rosbags.rosbag2 import StoragePlugin
from rosbags.rosbag2 import Writer as Writer2
from rosbags.typesys import Stores, get_types_from_msg, get_typestore

KINDS = ("bag", "mcap", "db3")
NS = 1_000_000_000


@cache
def _types(ros1: bool) -> tuple[Any, SimpleNamespace]:
    """Return the type store, and its message types by their short names."""
    store = get_typestore(Stores.ROS1_NOETIC if ros1 else Stores.ROS2_HUMBLE)
    if ros1:
        store.register(get_types_from_msg("geometry_msgs/TransformStamped[] transforms", "tf2_msgs/msg/TFMessage"))
    packages = ("nav_msgs", "sensor_msgs", "geometry_msgs", "tf2_msgs", "builtin_interfaces")
    named = {name.split("/")[-1]: cls for name, cls in store.types.items() if name.split("/")[0] in packages}
    return store, SimpleNamespace(**named, Header=store.types["std_msgs/msg/Header"])


@dataclass
class Recording:
    """Messages in the order of recording. `bag_ns` is the time of recording; it does not depend on header stamps."""

    ros1: bool = False
    messages: list[tuple[str, str, Any]] = field(default_factory=list)

    def __post_init__(self) -> None:
        self.store, self.t = _types(self.ros1)

    def header(self, stamp_ns: int, frame: str) -> Any:
        time = self.t.Time(sec=stamp_ns // NS, nanosec=stamp_ns % NS)
        return self.t.Header(seq=0, stamp=time, frame_id=frame) if self.ros1 else self.t.Header(stamp=time, frame_id=frame)

    def pose(self, x: float, y: float, yaw: float) -> Any:
        q = self.t.Quaternion(x=0.0, y=0.0, z=float(np.sin(yaw / 2)), w=float(np.cos(yaw / 2)))
        return self.t.Pose(position=self.t.Point(x=x, y=y, z=0.0), orientation=q)

    def odometry(
        self,
        stamp_ns: int,
        x: float = 0.0,
        y: float = 0.0,
        yaw: float = 0.0,
        *,
        topic: str = "/odom",
        frame: str = "odom",
        child: str = "base_link",
    ) -> None:
        zero = self.t.Vector3(x=0.0, y=0.0, z=0.0)
        message = self.t.Odometry(
            header=self.header(stamp_ns, frame),
            child_frame_id=child,
            pose=self.t.PoseWithCovariance(pose=self.pose(x, y, yaw), covariance=np.zeros(36)),
            twist=self.t.TwistWithCovariance(twist=self.t.Twist(linear=zero, angular=zero), covariance=np.zeros(36)),
        )
        self.messages.append((topic, "nav_msgs/msg/Odometry", message))

    def scan(
        self,
        stamp_ns: int,
        ranges: Any,
        *,
        angle_min: float = -1.0,
        step: float = 0.5,
        low: float = 0.1,
        high: float = 10.0,
        topic: str = "/scan",
        frame: str = "laser",
    ) -> None:
        ranges = np.asarray(ranges, dtype=np.float32)
        message = self.t.LaserScan(
            header=self.header(stamp_ns, frame), angle_min=angle_min, angle_max=angle_min + step * (len(ranges) - 1),
            angle_increment=step, time_increment=0.0, scan_time=0.1, range_min=low, range_max=high,
            ranges=ranges, intensities=np.zeros(0, dtype=np.float32),
        )  # fmt: skip
        self.messages.append((topic, "sensor_msgs/msg/LaserScan", message))

    def transform(
        self,
        parent: str,
        child: str,
        xyz: tuple[float, float, float] = (0.0, 0.0, 0.0),
        xyzw: tuple[float, float, float, float] = (0.0, 0.0, 0.0, 1.0),
        *,
        topic: str = "/tf_static",
        stamp_ns: int = 0,
    ) -> None:
        rotation = self.t.Quaternion(**dict(zip("xyzw", xyzw, strict=True)))
        translation = self.t.Vector3(**dict(zip("xyz", xyz, strict=True)))
        stamped = self.t.TransformStamped(
            header=self.header(stamp_ns, parent), child_frame_id=child,
            transform=self.t.Transform(translation=translation, rotation=rotation),
        )  # fmt: skip
        self.messages.append((topic, "tf2_msgs/msg/TFMessage", self.t.TFMessage(transforms=[stamped])))

    def image(
        self,
        stamp_ns: int,
        pixels: np.ndarray,
        encoding: str,
        *,
        topic: str,
        frame: str = "camera_optical",
        padding: int = 0,
        big_endian: bool = False,
    ) -> None:
        height, width = pixels.shape[:2]
        stored = pixels.astype(pixels.dtype.newbyteorder(">" if big_endian else "<"))
        rows = np.frombuffer(stored.tobytes(), dtype=np.uint8).reshape(height, -1)
        rows = np.hstack([rows, np.full((height, padding), 77, dtype=np.uint8)])
        message = self.t.Image(
            header=self.header(stamp_ns, frame), height=height, width=width, encoding=encoding,
            is_bigendian=int(big_endian), step=rows.shape[1], data=rows.ravel(),
        )  # fmt: skip
        self.messages.append((topic, "sensor_msgs/msg/Image", message))

    def compressed(self, stamp_ns: int, data: bytes, kind: str, *, topic: str, frame: str = "camera_optical") -> None:
        message = self.t.CompressedImage(
            header=self.header(stamp_ns, frame), format=kind, data=np.frombuffer(data, dtype=np.uint8)
        )
        self.messages.append((topic, "sensor_msgs/msg/CompressedImage", message))

    def camera_info(
        self,
        stamp_ns: int,
        size: tuple[int, int],
        k: Any,
        *,
        topic: str,
        frame: str = "camera_optical",
        distortion: tuple[float, ...] = (0.0,) * 5,
        model: str = "plumb_bob",
        p: Any = None,
    ) -> None:
        fx, fy, cx, cy = k
        K = np.array([fx, 0, cx, 0, fy, cy, 0, 0, 1], dtype=np.float64)
        P = (
            np.array([fx, 0, cx, 0, 0, fy, cy, 0, 0, 0, 1, 0], dtype=np.float64)
            if p is None
            else np.asarray(p, dtype=np.float64)
        )
        names = "DKRP" if self.ros1 else "dkrp"
        values = (np.asarray(distortion, dtype=np.float64), K, np.eye(3).ravel(), P)
        roi = self.t.RegionOfInterest(x_offset=0, y_offset=0, height=0, width=0, do_rectify=False)
        message = self.t.CameraInfo(
            header=self.header(stamp_ns, frame), width=size[0], height=size[1], distortion_model=model,
            binning_x=0, binning_y=0, roi=roi, **dict(zip(names, values, strict=True)),
        )  # fmt: skip
        self.messages.append((topic, "sensor_msgs/msg/CameraInfo", message))

    def write(self, path: Path, *, folder: bool = False) -> Path:
        """Write a `.bag`, `.mcap` or `.db3` file. With `folder`, write a whole ROS 2 bag folder."""
        if path.suffix == ".bag":
            with Writer1(path) as writer:
                self._fill(writer, self.store.serialize_ros1)
            return path
        plugin = StoragePlugin.MCAP if path.suffix == ".mcap" else StoragePlugin.SQLITE3
        target = path.with_suffix("")
        with Writer2(target, version=9, storage_plugin=plugin) as writer:
            self._fill(writer, self.store.serialize_cdr)
        if folder:
            return target
        (written,) = target.glob(f"*{path.suffix}")
        shutil.move(written, path)
        shutil.rmtree(target)
        return path

    def _fill(self, writer: Any, serialise: Any) -> None:
        connections: dict[str, Any] = {}
        for number, (topic, msgtype, message) in enumerate(self.messages):
            if topic not in connections:
                connections[topic] = writer.add_connection(topic, msgtype, typestore=self.store)
            writer.write(connections[topic], 5 * NS + number * 1_000_000, serialise(message, msgtype))


def laser_drive(ros1: bool = False, steps: int = 6) -> Recording:
    """Record a straight drive with odometry and scans. The laser is mounted ahead of the base."""
    recording = Recording(ros1)
    recording.transform("base_link", "laser", (0.2, 0.0, 0.3))
    for i in range(steps):
        stamp = 100 * NS + i * NS // 10
        recording.odometry(stamp, 0.1 * i)
        recording.scan(stamp + NS // 20, [1.0, 2.0, 3.0, 4.0, 5.0 + i])
    return recording


OPTICAL_XYZW = (-0.5, 0.5, -0.5, 0.5)


def color_pixels(seed: int = 0, size: tuple[int, int] = (8, 6)) -> np.ndarray:
    """Make a colour image (H, W, 3) uint8 of noise."""
    return np.random.default_rng(seed).integers(0, 256, (size[1], size[0], 3), dtype=np.uint8)


def depth_mm(seed: int = 0, size: tuple[int, int] = (8, 6)) -> np.ndarray:
    """Make a depth image (H, W) uint16 in mm. Some pixels are 0, without depth."""
    values = np.random.default_rng(seed + 100).integers(500, 5000, (size[1], size[0]), dtype=np.uint16)
    values[0, :3] = 0
    return values


def rgbd_drive(ros1: bool = False, frames: int = 3) -> Recording:
    """Record a straight drive with odometry and registered colour and depth images of 8 x 6 pixels."""
    recording = Recording(ros1)
    recording.transform("base_link", "camera_optical", (0.1, 0.0, 0.5), OPTICAL_XYZW)
    for i in range(frames):
        stamp = 100 * NS + i * NS // 10
        recording.odometry(stamp, 0.1 * i)
        recording.camera_info(stamp, (8, 6), (10.0, 10.0, 3.5, 2.5), topic="/camera/color/camera_info")
        recording.image(stamp + 5_000_000, color_pixels(i), "rgb8", topic="/camera/color/image_raw")
        recording.image(stamp + 9_000_000, depth_mm(i), "16UC1", topic="/camera/aligned_depth_to_color/image_raw")
    return recording
