"""`hybridmap compare`: one table, one referee, and a back-end that fails is a row."""

import json
import sys

import pytest

from hybridmap.backends import comparison, odometry
from hybridmap.cli import main
from hybridmap.errors import BackendError
from hybridmap.graph.io import read_graph

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


@pytest.mark.parametrize("way", [(), ("--incremental",)])
def test_json_has_a_figure_and_a_status_of_each_back_end(monkeypatch, capsys, square, way):
    names = ["odometry", "relaxation-ratslam", "gtsam-lm", "gtsam-isam2", "gtsam-gnc"]
    code, printed, _ = run(monkeypatch, capsys, "compare", square, "--backends", ",".join(names), "--json", *way)
    assert code == 0
    told = json.loads(printed)
    figures = {row["name"]: row["value"] for row in told["metrics"]}
    assert told["backends"] == names
    assert set(told["status"]) == set(told["certificate"]) == set(names)
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
    assert (out / "maps.png").read_bytes()[:4] == b"\x89PNG"
    page = (out / "comparison.html").read_text()
    assert page.count("data:image/png;base64") == 2
    assert "http" not in page
    assert "gtsam-lm" in page


def test_a_back_end_that_fails_is_a_row_that_says_so(monkeypatch, capsys, square, tmp_path):
    def fail(*_):
        raise BackendError("odometry: had a bad day")

    monkeypatch.setattr(odometry.OdometryBackend, "_optimise", fail)
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
        graph, ["gtsam-lm", "odometry"], incremental=True, progress=lambda done, total: seen.append((done, total))
    )
    assert [row.backend for row in rows] == ["gtsam-lm", "odometry"]
    assert seen[-1] == (8, 8)
    assert seen == sorted(seen)
