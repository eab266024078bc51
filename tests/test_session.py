"""Stream -> mapper -> map file."""

from __future__ import annotations

import hashlib
import os
import signal
import subprocess
import sys
import time
from pathlib import Path

import numpy as np
import pytest

from hybridmap import session
from hybridmap.backends.base import SolveStatus
from hybridmap.config import Config
from hybridmap.errors import OutputError, StreamError
from hybridmap.evaluate import evaluate_session
from hybridmap.evaluate.explain import Explainer
from hybridmap.geometry import between
from hybridmap.graph.edges import Proposer, Search, Status
from hybridmap.graph.io import graph_hash
from hybridmap.store import MapStore
from hybridmap.trajectory import read_tum
from hybridmap.vision.laser.front_end import LaserFrontEnd
from tests.streams_for_tests import RoomDrive

OVERRIDES = {"backends.names": ["gtsam-gnc", "relaxation-ratslam", "odometry"]}


def digests(folder: Path) -> dict[str, str]:
    return {path.name: hashlib.sha256(path.read_bytes()).hexdigest() for path in sorted((folder / "trajectory").iterdir())}


@pytest.fixture(scope="module")
def finished(tmp_path_factory):
    out = tmp_path_factory.mktemp("session") / "s"
    return session.run(RoomDrive(laps=2.2), Config.load("laser", OVERRIDES), out)


def test_the_folder_holds_what_is_promised(finished):
    names = {path.relative_to(finished.folder.path).as_posix() for path in finished.folder.path.rglob("*") if path.is_file()}
    trajectories = {f"trajectory/{name}.tum" for name in ("odometry", "gtsam-gnc", "relaxation-ratslam")}
    trajectories |= {f"trajectory/{name}_online.tum" for name in ("odometry", "gtsam-gnc", "relaxation-ratslam")}
    assert names == {"map.db", "config.yaml", "metrics.json", "reference/groundtruth.tum"} | trajectories


def test_the_file_gives_back_the_map(finished):
    with MapStore.open(finished.folder.path) as store:
        assert graph_hash(store.map()) == finished.head["graph_hash"]
        assert set(store.solutions()) == set(OVERRIDES["backends.names"])
        assert "ranges_m" in store.keyframe(0)
        assert set(store.snapshot(0)) >= {"grid_phases", "heading"}
        phases = store.grid_phases()
        assert phases.shape == (len(store.map()), 8, 2)
        np.testing.assert_array_equal(phases[-1], store.snapshot(len(phases) - 1)["grid_phases"])


def test_the_words_of_a_figure_hold_for_every_back_end(finished):
    words = {metric.name: metric.description for metric in finished.metrics}
    said = {words["chi2/gtsam-gnc"], words["chi2/relaxation-ratslam"]}
    assert len(said) == 1
    assert not [status for status in SolveStatus if any(status in text for text in said)]


def test_each_accepted_loop_counts_for_what_proposed_it(finished):
    count = {metric.name: metric.value for metric in finished.metrics}
    by = {who: count[f"loops_proposed_by/{who}"] for who in ("profile", "proximity", "global")}
    assert sum(by.values()) == count["loops_accepted"]
    assert by["profile"] > 0
    with MapStore.open(finished.folder.path) as store:
        loops = [edge.proposed_by for edge in store.map().edges if edge.status is Status.ACCEPTED]
    assert {who: loops.count(Proposer(who)) for who in by} == by


def test_a_pose_for_every_distinct_stamp(finished):
    stamps = sorted({sample.stamp_ns for sample in RoomDrive(laps=2.2)})
    for path in (finished.folder.path / "trajectory").iterdir():
        assert np.array_equal(read_tum(path).stamps_ns, stamps), path.name


def test_the_same_input_gives_the_same_bytes(finished, tmp_path):
    again = session.run(RoomDrive(laps=2.2), Config.load("laser", OVERRIDES), tmp_path / "s")
    assert again.head["graph_hash"] == finished.head["graph_hash"]
    assert digests(tmp_path / "s") == digests(finished.folder.path)


