"""`hybridmap ros2` over DDS: the map of the bag, the topics as a client sees them, every service and transition called.

rclpy comes from the wheels of PyPI, where they can be had; else the tests that need it are skipped with the reason.
`HYBRIDMAP_ROS2` names a folder to keep them in.
"""

import json
import os
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest
from ros2 import Ros2, Ros2Error, fetch
from rosbags.highlevel import AnyReader
from rosbags.rosbag1 import Writer

from hybridmap import session
from hybridmap.config import Config
from hybridmap.export.keyframes import OccupancyGrid
from hybridmap.live import LiveReport
from hybridmap.ros import contents, fastdds
from hybridmap.ros.middleware import DIAGNOSTICS, GRAPH, MAP, MAP_METADATA, OUTPUTS, PATH, POSE, TF, Output
from hybridmap.ros.ros2_types import serialised
from hybridmap.streams.messages import Messages, RawMessage
from hybridmap.streams.rosbag import BagStream
from tests.ros.test_contents import NS, SNAPSHOT
from tests.ros.test_robot import bag, read_by_map_server  # noqa: F401  the bag is a fixture

ROOT = Path(__file__).resolve().parents[2]
PROGRAM = ("-c", "from hybridmap.cli import main; main()", "ros2")
CLIENT = Path(__file__).with_name("client_of_ros2.py")
GRID = OccupancyGrid(np.array([[4.0, -4.0, 0.0], [0.0, 0.5, -0.5]], dtype=np.float32), np.array([-1.0, 2.0]), 0.05)


@pytest.fixture(scope="module")
def ros(tmp_path_factory) -> Ros2:
    try:
        return fetch(Path(os.environ.get("HYBRIDMAP_ROS2") or tmp_path_factory.mktemp("ros2")))
    except Ros2Error as error:
        pytest.skip(f"the wheels of ROS 2 cannot be had: {error}")


@pytest.fixture(scope="module")
def timed(bag, tmp_path_factory) -> Path:  # noqa: F811
    """The bag with each message recorded at its stamp."""
    path: Path = tmp_path_factory.mktemp("timed") / "room.bag"
    at_ns = 100 * NS
    with AnyReader([bag]) as reader, Writer(path) as writer:
        own = Messages("bag", True, "damaged")
        connections = {
            one.topic: writer.add_connection(one.topic, one.msgtype, typestore=reader.typestore) for one in reader.connections
        }
        for connection, _, data in reader.messages():
            if connection.topic != "/tf_static":
                at_ns = own.stamp_ns(RawMessage(connection.topic, 0, data))
            writer.write(connections[connection.topic], at_ns, data)
    return path


@pytest.fixture(scope="module")
def drive(ros, timed, tmp_path_factory) -> dict:
    """What a client heard and was answered while the node mapped a bag, and the folders of the live and the offline session."""
    folder = tmp_path_factory.mktemp("drive")
    log = folder / "node.log"
    environment = ros.environment() | {"PYTHONPATH": os.pathsep.join([str(ROOT), str(ROOT / "tools")])}
    command = [str(ros.python), *PROGRAM, "--out", str(folder / "live"), "--lag-s", "600", "--map-every", "0.5"]
    with log.open("w") as out:
        node = subprocess.Popen([*command, "--no-autostart", "map:=/floor"], env=environment, stdout=out, stderr=out)
        try:
            client = [str(ros.python), str(CLIENT), str(timed)]
            done = subprocess.run(client, env=environment, capture_output=True, text=True, timeout=240, check=False)
            assert done.returncode == 0, done.stderr[-2000:] + log.read_text()[-2000:]
            assert node.wait(120.0) == 0, log.read_text()[-2000:]
        finally:
            node.kill()
    recorded = session.run(BagStream(timed, Config.load("laser")), Config.load("laser"), folder / "offline")
    return {"heard": json.loads(done.stdout.splitlines()[-1]), "folder": folder, "offline": recorded.head}


@pytest.mark.slow
def test_the_graph_is_that_of_the_bag_and_the_session_is_whole(drive) -> None:
    live = drive["folder"] / "live"
    head = json.loads((live / "metrics.json").read_text())
    assert head["graph_hash"] == drive["offline"]["graph_hash"]
    assert head["stream"] == drive["offline"]["stream"]
    assert (live / "report.html").is_file()


@pytest.mark.slow
def test_the_correction_composed_with_odometry_is_the_pose(drive) -> None:
    heard = drive["heard"]
    assert heard["tf_frames"] == [["map", "odom"]]
    assert heard["poses"] > 20
    assert heard["pose_from_correction_median_m"] < 0.05


@pytest.mark.slow
def test_what_is_latched_comes_to_a_late_subscriber_under_its_remapped_name(drive) -> None:
    heard = drive["heard"]
    assert heard["path_nodes"] > 5
    assert heard["graph_markers"] == 5
    assert heard["map"][0] == heard["map"][1] > 0
    assert int(heard["diagnostics"]["samples of odometry"]) == drive["offline"]["stream"]["odometry"]


@pytest.mark.slow
def test_every_service_answers_a_client(drive) -> None:
    answers = drive["heard"]["services"]
    assert answers["save_map"][0], answers
    assert answers["serialize_map"][0], answers
    assert not answers["deserialize_map"][0]
    assert not answers["set_localization_mode"][0]
    assert answers["pause"] == answers["resume"] == "done"
    cells = read_by_map_server(drive["folder"] / "live.yaml")
    assert answers["dynamic_map"] == [len(cells), cells.count(100), cells.count(0)]


