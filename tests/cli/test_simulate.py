"""`hybridmap simulate`: formats by suffix, one JSON object, refusals."""

from __future__ import annotations

import json
import sys

import pytest

from hybridmap.cli import main
from hybridmap.config import Config
from hybridmap.evaluate.association import travel
from hybridmap.simulation import world_names
from hybridmap.streams import open_stream
from hybridmap.streams.base import SelfMotion
from hybridmap.streams.laser import LaserScan
from tests.narrowing import known

SHORT = ["--duration", "1", "--set", "simulation.camera.width_px=32", "--set", "simulation.camera.height_px=24"]


@pytest.fixture
def run(monkeypatch, capsys):
    def call(*arguments: str) -> tuple[str | int | None, str, str]:
        monkeypatch.setattr(sys, "argv", ["hybridmap", *arguments])
        with pytest.raises(SystemExit) as stopped:
            main()
        shown = capsys.readouterr()
        return stopped.value.code, shown.out, shown.err

    return call


@pytest.mark.parametrize(("name", "expected"), [("a.bag", "rosbag1"), ("a.mcap", "mcap"), ("a.db3", "db3"), ("a", "tum")])
def test_the_suffix_chooses_the_format(run, tmp_path, name, expected):
    code, out, _ = run("simulate", "corridor", "--out", str(tmp_path / name), "--json", *SHORT)
    assert code == 0
    shown = json.loads(out)
    figures = {row["name"]: row["value"] for row in shown["metrics"]}
    assert (shown["format"], shown["world"], shown["seed"]) == (expected, "corridor", 0)
    assert figures["duration/simulation"] == pytest.approx(1.0)
    assert 0 < figures["ate_rmse/odometry"] < 0.1
    assert open_stream(tmp_path / name, Config()).expected_observations == 6


def test_a_named_format_makes_a_bag_folder(run, tmp_path):
    code, out, err = run("simulate", "corridor", "--out", str(tmp_path / "bag"), "--format", "mcap", *SHORT)
    assert (code, err) == (0, "")
    assert "travel/simulation" in out
    assert sorted(file.name for file in (tmp_path / "bag").iterdir()) == ["bag.mcap", "metadata.yaml"]


def test_a_clock_offset_reaches_the_recording(run, tmp_path):
    arguments = ["--set", "simulation.sensors=laser", "--duration", "3", "--clock-offset", "0.25"]
    assert run("simulate", "corridor", "--out", str(tmp_path / "late.mcap"), *arguments)[0] == 0
    samples = list(open_stream(tmp_path / "late.mcap", Config()))
    first = {type(sample): sample.stamp_ns for sample in reversed(samples)}
    assert first[LaserScan] - first[SelfMotion] == 250_000_000


def test_settings_and_seed_reach_the_stream(run, tmp_path):
    for seed in ("1", "2"):
        code, _, _ = run(
            *("simulate", "corridor", "--out", str(tmp_path / f"{seed}.bag"), "--seed", seed, "--duration", "1"),
            *("--set", "simulation.sensors=laser", "--set", "simulation.laser.beams=90"),
        )
        assert code == 0
    scans = [
        [sample.ranges_m for sample in open_stream(tmp_path / f"{seed}.bag", Config()) if isinstance(sample, LaserScan)]
        for seed in ("1", "2")
    ]
    assert scans[0][0].shape == (90,)
    assert (scans[0][0] != scans[1][0]).any()


@pytest.mark.parametrize(
    ("arguments", "expected"),
    [
        (["atlantis"], "atlantis: no such world; worlds: lab, office, corridor, corridor-landmarks, campus"),
        (["corridor", "--duration", "-1"], "simulation.duration_s"),
        (["corridor", "--set", "simulation.sensors=sonar"], "simulation.sensors"),
        (["corridor", "--set", "simulation.sensors=laser"], "no camera; write a bag"),
        (["corridor", "--format", "avi"], "avi"),
    ],
)
def test_bad_input_is_one_line_and_leaves_nothing(run, tmp_path, arguments, expected):
    code, out, err = run("simulate", *arguments, "--out", str(tmp_path / "new"))
    assert (code, out) == (2, "")
    assert err.startswith("hybridmap: error: ")
    assert err.count("\n") == 1
    assert expected in err
    assert not list(tmp_path.iterdir())


def test_it_refuses_to_overwrite(run, tmp_path):
    arguments = ["simulate", "corridor", "--out", str(tmp_path / "a.bag"), *SHORT]
    assert run(*arguments)[0] == 0
    code, _, err = run(*arguments)
    assert code == 2
    assert "--overwrite" in err
    assert run(*arguments, "--overwrite")[0] == 0


def test_help_names_every_world(run):
    text = " ".join(run("simulate", "--help")[1].split())
    assert all(name in text for name in world_names())


def test_kidnap_says_when_and_how_far(run, tmp_path):
    small = ["--set", "simulation.camera.width_px=32", "--set", "simulation.camera.height_px=24"]
    rare = ["--set", "simulation.camera.rate_hz=0.5"]
    code, out, _ = run("simulate", "lab", "--kidnap", "--out", str(tmp_path / "t"), "--json", *rare, *small)
    assert code == 0
    values = {row["name"]: row["value"] for row in json.loads(out)["metrics"]}
    assert values["carried/simulation"] > 5
    truth = known(open_stream(tmp_path / "t", Config()).groundtruth)
    since_s = truth.stamps_s - truth.stamps_s[0]
    on_floor = (since_s < values["picked_up/simulation"], since_s > values["put_down/simulation"])
    driven_m = sum(travel(truth.poses[part])[-1] for part in on_floor)
    assert values["travel/simulation"] == pytest.approx(driven_m, abs=0.2)
    assert values["picked_up/simulation"] < values["put_down/simulation"] < values["duration/simulation"]
    code, out, err = run("simulate", "lab", "--kidnap", "--out", str(tmp_path / "short"), *SHORT)
    assert (code, out) == (2, "")
    assert "carried_m" in err
    assert not (tmp_path / "short").exists()