def test_at_the_stamp_of_a_node_the_frame_is_that_of_the_node(finished):
    with Explainer(finished.folder.path) as explainer:
        for number in (0, 1, 5, 20):
            story = explainer.frame(explainer.node(number).time_s)
            assert (story.at_node, story.made) == (number, True)
            assert story.moved == pytest.approx((0.0, 0.0), abs=1e-12)


def test_an_accepted_loop_shows_no_figure_that_would_have_refused_it(finished):
    with MapStore.open(finished.folder.path) as store:
        loops = [edge for edge in store.map().edges if edge.search is Search.NEAR and edge.status is Status.ACCEPTED]
    assert loops
    assert not any(edge.failed for edge in loops)
    assert all("ambiguity" in edge.figures for edge in loops)


def test_scans_between_nodes_are_put_right_on_the_final_map(finished, tmp_path):
    off = session.run(
        RoomDrive(laps=2.2), Config.load("laser", OVERRIDES | {"vision.laser.dense_trajectory": False}), tmp_path / "s"
    )
    truth = RoomDrive(laps=2.2).groundtruth
    error = {}
    for name, run in (("on", finished), ("off", off)):
        estimate = read_tum(run.folder.trajectory / "gtsam-gnc.tum")
        step = between(between(truth.poses[:-2], truth.poses[2:]), between(estimate.poses[:-2], estimate.poses[2:]))
        error[name] = np.sqrt((step[:, 2] ** 2).mean())
    assert error["on"] < 0.8 * error["off"]
    assert "cpu_s/retrace" in {m.name for m in finished.metrics}
    with MapStore.open(finished.folder.path) as store, MapStore.open(off.folder.path) as bare:
        assert len(store.track().anchors) > 0.9 * (len(truth) // 2)
        assert len(bare.track().anchors) == 0
    dead_reckoning = [(run.folder.trajectory / "odometry.tum").read_bytes() for run in (finished, off)]
    assert dead_reckoning[0] == dead_reckoning[1]


def test_a_drive_that_ends_lost_says_so(tmp_path, monkeypatch):
    lost = session.run(RoomDrive(laps=0.2), Config.load("laser", OVERRIDES), tmp_path / "known")
    assert (lost.head["verdict"], lost.head["reasons"]) == ("trusted", [])
    monkeypatch.setattr(LaserFrontEnd, "lost_since", 3)
    lost = session.run(RoomDrive(laps=0.2), Config.load("laser", OVERRIDES), tmp_path / "lost")
    assert lost.head["verdict"] == "doubtful"
    assert [(reason["kind"], reason["node"]) for reason in lost.head["reasons"]] == [("not localised", 3)]


def test_a_session_is_not_overwritten_by_chance_but_on_demand(tmp_path):
    config = Config.load("laser", {"vision.sensor": "none"})
    session.run(RoomDrive(laps=0.2, with_scans=False), config, tmp_path / "s")
    with pytest.raises(OutputError, match="overwrite"):
        session.run(RoomDrive(laps=0.2, with_scans=False), config, tmp_path / "s")
    (tmp_path / "s" / "notes.txt").write_text("mine")
    session.run(RoomDrive(laps=0.4, with_scans=False), config, tmp_path / "s", overwrite=True)
    assert (tmp_path / "s" / "notes.txt").read_text() == "mine"


def test_an_error_before_the_first_node_leaves_nothing_behind_and_loses_nothing(tmp_path):
    config = Config.load("laser", {"vision.sensor": "none"})
    with pytest.raises(StreamError, match="NaN"):
        session.run(RoomDrive(laps=0.5, nan_at=0), config, tmp_path / "new")
    assert not (tmp_path / "new").exists()
    kept = session.run(RoomDrive(laps=0.2, with_scans=False), config, tmp_path / "old").head["graph_hash"]
    with pytest.raises(StreamError, match="NaN"):
        session.run(RoomDrive(laps=0.5, nan_at=0), config, tmp_path / "old", overwrite=True)
    with MapStore.open(tmp_path / "old") as store:
        assert graph_hash(store.map()) == kept


def test_an_error_late_in_a_drive_keeps_what_was_mapped_and_the_session_before(tmp_path, caplog):
    config = Config.load("laser", {"vision.sensor": "none"})
    kept = session.run(RoomDrive(laps=0.2, with_scans=False), config, tmp_path / "s").head["graph_hash"]
    with pytest.raises(StreamError, match="NaN"):
        session.run(RoomDrive(laps=0.5, nan_at=50), config, tmp_path / "s", overwrite=True)
    assert "--resume" in caplog.text
    assert f"{tmp_path}/s/.previous" in caplog.text
    with MapStore.open(tmp_path / "s") as store:
        assert len(store.map()) > 3
        assert not store.ended
        assert "NaN" in store.broken_off
    with MapStore.open(tmp_path / "s" / ".previous") as store:
        assert graph_hash(store.map()) == kept
    caplog.clear()
    evaluate_session(tmp_path / "s")
    assert "broken off (odometry at stamp 5.000" in caplog.text


class Interrupted(RoomDrive):
    """A drive during which the user presses Ctrl-C."""

    def __iter__(self):
        for i, sample in enumerate(super().__iter__()):
            if i > 60:
                raise KeyboardInterrupt
            yield sample


def test_breaking_off_an_overwrite_brings_the_old_session_back(tmp_path):
    config = Config.load("laser", {"vision.sensor": "none"})
    kept = session.run(RoomDrive(laps=0.2, with_scans=False), config, tmp_path / "s").head["graph_hash"]
    with pytest.raises(KeyboardInterrupt):
        session.run(Interrupted(), config, tmp_path / "s", overwrite=True)
    with MapStore.open(tmp_path / "s") as store:
        assert graph_hash(store.map()) == kept
    with pytest.raises(KeyboardInterrupt):
        session.run(Interrupted(), config, tmp_path / "new")
    with MapStore.open(tmp_path / "new") as store:
        assert len(store.map()) > 1


class TooLarge(RoomDrive):
    """A drive during which the memory gives out."""

    def __iter__(self):
        for i, sample in enumerate(super().__iter__()):
            if i > 60:
                raise MemoryError
            yield sample


def test_a_failure_of_any_kind_keeps_what_was_mapped(tmp_path):
    with pytest.raises(MemoryError):
        session.run(TooLarge(), Config.load("laser", {"vision.sensor": "none"}), tmp_path / "s")
    with MapStore.open(tmp_path / "s") as store:
        assert len(store.map()) > 3
        assert store.broken_off == "MemoryError"


def test_nothing_to_map_is_said():
    class Empty(RoomDrive):
        def __iter__(self):
            return iter(())

    with pytest.raises(StreamError, match="nothing to map"):
        session.run(Empty(), Config.load("laser"), Path("never-made"))
    assert not Path("never-made").exists()


def test_a_killed_run_leaves_a_readable_map(tmp_path):
    script = (
        "import sys, time\n"
        "from pathlib import Path\n"
        "from hybridmap import session\n"
        "from hybridmap.config import Config\n"
        "from tests.streams_for_tests import RoomDrive\n"
        "class Slow(RoomDrive):\n"
        "    def __iter__(self):\n"
        "        for i, sample in enumerate(super().__iter__()):\n"
        "            if i > 120: print('there', flush=True); time.sleep(60)\n"
        "            yield sample\n"
        "session.run(Slow(), Config.load('laser'), Path(sys.argv[1]))\n"
    )
    process = subprocess.Popen(
        [sys.executable, "-c", script, str(tmp_path / "s")], stdout=subprocess.PIPE, cwd=Path(__file__).parents[1]
    )
    assert process.stdout is not None
    assert process.stdout.readline() == b"there\n"
    time.sleep(0.1)
    os.kill(process.pid, signal.SIGKILL)
    process.wait()
    with MapStore.open(tmp_path / "s") as store:
        assert len(store.map()) >= 3
        assert not store.ended
    assert "ate_rmse/odometry" in {metric.name for metric in evaluate_session(tmp_path / "s")}