@pytest.mark.slow
def test_an_initial_pose_is_heard(drive) -> None:
    assert (drive["folder"] / "node.log").read_text().count("initialpose: ignored") == 1


@pytest.mark.slow
def test_the_node_follows_its_lifecycle_and_is_silent_while_inactive(drive) -> None:
    expected = ["unconfigured", "still unconfigured", "inactive", "active", "inactive", "active", "inactive", "unconfigured"]
    assert drive["heard"]["states"] == expected
    assert drive["heard"]["heard_while_inactive"] == 0


@pytest.mark.slow
def test_a_borrowed_type_is_understood_by_those_who_have_the_real_one(ros) -> None:
    script = Path(__file__).with_name("borrowed_in_ros2.py")
    environment = ros.environment() | {"PYTHONPATH": str(ROOT)}
    done = subprocess.run(
        [str(ros.python), str(script)], env=environment, capture_output=True, text=True, timeout=60, check=False
    )
    assert done.returncode == 0, done.stderr
    came = json.loads(done.stdout.splitlines()[-1])
    assert (came["x"], came["bytes"]) == ([3.0], [came["sent"]])
    assert len(came["hashes"]) == 2
    assert came["hashes"][0] == came["hashes"][1]


REPORT = LiveReport("mapping", {"odometry": 90}, {"scans": {"too slow": 3}}, 0.25, 1.5, 0.0, 7)


@pytest.mark.parametrize(
    ("output", "given"),
    [
        (TF, {"transforms": [contents.transform(7 * NS + 9, "map", "odom", np.array([1.0, 2.0, 0.5]))]}),
        (POSE, contents.pose_with_covariance(NS, "map", np.array([1.0, 2.0, 0.5]), np.eye(3))),
        (PATH, contents.path("map", SNAPSHOT)),
        (GRAPH, contents.graph("map", SNAPSHOT)),
        (MAP, contents.occupancy(NS, "map", GRID)),
        (MAP_METADATA, contents.metadata(NS, GRID)),
        (DIAGNOSTICS, contents.diagnostics(NS, "hybridmap", REPORT, ["scans: late"])),
    ],
    ids=lambda one: one.topic if isinstance(one, Output) else "",
)
def test_bytes_hold_the_fields_that_were_given(output: Output, given: contents.Contents) -> None:
    messages = Messages("test", False, "wrong")
    messages.define(output.topic, output.msgtype)
    check(messages.decode(RawMessage(output.topic, 0, serialised(output.msgtype, given))), given)


def check(message, given) -> None:
    """The fields of a message are those given."""
    for name, value in given.items():
        found = getattr(message, name)
        if isinstance(value, contents.Stamp):
            assert (found.sec, found.nanosec) == value.parts
        elif isinstance(value, dict):
            check(found, value)
        elif isinstance(value, list) and value and isinstance(value[0], dict):
            assert len(found) == len(value)
            for one, of in zip(found, value, strict=True):
                check(one, of)
        else:
            assert np.allclose(found, value) if isinstance(value, list | np.ndarray | float) else found == value, name


def test_every_output_has_bytes_without_fields() -> None:
    for output in OUTPUTS:
        assert serialised(output.msgtype, {})[:4] == b"\x00\x01\x00\x00"


def test_a_profile_that_the_user_has_named_stays(monkeypatch: pytest.MonkeyPatch) -> None:
    for name in ("FASTDDS_DEFAULT_PROFILES_FILE", "FASTRTPS_DEFAULT_PROFILES_FILE", "FASTDDS_BUILTIN_TRANSPORTS"):
        monkeypatch.setenv(name, "")
    made = fastdds.provide_buffers()
    assert made is not None
    assert "<segment_size>33554432</segment_size>" in made.read_text()
    assert str(made) in (os.environ["FASTDDS_DEFAULT_PROFILES_FILE"], os.environ["FASTRTPS_DEFAULT_PROFILES_FILE"])
    assert fastdds.provide_buffers() is None
    made.unlink()


def test_where_there_are_no_wheels_the_tool_says_so_and_leaves_other_folders_alone(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("PIP_NO_INDEX", "1")
    monkeypatch.setenv("PIP_FIND_LINKS", "")
    for _ in range(2):  # what was begun may be tried again
        with pytest.raises(Ros2Error, match="ros-rclpy"):
            fetch(tmp_path / "ros2")
    (tmp_path / "home").mkdir()
    (tmp_path / "home" / "letters.txt").write_text("dear")
    with pytest.raises(Ros2Error, match="holds something else"):
        fetch(tmp_path / "home")
    assert [path.name for path in (tmp_path / "home").iterdir()] == ["letters.txt"]


def test_without_ros_the_error_says_how_to_get_it(tmp_path: Path) -> None:
    clean = {name: value for name, value in os.environ.items() if not name.startswith("ROS_")} | {"PYTHONPATH": str(ROOT)}
    command = [sys.executable, *PROGRAM, "--out", str(tmp_path / "s"), "no-rule"]
    done = subprocess.run(command, env=clean, capture_output=True, text=True, timeout=60, check=False)
    if "no remapping" in done.stderr:
        pytest.skip("rclpy is installed here")
    assert (done.returncode, done.stdout) == (2, "")
    assert done.stderr.startswith("hybridmap: error: rclpy cannot be imported")
    assert "setup.bash" in done.stderr
    assert len(done.stderr.splitlines()) == 1
    assert not (tmp_path / "s").exists()
