"""The messages of a robot give the samples of a bag that holds them."""

import dataclasses
import random
from collections.abc import Mapping
from pathlib import Path

import cv2
import numpy as np
import pytest

from hybridmap.config import Config
from hybridmap.errors import StreamError
from hybridmap.streams.bagfile import BagFile
from hybridmap.streams.base import Rig, Sample
from hybridmap.streams.incoming import Incoming
from hybridmap.streams.messages import RawMessage, Topic
from hybridmap.streams.rgbd import RgbdFrame
from hybridmap.streams.rosbag import BagStream
from tests.streams.recordings import NS, OPTICAL_XYZW, Recording, color_pixels, depth_mm, laser_drive, rgbd_drive


class Robot:
    """A robot that says what a bag holds."""

    def __init__(self, bag: Path, settings: Mapping[str, object] | None = None, settle_s: float = 0.0) -> None:
        self.bag = BagFile(bag)
        self.samples: list[Sample] = []
        self.rigs: list[Rig] = []
        topics = [Topic(topic.name, topic.msgtype, 1) for topic in self.bag.topics]
        config = Config.load(None, settings or {})
        self.incoming = Incoming(topics, config, self.begin, "robot", is_ros1=self.bag.is_ros1, settle_s=settle_s)

    def begin(self, rig: Rig):
        self.rigs.append(rig)
        return self.samples.append

    def say(self, messages: list[RawMessage] | None = None) -> None:
        for message in self.messages() if messages is None else messages:
            self.incoming.take(message.topic, message.data)

    def messages(self) -> list[RawMessage]:
        return list(self.bag.raw(self.incoming.subscriptions))


def same(a: object, b: object) -> bool:
    if isinstance(a, np.ndarray):
        return isinstance(b, np.ndarray) and a.dtype == b.dtype and np.array_equal(a, b, equal_nan=True)
    if dataclasses.is_dataclass(a):
        return type(a) is type(b) and all(same(getattr(a, f.name), getattr(b, f.name)) for f in dataclasses.fields(a))
    return a == b


def by_topic(samples: list[Sample]) -> dict[type, list[Sample]]:
    return {kind: [sample for sample in samples if type(sample) is kind] for kind in {type(sample) for sample in samples}}


def assert_same(bag: Path, robot: Robot, settings: Mapping[str, object] | None = None) -> None:
    stream = BagStream(bag, Config.load(None, settings or {}))
    expected, found = by_topic(list(stream)), by_topic(robot.samples)
    assert expected.keys() == found.keys()
    for kind, samples in expected.items():
        assert len(samples) == len(found[kind])
        assert all(same(a, b) for a, b in zip(samples, found[kind], strict=True))
    (rig,) = robot.rigs
    assert rig.sensors.keys() == stream.rig.sensors.keys()
    assert all(same(sensor, stream.rig.sensors[name]) for name, sensor in rig.sensors.items())


