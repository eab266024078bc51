"""`hybridmap optimize`: figures, files, and one line with exit code 2 for everything else."""

import json
import sys
from pathlib import Path

import numpy as np
import pytest

from hybridmap.backends import names
from hybridmap.backends.objective import chi2
from hybridmap.cli import main
from hybridmap.graph.io import read_graph
from tests.narrowing import known

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


def test_json_holds_the_figures_and_the_file_has_the_poses_they_are_of(monkeypatch, capsys, square, tmp_path):
    out = tmp_path / "out" / "solved.g2o"
    code, printed, _ = run(monkeypatch, capsys, "optimize", square, "--backend", "gtsam-lm", "--out", out, "--json")
    assert code == 0
    told = json.loads(printed)
    figures = {row["name"]: row["value"] for row in told["metrics"]}
    assert told["status"] == "converged"
    assert told["certificate"].startswith("F = ")
    assert figures["certificate_gap/gtsam-lm"] <= 1e-6
    assert "no map has less than" in told["chi2_proof"]
    assert figures["chi2_bound/gtsam-lm"] <= figures["chi2/gtsam-lm"]
    assert figures["chi2_gap/gtsam-lm"] <= 1e-4
    assert (told["nodes"], told["edges"], told["loops"]) == (4, 4, 1)
    assert (told["verdict"], told["reasons"]) == ("trusted", [])
    before, after = read_graph(square), read_graph(out)
    assert figures["chi2_initial/gtsam-lm"] == pytest.approx(chi2(before, before.initial))
    assert figures["chi2/gtsam-lm"] == pytest.approx(chi2(before, after.initial), rel=1e-9)
    assert figures["chi2/gtsam-lm"] < 1e-2 * figures["chi2_initial/gtsam-lm"]


@pytest.mark.parametrize("name", ["gtsam-lm", "odometry"])
def test_without_json_there_is_one_table_under_one_line(monkeypatch, capsys, tmp_path, name):
    square = tmp_path / f"{'long' * 30}.g2o"
    square.write_text(SQUARE)
    code, printed, _ = run(monkeypatch, capsys, "optimize", square, "--backend", name)
    assert code == 0
    assert printed.splitlines()[0] == f"{square}: {name}: converged"
    assert f"chi2/{name}" in printed
    assert "meaning" in printed


def test_a_back_end_that_diverged_is_exit_code_1_and_no_file(monkeypatch, capsys, tmp_path):
    spokes = [f"EDGE_SE2 0 {k} 1 0 0 1 0 0 1 0 1" for k in range(1, 40)]
    spokes += [f"EDGE_SE2 {k} {k + 1} 0.1 0.2 0 1 0 0 1 0 1" for k in range(1, 39)]
    star = tmp_path / "star.g2o"
    star.write_text("\n".join(spokes))
    out = tmp_path / "never.g2o"
    code, printed, _ = run(monkeypatch, capsys, "optimize", star, "--backend", "relaxation-paper", "--out", out, "--json")
    assert code == 1
    assert json.loads(printed)["status"] == "diverged"
    assert json.loads(printed)["verdict"] == "failed"
    assert "theta_max" in json.loads(printed)["message"]
    assert not out.exists()


def test_settings_reach_the_back_end(monkeypatch, capsys, square):
    words = ("optimize", square, "--backend", "relaxation-ratslam", "--set", "backends.relaxation.solve_sweeps=3", "--json")
    _, printed, _ = run(monkeypatch, capsys, *words)
    figures = {row["name"]: row["value"] for row in json.loads(printed)["metrics"]}
    assert figures["iterations/relaxation-ratslam"] == 3


@pytest.mark.parametrize(
    ("words", "says"),
    [
        (("optimize", "nowhere.g2o"), "nowhere.g2o: no such graph file"),
        (("optimize", "SQUARE", "--backend", "g2o"), "unknown back-end 'g2o'; there are odometry"),
        (("optimize", "FOLDER"), "holds no session"),
        (("optimize", "SQUARE", "--set", "backends.speed=3"), "unknown key 'backends.speed'"),
        (("optimize", "SQUARE", "--sideways"), "No such option"),
        (("compare", "SQUARE", "--backends", "gtsam-lm,none"), "unknown back-end 'none'"),
    ],
)
def test_bad_input_is_one_line_and_exit_code_2(monkeypatch, capsys, square, tmp_path, words, says):
    (tmp_path / "empty").mkdir()
    named = {"SQUARE": square, "FOLDER": tmp_path / "empty"}
    code, printed, errors = run(monkeypatch, capsys, *(named.get(word, word) for word in words))
    assert code == 2
    assert printed == ""
    assert errors.count("\n") == 1
    assert errors.startswith("hybridmap: error: ")
    assert says in errors


