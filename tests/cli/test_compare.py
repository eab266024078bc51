"""`hybridmap compare`: one table, one referee, and a back-end that fails is a row."""

import json
import logging
import sys
from dataclasses import replace

import numpy as np
import pytest

from hybridmap.backends import comparison, odometry
from hybridmap.backends.base import SolveStatus
from hybridmap.backends.comparison import Way
from hybridmap.backends.objective import chi2
from hybridmap.cli import main
from hybridmap.cli.graphs import open_graph
from hybridmap.errors import BackendError
from hybridmap.geometry import between
from hybridmap.graph.io import read_graph
from hybridmap.study.false_loops import inject
from hybridmap.trajectory import Trajectory
from tests.backends.graphs_for_tests import laps
from tests.narrowing import known
from tests.store.sessions import ring_map, truth_at, write_session

SQUARE = """VERTEX_SE2 0 0 0 0
VERTEX_SE2 1 1.1 0 1.6
VERTEX_SE2 2 1.1 1.2 3.1
VERTEX_SE2 3 0.1 1.1 -1.5
EDGE_SE2 0 1 1 0 1.5708 100 0 0 100 0 400
EDGE_SE2 1 2 1 0 1.5708 100 0 0 100 0 400
EDGE_SE2 2 3 1 0 1.5708 100 0 0 100 0 400
EDGE_SE2 3 0 1 0 1.5700 100 0 0 100 0 400
"""


def run(monkeypatch, capsys, *words):
    monkeypatch.setattr(sys, "argv", ["hybridmap", *map(str, words)])
    with pytest.raises(SystemExit) as end:
        main()
    printed = capsys.readouterr()
    return end.value.code or 0, printed.out, printed.err


@pytest.fixture
def square(tmp_path):
    path = tmp_path / "square.g2o"
    path.write_text(SQUARE)
    return path


@pytest.mark.parametrize("way", [(), ("--batch",), ("--incremental",)])
def test_json_has_a_figure_and_a_status_of_each_back_end(monkeypatch, capsys, square, way):
    names = ["odometry", "relaxation-ratslam", "gtsam-lm", "gtsam-isam2", "gtsam-gnc"]
    code, printed, _ = run(monkeypatch, capsys, "compare", square, "--backends", ",".join(names), "--json", *way)
    assert code == 0
    told = json.loads(printed)
    figures = {row["name"]: row["value"] for row in told["metrics"]}
    assert told["backends"] == names
    assert told["ways"] == (["incremental"] if "--incremental" in way else ["batch"])
    assert told["start"] == "the poses of the file"
    assert set(told["status"]) == set(told["chi2_proof"]) == set(told["certificate"]) == set(names)
    assert told["verdicts"] == {name: "doubtful" if name.startswith("odometry") else "trusted" for name in names}
    assert {name for name, reasons in told["reasons"].items() if reasons} == {"odometry"}
    assert figures["certificate_gap/gtsam-lm"] <= 1e-6
    for name in names:
        assert figures[f"chi2/{name}"] <= figures["chi2/odometry"] * (1 + 1e-9)
        assert figures[f"cpu_s/{name}"] >= 0
        assert figures[f"chi2_initial/{name}"] == figures["chi2_initial/odometry"]


def test_a_folder_gets_a_picture_and_a_page_that_needs_nothing_else(monkeypatch, capsys, square, tmp_path):
    out = tmp_path / "compared"
    code, printed, _ = run(monkeypatch, capsys, "compare", square, "--backends", "odometry,gtsam-lm", "--out", out)
    assert code == 0
    assert "gtsam-lm" in printed
    assert "\nodometry: reason: the map is dead reckoning" in printed
    assert "gtsam-lm: reason" not in printed
    assert (out / "maps.png").read_bytes()[:4] == b"\x89PNG"
    page = (out / "comparison.html").read_text()
    assert page.count("the map is dead reckoning") == 1
    assert page.count("data:image/") == 4  # over one another, side by side, convergence, residuals; no loop has a weight
    assert "http" not in page
    assert "gtsam-lm" in page
    assert "<details><summary>Settings" in page


def test_a_back_end_that_fails_is_a_row_that_says_so(monkeypatch, capsys, square, tmp_path):
    def fail(*_):
        raise BackendError("odometry: had a bad day")

    monkeypatch.setattr(odometry, "dead_reckoning", fail)
    words = ("compare", square, "--backends", "odometry,gtsam-lm")
    code, printed, _ = run(monkeypatch, capsys, *words, "--json")
    told = json.loads(printed)
    assert code == 0
    assert told["status"] == {"odometry": "failed", "gtsam-lm": "converged"}
    assert told["message"]["odometry"] == "odometry: had a bad day"
    assert not [row for row in told["metrics"] if row["name"].endswith("/odometry")]
    code, printed, _ = run(monkeypatch, capsys, *words, "--out", tmp_path / "page")
    assert code == 0
    assert "had a bad day" in printed
    assert "had a bad day" in (tmp_path / "page" / "comparison.html").read_text()


