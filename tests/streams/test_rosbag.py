"""Bags as streams: every format, mounting, beams, encodings, calibration, registration, order."""

from __future__ import annotations

import sqlite3

import cv2
import numpy as np
import pytest

from hybridmap.config import Config
from hybridmap.config.inputs import SensorsConfig
from hybridmap.streams import open_stream
from hybridmap.streams.base import SelfMotion
from hybridmap.streams.inspection import inspect_source
from hybridmap.streams.laser import LaserScan
from hybridmap.streams.rgbd import RgbdFrame
from hybridmap.streams.rosbag import BagStream
from tests.narrowing import as_a, known
from tests.streams.recordings import KINDS, NS, OPTICAL_XYZW, Recording, color_pixels, depth_mm, laser_drive, rgbd_drive


def _config(**sensors) -> Config:
    return Config(sensors=SensorsConfig(**sensors))


def _scans(path, config=None):
    return [sample for sample in open_stream(path, config or Config()) if isinstance(sample, LaserScan)]


def _frames(path, config=None):
    return [sample for sample in open_stream(path, config or Config()) if isinstance(sample, RgbdFrame)]


@pytest.mark.parametrize(("kind", "folder"), [*((kind, False) for kind in KINDS), ("mcap", True), ("db3", True)])
def test_every_format_gives_the_same_samples(tmp_path, kind, folder):
    stream = open_stream(laser_drive(kind == "bag").write(tmp_path / f"drive.{kind}", folder=folder), Config())
    for _ in range(2):
        samples = list(stream)
        assert [type(sample) for sample in samples] == [SelfMotion, LaserScan] * 6
        assert [sample.stamp_ns for sample in samples] == [100 * NS + i * NS // 20 for i in range(12)]
        np.testing.assert_allclose(as_a(SelfMotion, samples[4]).pose_odom_robot, [0.2, 0.0, 0.0])
        np.testing.assert_array_equal(as_a(LaserScan, samples[5]).ranges_m, [1, 2, 3, 4, 7])
        assert stream.report.counts == {"odometry": 6, "scans": 6}
    assert stream.expected_observations == 6
    np.testing.assert_allclose(stream.rig.sensors["laser"].bearings_rad, [-1.0, -0.5, 0.0, 0.5, 1.0])
    np.testing.assert_allclose(stream.rig.sensors["laser"].pose_base_laser, [0.2, 0.0, 0.0])
    assert stream.groundtruth is None


@pytest.mark.parametrize("kind", KINDS)
def test_every_format_gives_the_same_frames(tmp_path, kind):
    stream = open_stream(rgbd_drive(kind == "bag").write(tmp_path / f"drive.{kind}"), Config())
    frames = [sample for sample in stream if isinstance(sample, RgbdFrame)]
    assert [frame.stamp_ns for frame in frames] == [100 * NS + i * NS // 10 + 5_000_000 for i in range(3)]
    for i, frame in enumerate(frames):
        np.testing.assert_array_equal(frame.color, color_pixels(i))
        np.testing.assert_array_equal(frame.depth_m, (depth_mm(i) / 1000.0).astype(np.float32))
        assert frame.depth_m.dtype == np.float32
    camera = stream.rig.sensors["camera"]
    assert (camera.width_px, camera.height_px, camera.fx_px, camera.cx_px) == (8, 6, 10.0, 3.5)
    np.testing.assert_allclose(camera.T_base_camera[:3, 3], [0.1, 0.0, 0.5])
    np.testing.assert_allclose(camera.T_base_camera[:3, :3] @ [0, 0, 1], [1, 0, 0], atol=1e-12)


def test_values_that_are_no_return_become_nan(tmp_path):
    recording = laser_drive()
    recording.scan(200 * NS, [np.inf, np.nan, 0.05, 10.0, -np.inf], high=10.0)
    assert np.isnan(_scans(recording.write(tmp_path / "a.mcap"))[-1].ranges_m).all()


def test_configured_range_limits_narrow_those_of_the_recording(tmp_path):
    path = laser_drive().write(tmp_path / "a.mcap")
    stream = open_stream(path, _config(range_min_m=1.5, range_max_m=4.0))
    scan = next(sample for sample in stream if isinstance(sample, LaserScan))
    np.testing.assert_array_equal(scan.ranges_m, [np.nan, 2, 3, np.nan, np.nan])
    assert (stream.rig.sensors["laser"].range_min_m, stream.rig.sensors["laser"].range_max_m) == (1.5, 4.0)


def _seen_from_base(stream) -> np.ndarray:
    """(B, 2) directions of the beams in the base, with the range of the first scan."""
    scan = next(sample for sample in stream if isinstance(sample, LaserScan))
    angle = stream.rig.sensors["laser"].bearings_rad + stream.rig.sensors["laser"].pose_base_laser[2]
    points: np.ndarray = scan.ranges_m[:, None] * np.stack([np.cos(angle), np.sin(angle)], axis=1)
    return points[np.argsort(scan.ranges_m)]


def test_either_beam_order_and_a_laser_upside_down_give_the_same_points(tmp_path):
    ways = {
        "plain": ((-1.0, 0.5), [1, 2, 3, 4, 5], (0.0, 0.0, 0.0, 1.0)),
        "clockwise": ((1.0, -0.5), [5, 4, 3, 2, 1], (0.0, 0.0, 0.0, 1.0)),
        "upside down": ((-1.0, 0.5), [5, 4, 3, 2, 1], (1.0, 0.0, 0.0, 0.0)),  # roll pi
        "upside down, turned": ((-1.0, 0.5), [5, 4, 3, 2, 1], (0.0, 1.0, 0.0, 0.0)),  # roll pi, then yaw pi
    }
    seen = {}
    for name, ((start, step), ranges, xyzw) in ways.items():
        recording = Recording()
        recording.transform("base_link", "laser", xyzw=xyzw)
        recording.odometry(NS)
        recording.scan(NS, ranges, angle_min=start, step=step)
        stream = open_stream(recording.write(tmp_path / f"{name.replace(' ', '_')}.mcap"), Config())
        assert (np.diff(stream.rig.sensors["laser"].bearings_rad) > 0).all()
        seen[name] = _seen_from_base(stream)
    np.testing.assert_allclose(seen["clockwise"], seen["plain"], atol=1e-6)
    np.testing.assert_allclose(seen["upside down"], seen["plain"], atol=1e-6)
    np.testing.assert_allclose(seen["upside down, turned"], -seen["plain"], atol=1e-6)


def test_scans_of_uneven_length_are_brought_to_the_beams_of_the_first(tmp_path):
    recording = laser_drive(steps=1)
    recording.odometry(101 * NS)
    recording.scan(101 * NS, [7.0, 8.0, 9.0], angle_min=-0.5, step=0.5)
    stream = open_stream(recording.write(tmp_path / "a.mcap"), Config())
    scans = [sample for sample in stream if isinstance(sample, LaserScan)]
    np.testing.assert_array_equal(scans[1].ranges_m, [np.nan, 7, 8, 9, np.nan])
    assert stream.report.counts["scans with other beams than the first, brought to its beams"] == 1
    assert stream.report.remarks[-1] == "scans with other beams than the first, brought to its beams: 1 of 2"


def test_mounting_along_a_chain_of_static_and_constant_transforms(tmp_path):
    half = np.sqrt(0.5)
    recording = Recording()
    for i in range(3):
        recording.odometry(100 * NS + i, child="base_footprint")
        recording.transform("odom", "base_footprint", (float(i), 0, 0), topic="/tf", stamp_ns=100 * NS + i)
        recording.transform("base_footprint", "base_link", (0.0, 0.0, 0.1), topic="/tf", stamp_ns=100 * NS + i)
    recording.transform("base_link", "mast", (1.0, 0.0, 0.0), (0.0, 0.0, half, half))
    recording.transform("mast", "laser", (0.5, 0.0, 0.0))
    recording.scan(100 * NS + 2, [1, 2, 3])
    stream = open_stream(recording.write(tmp_path / "a.mcap"), Config())
    np.testing.assert_allclose(stream.rig.sensors["laser"].pose_base_laser, [1.0, 0.5, np.pi / 2], atol=1e-12)


def test_the_configured_mounting_wins(tmp_path):
    path = laser_drive().write(tmp_path / "a.mcap")
    config = _config(laser_mounting={"x_m": 1.0, "y_m": 2.0, "yaw_rad": 0.3, "upside_down": True})
    laser = open_stream(path, config).rig.sensors["laser"]
    np.testing.assert_allclose(laser.pose_base_laser, [1.0, 2.0, 0.3])


def test_a_base_other_than_the_odometry_s_is_reached_through_the_transforms(tmp_path):
    recording = laser_drive()
    recording.transform("base_link", "centre", (0.5, 0.0, 0.0))
    stream = open_stream(recording.write(tmp_path / "a.mcap"), _config(base_frame="centre"))
    np.testing.assert_allclose(as_a(SelfMotion, next(iter(stream))).pose_odom_robot, [0.5, 0.0, 0.0])
    np.testing.assert_allclose(stream.rig.sensors["laser"].pose_base_laser, [-0.3, 0.0, 0.0])


@pytest.mark.parametrize("kind", KINDS)
def test_self_motion_from_tf_where_there_is_no_odometry_topic(tmp_path, kind):
    recording = Recording(kind == "bag")
    recording.transform("base_footprint", "laser")
    for i in range(4):
        recording.transform("odom", "base_footprint", (0.1 * i, 0, 0), topic="/tf", stamp_ns=100 * NS + i * 1000)
        recording.transform("map", "odom", (0.0, float(i), 0), topic="/tf", stamp_ns=100 * NS + i * 1000)
    recording.scan(100 * NS + 1500, [1, 2, 3])
    stream = open_stream(recording.write(tmp_path / f"a.{kind}"), Config())
    motions = [sample for sample in stream if isinstance(sample, SelfMotion)]
    np.testing.assert_allclose([m.pose_odom_robot[0] for m in motions], [0.0, 0.1, 0.2, 0.3])
    assert any("odom -> base_footprint" in remark for remark in stream.report.remarks)


def test_ground_truth_is_kept_apart_from_odometry(tmp_path):
    recording = laser_drive()
    for i in range(20):
        recording.odometry(100 * NS + i, 7.0, topic="/ground_truth/odom", frame="odom")
    stream = open_stream(recording.write(tmp_path / "a.mcap"), Config())
    assert as_a(BagStream, stream).selection.odometry == "/odom"
    truth = known(stream.groundtruth)
    assert (len(truth), truth.poses[0, 0]) == (20, 7.0)


def test_odometry_in_the_world_frame_is_truth(tmp_path):
    recording = laser_drive()
    recording.odometry(100 * NS, 7.0, topic="/base_pose", frame="world")
    stream = open_stream(recording.write(tmp_path / "a.mcap"), Config())
    assert known(stream.groundtruth).poses[0, 0] == 7.0


def test_topics_are_named_by_the_configuration(tmp_path):
    recording = laser_drive()
    for i in range(3):
        recording.odometry(100 * NS + i, 5.0, topic="/other")
        recording.scan(100 * NS + i, [9, 9, 9], topic="/rear")
    path = recording.write(tmp_path / "a.mcap")
    assert len(_scans(path)) == 6
    stream = open_stream(path, _config(odometry_topic="other", scan_topic="/rear"))
    samples = list(stream)
    assert as_a(SelfMotion, samples[0]).pose_odom_robot[0] == 5.0
    assert sum(isinstance(sample, LaserScan) for sample in samples) == 3


def test_colour_is_taken_from_the_camera_that_gives_the_depth(tmp_path):
    recording = rgbd_drive()
    for i in range(9):
        recording.image(100 * NS + i, color_pixels(), "rgb8", topic="/rear/color/image_raw")
    stream = as_a(BagStream, open_stream(recording.write(tmp_path / "a.mcap"), Config()))
    assert stream.uses["color"] == "/camera/color/image_raw"
    assert stream.uses["depth"] == "/camera/aligned_depth_to_color/image_raw"


def test_the_sensor_to_map_with_is_chosen_by_the_configuration(tmp_path):
    recording = rgbd_drive()
    recording.transform("base_link", "laser")
    recording.scan(100 * NS, [1, 2, 3])
    path = recording.write(tmp_path / "a.mcap")
    assert "camera" not in open_stream(path, Config()).rig.sensors
    rig = open_stream(path, Config.from_tree({"vision": {"sensor": "rgbd"}}, "test")).rig
    assert (list(rig.sensors), rig.sensors["camera"].width_px) == (["camera"], 8)
    alone = open_stream(path, Config.from_tree({"vision": {"sensor": "none"}}, "test"))
    assert (dict(alone.rig.sensors), alone.expected_observations) == ({}, 0)


def test_samples_are_sorted_across_topics_whatever_the_order_of_recording(tmp_path):
    recording = Recording()
    recording.transform("base_link", "laser")
    for i in range(5):
        recording.scan(100 * NS + i * 10, [i, i, i])
    for i in range(6):
        recording.odometry(100 * NS + i * 10)
    samples = list(open_stream(recording.write(tmp_path / "a.mcap"), Config()))
    assert [sample.stamp_ns % NS for sample in samples] == [0, 0, 10, 10, 20, 20, 30, 30, 40, 40, 50]
    assert [type(sample) for sample in samples[:4]] == [SelfMotion, LaserScan] * 2


def test_one_message_out_of_place_is_sorted(tmp_path):
    recording = Recording()
    for tick in (0, 20, 10, 30, 50, 40):
        recording.odometry(100 * NS + tick, tick / 10)
    motions = list(open_stream(recording.write(tmp_path / "a.mcap"), Config()))
    assert [as_a(SelfMotion, m).pose_odom_robot[0] for m in motions] == [0, 1, 2, 3, 4, 5]


def test_only_the_part_between_start_and_end(tmp_path):
    path = laser_drive().write(tmp_path / "a.mcap")
    stream = open_stream(path, Config(), start_s=0.1, end_s=0.3)
    assert [sample.stamp_ns for sample in stream] == [100 * NS + i * NS // 20 for i in range(2, 7)]
    assert stream.expected_observations == 2


@pytest.mark.parametrize(
    ("encoding", "stored"),
    [
        ("bgr8", lambda rgb: rgb[..., ::-1]),
        ("rgba8", lambda rgb: np.dstack([rgb, np.full(rgb.shape[:2], 9, np.uint8)])),
        ("bgra8", lambda rgb: np.dstack([rgb[..., ::-1], np.full(rgb.shape[:2], 9, np.uint8)])),
    ],
)
def test_colour_encodings_with_padded_rows(tmp_path, encoding, stored):
    recording = rgbd_drive(frames=1)
    recording.messages = [m for m in recording.messages if m[0] != "/camera/color/image_raw"]
    recording.image(100 * NS, stored(color_pixels(5)), encoding, topic="/camera/color/image_raw", padding=5)
    np.testing.assert_array_equal(_frames(recording.write(tmp_path / "a.mcap"))[0].color, color_pixels(5))


def test_grey_pictures_repeat_their_channel(tmp_path):
    grey = color_pixels(5)[..., 0]
    recording = rgbd_drive(frames=1)
    recording.messages = [m for m in recording.messages if m[0] != "/camera/color/image_raw"]
    recording.image(100 * NS, grey, "mono8", topic="/camera/color/image_raw", padding=3)
    frame = _frames(recording.write(tmp_path / "a.mcap"))[0]
    np.testing.assert_array_equal(frame.color, np.dstack([grey] * 3))


def _with_depth(add) -> Recording:
    recording = rgbd_drive(frames=1)
    recording.messages = [m for m in recording.messages if "depth" not in m[0]]
    add(recording)
    return recording


DEPTH_TOPIC = "/camera/depth_registered/image"


@pytest.mark.parametrize("big_endian", [False, True])
def test_depth_of_16_bit_in_either_byte_order(tmp_path, big_endian):
    recording = _with_depth(
        lambda r: r.image(100 * NS, depth_mm(3), "16UC1", topic=DEPTH_TOPIC, padding=4, big_endian=big_endian)
    )
    frame = _frames(recording.write(tmp_path / "a.mcap"))[0]
    np.testing.assert_array_equal(frame.depth_m, (depth_mm(3) / 1000.0).astype(np.float32))


@pytest.mark.parametrize("big_endian", [False, True])
def test_depth_of_floats_with_nan(tmp_path, big_endian):
    depth = (depth_mm(3) / 1000.0).astype(np.float32)
    holes = depth.copy()
    holes[1, 1], holes[1, 2], holes[1, 3] = np.nan, np.inf, -1.0
    recording = _with_depth(lambda r: r.image(100 * NS, holes, "32FC1", topic=DEPTH_TOPIC, big_endian=big_endian))
    depth[1, 1:4] = 0.0
    np.testing.assert_array_equal(_frames(recording.write(tmp_path / "a.mcap"))[0].depth_m, depth)


def test_compressed_pictures(tmp_path):
    rgb, depth = np.full((6, 8, 3), (200, 60, 20), np.uint8), depth_mm(3)
    png = cv2.imencode(".png", depth)[1].tobytes()
    jpeg = cv2.imencode(".jpg", rgb[..., ::-1])[1].tobytes()
    recording = rgbd_drive(frames=1)
    recording.messages = [m for m in recording.messages if "image" not in m[0]]
    recording.compressed(100 * NS, jpeg, "rgb8; jpeg compressed bgr8", topic="/camera/color/image_raw/compressed")
    header = np.array([0], "<i4").tobytes() + np.array([0, 0], "<f4").tobytes()
    recording.compressed(
        100 * NS, header + png, "16UC1; compressedDepth png", topic="/camera/depth_registered/image/compressedDepth"
    )
    frame = _frames(recording.write(tmp_path / "a.mcap"))[0]
    assert np.abs(frame.color.astype(int) - rgb).max() <= 6
    np.testing.assert_array_equal(frame.depth_m, (depth / 1000.0).astype(np.float32))


def test_compressed_depth_of_floats_is_inverse_depth(tmp_path):
    depth = np.full((6, 8), 2.0, np.float32)
    a, b = 100.0 * 101.0, 1.0 - 101.0 / 10.0
    quantised = np.rint(a / depth + b).astype(np.uint16)
    quantised[0, 0] = 0
    header = np.array([1], "<i4").tobytes() + np.array([a, b], "<f4").tobytes()
    data = header + cv2.imencode(".png", quantised)[1].tobytes()
    recording = _with_depth(
        lambda r: r.compressed(100 * NS, data, "32FC1; compressedDepth png", topic=f"{DEPTH_TOPIC}/compressedDepth")
    )
    seen = _frames(recording.write(tmp_path / "a.mcap"))[0].depth_m
    assert seen[0, 0] == 0.0
    np.testing.assert_allclose(seen[1:], 2.0, atol=2e-4)


def test_a_plain_png_is_depth_too(tmp_path):
    data = cv2.imencode(".png", depth_mm(3))[1].tobytes()
    recording = _with_depth(lambda r: r.compressed(100 * NS, data, "png", topic=f"{DEPTH_TOPIC}/compressed"))
    seen = _frames(recording.write(tmp_path / "a.mcap"))[0].depth_m
    np.testing.assert_array_equal(seen, (depth_mm(3) / 1000.0).astype(np.float32))


def test_colour_and_depth_are_paired_by_stamp_and_the_rest_counted(tmp_path):
    recording = rgbd_drive(frames=3)
    recording.image(100 * NS + 250_000_000, color_pixels(), "rgb8", topic="/camera/color/image_raw")
    recording.image(100 * NS + 300_000_000, depth_mm(), "16UC1", topic="/camera/aligned_depth_to_color/image_raw")
    recording.image(100 * NS + 400_000_000, depth_mm(), "16UC1", topic="/camera/aligned_depth_to_color/image_raw")
    stream = open_stream(recording.write(tmp_path / "a.mcap"), Config())
    assert sum(isinstance(sample, RgbdFrame) for sample in stream) == stream.expected_observations == 3
    assert stream.report.counts["unmatched color"] == 1
    assert stream.report.counts["unmatched depth"] == 2


def test_depth_limits_of_the_configuration(tmp_path):
    depth = _frames(rgbd_drive().write(tmp_path / "a.mcap"), _config(depth_min_m=1.0, depth_max_m=3.0))[0].depth_m
    kept = depth[depth > 0]
    assert len(kept)
    assert kept.min() >= 1.0
    assert kept.max() <= 3.0


def test_lens_distortion_is_taken_out(tmp_path):
    size, k, D = (64, 48), (60.0, 60.0, 31.5, 23.5), (-0.3, 0.1, 0.0, 0.0, 0.0)
    K = np.array([[60, 0, 31.5], [0, 60, 23.5], [0, 0, 1.0]])
    u, v = np.rint(cv2.projectPoints(np.array([[0.3, 0.2, 1.0]]), np.zeros(3), np.zeros(3), K, np.array(D))[0][0, 0]).astype(
        int
    )
    color, depth = np.zeros((48, 64, 3), np.uint8), np.full((48, 64), 1000, np.uint16)
    color[v - 1 : v + 2, u - 1 : u + 2] = 255
    depth[v - 1 : v + 2, u - 1 : u + 2] = 2000
    recording = Recording()
    recording.transform("base_link", "camera_optical", xyzw=OPTICAL_XYZW)
    recording.odometry(NS)
    recording.camera_info(NS, size, k, topic="/camera/color/camera_info", distortion=D)
    recording.image(NS, color, "rgb8", topic="/camera/color/image_raw")
    recording.image(NS, depth, "16UC1", topic="/camera/aligned_depth_to_color/image_raw")
    frame = _frames(recording.write(tmp_path / "a.mcap"))[0]
    x, y = round(31.5 + 60 * 0.3), round(23.5 + 60 * 0.2)
    assert abs(u - x) + abs(v - y) >= 2  # the distortion is worth taking out
    assert frame.color[y, x].min() > 200
    assert frame.depth_m[y, x] == 2.0
    assert set(np.unique(frame.depth_m)) <= {np.float32(0.0), np.float32(1.0), np.float32(2.0)}  # never mixed


def test_a_rectified_picture_takes_the_projection_matrix(tmp_path):
    recording = Recording()
    recording.transform("base_link", "camera_optical", xyzw=OPTICAL_XYZW)
    recording.odometry(NS)
    p = [20.0, 0, 4.0, 0, 0, 21.0, 3.0, 0, 0, 0, 1, 0]
    recording.camera_info(
        NS, (8, 6), (10.0, 10.0, 3.5, 2.5), topic="/camera/rgb/camera_info", distortion=(-0.3, 0, 0, 0, 0), p=p
    )
    recording.image(NS, color_pixels(), "rgb8", topic="/camera/rgb/image_rect_color")
    recording.image(NS, depth_mm(), "16UC1", topic="/camera/depth_registered/image_rect")
    stream = open_stream(recording.write(tmp_path / "a.mcap"), Config())
    camera = stream.rig.sensors["camera"]
    assert (camera.fx_px, camera.fy_px, camera.cx_px, camera.cy_px) == (20.0, 21.0, 4.0, 3.0)
    frame = next(sample for sample in stream if isinstance(sample, RgbdFrame))
    np.testing.assert_array_equal(frame.color, color_pixels())


def test_depth_of_another_camera_is_registered_to_colour(tmp_path):
    """A wall 2 m ahead with a nearer box, seen by a depth camera of half the resolution 10 cm to the left of the colour one."""
    recording = Recording()
    recording.transform("base_link", "color_optical", (0.0, 0.0, 0.5), OPTICAL_XYZW)
    recording.transform("color_optical", "depth_optical", (-0.1, 0.0, 0.0))
    recording.odometry(NS)
    recording.camera_info(NS, (64, 48), (60.0, 60.0, 31.5, 23.5), topic="/camera/color/camera_info", frame="color_optical")
    recording.camera_info(NS, (32, 24), (30.0, 30.0, 15.5, 11.5), topic="/camera/depth/camera_info", frame="depth_optical")
    depth = np.full((24, 32), 2000, np.uint16)
    depth[10:14, 14:18] = 1000
    recording.image(NS, color_pixels(0, (64, 48)), "rgb8", topic="/camera/color/image_raw", frame="color_optical")
    recording.image(NS, depth, "16UC1", topic="/camera/depth/image_rect_raw", frame="depth_optical")
    stream = open_stream(recording.write(tmp_path / "a.mcap"), Config())
    seen = next(sample for sample in stream if isinstance(sample, RgbdFrame)).depth_m
    assert seen.shape == (48, 64)
    box = np.argwhere(np.isclose(seen, 1.0))
    # The box' middle lies on the depth camera's axis, so at x = -0.1 m in the colour camera.
    np.testing.assert_allclose(box.mean(axis=0), [23.5, 31.5 - 60 * 0.1], atol=0.6)
    assert len(box) == pytest.approx(64, abs=8)
    assert (seen > 0).mean() > 0.9
    assert any("registered" in remark for remark in stream.report.remarks)


@pytest.mark.data
@pytest.mark.parametrize(
    ("source", "motions", "scans", "first_s", "last_s"),
    [
        ("real/fr079/fr079.mcap", 8951, 4934, 1211.520329, 2273.219477),
        ("real/aces/aces.bag", 7375, 7374, 70.179699, 1435.9),
    ],
)
def test_recordings_give_what_their_readme_says(data_dir, source, motions, scans, first_s, last_s):
    stream = open_stream(data_dir / source, Config())
    samples = list(stream)
    assert stream.report.counts == {"odometry": motions, "scans": scans}
    assert samples[0].stamp_ns == round(first_s * NS)
    assert samples[-1].stamp_ns == round(last_s * NS)
    assert stream.expected_observations == scans


def test_a_database_without_message_definitions(tmp_path):
    """As ROS 2 wrote them up to Humble: the types are the standard ones."""
    path = laser_drive().write(tmp_path / "a.db3")
    with sqlite3.connect(path) as database:
        database.execute("DROP TABLE message_definitions")
        database.execute("DROP TABLE schema")
    assert len(list(open_stream(path, Config()))) == 12


def test_messages_that_are_lost_are_counted(tmp_path):
    folder = laser_drive().write(tmp_path / "a.db3", folder=True)
    (file,) = folder.glob("*.db3")
    with sqlite3.connect(file) as database:
        database.execute("DELETE FROM messages WHERE id = (SELECT max(id) FROM messages)")
    stream = open_stream(folder, Config())
    assert len(list(stream)) == 11
    assert stream.report.lost == {"/scan": (1, 6)}
    assert "/scan: 1 of 6 messages cannot be read" in inspect_source(folder, Config()).problems


def test_a_broken_transform_elsewhere_does_not_matter_and_is_remarked_on(tmp_path):
    recording = laser_drive()
    recording.transform("base_link", "arm", (np.nan, 0.0, 0.0), topic="/tf", stamp_ns=100 * NS)
    recording.transform("arm", "hand", xyzw=(0.0, 0.0, 0.0, 0.0), topic="/tf", stamp_ns=100 * NS)
    stream = open_stream(recording.write(tmp_path / "a.mcap"), Config())
    assert len(list(stream)) == 12
    assert [remark.split(" holds")[0] for remark in stream.report.remarks] == [
        "transform base_link -> arm", "transform arm -> hand"
    ]  # fmt: skip
