"""Bad input: one clear line that names the place, what was found and what to do; never a traceback, never silence."""

from __future__ import annotations

import re
import resource
import shutil
import zlib
from types import SimpleNamespace

import cv2
import numpy as np
import pytest
from rosbags.rosbag2 import Reader, StoragePlugin, Writer
from rosbags.typesys import Stores, get_typestore
from typer.testing import CliRunner

from hybridmap import session
from hybridmap.cli.app import app
from hybridmap.cli.map import LOST
from hybridmap.config import Config
from hybridmap.config.inputs import SensorsConfig
from hybridmap.errors import StreamError, counted
from hybridmap.store import SessionFolder
from hybridmap.streams import open_stream
from hybridmap.streams.cameras import Calibration, DepthRegistration, decode_color
from hybridmap.streams.inspection import inspect_source
from hybridmap.streams.laser import LaserScan
from hybridmap.streams.rosbag import BagStream
from tests.narrowing import as_a
from tests.streams.recordings import KINDS, NS, Recording, color_pixels, depth_mm, laser_drive, rgbd_drive


def _refusal(source, config: Config | None = None) -> str:
    with pytest.raises(StreamError) as caught:
        list(open_stream(source, config or Config()))
    text = str(caught.value)
    assert "\n" not in text
    assert "Traceback" not in text
    return text


def _refuses(source, *words: str, config: Config | None = None) -> None:
    text = _refusal(source, config)
    for word in words:
        assert word in text


@pytest.mark.parametrize("name", ["a.bag", "a.mcap", "a.db3", "a.csv", "folder", "a.txt"])
def test_a_missing_source(tmp_path, name):
    _refuses(tmp_path / name, name, "no such file")


def test_no_such_world():
    _refuses("atlantis", "atlantis", "no such")
    _refuses("sim:atlantis", "atlantis", "office")


@pytest.mark.parametrize("name", ["a.bag", "a.mcap", "a.db3", "a.csv"])
def test_an_empty_file(tmp_path, name):
    (tmp_path / name).touch()
    _refuses(tmp_path / name, name, "empty")


@pytest.mark.parametrize("name", ["a.bag", "a.mcap", "a.db3"])
@pytest.mark.parametrize("content", [b"x", b"this is no bag\n" * 100, bytes(range(256)) * 40])
def test_a_file_of_another_kind(tmp_path, name, content):
    (tmp_path / name).write_bytes(content)
    _refuses(tmp_path / name, name)


def test_a_file_with_an_unknown_suffix(tmp_path):
    (tmp_path / "a.txt").write_text("x")
    _refuses(tmp_path / "a.txt", "'.txt'", ".mcap")


def test_a_folder_that_is_nothing(tmp_path):
    _refuses(tmp_path, "neither")
    (tmp_path / "drive.mcap").touch()
    _refuses(tmp_path, "drive.mcap")


@pytest.mark.parametrize("fraction", [0.02, 0.3, 0.6, 0.9, 0.999])
@pytest.mark.parametrize("kind", KINDS)
def test_a_bag_that_is_cut_off(tmp_path, kind, fraction):
    path = laser_drive(kind == "bag", steps=60).write(tmp_path / f"a.{kind}")
    data = path.read_bytes()
    path.write_bytes(data[: int(fraction * len(data))])
    _refuses(path, f"a.{kind}", "cut off" if fraction > 0.1 or kind != "bag" else "")


def test_a_bag_without_index(tmp_path):
    path = laser_drive(ros1=True).write(tmp_path / "a.bag")
    data = bytearray(path.read_bytes())
    at = data.index(b"index_pos=") + len(b"index_pos=")
    data[at : at + 8] = bytes(8)
    path.write_bytes(data)
    _refuses(path, "no index", "rosbag reindex")


@pytest.mark.parametrize("kind", ["mcap", "db3"])
def test_a_folder_whose_file_is_missing_or_whose_metadata_is_damaged(tmp_path, kind):
    folder = laser_drive().write(tmp_path / f"a.{kind}", folder=True)
    broken = shutil.copytree(folder, tmp_path / "broken")
    (broken / "metadata.yaml").write_text("rosbag2_bagfile_information: [")
    _refuses(broken, "broken", "metadata.yaml")
    (broken / "metadata.yaml").write_text("rosbag2_bagfile_information: {version: 9}")
    _refuses(broken, "broken", "metadata")
    (file,) = folder.glob(f"*.{kind}")
    file.unlink()
    _refuses(folder, "missing")


