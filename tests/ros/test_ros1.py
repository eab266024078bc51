"""`hybridmap ros1` under a real ROS 1 master: the map of the bag, the topics as a client sees them, every service called.

ROS 1 comes from Debian's packages, where they can be had; else the test is skipped with the reason. `HYBRIDMAP_ROS1` names a
folder to keep them in.
"""

import json
import os
import signal
import subprocess
import sys
from pathlib import Path

import pytest
from ros1 import Ros1, Ros1Error, fetch, master

from hybridmap import session
from hybridmap.config import Config
from hybridmap.streams.rosbag import BagStream
from tests.ros.test_robot import bag, read_by_map_server  # noqa: F401  the bag is a fixture

NODE = (sys.executable, "-c", "from hybridmap.cli import main; main()", "ros1")
CLIENT = Path(__file__).with_name("client_of_ros1.py")


@pytest.fixture(scope="module")
def ros(tmp_path_factory) -> Ros1:
    try:
        return fetch(Path(os.environ.get("HYBRIDMAP_ROS1") or tmp_path_factory.mktemp("ros1")))
    except (Ros1Error, subprocess.TimeoutExpired, OSError) as error:
        pytest.skip(f"Debian's packages of ROS 1 cannot be had: {error}")


@pytest.fixture(scope="module")
def drive(ros, bag, tmp_path_factory) -> dict:  # noqa: F811
    """What a client heard and was answered while the node mapped a bag, and the folders of the live and the offline session."""
    folder = tmp_path_factory.mktemp("drive")
    log = folder / "node.log"
    try:
        with master(ros) as environment, log.open("w") as out:
            command = [*NODE, "--out", str(folder / "live"), "--lag-s", "600", "--map-every", "0.5", "map:=/floor"]
            node = subprocess.Popen(command, env=environment, stdout=out, stderr=out)
            try:
                client = [sys.executable, str(CLIENT), str(bag)]
                done = subprocess.run(client, env=environment, capture_output=True, text=True, timeout=240)
                assert done.returncode == 0, done.stderr[-2000:] + log.read_text()[-2000:]
                node.send_signal(signal.SIGINT)
                assert node.wait(120.0) == 0, log.read_text()[-2000:]
            finally:
                node.kill()
    except Ros1Error as error:
        pytest.skip(f"no master: {error}")
    recorded = session.run(BagStream(bag, Config.load("laser")), Config.load("laser"), folder / "offline")
    heard = json.loads(done.stdout.splitlines()[-1])
    return {"heard": heard, "folder": folder, "offline": recorded.head}


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
    assert heard["path_nodes"] > 5
    assert heard["graph_markers"] == 5


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
    assert drive["heard"]["map"][0] > 0  # the latched grid, under the name of the remapping


def test_without_ros_the_error_says_how_to_get_it(tmp_path: Path) -> None:
    clean = {name: value for name, value in os.environ.items() if not name.startswith("ROS_")}
    clean["PYTHONPATH"] = str(Path(__file__).resolve().parents[2])
    done = subprocess.run([*NODE, "--out", str(tmp_path / "s")], env=clean, capture_output=True, text=True, timeout=60)
    if "no ROS master" in done.stderr:
        pytest.skip("rospy is installed here")
    assert (done.returncode, done.stdout) == (2, "")
    assert done.stderr.startswith("hybridmap: error: rospy cannot be imported")
    assert "setup.bash" in done.stderr
    assert len(done.stderr.splitlines()) == 1
    assert not (tmp_path / "s").exists()
