"""`hybridmap inspect`: what a source holds, what would be used, and whether it can be mapped."""

from __future__ import annotations

import json
import os
import sqlite3
import subprocess
import sys

import pytest
from typer.testing import CliRunner

from hybridmap.cli.app import app
from hybridmap.config import Config
from hybridmap.errors import ConfigError, StreamError
from hybridmap.simulation.writers import write_rosbag1, write_rosbag2, write_tum
from hybridmap.streams import open_stream
from hybridmap.streams.inspection import inspect_source
from tests.narrowing import known


def _drive(sensors: str):
    simulation = {"duration_s": 0.5, "sensors": sensors, "camera": {"width_px": 32, "height_px": 24}}
    return open_stream("sim:lab", Config.from_tree({"simulation": simulation}, "test"))


@pytest.fixture(scope="module")
def laser_bag(tmp_path_factory):
    path = tmp_path_factory.mktemp("bags") / "drive.bag"
    write_rosbag1(_drive("laser"), path)
    return path


def _inspect(*arguments: str) -> str:
    done = CliRunner().invoke(app, ["inspect", *arguments], catch_exceptions=False)
    assert done.exit_code == 0
    return done.stdout


def test_a_bag_in_words(laser_bag):
    text = _inspect(str(laser_bag))
    assert "ROS 1 bag" in text
    for words in ("sensor_msgs/LaserScan", "uses odometry: /odom", "uses scan: /scan", "uses groundtruth: /groundtruth"):
        assert words in text
    assert text.rstrip().endswith("mappable: yes")


def test_a_bag_as_json(laser_bag):
    found = json.loads(_inspect(str(laser_bag), "--json"))
    assert (found["kind"], found["mappable"], found["reason"]) == ("ROS 1 bag", True, None)
    assert found["uses"] == {"odometry": "/odom", "scan": "/scan", "groundtruth": "/groundtruth"}
    counts = {part["name"]: part["count"] for part in found["parts"]}
    figures = {metric["name"]: metric["value"] for metric in found["metrics"]}
    assert figures["count/odom"] == counts["/odom"] == 16
    assert figures["rate/odom"] == pytest.approx(30.0)
    assert figures["duration/odom"] == pytest.approx(0.5)
    assert figures["longest_gap/odom"] == pytest.approx(1 / 30, abs=1e-6)
    assert found["sensor"].startswith("laser")


def test_what_would_be_used_follows_the_options(laser_bag):
    assert "maps with: none" in _inspect(str(laser_bag), "--set", "vision.sensor=none")
    text = _inspect(str(laser_bag), "--scan-topic", "/nowhere")
    assert "mappable: no, because" in text
    assert "sensors.scan_topic" in text
    assert "/scan" in text.splitlines()[-1]


def test_a_bag_without_odometry_opens_but_cannot_be_mapped(tmp_path):
    path = tmp_path / "drive"
    write_rosbag2(_drive("laser"), path, "sqlite3")
    (file,) = path.glob("*.db3")
    with sqlite3.connect(file) as database:
        (odometry,) = database.execute("SELECT id FROM topics WHERE name = '/odom'").fetchone()
        database.execute("DELETE FROM messages WHERE topic_id = ?", (odometry,))
    found = inspect_source(file, Config())
    assert not found.mappable
    assert "no odometry" in known(found.reason)
    assert "/odom: no messages" in found.problems
    folder = inspect_source(path, Config())
    assert any("0 messages can be read of the 16" in problem for problem in folder.problems)


def test_messages_lost_on_the_way_are_reported(tmp_path):
    path = tmp_path / "drive"
    write_rosbag2(_drive("rgbd"), path, "sqlite3")
    (file,) = path.glob("*.db3")
    with sqlite3.connect(file) as database:
        (depth,) = database.execute("SELECT id FROM topics WHERE name LIKE '%depth%image%'").fetchone()
        database.execute("DELETE FROM messages WHERE id = (SELECT min(id) FROM messages WHERE topic_id = ?)", (depth,))
    found = inspect_source(file, Config())
    assert found.mappable
    assert "1 unmatched color" in found.problems