@pytest.mark.data
def test_a_bag_of_an_old_format(data_dir):
    _refuses(data_dir / "real/bags/ccny_laser_scan_sparsifier.bag", "ccny_laser_scan_sparsifier.bag", "magic")


def test_damage_in_the_middle_is_met_before_the_first_sample(tmp_path):
    path = laser_drive(steps=200).write(tmp_path / "a.mcap")
    data = bytearray(path.read_bytes())
    middle = len(data) // 2
    data[middle : middle + 2000] = b"\xff" * 2000
    path.write_bytes(data)
    with pytest.raises(StreamError, match=r"a\.mcap"):
        open_stream(path, Config())


@pytest.mark.parametrize("kind", KINDS)
def test_no_odometry(tmp_path, kind):
    recording = laser_drive(kind == "bag")
    recording.messages = [m for m in recording.messages if m[0] != "/odom"]
    _refuses(recording.write(tmp_path / f"a.{kind}"), "no odometry", "nav_msgs/Odometry", "/scan (sensor_msgs/LaserScan)")


def test_ground_truth_is_not_taken_for_odometry(tmp_path):
    recording = laser_drive()
    recording.messages = [
        ("/ground_truth", *message[1:]) if message[0] == "/odom" else message for message in recording.messages
    ]
    _refuses(recording.write(tmp_path / "a.mcap"), "no odometry")


@pytest.mark.parametrize("kind", KINDS)
@pytest.mark.parametrize("value", [np.nan, np.inf])
def test_odometry_that_is_no_number(tmp_path, kind, value):
    recording = laser_drive(kind == "bag")
    recording.odometry(200 * NS + 5, float(value))
    _refuses(recording.write(tmp_path / f"a.{kind}"), "/odom", "NaN or Inf", "200.000000005")


def test_a_heading_that_is_no_number(tmp_path):
    recording = laser_drive()
    recording.odometry(200 * NS, yaw=np.nan)
    _refuses(recording.write(tmp_path / "a.mcap"), "/odom", "NaN", "200.000000000")


def test_a_rotation_of_length_zero(tmp_path):
    recording = laser_drive()
    recording.odometry(200 * NS)
    recording.messages[-1][2].pose.pose.orientation.w = 0.0
    _refuses(recording.write(tmp_path / "a.mcap"), "/odom", "quaternion", "200.000000000")


@pytest.mark.parametrize("topic", ["/odom", "/scan"])
@pytest.mark.parametrize("kind", KINDS)
def test_stamps_of_a_topic_that_go_back(tmp_path, kind, topic):
    recording = laser_drive(kind == "bag")
    back = 100 * NS + 7
    if topic == "/odom":
        recording.odometry(back)
    else:
        recording.scan(back, [1, 2, 3, 4, 5])
    _refuses(recording.write(tmp_path / f"a.{kind}"), topic, "100.000000007", "goes back")


def test_stamps_that_are_not_filled_in(tmp_path):
    recording = Recording()
    recording.transform("base_link", "laser")
    for _ in range(5):
        recording.odometry(0)
    recording.scan(0, [1, 2, 3])
    _refuses(recording.write(tmp_path / "a.mcap"), "/odom", "all 5 messages carry the stamp 0.000000000")


def test_two_clocks(tmp_path):
    recording = laser_drive()
    recording.messages = [m for m in recording.messages if m[0] != "/scan"]
    recording.scan(1_700_000_000 * NS, [1, 2, 3])
    _refuses(recording.write(tmp_path / "a.mcap"), "one clock", "1700000000")


@pytest.mark.parametrize(
    ("setting", "topic", "candidate"),
    [("odometry_topic", "/odometry", "/odom"), ("scan_topic", "/odom", "/scan"), ("color_topic", "/x", "none")],
)
def test_a_named_topic_that_is_not_there(tmp_path, setting, topic, candidate):
    config = Config(sensors=SensorsConfig(**{setting: topic}))
    _refuses(laser_drive().write(tmp_path / "a.mcap"), f"sensors.{setting}", topic, candidate, config=config)


