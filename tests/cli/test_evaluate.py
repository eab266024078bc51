from __future__ import annotations

import json
import subprocess
import sys

import pytest

from hybridmap.store import SessionFolder
from tests.store.sessions import ring_map, write_session


def run(*arguments: object) -> subprocess.CompletedProcess[str]:
    command = [sys.executable, "-c", "from hybridmap.cli import main; main()", *map(str, arguments)]
    return subprocess.run(command, capture_output=True, text=True, check=False)


def test_json_is_one_object_and_metrics_json_is_extended(tmp_path):
    session = write_session(tmp_path / "s", ring_map(), keyframes=False)
    done = run("evaluate", tmp_path / "s", "--json")
    assert done.returncode == 0, done.stderr
    tree = json.loads(done.stdout)
    assert tree["primary_backend"] == "gtsam-lm"
    values = {row["name"]: row["value"] for row in tree["metrics"]}
    assert values["ate_rmse/gtsam-lm"] < values["ate_rmse/odometry"]
    stored = SessionFolder(session.path).read_metrics()
    assert {metric.name for metric in stored.metrics} == set(values)
    assert stored.head["graph_hash"] == "0"


@pytest.mark.parametrize("ended", [True, False])
def test_a_page_that_is_missing_is_written(tmp_path, ended):
    """Ctrl-C after the end of a session, while its page is made, leaves a whole session without one."""
    session = write_session(tmp_path / "s", ring_map(), keyframes=False, solve=ended, ended=ended)
    done = run("evaluate", tmp_path / "s")
    assert done.returncode == 0, done.stderr
    assert done.stderr.count("broken off") == (not ended)
    assert "ATE of odometry" in session.report.read_text()


def test_bad_input_is_one_line_and_code_two(tmp_path):
    for arguments in ((tmp_path / "gone",), (tmp_path,)):
        done = run("evaluate", *arguments)
        assert done.returncode == 2
        assert done.stdout == ""
        assert done.stderr.startswith("hybridmap: error: ")
        assert done.stderr.count("\n") == 1


def test_loops_judges_the_candidates_too(tmp_path):
    write_session(tmp_path / "s", ring_map())
    done = run("evaluate", tmp_path / "s", "--loops", "--json")
    assert done.returncode == 0, done.stderr
    values = {row["name"]: row["value"] for row in json.loads(done.stdout)["metrics"]}
    assert values["pair_auc/four-band"] == 0.5  # every view of this session is the same
    assert values["loop_recall/graph"] == 1.0
    assert {metric.name for metric in SessionFolder(tmp_path / "s").read_metrics().metrics} == set(values)


def test_loops_needs_a_truth_and_views(tmp_path):
    blind = write_session(tmp_path / "blind", ring_map(), keyframes=False)
    done = run("evaluate", tmp_path / "blind", "--loops")
    assert (done.returncode, done.stdout) == (2, "")
    assert "hold no views" in done.stderr
    blind.groundtruth.unlink()
    (tmp_path / "relations").write_text("0.0 1.0 0.3 0.0 0.1\n")
    done = run("evaluate", tmp_path / "blind", "--relations", tmp_path / "relations", "--loops")
    assert (done.returncode, done.stdout) == (2, "")
    assert "--reference" in done.stderr
    assert blind.read_metrics().metrics == []


@pytest.mark.parametrize("more", [(), ("--loops",)])
def test_relations_of_another_recording_are_refused_and_nothing_is_kept(tmp_path, more):
    session = write_session(tmp_path / "s", ring_map())
    before = session.metrics_json.read_bytes()
    (tmp_path / "alien.relations").write_text("1000.0 1001.0 0.3 0.0 0.1\n1002.0 1003.0 0.3 0.0 0.1\n")
    done = run("evaluate", tmp_path / "s", "--relations", tmp_path / "alien.relations", *more)
    assert (done.returncode, done.stdout, done.stderr.count("\n")) == (2, "", 1)
    assert "alien.relations: none of its 2 relations lies within the session, 0.000..59.400 s" in done.stderr
    assert session.metrics_json.read_bytes() == before


def test_figures_that_cannot_be_kept_are_shown_with_a_warning(tmp_path):
    session = write_session(tmp_path / "s", ring_map(), keyframes=False)
    session.report.write_text("the page")
    before = session.metrics_json.read_bytes()
    for name in (".metrics.json.partial", ".report.html.partial"):
        (tmp_path / "s" / name).mkdir()  # nothing can be written there, whoever runs the test
    done = run("evaluate", tmp_path / "s", "--json")
    assert done.returncode == 0
    assert "ate_rmse/gtsam-lm" in {row["name"] for row in json.loads(done.stdout)["metrics"]}
    assert "metrics.json: cannot be written: " in done.stderr
    assert "report.html: cannot be written: " in done.stderr
    assert done.stderr.count("\n") == 2
    assert session.metrics_json.read_bytes() == before
    assert session.report.read_text() == "the page"