def test_rows_come_in_the_order_asked_for_and_progress_reaches_its_end(square):
    seen = []
    graph = read_graph(square)
    rows = comparison.compare(
        graph, ["gtsam-lm", "odometry"], ways=[Way.INCREMENTAL], progress=lambda done, total: seen.append((done, total))
    )
    assert [row.title for row in rows] == ["gtsam-lm", "odometry"]
    assert seen[-1] == (8, 8)
    assert seen == sorted(seen)


@pytest.fixture(scope="module")
def session(tmp_path_factory):
    """A session with closures, and its truth."""
    folder = write_session(tmp_path_factory.mktemp("compared") / "session", ring_map(2.2))
    stamps = np.arange(0, 60 * 10**9, 10**8)
    folder.write_groundtruth(Trajectory(stamps, truth_at(stamps)))
    return folder


def test_a_session_is_shown_in_both_ways_with_its_errors(monkeypatch, capsys, session, tmp_path):
    stamps = np.array([0, 30 * 10**9])
    relations = tmp_path / "session.relations"
    first, second = truth_at(stamps)
    relations.write_text("0.0 30.0 " + " ".join(f"{value:.9f}" for value in between(first, second)) + "\n")
    words = ("compare", session.path, "--backends", "odometry,relaxation-ratslam,gtsam-gnc", "--relations", relations)
    code, printed, _ = run(monkeypatch, capsys, *words, "--json", "--out", tmp_path / "page")
    assert code == 0
    told = json.loads(printed)
    both = [f"{name}{way}" for name in ("relaxation-ratslam", "gtsam-gnc") for way in ("", "/incremental")]
    assert told["backends"] == ["odometry", *both]
    assert told["start"] == "dead reckoning"
    figures = {row["name"]: row["value"] for row in told["metrics"]}
    for name in both:
        assert figures[f"ate_rmse/{name}"] <= figures["ate_rmse/odometry"]
        assert f"relation_trans_mean/{name}" in figures
    page = (tmp_path / "page" / "comparison.html").read_text()
    assert "beginning with dead reckoning" in page
    assert "The true way is laid onto" in page
    assert "relations (m)" in page
    assert ">nan<" not in page


def test_what_the_verdict_on_a_graph_does_not_know_is_said(tmp_path):
    folder = write_session(tmp_path / "session", ring_map(2.2))
    assert open_graph(folder.path).head["remarks"] == []
    folder.write_metrics({**folder.read_metrics().head, "verdict": "doubtful"}, folder.read_metrics().metrics)
    assert "doubtful" in open_graph(folder.path).head["remarks"][0]


def test_what_only_a_session_has_is_refused_for_a_file(monkeypatch, capsys, square, tmp_path):
    code, printed, error = run(monkeypatch, capsys, "compare", square, "--reference", tmp_path / "truth.tum")
    assert code == 2
    assert printed == ""
    assert "--reference and --relations are for session folders" in error


def test_a_drive_ends_where_a_session_ends():
    graph, _ = laps(np.random.default_rng(0), nodes=80, per_lap=30)
    false = inject(graph, 0.1, "random", np.random.default_rng(1))
    batch, driven = comparison.compare(false, ["gtsam-gnc"], ways=list(Way), traced=True)
    assert (batch.title, driven.title) == ("gtsam-gnc", "gtsam-gnc/incremental")
    whole, grown = known(batch.solution).report, known(driven.solution).report
    assert whole.rejected_edge_ids == grown.rejected_edge_ids
    assert grown.iterations > whole.iterations
    curve = known(driven.curve)
    assert curve.shape == (81, 2)
    assert curve[-1, 1] == pytest.approx(grown.unit_variance)


def test_a_curve_leads_from_the_start_to_the_solution():
    graph, _ = laps(np.random.default_rng(0), nodes=80, per_lap=30)
    for name in ("gtsam-lm", "relaxation-ratslam"):
        (row,) = comparison.compare(graph, [name], traced=True)
        effort, cost = known(row.curve).T
        report = known(row.solution).report
        assert cost[0] == pytest.approx(chi2(graph, graph.initial))
        assert cost[-1] == pytest.approx(report.chi2)
        assert effort[-1] == report.iterations
        assert np.all(np.diff(effort) > 0)
        assert np.all(np.diff(cost) <= 2e-3 * cost[:-1])  # relaxation's own objective is another one
        assert len(cost) >= 3


