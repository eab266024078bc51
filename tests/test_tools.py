"""What developers run: the picture, and the page of results."""

import json
import subprocess
import sys
import tomllib
from pathlib import Path
from typing import Any

import barred
import cv2
import figures
import kidnappings
import numpy as np
import pytest
import result_studies as studies
import results
import verdict_table
from packaging.requirements import Requirement

from hybridmap.metrics import Metric, to_json
from tests.narrowing import known
from tests.store.sessions import ring_map, write_session

ROOT = Path(__file__).resolve().parents[1]


def test_picture_of_a_session(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    session = write_session(tmp_path / "session", ring_map(1.2))
    figures.draw(session, tmp_path / "images" / "picture.png")
    picture = known(cv2.imread(str(tmp_path / "images" / "picture.png")))
    assert picture.shape[1] > 1000
    assert picture.min() < 100 < 250 < picture.max()
    assert "picture.png" in capsys.readouterr().out


def test_a_carried_robot_is_a_row() -> None:
    row = kidnappings.drive("lab", "laser", 1.0, seed=1)
    assert row["kidnapped"] == str(row["node"])
    assert row["right"]
    assert not row["silent"]


def row(results: Any, **changes: str) -> dict[str, str]:
    """A line of the record."""
    given = {
        "topic": "x",
        "command": "c",
        "figure": "ate_m/a",
        "unit": "m",
        "values": "0.1 0.3",
        "median": "0.2",
        "worst": "0.3",
    }
    return given | {"side": "at most", "bar": "0.5", "passed": "yes", "day": "2026-11-30", "machine": "m"} | changes


def test_page_of_results_is_what_was_recorded() -> None:
    found = results.recorded()
    text = (ROOT / "docs" / "results.md").read_text()
    assert text == results.page(found)
    assert len(text.splitlines()) <= 160  # three screens
    readme = (ROOT / "README.md").read_text()
    assert results.with_headlines(readme, found) == readme
    assert "fr079" in readme


def test_every_topic_is_on_the_page_and_every_question_finds_its_figures() -> None:
    topics = {topic.name: topic for topic in studies.TOPICS}
    assert {name for names in studies.PARTS.values() for name in names} == set(topics)
    assert {found["topic"] for found in results.recorded()} <= set(topics)
    for name, topic in topics.items():
        rows = [found for found in results.recorded() if found["topic"] == name]
        assert all(any(results.is_of(found, question) for found in rows) for question in topic.questions if rows), name


def test_a_command_s_figures_are_held_against_the_bars_they_are_given(tmp_path: Path) -> None:
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
    rows = results.read(step, done, 1.0, ["a"], tmp_path)
    assert [(found["figure"], found["worst"], found["passed"]) for found in rows] == [
        ("ate_rmse/gtsam-lm", "0.3", "no"),
        ("nodes", "", ""),
        ("same_graph", "0", "no"),
    ]
    with pytest.raises(SystemExit, match="gave no figure"):
        results.read(studies.Step("x", (studies.Figure("other"),)), done, 1.0, [], tmp_path)


def test_a_command_s_own_bars_are_taken_with_their_side(tmp_path: Path) -> None:
    metrics = [
        barred.at_least("speed", np.float64(7.5), 8.0, "of the baseline"),
        barred.at_most("error", 0.1, 0.2, "largest", "m"),
        Metric("unjudged", 3.0, "m", "only shown"),
    ]
    done = subprocess.CompletedProcess([], 1, to_json({}, metrics), "")
    rows = results.read(studies.Step("python tools/bench.py", own_bars=True), done, 1.0, [], tmp_path)
    assert [(found["figure"], found["side"], found["bar"], found["passed"]) for found in rows] == [
        ("speed", "at least", "8", "no"),
        ("error", "at most", "0.2", "yes"),
    ]


def test_a_study_s_bars_are_taken_with_the_value_of_every_seed(tmp_path: Path) -> None:
    (tmp_path / "s").mkdir()
    columns = (
        "source,setting,false_loop_kind,false_loop_rate,backend,figure,unit,statistic,value,side,bar,passed,median,worst,values"
    )
    lines = ["intel,default,random,0.1,gnc,ate_m,m,worst,0.3,at most,0.5,yes,0.2,0.3,0.1 0.3"]
    lines += ["intel,default,random,0.1,gnc,ate_m,m,median,0.2,at most,0.1,no,0.2,0.3,0.1 0.3"]
    (tmp_path / "s" / "bars.csv").write_text("\n".join([columns, *lines]) + "\n")
    step = studies.Step("hybridmap study s --out s", study="s", own_bars=True)
    rows = results.read(step, subprocess.CompletedProcess([], 1, to_json({}, []), ""), 1.0, [], tmp_path)
    assert [found["figure"] for found in rows] == [
        "ate_m/intel/default/random 10 %/gnc",
        "ate_m median/intel/default/random 10 %/gnc",
    ]
    assert [(found["values"], found["worst"], found["passed"]) for found in rows] == [
        ("0.1 0.3", "0.3", "yes"),
        ("0.1 0.3", "0.2", "no"),
    ]


def test_a_question_has_one_line_with_the_median_and_the_worst_of_its_figures() -> None:
    one, other = row(results), row(results, figure="ate_m/b", values="0.2 0.4 -", worst="0.4")
    assert results.line("ATE", [one, other]) == "| ATE | 5 | 0.25 m | 0.4 m | <= 0.5 m | ✓ |"
    missed = row(results, bar="0.2", passed="no")
    assert results.line("ATE", [one, missed]) == "| ATE | 4 | 0.2 m | 0.3 m | <= its own; at worst 150 % of it | ✗ 1 missed |"
    lower = row(results, side="at least", bar="0.05", worst="0.1")
    assert results.line("ATE", [one, lower]) == "| ATE | 2 | 0.2 m | 0.3 m | >= 0.05 m, <= 0.5 m | ✓ |"
    mean = row(results, figure="ate_m mean/a", median="0.2", worst="0.2", unit="1")
    assert results.line("ATE", [mean]) == "| ATE | 1 |  | 0.2 | <= 0.5 | ✓ |"
    assert results.line("ATE", [row(results, values="0.3", bar="", passed="", side="")]) == "| ATE | 1 |  | 0.3 m |  |  |"


def test_results_names_its_topics() -> None:
    said = subprocess.run([sys.executable, ROOT / "tools" / "results.py", "--list"], capture_output=True, text=True, check=True)
    assert "demo: hybridmap demo --out demo" in said.stdout


def test_table_of_verdicts(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    head = "source,setting,false_loop_kind,false_loop_rate,seed,backend,ate_m,verdict\n"
    rows = ["lab,clean,,0,0,map,0.02,0", "lab,clean,,0,1,map,0.02,1", "lab,worse,,0,0,map,0.07,0", "lab,worse,,0,1,map,,2"]
    (tmp_path / "cells.csv").write_text(head + "\n".join(rows) + "\n")
    assert verdict_table.show(verdict_table.judged(tmp_path)) == 1
    told = capsys.readouterr().out.splitlines()
    assert told[2:4] == ["| right | 2 | 1 | 1 | 0 |", "| wrong | 2 | 1 | 0 | 1 |"]
    assert [line.partition(":")[0] for line in told[4:]] == ["right and doubtful", "wrong and trusted"]


def test_a_clean_map_that_lost_true_loops_is_no_measure() -> None:
    names = ("source", "setting", "backend", "ate_m", "own_lost_percent")
    rows = [("laps", "clean", "lm", "0.1", "0"), ("laps", "clean", "dcs", "0.4", "30"), ("laps", "worse", "dcs", "0.1", "0")]
    clean = verdict_table.clean_errors([dict(zip(names, row, strict=True)) for row in rows])
    assert clean == {("laps", "lm"): 0.1, ("laps", "dcs"): 0.1}


def test_spoilt_tables_are_read_without_a_finding() -> None:
    command = [sys.executable, "tools/mutate.py", "--kind", "csv", "--count", "12"]
    done = subprocess.run(command, cwd=ROOT, capture_output=True, text=True, timeout=120)
    assert done.returncode == 0, done.stdout
    assert done.stdout.splitlines()[-1].split()[:2] == ["csv", "12"]


def test_tested_versions_are_of_all_that_is_needed_and_allowed() -> None:
    lines = (ROOT / "constraints.txt").read_text().splitlines()
    tested = dict(line.lower().split("==") for line in lines if not line.startswith("#"))
    project = tomllib.loads((ROOT / "pyproject.toml").read_text())["project"]
    for text in (*project["dependencies"], *project["optional-dependencies"]["dev"]):
        needed = Requirement(text)
        assert needed.specifier.contains(tested[needed.name.lower()], prereleases=True), text
    bounded = {Requirement(text).name for text in project["dependencies"] if "<" in text}
    assert {"gtsam", "numpy", "open3d", "opencv-python-headless"} <= bounded