def test_a_laser_without_mounting(tmp_path):
    recording = laser_drive()
    recording.messages = recording.messages[1:]
    _refuses(recording.write(tmp_path / "a.mcap"), "'base_link' -> 'laser'", "sensors.laser_mounting")


def test_a_laser_that_moves_on_the_robot(tmp_path):
    recording = laser_drive()
    recording.messages = recording.messages[1:]
    for i in range(3):
        recording.transform("base_link", "laser", (0.1 * i, 0.0, 0.0), topic="/tf", stamp_ns=i)
    _refuses(recording.write(tmp_path / "a.mcap"), "moves on /tf", "sensors.laser_mounting")


def test_a_laser_that_does_not_scan_level(tmp_path):
    recording = laser_drive()
    half = 0.5**0.5
    recording.transform("base_link", "laser", xyzw=(half, 0.0, 0.0, half))
    _refuses(recording.write(tmp_path / "a.mcap"), "90 deg", "level")


def test_a_base_that_is_not_joined_to_the_odometry(tmp_path):
    config = Config(sensors=SensorsConfig(base_frame="chassis"))
    _refuses(laser_drive().write(tmp_path / "a.mcap"), "'base_link' -> 'chassis'", config=config)


def _without(topic_part: str) -> Recording:
    recording = rgbd_drive()
    recording.messages = [m for m in recording.messages if topic_part not in m[0]]
    return recording


@pytest.mark.parametrize(
    ("topic_part", "words"),
    [
        ("depth", ["no depth pictures", "sensors.depth_topic"]),
        ("/color/image", ["no colour pictures", "sensors.color_topic"]),
        ("camera_info", ["no calibration", "sensors.camera_intrinsics"]),
        ("tf_static", ["'base_link' -> 'camera_optical'", "sensors.camera_mounting"]),
    ],
)
def test_rgbd_that_lacks_something(tmp_path, topic_part, words):
    _refuses(_without(topic_part).write(tmp_path / "a.mcap"), *words)


def test_depth_of_another_size_that_cannot_be_registered(tmp_path):
    recording = _without("depth")
    recording.image(100 * NS, depth_mm(0, (4, 3)), "16UC1", topic="/camera/depth/image_raw")
    _refuses(recording.write(tmp_path / "a.mcap"), "depth is 4x3, colour 8x6", "sensors.depth_info_topic")


def test_depth_of_another_size_without_extrinsics(tmp_path):
    recording = _without("depth")
    recording.camera_info(100 * NS, (4, 3), (5.0, 5.0, 1.5, 1.0), topic="/camera/depth/camera_info", frame="depth_frame")
    recording.image(100 * NS, depth_mm(0, (4, 3)), "16UC1", topic="/camera/depth/image_raw", frame="depth_frame")
    _refuses(recording.write(tmp_path / "a.mcap"), "another size", "'camera_optical' -> 'depth_frame'")


def test_a_size_that_changes_on_the_way(tmp_path):
    recording = rgbd_drive()
    recording.odometry(101 * NS)
    recording.image(101 * NS, color_pixels(0, (4, 4)), "rgb8", topic="/camera/color/image_raw")
    recording.image(101 * NS, depth_mm(0), "16UC1", topic="/camera/aligned_depth_to_color/image_raw")
    _refuses(recording.write(tmp_path / "a.mcap"), "/camera/color/image_raw", "4x4", "8x6")


@pytest.mark.parametrize(
    ("encoding", "topic", "pixels"),
    [
        ("yuv422", "/camera/color/image_raw", color_pixels()[..., :2]),
        ("16UC1", "/camera/color/image_raw", depth_mm()),
        ("rgb8", "/camera/depth_registered/image", color_pixels()),
    ],
)
def test_an_encoding_that_is_not_of_the_kind(tmp_path, encoding, topic, pixels):
    recording = _without("depth" if "depth" in topic else "/color/image")
    recording.image(100 * NS, pixels, encoding, topic=topic)
    _refuses(recording.write(tmp_path / "a.mcap"), topic, encoding, "expected")


def test_a_picture_with_too_few_bytes(tmp_path):
    recording = rgbd_drive()
    image = next(message for topic, _, message in recording.messages if topic == "/camera/color/image_raw")
    image.data = image.data[:-5]
    _refuses(recording.write(tmp_path / "a.mcap"), "/camera/color/image_raw", "139 bytes", "144")