def test_what_is_at_no_optimum_has_no_gap_and_says_why(monkeypatch, capsys, square):
    words = ("compare", square, "--backends", "odometry,gtsam-lm")
    _, printed, _ = run(monkeypatch, capsys, *words, "--json")
    gaps = [row["name"] for row in json.loads(printed)["metrics"] if row["name"].startswith("certificate_gap")]
    assert gaps == ["certificate_gap/gtsam-lm"]
    _, printed, _ = run(monkeypatch, capsys, *words)
    assert "odometry: dead reckoning; not certified: this solution is not at an optimum" in printed


def contents(folder):
    return {path.name: path.read_bytes() for path in folder.iterdir()}


def test_an_earlier_comparison_goes_only_where_that_was_asked_for(monkeypatch, capsys, square, tmp_path):
    out = tmp_path / "compared"
    words = ("compare", square, "--out", out, "--backends")
    assert run(monkeypatch, capsys, *words, "odometry")[0] == 0
    before = contents(out)
    code, printed, error = run(monkeypatch, capsys, *words, "gtsam-lm")
    assert (code, printed, error.count("\n")) == (2, "", 1)
    assert "holds a comparison already; choose another folder or give --overwrite" in error
    assert contents(out) == before
    assert run(monkeypatch, capsys, *words, "gtsam-lm", "--overwrite")[0] == 0
    assert set(contents(out)) == set(before)
    assert contents(out)["comparison.html"] != before["comparison.html"]


@pytest.mark.parametrize("name", ["maps.png", "comparison.html", "notes.txt"])
def test_a_file_of_somebody_else_is_never_lost(monkeypatch, capsys, square, tmp_path, name):
    out = tmp_path / "mine"
    out.mkdir()
    (out / name).write_text("mine: of hybridmap 1.0")
    code, printed, error = run(monkeypatch, capsys, "compare", square, "--backends", "odometry", "--out", out, "--overwrite")
    assert (code, printed) == (2, "")
    assert f"not empty and no comparison (it holds '{name}')" in error
    assert contents(out) == {name: b"mine: of hybridmap 1.0"}


def test_a_back_end_named_twice_is_refused(monkeypatch, capsys, square):
    code, printed, error = run(monkeypatch, capsys, "compare", square, "--backends", "gtsam-lm, gtsam-lm")
    assert (code, printed) == (2, "")
    assert "back-end 'gtsam-lm' is named twice" in error


def test_the_words_over_the_table_say_what_was_done(monkeypatch, capsys, square):
    for way, said, unsaid in (("--incremental", "incremental from", "batch"), ("--batch", "batch from", "incremental")):
        _, printed, _ = run(monkeypatch, capsys, "compare", square, "--backends", "odometry", way)
        title = printed.splitlines()[0]
        assert said in title
        assert unsaid not in title


def test_the_message_of_a_drive_says_what_its_iterations_are():
    graph, _ = laps(np.random.default_rng(0), nodes=40)
    (row,) = comparison.compare(graph, ["relaxation-ratslam"], ways=[Way.INCREMENTAL])
    report = known(row.solution).report
    assert report.iterations > 20
    assert row.message.startswith(f"{report.iterations} iterations over 40 nodes; at the end: ")


def test_matplotlib_says_nothing_of_its_cache(monkeypatch, capsys, square):
    run(monkeypatch, capsys, "compare", square, "--backends", "odometry")
    logging.getLogger("matplotlib").warning("mkdir -p failed")
    assert capsys.readouterr().err == ""


def test_a_row_without_a_map_is_not_judged(monkeypatch, capsys, tmp_path):
    path = tmp_path / "s"
    write_session(path, ring_map(), keyframes=False)
    one, other = comparison.compare(open_graph(path).graph, ["odometry", "gtsam-lm"])
    solution = known(other.solution)
    singular = replace(solution, report=replace(solution.report, status=SolveStatus.SINGULAR))
    monkeypatch.setattr(comparison, "compare", lambda *_, **__: [one, replace(other, solution=singular)])
    _, printed, _ = run(monkeypatch, capsys, "compare", path, "--backends", "odometry,gtsam-lm", "--json")
    names = {row["name"] for row in json.loads(printed)["metrics"]}
    assert "ate_rmse/odometry" in names
    assert "ate_rmse/gtsam-lm" not in names
