"""What developers run: the picture, and the page of results."""

import importlib
import json
import subprocess
import sys
from pathlib import Path

import cv2
import numpy as np
import pytest

from hybridmap.graph.io import write_g2o
from hybridmap.metrics import Metric, to_json
from tests.backends.graphs_for_tests import laps
from tests.narrowing import known
from tests.store.sessions import ring_map, write_session

ROOT = Path(__file__).resolve().parents[1]


@pytest.fixture(autouse=True)
def tools_on_path(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.syspath_prepend(str(ROOT / "tools"))


def test_picture_of_a_session(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    figures = importlib.import_module("figures")
    session = write_session(tmp_path / "session", ring_map(1.2))
    figures.draw(session, tmp_path / "images" / "picture.png")
    picture = known(cv2.imread(str(tmp_path / "images" / "picture.png")))
    assert picture.shape[1] > 1000
    assert picture.min() < 100 < 250 < picture.max()
    assert "picture.png" in capsys.readouterr().out


def test_page_of_results_is_what_was_recorded() -> None:
    results = importlib.import_module("results")
    found = json.loads((ROOT / "docs" / "results.json").read_text())
    assert (ROOT / "docs" / "results.md").read_text() == results.page(found)
    readme = (ROOT / "README.md").read_text()
    assert results.with_headlines(readme, found) == readme
    assert "fr079" in readme


def test_figures_are_held_against_their_bars(tmp_path: Path) -> None:
    results, studies = importlib.import_module("results"), importlib.import_module("result_studies")
    step = studies.Step("hybridmap map x", (studies.Figure("ate_rmse/PRIMARY", 0.2), studies.Figure("nodes")), same_graph=True)
    output = {
        "primary_backend": "gtsam-lm",
        "graph_hash": "b",
        "metrics": [
            {"name": "ate_rmse/gtsam-lm", "value": 0.3, "unit": "m"},
            {"name": "nodes", "value": None, "unit": "1"},
        ],
    }
    done = subprocess.CompletedProcess([], 0, json.dumps(output), "")
    rows = results.read(step, done, 1.0, ["a"])
    assert [(row["value"], row["passed"]) for row in rows] == [("0.3", False), ("–", None), ("no", False)]
    assert results.table_line(rows[0]) == "| `ate_rmse/gtsam-lm` | 0.3 | m | <= 0.2 ✗ missed |"
    with pytest.raises(SystemExit, match="gave no figure"):
        results.read(studies.Step("x", (studies.Figure("other"),)), done, 1.0, [])


def test_a_command_s_own_bars_are_taken_with_their_side(tmp_path: Path) -> None:
    results, studies = importlib.import_module("results"), importlib.import_module("result_studies")
    metrics = [
        Metric("speed", 7.5, "1", "of the baseline; at least 8", 8.0, False),
        Metric("error", 0.1, "m", "largest; at most 0.2", 0.2, True),
        Metric("unjudged", 3.0, "m", "only shown"),
    ]
    done = subprocess.CompletedProcess([], 1, to_json({}, metrics), "")
    rows = results.read(studies.Step("python tools/bench.py", own_bars=True), done, 1.0, [])
    assert [results.table_line(row) for row in rows] == [
        "| `speed` | 7.5 |  | >= 8 ✗ missed |",
        "| `error` | 0.1 | m | <= 0.2 ✓ |",
    ]


def test_results_names_its_studies() -> None:
    said = subprocess.run([sys.executable, ROOT / "tools" / "results.py", "--list"], capture_output=True, text=True, check=True)
    assert "demo: The demo" in said.stdout


def test_a_bar_has_a_side() -> None:
    barred, results, studies = (importlib.import_module(name) for name in ("barred", "results", "result_studies"))
    few, many = barred.at_least("speed/x", np.float64(14.0), 15.0, "times"), barred.at_most("cost/x", 1.2, 1.15, "of bare")
    assert not few.passed
    assert not many.passed
    assert barred.at_least("speed/x", 15.0, 15.0, "times").passed
    assert barred.at_most("cost/x", 1.15, 1.15, "of bare").passed
    written = json.loads(to_json({}, [few, many]))["metrics"]
    rows = [results.own_row(studies.Step("x", own_bars=True), metric) for metric in written]
    assert [results.table_line(row) for row in rows] == [
        "| `speed/x` | 14 |  | >= 15 ✗ missed |",
        "| `cost/x` | 1.2 |  | <= 1.15 ✗ missed |",
    ]


def test_the_study_of_false_loops_gives_its_table_as_figures(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    study = importlib.import_module("false_loop_study")
    graph, truth = laps(np.random.default_rng(0), nodes=90, per_lap=30)
    write_g2o(tmp_path / "laps.g2o", graph, truth)
    words = ["--seeds", "2", "--shares", "0.1", "--modes", "random", "--backends", "gtsam-lm", "gtsam-gnc", "--json"]
    monkeypatch.setattr(sys, "argv", ["false_loop_study", str(tmp_path / "laps.g2o"), *words])
    study.main()
    printed = capsys.readouterr()
    found = {metric["name"]: metric["value"] for metric in json.loads(printed.out)["metrics"]}
    assert found["ate_max/gtsam-gnc-random-10%"] < 0.05 < found["ate_median/gtsam-lm-random-10%"]
    assert found["within_5_cm/gtsam-gnc-random-10%"] == 2
    assert found["false_kept/gtsam-lm-random-10%"] >= 5
    assert found["true_lost/gtsam-lm-random-10%"] == 0.0
    assert "gtsam-gnc" in printed.err


def test_size_counts_lines_importers_and_settings(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    size = importlib.import_module("size")
    texts = {
        "hybridmap/__init__.py": "from hybridmap.alone import x\n",
        "hybridmap/alone.py": "x = 1\n\ny = 2\n",
        "hybridmap/shared.py": "",
        "hybridmap/cli/one.py": "from hybridmap import shared\n",
        "hybridmap/cli/two.py": "def later():\n    import hybridmap.shared\n",
        "tools/one.py": "\n",
    }
    for name, text in texts.items():
        (tmp_path / name).parent.mkdir(parents=True, exist_ok=True)
        (tmp_path / name).write_text(text)
    files = {size.name_of(path, tmp_path): path for path in (tmp_path / "hybridmap").rglob("*.py")}
    assert size.importers(files) == {
        "hybridmap.alone": {"hybridmap"},
        "hybridmap.shared": {"hybridmap.cli.one", "hybridmap.cli.two"},
    }
    size.main(tmp_path)
    lines = capsys.readouterr().out.splitlines()
    assert lines[:4] == [
        "hybridmap: 7 lines, 6 of them not blank",
        "tools: 1 lines, 0 of them not blank",
        "modules: 4, with the packages themselves 5",
        "modules outside cli/ with a single importer: 1",
    ]
    assert lines[-1] == "  hybridmap.alone"


def test_walk_sees_the_files_of_each_node() -> None:
    walk = importlib.import_module("walk")
    overrides = {"simulation.sensors": "laser", "vision.sensor": "laser"}
    visited = walk.walk("sim:corridor", 6.0, ROOT / "hybridmap", overrides)
    assert len(visited) > 3
    assert all({"mapper.py", "neural/grid.py", "vision/laser/front_end.py"} <= files for files in visited[1:])