def test_a_tum_folder_and_what_is_wrong_with_it(tmp_path):
    path = tmp_path / "drive"
    write_tum(_drive("rgbd"), path)
    text = _inspect(str(path))
    assert "uses odometry: odometry.txt" in text
    assert "RGB-D, 32x24 pixels" in text
    (path / "odometry.txt").rename(path / "odometry_b.txt")
    text = _inspect(str(path))
    assert "mappable: no, because" in text
    assert "odometry_b.txt" in text
    assert _inspect(str(path), "--odometry-file", "odometry_b.txt").rstrip().endswith("mappable: yes")
    (path / "camera.yaml").unlink()
    assert "problem: camera.yaml: no calibration and mounting" in _inspect(str(path))


def test_a_velocity_table(tmp_path):
    path = tmp_path / "drive.csv"
    path.write_text("stamp_s,v_m_s,omega_rad_s\n1,0.1,0\n2,0.1,0\n3,0.1,0\n10,0.1,0\n")
    text = _inspect(str(path))
    assert "velocities" in text
    assert "dead reckoning" in text
    assert "nothing for 7.00 s, 2.0 s after its beginning" in text


@pytest.mark.parametrize("world", ["lab", "campus"])
def test_a_world_can_be_mapped_with_its_own_sensors(world):
    assert json.loads(_inspect(world, "--json"))["mappable"]


def test_a_world():
    text = _inspect("office")
    assert "simulated world" in text
    assert text.rstrip().endswith("mappable: yes")


def test_what_cannot_be_opened_is_an_error(tmp_path):
    (tmp_path / "cut.bag").write_bytes(b"#ROSBAG V2.0\n")
    for name in ("cut.bag", "missing.mcap"):
        with pytest.raises(StreamError, match=name):
            inspect_source(tmp_path / name, Config())


@pytest.mark.data
def test_a_foreign_bag_without_scans_or_pictures(data_dir):
    found = inspect_source(data_dir / "real/bags/evo_nav2_turtlebot.mcap", Config())
    counts = {part.name: part.count for part in found.parts}
    assert counts == {"/amcl_pose": 135, "/odom": 2639, "/tf": 5422, "/tf_static": 1}
    assert found.mappable
    assert found.uses == {"odometry": "/odom"}
    assert any("self-motion alone" in remark for remark in found.remarks)


@pytest.mark.parametrize(
    ("source", "option"),
    [("lab", "--scan-topic"), ("drive.csv", "--odometry-topic"), ("drive.csv", "--odometry-file"), ("bag", "--odometry-file")],
)
def test_an_option_that_does_not_fit_the_source_is_refused(laser_bag, tmp_path, source, option):
    (tmp_path / "drive.csv").write_text("stamp_s,v_m_s,omega_rad_s\n0,1,0\n")
    named = {"lab": "lab", "bag": str(laser_bag)}.get(source, str(tmp_path / source))
    with pytest.raises(ConfigError, match=f"^{option}: is for a"):
        CliRunner().invoke(app, ["inspect", named, option, "x"], catch_exceptions=False)


def test_a_name_that_is_not_utf_8_is_printed_with_its_bytes_as_numbers(laser_bag, tmp_path):
    path = tmp_path / os.fsdecode(b"drive\xff.bag")
    path.write_bytes(laser_bag.read_bytes())
    command = [sys.executable, "-c", "from hybridmap.cli import main; main()"]
    environment = {**os.environ, "PYTHONIOENCODING": "utf-8:strict"}
    for arguments in (["inspect", path], ["map", path, "--out", tmp_path / "session", "--end", "0.3", "--json"]):
        done = subprocess.run([*command, *arguments], capture_output=True, env=environment, timeout=60)
        assert done.returncode == 0, done.stderr
    assert "drive" in (tmp_path / "session" / "report.html").read_text(encoding="utf-8")
