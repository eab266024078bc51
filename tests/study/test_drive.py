"""Drives as they were mapped: the session's own figures, recordings, disturbances, kidnapping, and bars with an exit code."""

import csv
import json
from pathlib import Path

import pytest
import yaml

from hybridmap import session
from hybridmap.backends.driver import Driver
from hybridmap.cli import main
from hybridmap.config import Config
from hybridmap.errors import BackendError
from hybridmap.evaluate.session_errors import evaluate_session
from hybridmap.geometry import between
from hybridmap.simulation.writers import write_rosbag2
from hybridmap.streams import open_stream
from hybridmap.study.cells import lay_out
from hybridmap.study.folder import BARS_CSV, TIMINGS_CSV
from hybridmap.study.frozen import Frozen
from hybridmap.study.model import StudyConfig
from hybridmap.study.pools import ThisProcess
from hybridmap.study.study import run_study
from tests.narrowing import known

LASER = {"simulation.sensors": "laser", "simulation.world": "lab", "nodes.distance_m": 0.25, "backends.names": ["gtsam-gnc"]}
SECONDS = 12.0
MAPPED_BACKENDS = [{"backend": "odometry", "way": "mapped"}, {"name": "map", "backend": "primary", "way": "mapped"}]


def study_of(*sources, **changes):
    return StudyConfig.from_tree({"name": "drive", "seeds": [2], "sources": [*sources], **changes}, "drive.yaml", Path.cwd())


def figures_of(done):
    return {(cell.setting, cell.seed, cell.backend): result.figures for cell, result in done.rows}


@pytest.fixture(scope="module")
def recording(tmp_path_factory):
    """A drive by laser, and relations of its truth."""
    folder = tmp_path_factory.mktemp("recording")
    stream = open_stream("lab", Config.load("laser", LASER), end_s=SECONDS)
    write_rosbag2(stream, folder / "drive.mcap")
    truth = known(stream.groundtruth)
    stamps = truth.stamps_ns[[0, 100, 200, 300]]
    poses = truth.at(stamps)
    rows = [(stamps[i] / 1e9, stamps[j] / 1e9, *between(poses[i], poses[j])) for i, j in ((0, 1), (1, 2), (0, 3))]
    (folder / "relations.txt").write_text("\n".join(" ".join(f"{value:.9f}" for value in row) for row in rows))
    return folder


@pytest.fixture
def source(recording):
    return {
        "name": "log",
        "recording": str(recording / "drive.mcap"),
        "relations": str(recording / "relations.txt"),
        "overrides": LASER,
    }


def test_a_recording_has_the_figures_of_its_session(recording, source, tmp_path):
    done = run_study(study_of(source), tmp_path / "study", ThisProcess())
    config = Config.load("laser", LASER)
    made = session.run(open_stream(recording / "drive.mcap", config), config, tmp_path / "session")
    told = {m.name: m.value for m in evaluate_session(made.folder.path, relations=recording / "relations.txt")}
    found = figures_of(done)
    assert list(found) == [("default", None, "odometry"), ("default", None, "map")]
    for title, backend in (("odometry", "odometry"), ("map", "gtsam-gnc")):
        figures = found["default", None, title]
        assert figures["ate_m"] == pytest.approx(told[f"ate_rmse/{backend}"], rel=1e-9)
        assert figures["relation_m"] == pytest.approx(told[f"relation_trans_mean/{backend}"], rel=1e-9)
    assert 0.0 < found["default", None, "map"]["ate_m"] < found["default", None, "odometry"]["ate_m"]
    assert found["default", None, "map"]["registration_chi2_ratio"] == pytest.approx(told["edge_chi2_ratio/registration"])
    assert found["default", None, "map"]["nodes"] == made.metrics[0].value
    assert done.head["status"] == {"mapped": 2}
    timings = list(csv.DictReader((tmp_path / "study" / TIMINGS_CSV).open()))
    assert timings[0]["cpu_s"] == ""
    assert float(timings[1]["cpu_s_per_min"]) == pytest.approx(60.0 * float(timings[1]["cpu_s"]) / SECONDS, rel=0.05)