@pytest.mark.parametrize(
    ("topic", "kind", "data", "word"),
    [
        ("/camera/color/image_raw/compressed", "jpeg", b"no jpeg", "cannot be decoded"),
        ("/camera/depth_registered/image/compressedDepth", "16UC1; compressedDepth rvl", b"x" * 40, "RVL"),
        ("/camera/depth_registered/image/compressedDepth", "16UC1; compressedDepth png", b"x" * 40, "cannot be decoded"),
    ],
)
def test_a_compressed_picture_that_cannot_be_decoded(tmp_path, topic, kind, data, word):
    recording = _without("depth" if "depth" in topic else "/color/image")
    recording.compressed(100 * NS, data, kind, topic=topic)
    _refuses(recording.write(tmp_path / "a.mcap"), topic, word)


def test_a_camera_that_is_not_calibrated(tmp_path):
    recording = _without("camera_info")
    recording.camera_info(100 * NS, (8, 6), (0.0, 0.0, 0.0, 0.0), topic="/camera/color/camera_info")
    _refuses(recording.write(tmp_path / "a.mcap"), "/camera/color/camera_info", "not calibrated")


def test_calibration_of_another_size(tmp_path):
    recording = _without("camera_info")
    recording.camera_info(100 * NS, (16, 12), (10.0, 10.0, 3.5, 2.5), topic="/camera/color/camera_info")
    _refuses(recording.write(tmp_path / "a.mcap"), "8x6", "16x12")


def test_colour_and_depth_that_never_meet(tmp_path):
    config = Config(sensors=SensorsConfig(sync_tolerance_s=0.001))
    _refuses(rgbd_drive().write(tmp_path / "a.mcap"), "sync_tolerance_s = 0.001", config=config)


@pytest.mark.parametrize(("sensor", "maker"), [("laser", rgbd_drive), ("rgbd", laser_drive)])
def test_a_sensor_that_the_bag_does_not_have(tmp_path, sensor, maker):
    config = Config.from_tree({"vision": {"sensor": sensor}}, "test")
    _refuses(maker().write(tmp_path / "a.mcap"), "no laser" if sensor == "laser" else "no colour", config=config)


def test_a_window_without_odometry(tmp_path):
    path = laser_drive().write(tmp_path / "a.mcap")
    span = r"a.mcap: no odometry between --start and --end; the recording has it from 0.000 to \d.\d{3} s after its first stamp"
    with pytest.raises(StreamError, match=span):
        open_stream(path, Config(), start_s=100.0)
    with pytest.raises(StreamError, match="before --start"):
        open_stream(path, Config(), start_s=2.0, end_s=1.0)


def test_a_camera_whose_frame_is_no_optical_one_is_remarked_on(tmp_path):
    recording = _without("tf_static")
    recording.transform("base_link", "camera_optical", (0.1, 0.0, 0.5))
    stream = open_stream(recording.write(tmp_path / "a.mcap"), Config())
    assert any("optical frame" in remark for remark in as_a(BagStream, stream).remarks)


def test_odometry_of_tf_that_is_no_number(tmp_path):
    recording = Recording()
    recording.transform("base_link", "laser")
    for i in range(3):
        recording.transform("odom", "base_link", (np.nan if i == 2 else 0.1 * i, 0, 0), topic="/tf", stamp_ns=100 * NS + i)
    recording.scan(100 * NS, [1, 2, 3])
    _refuses(recording.write(tmp_path / "a.mcap"), "/tf", "odom -> base_link", "NaN", "100.000000002")


def _claiming(width: int, height: int) -> bytes:
    """A PNG of 8 x 6 pixels whose header says another size, with the right checksum."""
    data = bytes(cv2.imencode(".png", color_pixels())[1].tobytes())
    header = width.to_bytes(4, "big") + height.to_bytes(4, "big") + data[24:29]
    return data[:16] + header + zlib.crc32(b"IHDR" + header).to_bytes(4, "big") + data[33:]


CLAIMS, DAMAGED = "claims a size of", "cannot be decoded"


