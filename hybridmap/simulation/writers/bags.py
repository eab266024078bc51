"""ROS 1 and ROS 2 bags, written without ROS."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from heapq import merge
from pathlib import Path
from typing import Any, Literal

from hybridmap.errors import StreamError
from hybridmap.output import staged
from hybridmap.simulation.writers.messages import (
    ODOM_FRAME,
    RECORDING,
    TF_TYPE,
    WORLD_FRAME,
    MessageFactory,
    Progress,
    silent,
    twist_between,
)
from hybridmap.streams.base import Sample, SelfMotion, Stream
from hybridmap.streams.laser import LaserScan
from hybridmap.streams.rgbd import RgbdFrame

ODOMETRY, SCAN, TRUTH, TF_STATIC = "/odom", "/scan", "/groundtruth", "/tf_static"
COLOR, DEPTH, CAMERA_INFO = "/camera/color/image_raw", "/camera/depth/image_raw", "/camera/color/camera_info"
_TYPES = {
    TF_STATIC: TF_TYPE,
    ODOMETRY: "nav_msgs/msg/Odometry",
    TRUTH: "nav_msgs/msg/Odometry",
    COLOR: "sensor_msgs/msg/Image",
    DEPTH: "sensor_msgs/msg/Image",
    CAMERA_INFO: "sensor_msgs/msg/CameraInfo",
    SCAN: "sensor_msgs/msg/LaserScan",
}
_PARENTS = {ODOMETRY: ODOM_FRAME, TRUTH: WORLD_FRAME}
_ORDER = (ODOMETRY, TRUTH, "")
_TF_DEFINITION = "geometry_msgs/TransformStamped[] transforms"
_SUFFIXES = {"mcap": ".mcap", "sqlite3": ".db3"}
_Written = tuple[str, int, Any]


def write_rosbag1(stream: Stream, path: Path, *, overwrite: bool = False, progress: Progress = silent) -> dict[str, int]:
    """Write a ROS 1 bag.

    Args:
        stream: with poses as self-motion.
        path: of the `.bag` file.
        overwrite: replace a bag that is there.
        progress: called after every scan or frame with the number written, and that expected, None if unknown.

    Returns:
        Topic -> number of messages written.

    Raises:
        OutputError: the place is taken or cannot be written to.
        StreamError: the stream holds what a bag cannot.
    """
    from rosbags.rosbag1 import Writer
    from rosbags.typesys import Stores, get_types_from_msg, get_typestore

    store = get_typestore(Stores.ROS1_NOETIC)
    store.register(get_types_from_msg(_TF_DEFINITION, TF_TYPE))
    with staged(path, kind=RECORDING, overwrite=overwrite) as work, Writer(work / path.name) as writer:

        def connect(topic: str) -> Any:
            return writer.add_connection(topic, _TYPES[topic], typestore=store, latching=int(topic == TF_STATIC))

        messages = _messages(stream, MessageFactory(store, is_ros1=True), progress)
        return _record(messages, connect, writer.write, store.serialize_ros1)


def write_rosbag2(
    stream: Stream,
    path: Path,
    storage: Literal["mcap", "sqlite3"] = "mcap",
    *,
    overwrite: bool = False,
    progress: Progress = silent,
) -> dict[str, int]:
    """Write a ROS 2 bag: a folder with `metadata.yaml`, or the bare file where `path` ends in `.mcap` or `.db3`.

    Args:
        stream: with poses as self-motion.
        path: of the folder or file.
        storage: format of the messages' file.
        overwrite: replace a bag that is there.
        progress: called after every scan or frame with the number written, and that expected, None if unknown.

    Returns:
        Topic -> number of messages written.

    Raises:
        OutputError: the place is taken or cannot be written to.
        StreamError: the stream holds what a bag cannot.
    """
    suffix = _SUFFIXES[storage]
    bare = path.suffix.lower() in _SUFFIXES.values()
    if bare and path.suffix.lower() != suffix:
        raise StreamError(f"{path}: a {storage} bag ends in {suffix}")
    with staged(path, kind=RECORDING, overwrite=overwrite) as work:
        folder = work / (path.stem if bare else path.name)
        counts = _write_folder(stream, folder, storage, progress)
        if bare:
            next(folder.glob(f"*{suffix}")).rename(work / path.name)
    return counts


def _write_folder(stream: Stream, folder: Path, storage: str, progress: Progress) -> dict[str, int]:
    from rosbags.rosbag2 import StoragePlugin, Writer
    from rosbags.typesys import Stores, get_typestore

    store = get_typestore(Stores.ROS2_HUMBLE)
    with Writer(folder, version=8, storage_plugin=StoragePlugin[storage.upper()]) as writer:

        def connect(topic: str) -> Any:
            return writer.add_connection(topic, _TYPES[topic], typestore=store, offered_qos_profiles=_quality(topic))

        return _record(
            _messages(stream, MessageFactory(store, is_ros1=False), progress), connect, writer.write, store.serialize_cdr
        )


def _record(
    messages: Iterator[_Written],
    connect: Callable[[str], Any],
    write: Callable[[Any, int, bytes | memoryview], None],
    serialize: Callable[[Any, str], bytes | memoryview],
) -> dict[str, int]:
    connections: dict[str, Any] = {}
    counts: dict[str, int] = {}
    for topic, stamp_ns, message in messages:
        if topic not in connections:
            connections[topic] = connect(topic)
        write(connections[topic], stamp_ns, serialize(message, _TYPES[topic]))
        counts[topic] = counts.get(topic, 0) + 1
    return counts


def _messages(stream: Stream, make: MessageFactory, progress: Progress) -> Iterator[_Written]:
    """Topic, stamp and message of every sample and of the ground truth, in order of stamp; first the mounting."""
    total = stream.expected_observations
    camera, laser = (stream.rig.sensors.get(name) for name in ("camera", "laser"))
    before: dict[str, SelfMotion] = {}
    mounted = False
    done = 0
    for topic, sample in _with_truth(stream):
        stamp = sample.stamp_ns
        if not mounted:
            mounted = True
            yield TF_STATIC, stamp, make.mounting(stamp, camera, laser)
        if isinstance(sample, SelfMotion):
            yield topic, stamp, make.odometry(sample, twist_between(before.get(topic), sample), _PARENTS[topic])
            before[topic] = sample
            continue
        if isinstance(sample, RgbdFrame) and camera is not None:
            yield COLOR, stamp, make.color(sample)
            yield DEPTH, stamp, make.depth(sample)
            yield CAMERA_INFO, stamp, make.camera_info(stamp, camera)
        elif isinstance(sample, LaserScan) and laser is not None:
            yield SCAN, stamp, make.scan(sample, laser)
        else:
            raise StreamError(f"{stream.name}: a bag holds poses, frames and scans; found {type(sample).__name__}")
        done += 1
        progress(done, total)


def _with_truth(stream: Stream) -> Iterator[tuple[str, Sample]]:
    """The samples of a stream and its true poses by stamp, each with its topic; at equal stamps odometry, truth, views."""
    truth = stream.groundtruth
    poses = [] if truth is None else zip(truth.stamps_ns.tolist(), truth.poses, strict=True)
    true_poses = ((TRUTH, SelfMotion(stamp, pose)) for stamp, pose in poses)
    samples = ((ODOMETRY if isinstance(sample, SelfMotion) else "", sample) for sample in stream)
    return merge(samples, true_poses, key=lambda written: (written[1].stamp_ns, _ORDER.index(written[0])))


def _quality(topic: str) -> list[Any]:
    """Quality of service: transforms that never change are kept for late subscribers, as ROS 2 does."""
    from rosbags.interfaces import Qos, QosDurability, QosHistory, QosLiveliness, QosReliability, QosTime

    forever = QosTime(9223372036, 854775807)
    durability = QosDurability.TRANSIENT_LOCAL if topic == TF_STATIC else QosDurability.VOLATILE
    return [
        Qos(
            QosHistory.KEEP_LAST,
            10,
            QosReliability.RELIABLE,
            durability,
            forever,
            forever,
            QosLiveliness.AUTOMATIC,
            forever,
            False,
        )
    ]
