"""What is written reads back to the same bits; nothing is replaced or left half-written."""

from __future__ import annotations

from dataclasses import fields

import numpy as np
import pytest

from hybridmap.config import Config
from hybridmap.config.inputs import CameraConfig, SimulationConfig
from hybridmap.errors import OutputError, StreamError
from hybridmap.geometry import quaternion_from_yaw, rotation_from_quaternion, yaw_from_quaternion
from hybridmap.simulation import SimulatedStream
from hybridmap.simulation.writers import write_rosbag1, write_rosbag2, write_tum
from hybridmap.simulation.writers.messages import quaternion_of, quaternion_of_rotation
from hybridmap.streams import open_stream
from hybridmap.streams.base import SelfMotion
from hybridmap.streams.laser import LaserScan
from hybridmap.streams.rgbd import RgbdFrame
from tests.narrowing import known

WRITERS = {
    "drive.bag": write_rosbag1,
    "drive.mcap": write_rosbag2,
    "drive.db3": lambda stream, path, **more: write_rosbag2(stream, path, "sqlite3", **more),
    "folder-of-mcap": write_rosbag2,
    "folder-of-pictures": write_tum,
}


@pytest.fixture(scope="module")
def stream() -> SimulatedStream:
    camera = CameraConfig(width_px=64, height_px=48)
    return SimulatedStream(SimulationConfig(world="corridor", duration_s=3.0, sensors="rgbd", camera=camera), 4)


@pytest.fixture(scope="module")
def laser_stream() -> SimulatedStream:
    return SimulatedStream(SimulationConfig(world="corridor", duration_s=3.0, sensors="laser"), 4)


def assert_same_samples(found, expected):
    found, expected = list(found), list(expected)
    assert [type(sample) for sample in found] == [type(sample) for sample in expected]
    for one, other in zip(found, expected, strict=True):
        for name in (field.name for field in fields(other)):
            a, b = np.asarray(getattr(one, name)), np.asarray(getattr(other, name))
            assert (a.dtype, a.shape) == (b.dtype, b.shape)
            assert np.array_equal(a, b, equal_nan=b.dtype.kind == "f"), (name, one.stamp_ns)


def assert_same_drive(path, stream):
    found = open_stream(path, Config())
    assert_same_samples(found, stream)
    truth = known(found.groundtruth)
    np.testing.assert_array_equal(truth.stamps_ns, stream.groundtruth.stamps_ns)
    np.testing.assert_array_equal(truth.poses, stream.groundtruth.poses)
    for sensor in ("camera", "laser"):
        one, other = found.rig.sensors.get(sensor), stream.rig.sensors.get(sensor)
        assert (one is None) == (other is None)
        for name in () if other is None else (field.name for field in fields(other)):
            np.testing.assert_array_equal(getattr(one, name), getattr(other, name))


@pytest.mark.parametrize("name", WRITERS)
def test_frames_and_odometry_read_back_to_the_same_bits(name, stream, tmp_path):
    written = WRITERS[name](stream, tmp_path / name)
    assert 16 in written.values()
    assert 91 in written.values()
    assert [entry.name for entry in tmp_path.iterdir()] == [name]
    assert_same_drive(tmp_path / name, stream)


@pytest.mark.parametrize("name", ["drive.bag", "drive.mcap"])
def test_scans_read_back_to_the_same_bits(name, laser_stream, tmp_path):
    WRITERS[name](laser_stream, tmp_path / name)
    assert_same_drive(tmp_path / name, laser_stream)


@pytest.mark.parametrize("offset_s", [-0.11, 0.11])
def test_a_late_clock_reads_back_to_the_same_bits(offset_s, tmp_path):
    config = SimulationConfig(world="corridor", duration_s=2.0, sensors="laser", clock_offset_s=offset_s)
    write_rosbag2(SimulatedStream(config, 4), tmp_path / "drive.mcap")
    assert_same_drive(tmp_path / "drive.mcap", SimulatedStream(config, 4))


@pytest.mark.parametrize("name", ["drive.bag", "folder-of-pictures"])
def test_the_same_drive_gives_the_same_files(name, stream, tmp_path):
    contents = []
    for turn in ("first", "second"):
        path = tmp_path / turn / name
        WRITERS[name](stream, path)
        files = [path] if path.is_file() else sorted(path.rglob("*.*"))
        contents.append([(file.name, file.read_bytes()) for file in files])
    assert contents[0] == contents[1]


def test_a_folder_of_pictures_leaves_scans_out_and_says_so(tmp_path):
    camera = CameraConfig(width_px=32, height_px=24)
    both = SimulatedStream(SimulationConfig(world="corridor", duration_s=1.0, sensors="both", camera=camera), 0)
    assert write_tum(both, tmp_path / "tum")["scans left out"] == 6
    assert_same_samples(open_stream(tmp_path / "tum", Config()), [s for s in both if not isinstance(s, LaserScan)])