def shifted_pictures(ros1: bool) -> Recording:
    """Pictures of 3 cameras with stamps apart, some of which have no partner."""
    recording = rgbd_drive(ros1, frames=6)
    for i in range(4):
        recording.image(101 * NS + i * NS // 10, depth_mm(i), "16UC1", topic="/camera/aligned_depth_to_color/image_raw")
    return recording


def compressed_pictures(ros1: bool) -> Recording:
    """Colour as PNG, depth as compressedDepth, on topics of image_transport."""
    recording = Recording(ros1)
    recording.transform("base_link", "camera_optical", (0.1, 0.0, 0.5), OPTICAL_XYZW)
    for i in range(4):
        stamp_ns = 100 * NS + i * NS // 10
        recording.odometry(stamp_ns, 0.1 * i)
        recording.camera_info(stamp_ns, (8, 6), (10.0, 10.0, 3.5, 2.5), topic="/camera/color/camera_info")
        color = cv2.imencode(".png", color_pixels(i)[..., ::-1])[1].tobytes()
        recording.compressed(stamp_ns + 5_000_000, color, "rgb8; png", topic="/camera/color/image_raw/compressed")
        depth = bytes(12) + cv2.imencode(".png", depth_mm(i))[1].tobytes()
        topic = "/camera/aligned_depth_to_color/image_raw/compressedDepth"
        recording.compressed(stamp_ns + 9_000_000, depth, "16UC1; compressedDepth", topic=topic)
    return recording


@pytest.mark.parametrize("suffix", ["bag", "mcap"])
@pytest.mark.parametrize("drive", [laser_drive, rgbd_drive, shifted_pictures, compressed_pictures])
def test_as_a_bag(tmp_path: Path, drive, suffix: str) -> None:
    bag = drive(suffix == "bag").write(tmp_path / f"drive.{suffix}")
    robot = Robot(bag)
    robot.say()
    robot.incoming.flush()
    assert robot.incoming.missing == []
    assert_same(bag, robot)


@pytest.mark.parametrize("seed", range(5))
def test_whichever_topic_is_ahead(tmp_path: Path, seed: int) -> None:
    """Topics come over connections of their own: each in order, the others earlier or later."""
    bag = shifted_pictures(True).write(tmp_path / "drive.bag")
    robot = Robot(bag)
    left: dict[str, list[RawMessage]] = {}
    for message in robot.messages():
        left.setdefault(message.topic, []).append(message)
    chance = random.Random(seed)
    while left:
        topic = chance.choice(sorted(left))
        robot.say([left[topic].pop(0)])
        if not left[topic]:
            del left[topic]
    robot.incoming.flush()
    assert_same(bag, robot)


def transforms_drive(base_offset: bool) -> Recording:
    recording = laser_drive(True)
    recording.messages = [message for message in recording.messages if message[1] != "nav_msgs/msg/Odometry"]
    for i in range(8):
        stamp, yaw = 100 * NS + i * NS // 10, 0.1 * i
        xyzw = (0.0, 0.0, float(np.sin(yaw / 2)), float(np.cos(yaw / 2)))
        for _ in range(2):  # tf is published again and again
            recording.transform("odom", "base_link", (0.1 * i, 0.0, 0.0), xyzw, topic="/tf", stamp_ns=stamp)
    if base_offset:
        recording.transform("base_link", "middle", (0.3, 0.1, 0.0))
    return recording


@pytest.mark.parametrize("base", [None, "middle"])
def test_self_motion_by_transforms_carried_to_the_base(tmp_path: Path, base: str | None) -> None:
    settings = {} if base is None else {"sensors.base_frame": base}
    bag = transforms_drive(base is not None).write(tmp_path / "drive.bag")
    robot = Robot(bag, settings)
    robot.say()
    assert len(by_topic(robot.samples)) == 2
    assert_same(bag, robot, settings)


def test_it_waits_for_a_late_transform_and_says_so(tmp_path: Path) -> None:
    robot = Robot(laser_drive(True).write(tmp_path / "drive.bag"))
    mounting = [message for message in robot.messages() if message.topic == "/tf_static"]
    robot.say([message for message in robot.messages() if message.topic == "/odom"])
    assert robot.incoming.missing == ["robot: no message yet on /scan (sensor_msgs/msg/LaserScan)"]
    robot.say([message for message in robot.messages() if message.topic == "/scan"])
    assert robot.samples == []
    (missing,) = robot.incoming.missing
    assert "'base_link' -> 'laser'" in missing
    robot.say(mounting)
    assert robot.incoming.missing == []
    assert len(robot.samples) == 12


def test_a_drive_that_ends_before_the_time_for_transforms_is_not_lost(tmp_path: Path) -> None:
    bag = laser_drive(True).write(tmp_path / "drive.bag")
    robot = Robot(bag, settle_s=1e6)
    robot.say()
    robot.incoming.look()
    assert robot.samples == []
    robot.incoming.flush()
    assert_same(bag, robot)


def test_a_damaged_message_is_refused_and_the_next_taken(tmp_path: Path) -> None:
    robot = Robot(laser_drive(True).write(tmp_path / "drive.bag"))
    robot.say()
    before = len(robot.samples)
    (message, *_) = (message for message in robot.messages() if message.topic == "/scan")
    with pytest.raises(StreamError, match="/scan: message 7"):
        robot.incoming.take("/scan", message.data[:30])
    robot.incoming.take("/scan", message.data)
    assert len(robot.samples) == before + 1


def test_without_a_sensor_it_says_what_it_expects(tmp_path: Path) -> None:
    recording = Recording(True)
    recording.odometry(NS)
    with pytest.raises(StreamError, match=r"no laser scans or colour with depth.*vision\.sensor none"):
        Robot(recording.write(tmp_path / "drive.bag"))
    robot = Robot(tmp_path / "drive.bag", {"vision.sensor": "none"})
    robot.say()
    assert len(robot.samples) == 1


def test_a_recording_that_is_played_again_gives_its_samples_again(tmp_path: Path) -> None:
    bag = rgbd_drive(True, frames=6).write(tmp_path / "drive.bag")
    robot = Robot(bag)
    robot.say()
    robot.incoming.flush()
    first = len(by_topic(robot.samples)[RgbdFrame])
    robot.incoming.begin_anew()
    robot.say()
    robot.incoming.flush()
    assert len(by_topic(robot.samples)[RgbdFrame]) == 2 * first
    assert not any(robot.incoming.losses.values())
