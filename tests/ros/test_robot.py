"""A node maps what a robot publishes into the map of a bag of it, and publishes and serves that."""

import threading
import time
from pathlib import Path

import numpy as np
import pytest

from hybridmap import session
from hybridmap.config import Config
from hybridmap.errors import LiveError, OutputError, RosError, StoreError, StreamError
from hybridmap.geometry import compose
from hybridmap.live import LiveLimits, LiveMapper
from hybridmap.ros.robot import NodeOptions, RobotNode
from hybridmap.streams.base import SelfMotion
from hybridmap.streams.laser import LaserScan
from hybridmap.streams.rosbag import BagStream
from tests.ros.robots import PlayedRobot
from tests.streams.recordings import NS, Recording
from tests.streams_for_tests import BEARINGS, RoomDrive

NO_LIMIT = LiveLimits(lag_s=600.0)
SLOWLY_AFTER_S = 15.0
"""From here to its end, 16 s, the drive is played at its own speed: poses and corrections can then be compared."""


@pytest.fixture(scope="module")
def bag(tmp_path_factory) -> Path:
    """Laps in a room as a ROS 1 bag."""
    recording, step = Recording(True), float(BEARINGS[1] - BEARINGS[0])
    recording.transform("base_link", "laser", (0.1, 0.0, 0.3))
    for sample in RoomDrive(laps=1.3, bias_rad_per_m=0.05):
        stamp_ns = sample.stamp_ns + 100 * NS
        if isinstance(sample, SelfMotion):
            recording.odometry(stamp_ns, *sample.pose_odom_robot)
        elif isinstance(sample, LaserScan):
            recording.scan(stamp_ns, sample.ranges_m, angle_min=float(BEARINGS[0]), step=step, low=0.05, high=30.0)
    return recording.write(tmp_path_factory.mktemp("bag") / "room.bag")


def pose_of(contents) -> np.ndarray:
    p, q = contents["position"], contents["orientation"]
    return np.array([p["x"], p["y"], 2 * np.arctan2(q["z"], q["w"])])


def transform_of(contents) -> np.ndarray:
    p, q = contents["transform"]["translation"], contents["transform"]["rotation"]
    return np.array([p["x"], p["y"], 2 * np.arctan2(q["z"], q["w"])])


def read_by_map_server(yaml: Path) -> list[int]:
    """Cells of the files of a map, as map_server publishes them (trinary)."""
    words = dict(line.split(": ", 1) for line in yaml.read_text().splitlines())
    head, size, _, pixels = (yaml.parent / words["image"]).read_bytes().split(b"\n", 3)
    assert head == b"P5"
    width, height = map(int, size.split())
    occupied = (255 - np.frombuffer(pixels, np.uint8).reshape(height, width)[::-1].astype(float)) / 255
    cells = np.full(occupied.shape, -1)
    cells[occupied > float(words["occupied_thresh"])] = 100
    cells[occupied < float(words["free_thresh"])] = 0
    return cells.ravel().tolist()


def test_the_map_is_that_of_the_bag_and_is_published_and_served(bag: Path, tmp_path: Path) -> None:
    recorded = session.run(BagStream(bag, Config.load("laser")), Config.load("laser"), tmp_path / "recorded")
    robot, out = PlayedRobot(bag), tmp_path / "live"
    node = RobotNode(robot, NodeOptions(out, map_every_s=0.5, limits=NO_LIMIT))
    assert robot.services == {}
    node.start()
    with pytest.raises(RosError, match="not mapping yet"):
        robot.services["~pause"].does(False)
    robot.wait_for(lambda: "/tf_static" in robot.takers)
    robot.play(20.0, until_s=8.0)
    robot.wait_for(lambda: bool(robot.published["~pose"]))
    robot.play(20.0, from_s=8.0, until_s=SLOWLY_AFTER_S)
    robot.wait_for(lambda: bool(robot.published["~path"] and robot.published["map"]))
    robot.play(1.0, from_s=SLOWLY_AFTER_S)
    mapped = robot.services["dynamic_map"].does(False)["map"]
    saved = robot.services["~save_map"].does(False)
    assert saved["success"], saved
    assert read_by_map_server(tmp_path / "live.yaml") == mapped["data"].tolist()
    assert robot.services["~serialize_map"].does(False)["success"]
    assert robot.services["~pause"].does(False) == robot.services["~resume"].does(False) == {}
    for name, value in (("~deserialize_map", False), ("~set_localization_mode", True)):
        refused = robot.services[name].does(value)
        assert not refused["success"]
        assert "--map" in refused["message"]
    robot.takers["initialpose"](b"", None)
    assert any("initialpose" in warning for warning in robot.warnings)
    robot.wait_for(lambda: len(robot.published["/tf"]) > 20)
    finished = node.finish()
    assert finished.head["graph_hash"] == recorded.head["graph_hash"]
    assert finished.head["stream"] == recorded.head["stream"]
    check_published(robot, bag)