def test_chance_alone_makes_seeds_of_a_recording_and_results_are_kept(source, tmp_path):
    settings = [{"name": "as it is"}, {"name": "zero", "disturb": {"beams_lost": 0.0}}]
    settings += [{"name": "worse", "disturb": {"beams_lost": 0.3, "wheel_pull_deg_per_m": 5.0}}]
    study = study_of(source, settings=settings, seeds=[2, 3])
    cells = lay_out(study).cells
    assert [(cell.setting, cell.seed) for cell in cells[::2]] == [
        ("as it is", None),
        ("zero", None),
        ("worse", 2),
        ("worse", 3),
    ]
    assert cells[0].key == cells[2].key  # no strength, no disturbance
    assert len({cell.source_key for cell in cells}) == 3
    done = run_study(study, tmp_path, ThisProcess())
    found = figures_of(done)
    odometry = found["worse", 2, "odometry"]
    assert odometry == found["worse", 3, "odometry"] != found["as it is", None, "odometry"]
    assert found["worse", 2, "map"]["ate_m"] != found["worse", 3, "map"]["ate_m"]
    tables = {path.name: path.read_bytes() for path in tmp_path.glob("*.csv")}
    again = run_study(study, tmp_path, ThisProcess())
    assert again.computed == 0
    assert {path.name: path.read_bytes() for path in tmp_path.glob("*.csv")} == tables


def test_other_words_files_or_numbers_make_other_drives(recording, source):
    def keys(changes=None, **setting):
        study = study_of({**source, **(changes or {})}, settings=[{"name": "a", **setting}])
        return {cell.source_key for cell in lay_out(study).cells}

    base = keys()
    assert keys({"name": "other"}) == base
    (recording / "other.txt").write_text((recording / "relations.txt").read_text().replace("0.0", "0.1", 1))
    others = [
        keys({"relations": str(recording / "other.txt")}),
        keys({"end_s": 5.0}),
        keys(overrides={"nodes.angle_deg": 30.0}),
        keys(disturb={"scan_range_m": 3.0}),
        keys(disturb={"scan_range_m": 4.0}),
    ]
    assert len(set.union(base, *others)) == 1 + len(others)


def test_a_drive_whose_back_end_diverges_is_lost_and_has_the_errors_of_odometry(tmp_path):
    backends = {"backends.names": ["relaxation-paper", "gtsam-gnc"], "backends.relaxation.theta": 1.0}
    ways = [*MAPPED_BACKENDS, {"name": "other", "backend": "gtsam-gnc", "way": "mapped"}]
    source = {"simulated": "lab", "config": "laser", "end_s": 60.0, "overrides": {**LASER, **backends}}
    done = run_study(study_of(source, backends=ways, bars=[{"figure": "ate_m", "at_most": 9.0}]), tmp_path, ThisProcess())
    results = {cell.backend: result for cell, result in done.rows}
    lost = results["map"]
    assert (lost.status, lost.lost, lost.figures["verdict"]) == ("diverged", True, 2.0)
    assert lost.message
    assert lost.timings["cpu_s"] > 0.0
    assert lost.figures["ate_m"] == results["odometry"].figures["ate_m"]
    assert known(lost.figures["ate_m"]) > known(results["other"].figures["ate_m"])
    assert (results["other"].status, results["other"].lost) == ("mapped", False)
    assert {verdict.cell.backend for verdict in done.missed} == {"map"}  # who has no map misses every bar