BAD_LINES = {
    "found NaN or Inf": ["EDGE_SE2 3 0 nan 0 1.57 100 0 0 100 0 400"],
    "not positive definite": ["EDGE_SE2 3 0 1 0 1.57 100 200 0 100 0 400"],
    "bad.g2o:9: edge 3 -> 0 has an information matrix that is not positive definite": ["EDGE_SE2 3 0 1 0 1.57 100 0 0 100 0 0"],
    "outside 1e-09 to 1e+15": ["EDGE_SE2 3 0 1 0 1.57 100 0 0 100 0 1e-300"],
    "beyond 1e+09": ["EDGE_SE2 3 0 1e200 0 1.57 100 0 0 100 0 400"],
    "bad.g2o: vertex 7 is not connected to vertex 0 (2 of 6 nodes are not)": [
        "VERTEX_SE2 7 0 0 0",
        "VERTEX_SE2 8 1 0 0",
        "EDGE_SE2 7 8 1 0 0 1 0 0 1 0 1",
    ],
    "names vertex 99, which the file does not give": ["EDGE_SE2 3 99 1 0 0 100 0 0 100 0 400"],
    "vertex 0 is given twice": ["VERTEX_SE2 0 0 0 0"],
    "leads from a node to itself": ["EDGE_SE2 3 3 1 0 0 100 0 0 100 0 400"],
}


@pytest.mark.parametrize("name", [name for name in names() if name.startswith(("gtsam", "relaxation"))])
def test_a_graph_that_no_solver_can_take_is_one_line_for_every_back_end(monkeypatch, capsys, square, tmp_path, name):
    for says, lines in BAD_LINES.items():
        bad, out = tmp_path / "bad.g2o", tmp_path / "out.g2o"
        bad.write_text(square.read_text() + "\n".join(lines) + "\n")
        code, printed, errors = run(monkeypatch, capsys, "optimize", bad, "--backend", name, "--out", out, "--json")
        assert (code, printed, errors.count("\n")) == (2, "", 1), says
        assert errors.startswith("hybridmap: error: ")
        assert says in errors
        assert not out.exists()


@pytest.mark.data
@pytest.mark.parametrize("name", ["gtsam-gn", "gtsam-dogleg"])
def test_a_solver_that_found_the_graph_singular_is_exit_code_1_and_no_file(monkeypatch, capsys, data_dir, tmp_path, name):
    path, out = data_dir / "posegraphs" / "input_INTEL_g2o.g2o", tmp_path / "out.g2o"
    code, printed, _ = run(monkeypatch, capsys, "optimize", path, "--backend", name, "--out", out, "--json")
    assert code == 1
    assert json.loads(printed)["status"] == "singular"
    assert not out.exists()


@pytest.mark.data
def test_manhattan_reaches_the_published_optimum(monkeypatch, capsys, data_dir):
    path = data_dir / "posegraphs" / "manhattanOlson3500.g2o"
    _, printed, _ = run(monkeypatch, capsys, "optimize", path, "--json")
    figures = {row["name"]: row["value"] for row in json.loads(printed)["metrics"]}
    assert figures["chi2/gtsam-lm"] == pytest.approx(146.08, abs=0.01)


def test_files_are_never_left_half_written(square, tmp_path):
    graph = read_graph(square)
    assert np.isfinite(graph.initial).all()
    assert not list(Path(tmp_path).glob(".*partial"))


def test_a_file_in_the_way_is_not_lost(monkeypatch, capsys, tmp_path):
    (tmp_path / "square.g2o").write_text(SQUARE)
    (tmp_path / "out.g2o").write_text("mine")
    words = ("optimize", tmp_path / "square.g2o", "--backend", "gtsam-lm", "--out")
    code, _, error = run(monkeypatch, capsys, *words, tmp_path / "out.g2o")
    assert (code, error.count("\n")) == (2, 1)
    assert (tmp_path / "out.g2o").read_text() == "mine"
    assert run(monkeypatch, capsys, *words, tmp_path)[0] == 2
    assert run(monkeypatch, capsys, *words, tmp_path / "out.g2o", "--overwrite")[0] == 0
    assert (tmp_path / "out.g2o").read_text().startswith("VERTEX_SE2")


def test_the_vertex_that_a_file_fixes_stays_where_it_is(monkeypatch, capsys, square, tmp_path):
    square.write_text(SQUARE + "FIX 2\n")
    out = tmp_path / "out.g2o"
    code, printed, _ = run(monkeypatch, capsys, "optimize", square, "--out", out, "--json")
    assert code == 0
    before, after = read_graph(square), read_graph(out)
    assert np.array_equal(after.initial[2], before.initial[2])
    assert not np.allclose(after.initial[0], before.initial[0], atol=1e-3)
    assert known(after.file).held == 2
    figures = {row["name"]: row["value"] for row in json.loads(printed)["metrics"]}
    assert chi2(after, after.initial) == pytest.approx(figures["chi2/gtsam-lm"], rel=1e-9)