def test_the_robot_is_found_on_a_finished_map(bag: Path, tmp_path: Path) -> None:
    finished = session.run(BagStream(bag, Config.load("laser")), Config.load("laser"), tmp_path / "monday")
    robot = PlayedRobot(bag)
    node = RobotNode(robot, NodeOptions(tmp_path / "tuesday", known_map=tmp_path / "monday", limits=NO_LIMIT))
    node.start()
    robot.wait_for(lambda: "/tf_static" in robot.takers)
    robot.play(20.0, until_s=SLOWLY_AFTER_S)
    robot.wait_for(lambda: bool(robot.published["~localization_pose"]), 120.0)
    robot.play(1.0, from_s=SLOWLY_AFTER_S)
    (_, known) = robot.published["/tf"][-1]["transforms"]
    assert (known["header"]["frame_id"], known["child_frame_id"]) == ("known_map", "map")
    assert np.abs(transform_of(known)).max() < 0.1  # the same drive
    assert robot.services["~set_localization_mode"].does(False) == {"success": True, "message": "mapping"}
    assert robot.services["~deserialize_map"].does(False)["success"]
    again = node.finish()
    assert again.head["graph_hash"] == finished.head["graph_hash"]


def test_a_paused_node_leaves_views_out_and_takes_odometry_in(bag: Path, tmp_path: Path) -> None:
    robot = PlayedRobot(bag)
    node = RobotNode(robot, NodeOptions(tmp_path / "live", limits=NO_LIMIT))
    node.start()
    robot.wait_for(lambda: "/tf_static" in robot.takers)
    node.pause()
    robot.play(20.0, until_s=4.0)
    robot.wait_for(lambda: bool(robot.published["~pose"]))
    robot.play(40.0, from_s=4.0, until_s=8.0)
    node.pause(False)
    robot.play(40.0, from_s=8.0, until_s=12.0)
    stream = node.finish().head["stream"]
    assert stream["scans left out (paused)"] > 5
    assert stream["scans"] > 5
    whole = [sample for sample in BagStream(bag, Config()) if isinstance(sample, SelfMotion)]
    until_ns = whole[0].stamp_ns + 12 * NS
    assert stream["odometry"] == sum(sample.stamp_ns <= until_ns for sample in whole)


def test_a_grid_that_does_not_come_ends_no_drive_and_holds_up_no_diagnostics(
    bag: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    asked = threading.Event()

    def grid(*_: object, **__: object) -> None:
        asked.set()
        time.sleep(2.0)
        raise LiveError("no grid in this time")

    monkeypatch.setattr(LiveMapper, "grid", grid)
    robot = PlayedRobot(bag)
    node = RobotNode(robot, NodeOptions(tmp_path / "live", limits=NO_LIMIT))
    node.start()
    robot.wait_for(lambda: "/tf_static" in robot.takers)
    robot.play(40.0, until_s=8.0)
    assert asked.wait(30.0)
    before = len(robot.published["/diagnostics"])
    robot.wait_for(lambda: len(robot.published["/diagnostics"]) >= before + 2, timeout_s=1.9)
    robot.wait_for(lambda: bool(robot.warnings))
    assert not node.ended.is_set()
    assert node.finish().head["graph_hash"]


def check_published(robot: PlayedRobot, bag: Path) -> None:
    """The correction on /tf, composed with the odometry, is the pose on the map."""
    (last,) = robot.published["/tf"][-1]["transforms"]
    assert (last["header"]["frame_id"], last["child_frame_id"]) == ("map", "odom")
    stamps_ns = [message["transforms"][0]["header"]["stamp"].ns for message in robot.published["/tf"]]
    assert stamps_ns == sorted(stamps_ns)
    odometry = {
        sample.stamp_ns: sample.pose_odom_robot for sample in BagStream(bag, Config()) if isinstance(sample, SelfMotion)
    }
    corrections = [transform_of(one) for one in robot.published["~map_to_odom"]]
    slowly = [one for one in robot.published["~pose"] if one["header"]["stamp"].ns > (100 + SLOWLY_AFTER_S) * NS]
    assert len(slowly) > 5
    for one in slowly:
        pose, moved = pose_of(one["pose"]["pose"]), odometry[one["header"]["stamp"].ns]
        off = min(np.hypot(*(compose(correction, moved) - pose)[:2]) for correction in corrections)
        assert off < 0.02
    assert robot.published["map_metadata"][-1] == {**robot.published["map"][-1]["info"]}


def test_a_node_without_a_sensor_says_what_it_waits_for_and_writes_nothing(bag: Path, tmp_path: Path) -> None:
    robot = PlayedRobot(bag)
    node = RobotNode(robot, NodeOptions(tmp_path / "s", overrides={"sensors.scan_topic": "/front"}))
    node.start()
    robot.wait_for(lambda: bool(robot.published["/diagnostics"]))
    time.sleep(0.7)
    assert "/front" in node.missing[0]
    assert "/scan" in node.missing[0]
    with pytest.raises(StreamError, match=r"nothing was mapped: .*'/front'"):
        node.finish()
    assert not (tmp_path / "s").exists()


def test_a_finished_map_that_is_not_there_is_refused_before_anything_is_started(tmp_path: Path) -> None:
    with pytest.raises(StoreError, match="mondey"):
        NodeOptions(tmp_path / "s", known_map=tmp_path / "mondey")


def test_a_folder_that_holds_something_ends_the_node_with_the_reason(bag: Path, tmp_path: Path) -> None:
    (tmp_path / "s").mkdir()
    (tmp_path / "s" / "letters.txt").write_text("dear")
    robot = PlayedRobot(bag)
    node = RobotNode(robot, NodeOptions(tmp_path / "s"))
    node.start()
    robot.wait_for(lambda: "/tf_static" in robot.takers)
    robot.play(20.0)
    assert node.ended.wait(60.0)
    with pytest.raises(OutputError):
        node.finish()
