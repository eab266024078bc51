"""`hybridmap study`: tables, JSON, a page; errors in one line that leave nothing."""

import builtins
import json
import os

import pytest
import yaml

from hybridmap.cli import main
from hybridmap.report import study_page
from hybridmap.study.folder import PAGE
from tests.study.studies import TREE


@pytest.fixture
def run(monkeypatch, capsys, tmp_path):
    for name in ("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS"):
        monkeypatch.setenv(name, os.environ.get(name, "1"))  # the command sets them: put them back afterwards
    (tmp_path / "small.yaml").write_text(yaml.safe_dump(TREE))

    def command(*words):
        monkeypatch.setattr("sys.argv", ["hybridmap", "study", *map(str, words)])
        with pytest.raises(SystemExit) as stopped:
            main()
        shown = capsys.readouterr()
        return stopped.value.code or 0, shown.out, shown.err

    return command


def test_a_study_is_run_and_gone_on_with(run, tmp_path, monkeypatch):
    out = tmp_path / "out"
    words = (tmp_path / "small.yaml", "--out", out, "--workers", 0)
    code, printed, _ = run(*words, "--json")
    told = json.loads(printed)
    assert code == 0
    assert json.loads((out / "metrics.json").read_text()) == told
    assert (told["cells"], told["status"]) == (18, {"converged": 18})
    found = {entry.name for entry in out.iterdir()} - {".lock"}
    names = {
        "study.yaml",
        "cells.csv",
        "timings.csv",
        "summary.csv",
        "bars.csv",
        "effects.csv",
        "metrics.json",
        "report.html",
        "cells",
        "sources",
    }
    assert found == names
    before = (out / "cells.csv").read_bytes()
    monkeypatch.setattr(study_page, "write_study_page", lambda study: study.folder.path / PAGE)  # one page is enough
    code, printed, _ = run(*words)
    assert code == 0
    assert "18 computed earlier" in printed
    assert "laps/default/aliased 30 %" in printed
    assert (out / "cells.csv").read_bytes() == before
    code, printed, _ = run(*words, "--set", "seeds=[3]")
    assert "9 cells" in printed
    assert yaml.safe_load((out / "study.yaml").read_text())["seeds"] == [3]
    code, printed, _ = run(out / "study.yaml", "--out", tmp_path / "again", "--workers", 0)  # what was resolved can be run
    assert (tmp_path / "again" / "cells.csv").read_bytes() == (out / "cells.csv").read_bytes()


def test_cells_without_a_result_are_exit_code_1_and_why_stands_under_the_table(run, tmp_path, monkeypatch):
    monkeypatch.setattr(study_page, "write_study_page", lambda study: study.folder.path / PAGE)
    tree = TREE | {
        "backends": ["gtsam-lm"],
        "seeds": 1,
        "sources": [{"name": "way", "synthetic": {"nodes": 20, "per_lap": 60}}],
    }
    (tmp_path / "way.yaml").write_text(yaml.safe_dump(tree))
    code, printed, _ = run(tmp_path / "way.yaml", "--out", tmp_path / "out", "--workers", 0)
    (note,) = [line for line in printed.splitlines() if line.startswith("note: ")]
    assert code == 1
    assert "cells failed: way/" in note
    assert "loops" in note


@pytest.mark.parametrize(
    ("words", "expected"),
    [
        (("none.yaml", "--out", "out"), "no such study file"),
        (("small.yaml", "--out", "out", "--set", "seads=1"), "unknown key 'seads'"),
        (("small.yaml", "--out", "out", "--set", "seeds"), "expected KEY=VALUE"),
        (("small.yaml", "--out", "out", "--workers", "-1"), "workers"),
        (("small.yaml", "--out", "small.yaml"), "is a file"),
        (("small.yaml", "--out", "."), "not empty and no study"),
    ],
)
def test_errors_are_one_line_and_leave_nothing(run, tmp_path, monkeypatch, words, expected):
    monkeypatch.chdir(tmp_path)
    code, out, err = run(*words)
    assert (code, out, err.count("\n")) == (2, "", 1)
    assert expected in err
    assert sorted(entry.name for entry in tmp_path.iterdir()) == ["small.yaml"]


def test_without_the_extra_the_cluster_is_refused_in_one_line(run, tmp_path, monkeypatch):
    load = builtins.__import__

    def absent(name, *rest, **more):
        if name == "distributed":
            raise ImportError(name)
        return load(name, *rest, **more)

    monkeypatch.setattr(builtins, "__import__", absent)
    code, out, err = run(tmp_path / "small.yaml", "--out", tmp_path / "out", "--scheduler", "tcp://127.0.0.1:1")
    assert (code, out, err.count("\n")) == (2, "", 1)
    assert "pip install 'hybridmap[cluster]'" in err
    assert not (tmp_path / "out").exists()