@pytest.mark.parametrize(
    ("size", "said"),
    [
        ((60_000, 60_000), CLAIMS),
        ((2**31 - 1, 2**31 - 1), CLAIMS),
        ((0, 0), DAMAGED),
        ((16, 6), ""),
        ((8, 5000), ""),
    ],
)
def test_a_picture_whose_header_lies(tmp_path, size, said):
    recording = rgbd_drive()
    for k, (topic, _, message) in enumerate(recording.messages):
        if topic.endswith("image_raw") and "depth" not in topic:
            stamp_ns = message.header.stamp.sec * NS + message.header.stamp.nanosec
            recording.compressed(stamp_ns, _claiming(*size), "png", topic=topic)
            recording.messages[k] = recording.messages.pop()
    path = recording.write(tmp_path / "a.mcap")
    before = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
    _refuses(path, "/camera/color/image_raw", said)
    assert resource.getrusage(resource.RUSAGE_SELF).ru_maxrss - before < 500_000  # kB


def test_a_single_row_with_a_huge_step_takes_no_memory():
    message = SimpleNamespace(height=1, width=2, step=2**32 - 1, encoding="mono8", is_bigendian=0, data=np.zeros(2, np.uint8))
    assert decode_color(message, "x").shape == (1, 2, 3)


@pytest.mark.parametrize(
    ("layout", "said"),
    [
        ({"width": 0}, "0x2 pixels, expected at least 1x1"),
        ({"step": 3}, "rows of 3 bytes, expected at least 4"),
        ({"data": np.zeros(7, np.uint8)}, "holds 7 bytes, expected at least 8"),
    ],
)
def test_a_picture_whose_layout_cannot_be(layout, said):
    sound = {"height": 2, "width": 4, "step": 4, "encoding": "mono8", "is_bigendian": 0, "data": np.zeros(8, np.uint8)}
    assert decode_color(SimpleNamespace(**sound), "x").shape == (2, 4, 3)
    with pytest.raises(StreamError, match=said):
        decode_color(SimpleNamespace(**(sound | layout)), "x")


def test_a_colour_camera_that_cannot_be_finer_than_that():
    depth = Calibration(8, 6, np.diag([1e-3, 1e-3, 1.0]))
    with pytest.raises(StreamError, match="focal lengths"):
        DepthRegistration(depth, Calibration(8, 6, np.diag([1e4, 1e4, 1.0])), np.eye(4))


def _damage_some(path, topic_bytes: dict[str, list[int]]):
    """Cut messages of an mcap short: topic -> their numbers. Their headers stay."""
    with Reader(path) as reader:
        messages = [(c.topic, c.msgtype, t, bytes(data)) for c, t, data in reader.messages()]
    path.unlink()
    numbers: dict[str, int] = {}
    with Writer(path.parent / "again", version=8, storage_plugin=StoragePlugin.MCAP) as writer:
        connections = {}
        for topic, msgtype, time_ns, data in messages:
            if topic not in connections:
                connections[topic] = writer.add_connection(topic, msgtype, typestore=get_typestore(Stores.ROS2_HUMBLE))
            number = numbers.get(topic, 0)
            numbers[topic] = number + 1
            writer.write(connections[topic], time_ns, data[:40] if number in topic_bytes.get(topic, []) else data)
    next((path.parent / "again").glob("*.mcap")).rename(path)


@pytest.mark.parametrize("damaged", [[2, 4], [0], [0, 1, 5]])
def test_damaged_scans_are_skipped_and_counted_on_request(tmp_path, damaged):
    path = laser_drive().write(tmp_path / "a.mcap")
    _damage_some(path, {"/scan": damaged})
    _refuses(path, "/scan")
    stream = open_stream(path, Config(), skip_damaged=True)
    scans = [sample for sample in stream if isinstance(sample, LaserScan)]
    assert len(scans) == 6 - len(damaged)
    assert stream.report.lost == {"/scan": (len(damaged), 6)}
    assert all(f"/scan: message {number + 1} (" in said for number, said in zip(damaged, stream.report.skips, strict=True))
    assert all(re.match(r"skipped, stamp 10\d\.\d{9} s: /scan: message \d", said) for said in stream.report.skips)


def test_of_many_damaged_scans_the_first_few_are_named(tmp_path):
    path = laser_drive().write(tmp_path / "a.mcap")
    _damage_some(path, {"/scan": [0, 1, 2, 4, 5]})
    finished = session.run(open_stream(path, Config(), skip_damaged=True), Config(), tmp_path / "s")
    said = [remark for remark in finished.head["remarks"] if remark.startswith("skipped")]
    assert [one.partition(" (")[0].rpartition(": ")[2] for one in said[:3]] == ["message 1", "message 2", "message 3"]
    assert said[3:] == ["skipped 2 more that are damaged"]


