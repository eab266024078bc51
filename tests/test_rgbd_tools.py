"""What the RGB-D studies say about a drive."""

import importlib
from pathlib import Path

import numpy as np
import pytest

from hybridmap.config import Config
from hybridmap.graph.edges import EdgeKind
from hybridmap.streams.base import SelfMotion
from hybridmap.streams.rgbd import RgbdFrame

ROOT = Path(__file__).resolve().parents[1]


@pytest.fixture(autouse=True)
def tools_on_path(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.syspath_prepend(str(ROOT / "tools"))


@pytest.fixture(scope="module")
def short_drive():
    with pytest.MonkeyPatch.context() as patch:
        patch.syspath_prepend(str(ROOT / "tools"))
        runs = importlib.import_module("mapping_runs")
        config = Config.load("lab", {"simulation.duration_s": 5.0, "backends.names": ["gtsam-gnc"]})
        return runs, runs.map_in_memory("lab", config)


def test_a_drive_in_memory_has_its_track_its_costs_and_its_errors(short_drive):
    runs, run = short_drive
    assert run.frames == 26
    assert len(run.track) == len(run.truth)
    assert set(run.cpu_s) >= {"profile", "tracking", "matching", "neural", "graph", "rest", "backend/gtsam-gnc"}
    assert run.ate_m("gtsam-gnc") < 0.1
    edges = runs.edge_errors(run, EdgeKind.REGISTRATION)
    assert len(edges.numbers) == len(edges.trans_m) == len(edges.rot_deg) == len(edges.chi2) > 5
    assert 0 < np.median(edges.trans_m) < 0.02


def test_figures_of_a_drive_are_held_against_their_bars(short_drive):
    study = importlib.import_module("rgbd_study")
    figures = study.figures_of(short_drive[1])
    assert figures["false"] == 0
    assert np.isnan(figures["recall"])  # it never comes back
    assert figures["ms_frame"] == pytest.approx(sum(v for k, v in figures.items() if k.startswith("ms_") and k != "ms_frame"))
    lines = study.table([("lab", 1, {**figures, "ate_gtsam-gnc": 0.03, "edge_p95_cm": 7.0, "chi2_loop": 0.4, "recall": 0.9})])
    by_name = {line.split(" | ")[0].strip("| "): line for line in lines}
    assert "0.03 ✗ | <= 0.02" in by_name["ate_gtsam-gnc"]
    assert "7 | <= 8" in by_name["edge_p95_cm"]
    assert "0.4 ✗" in by_name["chi2_loop"]
    assert "0.9 | >= 0.85" in by_name["recall"]


def test_a_sweep_says_where_the_map_is_worse_than_odometry():
    sweep = importlib.import_module("threshold_sweep")
    good = sweep.Outcome("12", 30, 2, 1, 0, 0.5, 0.1)
    assert good.harmless
    assert sweep.line(good) == "| 12 | 30 | 2 | 1 | 0 | 0.5000 | 0.1000 |  |"
    worse = sweep.Outcome("4", 30, 2, -1, -1, 0.5, 0.6)
    assert not worse.harmless
    assert sweep.line(worse) == "| 4 | 30 | 2 | ? | ? | 0.5000 | 0.6000 | ✗ worse |"


def test_a_sweep_judges_one_value():
    sweep = importlib.import_module("threshold_sweep")
    config = Config.load("lab", {"simulation.duration_s": 3.0, "backends.names": ["gtsam-gnc"]})
    one = sweep.outcome("lab", config, "12")
    assert (one.loops, one.rejected, one.wrong, one.wrong_kept) == (0, 0, 0, 0)
    assert 0 < one.map_m <= one.odometry_m


def test_a_drive_is_spoilt_the_same_way_each_time_and_as_the_case_says():
    robustness, streams = importlib.import_module("rgbd_robustness"), importlib.import_module("hybridmap.streams.open")
    config = Config.load("lab", {"simulation.duration_s": 3.0})
    clean = list(streams.open_stream("lab", config))
    case = robustness.Case(lost=0.3, range_max_m=2.0, color_noise=10.0, exposure_s=0.05, noise=3.0)
    spoilt = robustness.Spoilt(streams.open_stream("lab", config), case, seed=4)
    once, again = list(spoilt), list(spoilt)
    frames = [(a, b) for a, b in zip(clean, once, strict=True) if isinstance(b, RgbdFrame)]
    assert all(np.array_equal(a.color, b.color) for a, b in zip(once, again, strict=True) if isinstance(a, RgbdFrame))
    for before, after in frames:
        near = (before.depth_m > 0) & (before.depth_m <= 2.0)
        assert after.depth_m.max() <= 2.0
        assert (after.depth_m[near] > 0).mean() == pytest.approx(0.7, abs=0.05)
        assert np.std(after.color.astype(float) - before.color) > 5.0
    motion = [(a, b) for a, b in zip(clean, once, strict=True) if isinstance(b, SelfMotion)]
    assert [a.stamp_ns for a, _ in motion] == [b.stamp_ns for _, b in motion]
    assert not np.array_equal(motion[-1][0].pose_odom_robot, motion[-1][1].pose_odom_robot)
    assert motion[-1][0].pose_odom_robot == pytest.approx(motion[-1][1].pose_odom_robot, abs=0.3)


def test_a_map_worse_than_odometry_and_a_false_edge_miss_their_bars():
    robustness = importlib.import_module("rgbd_robustness")
    figures = {"ate_gtsam-gnc": 0.1, "ate_odometry": 0.3, "false": 0.0}
    assert [m.passed for m in robustness.held("x", figures)] == [True, True]
    assert [m.passed for m in robustness.held("x", {**figures, "ate_odometry": 0.05, "false": 1.0})] == [False, False]