def test_a_back_end_that_fails_on_the_way_ends_no_study(source, tmp_path, monkeypatch):
    update = Driver.update

    def tire(self, graph):
        if graph.n_nodes > 5:
            raise BackendError("a bad\nday")
        return update(self, graph)

    monkeypatch.setattr(Driver, "update", tire)
    monkeypatch.setattr(Driver, "finish", tire)
    done = run_study(study_of(source), tmp_path, ThisProcess())
    results = {cell.backend: result for cell, result in done.rows}
    assert (results["map"].status, results["map"].message, results["map"].lost) == ("failed", "a bad day", True)
    assert results["map"].figures["relation_m"] == results["odometry"].figures["relation_m"]
    packed = known(done.folder.frozen(done.grid.cells[0].source_key))
    frozen = Frozen.unpack(packed)
    assert known(frozen.mapped).poses["gtsam-gnc"].shape == (known(frozen.graph).n_nodes, 3)


def test_a_kidnapped_robot_is_watched_until_it_is_found(tmp_path):
    source = {"simulated": "lab", "config": "laser", "overrides": {**LASER, "simulation.carried_m": 3.0}, "seeds": [1]}
    bars = [{"figure": "found_m", "at_most": 1e9}, {"figure": "known_m", "at_most": 5.0}]
    done = run_study(study_of(source, bars=bars), tmp_path, ThisProcess())
    figures = figures_of(done)["default", 1, "map"]
    assert figures["kidnapped_m"] > 1.0
    assert figures["known_m"] < 5.0
    assert "found_m" in figures
    assert "found_m" not in figures_of(done)["default", 1, "odometry"]
    assert {verdict.bar.figure: verdict.passed for verdict in done.verdicts} == {
        "found_m": figures["found_m"] is not None,
        "known_m": True,
    }


def test_a_graph_of_a_drive_goes_to_other_back_ends_as_well(source, tmp_path):
    backends = [*MAPPED_BACKENDS, "gtsam-lm", {"name": "none", "backend": "relaxation-paper", "way": "mapped"}]
    done = run_study(study_of(source, backends=backends), tmp_path, ThisProcess())
    result = {cell.backend: result for cell, result in done.rows}
    assert result["gtsam-lm"].status == "converged"
    assert result["gtsam-lm"].figures["ate_m"] == pytest.approx(result["map"].figures["ate_m"], abs=0.02)
    assert result["none"].status == "failed"
    assert "did not follow the drive" in result["none"].message


def test_a_recording_that_a_worker_lacks_is_tried_again(recording, source, tmp_path):
    grid = lay_out(study_of(source))
    (task,) = grid.sources.values()
    (recording / "drive.mcap").rename(tmp_path / "away.mcap")
    try:
        with pytest.raises(FileNotFoundError, match="at the same path on every worker"):
            task.make()
    finally:
        (tmp_path / "away.mcap").rename(recording / "drive.mcap")


def test_a_missed_bar_is_exit_code_1_and_said(source, tmp_path, monkeypatch, capsys):
    bars = [{"figure": "relation_m", "at_most": "odometry"}, {"figure": "nodes", "at_least": 1000}]
    tree = {"sources": [source], "bars": bars}
    (tmp_path / "study.yaml").write_text(yaml.safe_dump(tree))

    def run(*words):
        monkeypatch.setattr(
            "sys.argv", ["hybridmap", "study", str(tmp_path / "study.yaml"), "--out", str(tmp_path / "out"), *words]
        )
        with pytest.raises(SystemExit) as stopped:
            main()
        return stopped.value.code or 0, capsys.readouterr().out

    code, printed = run("--json")
    rows = {row["name"]: row for row in json.loads(printed)["metrics"]}
    assert code == 1
    assert rows["relation_worst/log/default/map"]["passed"] is True
    assert rows["nodes_worst/log/default/map"]["passed"] is False
    lines = list(csv.DictReader((tmp_path / "out" / BARS_CSV).open()))
    assert [(line["figure"], line["passed"]) for line in lines] == [("relation_m", "yes"), ("nodes", "no")]
    code, printed = run("--set", "bars=[]")
    assert code == 0
    assert "bars:" not in printed