def test_a_folder_of_pictures_needs_a_camera(laser_stream, tmp_path):
    with pytest.raises(StreamError, match="no camera; write a bag"):
        write_tum(laser_stream, tmp_path / "tum")
    assert not list(tmp_path.iterdir())


@pytest.mark.parametrize("name", WRITERS)
def test_what_is_there_is_kept_unless_told_otherwise(name, stream, tmp_path):
    path = tmp_path / name
    WRITERS[name](stream, path)
    before = {file: file.stat().st_mtime_ns for file in [path, *path.rglob("*")]}
    with pytest.raises(OutputError, match=r"already.*--overwrite"):
        WRITERS[name](stream, path)
    assert {file: file.stat().st_mtime_ns for file in before} == before
    WRITERS[name](stream, path, overwrite=True)
    assert_same_drive(path, stream)


def test_a_folder_that_is_no_recording_is_never_replaced(stream, tmp_path):
    (tmp_path / "precious").mkdir()
    (tmp_path / "precious" / "thesis.txt").write_text("years of work")
    with pytest.raises(OutputError, match="no recording"):
        write_tum(stream, tmp_path / "precious", overwrite=True)
    assert (tmp_path / "precious" / "thesis.txt").read_text() == "years of work"


class Breaking:
    """A stream that breaks off in the middle."""

    def __init__(self, stream) -> None:
        self._stream = stream

    def __getattr__(self, name):
        return getattr(self._stream, name)

    def __iter__(self):
        for count, sample in enumerate(self._stream):
            if count == 20:
                raise StreamError("broken off")
            yield sample


@pytest.mark.parametrize("name", WRITERS)
def test_a_failure_leaves_nothing_behind(name, stream, tmp_path):
    with pytest.raises(StreamError, match="broken off"):
        WRITERS[name](Breaking(stream), tmp_path / "new" / "deep" / name)
    assert not list(tmp_path.iterdir())


def test_a_failure_leaves_the_old_recording(stream, tmp_path):
    write_rosbag1(stream, tmp_path / "drive.bag")
    with pytest.raises(StreamError, match="broken off"):
        write_rosbag1(Breaking(stream), tmp_path / "drive.bag", overwrite=True)
    assert_same_drive(tmp_path / "drive.bag", stream)


def test_progress_counts_every_frame(stream, tmp_path):
    seen = []
    write_rosbag1(stream, tmp_path / "drive.bag", progress=lambda done, total: seen.append((done, total)))
    assert seen == [(k, 16) for k in range(1, 17)]


def test_a_suffix_that_contradicts_the_storage_is_refused(stream, tmp_path):
    with pytest.raises(StreamError, match=r"sqlite3 bag ends in \.db3"):
        write_rosbag2(stream, tmp_path / "drive.mcap", "sqlite3")


def test_every_heading_has_a_quaternion_that_reads_back_to_its_bits():
    drawn = np.random.default_rng(0).uniform(-np.pi, np.pi, 20000)
    headings = yaw_from_quaternion(*quaternion_from_yaw(drawn).T)
    plain = yaw_from_quaternion(*quaternion_from_yaw(headings).T)
    assert (plain != headings).any()  # or there would be no need
    assert all(float(yaw_from_quaternion(*quaternion_of(float(yaw)))) == yaw for yaw in headings)


def test_mountings_become_quaternions_that_read_back():
    exact = (-0.5, 0.5, -0.5, 0.5)
    np.testing.assert_array_equal(
        rotation_from_quaternion(quaternion_of_rotation(rotation_from_quaternion(exact))), rotation_from_quaternion(exact)
    )
    for drawn in np.random.default_rng(1).standard_normal((50, 4)):
        rotation = rotation_from_quaternion(drawn)
        np.testing.assert_allclose(rotation_from_quaternion(quaternion_of_rotation(rotation)), rotation, atol=1e-11)
    with pytest.raises(StreamError, match="rotation matrix"):
        quaternion_of_rotation(np.diag([1.0, 1.0, -1.0]))


def test_a_bag_holds_the_topics_that_robots_publish(stream, tmp_path):
    counts = write_rosbag2(stream, tmp_path / "bag")
    assert counts == {
        "/tf_static": 1,
        "/odom": 91,
        "/groundtruth": 91,
        "/camera/color/image_raw": 16,
        "/camera/depth/image_raw": 16,
        "/camera/color/camera_info": 16,
    }
    assert sum(isinstance(sample, RgbdFrame) for sample in stream) == 16
    assert sum(isinstance(sample, SelfMotion) for sample in stream) == 91
