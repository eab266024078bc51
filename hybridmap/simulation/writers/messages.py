"""Samples as messages of ROS 1 or ROS 2, and rotations as quaternions that read back to the same bits."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from hybridmap.errors import StreamError
from hybridmap.geometry import Array, between, log, quaternion_from_yaw, rotation_from_quaternion, yaw_from_quaternion
from hybridmap.output import Kind
from hybridmap.streams.base import SelfMotion
from hybridmap.streams.laser import Laser, LaserScan
from hybridmap.streams.rgbd import Camera, RgbdFrame
from hybridmap.trajectory import NS_PER_S

BASE_FRAME, ODOM_FRAME, WORLD_FRAME = "base_link", "odom", "world"
CAMERA_FRAME, LASER_FRAME = "camera_color_optical_frame", "laser"
TF_TYPE = "tf2_msgs/msg/TFMessage"
_MM_PER_M = 1000.0

Progress = Callable[[int, int | None], None]
"""Called with the number of observations written so far, and that of all, None if unknown."""


def silent(done: int, total: int | None) -> None:
    """A progress callback that does nothing."""


def _is_recording(folder: Path) -> bool:
    return any((folder / sign).is_file() for sign in ("metadata.yaml", "associations.txt"))


RECORDING = Kind("recording", (), _is_recording)
"""A ROS 2 bag or a TUM folder; `--overwrite` replaces it whole."""


@dataclass(frozen=True, slots=True)
class MessageFactory:
    """Builds messages of one type store.

    Attributes:
        typestore: of `rosbags`, with tf2_msgs/TFMessage registered.
        is_ros1: whether headers carry a sequence number.
    """

    typestore: Any
    is_ros1: bool

    def _make(self, msgtype: str, *fields: Any) -> Any:
        return self.typestore.types[msgtype](*fields)

    def _header(self, stamp_ns: int, frame: str) -> Any:
        stamp = self._make("builtin_interfaces/msg/Time", stamp_ns // NS_PER_S, stamp_ns % NS_PER_S)
        return self._make("std_msgs/msg/Header", *([0] if self.is_ros1 else []), stamp, frame)

    def odometry(self, sample: SelfMotion, twist: Array, parent: str = ODOM_FRAME) -> Any:
        """nav_msgs/Odometry of `base_link` in `parent`; twist (3,) in the robot's frame, m/s and rad/s."""
        x, y, yaw = (float(value) for value in sample.pose_odom_robot)
        rotation = self._make("geometry_msgs/msg/Quaternion", *(float(q) for q in quaternion_of(yaw)))
        pose = self._make("geometry_msgs/msg/Pose", self._make("geometry_msgs/msg/Point", x, y, 0.0), rotation)
        linear = self._make("geometry_msgs/msg/Vector3", float(twist[0]), float(twist[1]), 0.0)
        angular = self._make("geometry_msgs/msg/Vector3", 0.0, 0.0, float(twist[2]))
        return self._make(
            "nav_msgs/msg/Odometry",
            self._header(sample.stamp_ns, parent),
            BASE_FRAME,
            self._make("geometry_msgs/msg/PoseWithCovariance", pose, np.zeros(36)),
            self._make(
                "geometry_msgs/msg/TwistWithCovariance", self._make("geometry_msgs/msg/Twist", linear, angular), np.zeros(36)
            ),
        )

    def _image(self, stamp_ns: int, pixels: NDArray[Any], encoding: str) -> Any:
        height, width = pixels.shape[:2]
        data = np.ascontiguousarray(pixels).view(np.uint8).reshape(-1)
        header = self._header(stamp_ns, CAMERA_FRAME)
        return self._make("sensor_msgs/msg/Image", header, height, width, encoding, 0, len(data) // height, data)

    def color(self, frame: RgbdFrame) -> Any:
        """sensor_msgs/Image, rgb8."""
        return self._image(frame.stamp_ns, frame.color, "rgb8")

    def depth(self, frame: RgbdFrame) -> Any:
        """sensor_msgs/Image, 16UC1, whole millimetres (REP-118)."""
        return self._image(frame.stamp_ns, millimetres(frame.depth_m), "16UC1")

    def camera_info(self, stamp_ns: int, camera: Camera) -> Any:
        """sensor_msgs/CameraInfo of an undistorted camera (no distortion, no rectification)."""
        fx, fy, cx, cy = camera.fx_px, camera.fy_px, camera.cx_px, camera.cy_px
        K = np.array([fx, 0.0, cx, 0.0, fy, cy, 0.0, 0.0, 1.0])
        P = np.array([fx, 0.0, cx, 0.0, 0.0, fy, cy, 0.0, 0.0, 0.0, 1.0, 0.0])
        region = self._make("sensor_msgs/msg/RegionOfInterest", 0, 0, 0, 0, False)
        header = self._header(stamp_ns, CAMERA_FRAME)
        size = camera.height_px, camera.width_px
        return self._make(
            "sensor_msgs/msg/CameraInfo", header, *size, "plumb_bob", np.zeros(5), K, np.eye(3).reshape(-1), P, 0, 0, region
        )

    def scan(self, scan: LaserScan, laser: Laser) -> Any:
        """sensor_msgs/LaserScan; no return is +Inf (REP-117)."""
        bearings = laser.bearings_rad
        ranges = np.where(np.isfinite(scan.ranges_m), scan.ranges_m, np.float32(np.inf)).astype(np.float32)
        limits = float(laser.range_min_m), float(laser.range_max_m)
        angles = float(bearings[0]), float(bearings[-1]), float(np.float32(bearings[1] - bearings[0]))
        header = self._header(scan.stamp_ns, LASER_FRAME)
        return self._make(
            "sensor_msgs/msg/LaserScan", header, *angles, 0.0, 0.0, *limits, ranges, np.zeros(0, dtype=np.float32)
        )

    def mounting(self, stamp_ns: int, camera: Camera | None, laser: Laser | None) -> Any:
        """tf2_msgs/TFMessage with the pose of each sensor in `base_link`; a sensor that is None is left out."""
        transforms = []
        if camera is not None:
            T = camera.T_base_camera
            transforms.append(self._transform(stamp_ns, CAMERA_FRAME, T[:3, 3], quaternion_of_rotation(T[:3, :3])))
        if laser is not None:
            x, y, yaw = laser.pose_base_laser
            transforms.append(self._transform(stamp_ns, LASER_FRAME, np.array([x, y, 0.0]), quaternion_of(float(yaw))))
        return self._make(TF_TYPE, transforms)

    def _transform(self, stamp_ns: int, child: str, translation: Array, quaternion: Array) -> Any:
        moved = self._make("geometry_msgs/msg/Vector3", *(float(value) for value in translation))
        turned = self._make("geometry_msgs/msg/Quaternion", *(float(value) for value in quaternion))
        transform = self._make("geometry_msgs/msg/Transform", moved, turned)
        header = self._header(stamp_ns, BASE_FRAME)
        return self._make("geometry_msgs/msg/TransformStamped", header, child, transform)


def millimetres(depth_m: NDArray[np.float32]) -> NDArray[np.uint16]:
    """Depth (H, W), m, in whole millimetres; 0 where there is none."""
    return np.asarray(np.rint(depth_m.astype(np.float64) * _MM_PER_M), dtype=np.uint16)


def twist_between(before: SelfMotion | None, after: SelfMotion) -> Array:
    """Mean velocity (3,), m/s and rad/s in the robot's frame, from one odometry sample to the next; zeros for the first."""
    if before is None or after.stamp_ns <= before.stamp_ns:
        return np.zeros(3)
    step = log(between(before.pose_odom_robot, after.pose_odom_robot))
    return np.asarray(step * (NS_PER_S / (after.stamp_ns - before.stamp_ns)))


def quaternion_of_rotation(rotation: Array) -> Array:
    """Quaternion (4,), x y z w, of a rotation matrix (3, 3), so that `rotation_from_quaternion` gives it back.

    Raises:
        StreamError: the matrix is no rotation.
    """
    values, vectors = np.linalg.eigh(_symmetric(rotation))
    quaternion = np.asarray(vectors[:, int(np.argmax(values))])
    snapped = np.round(quaternion * 2.0**40) / 2.0**40
    quaternion = snapped / np.linalg.norm(snapped)
    if np.abs(rotation_from_quaternion(quaternion) - rotation).max() > 1e-6:
        raise StreamError(f"the camera's mounting: expected a rotation matrix, found {np.round(rotation, 4).tolist()}")
    return quaternion if quaternion[3] >= 0.0 else -quaternion


def _symmetric(R: Array) -> Array:
    """Bar-Itzhack's matrix (4, 4), whose dominant eigenvector is the quaternion."""
    return np.array(
        [
            [R[0, 0] - R[1, 1] - R[2, 2], R[1, 0] + R[0, 1], R[2, 0] + R[0, 2], R[2, 1] - R[1, 2]],
            [R[1, 0] + R[0, 1], R[1, 1] - R[0, 0] - R[2, 2], R[2, 1] + R[1, 2], R[0, 2] - R[2, 0]],
            [R[2, 0] + R[0, 2], R[2, 1] + R[1, 2], R[2, 2] - R[0, 0] - R[1, 1], R[1, 0] - R[0, 1]],
            [R[2, 1] - R[1, 2], R[0, 2] - R[2, 0], R[1, 0] - R[0, 1], R[0, 0] + R[1, 1] + R[2, 2]],
        ]
    )


_NEIGHBOURS = (0, *(sign * ulps for ulps in range(1, 9) for sign in (1, -1)))


def quaternion_of(yaw_rad: float) -> Array:
    """Quaternion (4,), x y z w, from which `yaw_from_quaternion` gives back `yaw_rad` itself.

    One heading in six comes back changed in its last bit from its own quaternion; that of a heading a few units in the last
    place away gives it exactly, if the heading was ever read from a quaternion.
    """
    for ulps in _NEIGHBOURS:
        quaternion = quaternion_from_yaw(yaw_rad + ulps * np.spacing(yaw_rad))
        if yaw_from_quaternion(*quaternion) == yaw_rad:
            return quaternion
    return quaternion_from_yaw(yaw_rad)