def test_inspect_counts_damaged_scans_on_request(tmp_path):
    path = laser_drive().write(tmp_path / "a.mcap")
    _damage_some(path, {"/scan": [2, 4]})
    seen = inspect_source(path, Config(), skip_damaged=True)
    assert seen.mappable
    assert seen.lost == {"/scan": (2, 6)}
    assert inspect_source(path, Config()).lost == {}
    assert CliRunner().invoke(app, ["inspect", str(path), "--skip-damaged", "--strict"]).exit_code == LOST


def test_inspect_says_that_a_damaged_scan_has_to_be_skipped(tmp_path):
    path = laser_drive().write(tmp_path / "a.mcap")
    shown = CliRunner().invoke(app, ["inspect", str(path)]).stdout
    assert shown.endswith("mappable: yes\n")
    _damage_some(path, {"/scan": [2]})
    shown = CliRunner().invoke(app, ["inspect", str(path)]).stdout
    assert "problem: " in shown
    assert shown.endswith("mappable: yes, with --skip-damaged\n")
    shown = CliRunner().invoke(app, ["inspect", str(path), "--skip-damaged"]).stdout
    assert shown.endswith("mappable: yes\n")


def test_a_topic_of_damaged_scans_alone_counts_as_lost(tmp_path):
    path = laser_drive().write(tmp_path / "a.mcap")
    _damage_some(path, {"/scan": list(range(6))})
    stream = open_stream(path, Config(), skip_damaged=True)
    assert not [sample for sample in stream if isinstance(sample, LaserScan)]
    assert stream.report.lost == {"/scan": (6, 6)}


def test_messages_that_zeros_replace_are_counted_and_strictness_makes_an_exit_code_of_it(tmp_path):
    path = laser_drive(steps=60).write(tmp_path / "a.mcap")
    data = bytearray(path.read_bytes())
    at = data.index(b"laser", len(data) // 2)
    data[at - 200 : at + 600] = bytes(800)
    path.write_bytes(data)
    stream = open_stream(path, Config())
    samples = len(list(stream))
    assert sum(gone for gone, _ in stream.report.lost.values()) == 120 - samples > 0
    for arguments in (["inspect", str(path)], ["map", str(path), "--out", str(tmp_path / "session"), "--json"]):
        assert CliRunner().invoke(app, [*arguments, "--strict"]).exit_code == LOST
    head = SessionFolder(tmp_path / "session").read_metrics().head
    assert {name: tuple(counts) for name, counts in head["lost"].items()} == stream.report.lost


@pytest.mark.parametrize("seconds", [float("nan"), float("inf"), -1.0, 1e300])
def test_a_part_that_no_recording_has(tmp_path, seconds):
    path = laser_drive().write(tmp_path / "a.mcap")
    for part in ({"start_s": seconds}, {"end_s": seconds}):
        with pytest.raises(StreamError, match="expected seconds"):
            open_stream(path, Config(), **part)


def test_a_later_scan_with_beams_at_no_angle_is_damaged(tmp_path):
    recording = laser_drive()
    scans = [message for topic, _, message in recording.messages if topic == "/scan"]
    scans[2].angle_increment = float("nan")
    path = recording.write(tmp_path / "a.mcap")
    _refuses(path, "/scan", "steps of nan rad")
    stream = open_stream(path, Config(), skip_damaged=True)
    assert sum(isinstance(sample, LaserScan) for sample in stream) == len(scans) - 1
    assert stream.report.lost["/scan"] == (1, len(scans))


@pytest.mark.parametrize(("beams", "step"), [(200_000, 1e-5), (5, float("inf")), (5, float("nan")), (5, 0.0), (1, 0.1)])
def test_a_scan_that_no_laser_takes(tmp_path, beams, step):
    recording = laser_drive()
    for topic, _, message in recording.messages:
        if topic == "/scan":
            message.ranges, message.angle_increment = np.full(beams, 2.0, np.float32), step
    _refuses(recording.write(tmp_path / "a.mcap"), "/scan", counted(beams, "beam"))
