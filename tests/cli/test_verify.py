import csv
import functools
import json

import pytest

import hybridmap.verification as cells
from hybridmap.cli import main
from hybridmap.cli.show import emit
from hybridmap.metrics import Metric
from hybridmap.verification.single_cells import SCORES
from tests.verification.cells_for_tests import TINY
from tests.verification.paths_for_tests import there_and_back, write_csv

FEW = ("--set", "neural.modules=3", "--set", "neural.spacing_max_m=0.2", "--shuffles", 2)


@pytest.fixture
def run(monkeypatch, capsys):
    monkeypatch.setattr(cells, "Scale", lambda: TINY)

    def command(*arguments):
        monkeypatch.setattr("sys.argv", ["hybridmap", "verify", *map(str, arguments)])
        with pytest.raises(SystemExit) as stopped:
            main()
        shown = capsys.readouterr()
        return stopped.value.code, shown.out, shown.err

    return command


def test_verify_keeps_its_bars_and_writes_a_page_that_needs_nothing(run, tmp_path):
    code, out, _ = run("--out", tmp_path / "cells", "--seed", 3, "--json")
    shown = json.loads(out)
    assert (code, shown["failed"]) == (0, [])
    assert shown["seed"] == 3
    assert json.loads((tmp_path / "cells" / "metrics.json").read_text()) == shown
    page = (tmp_path / "cells" / "verify.html").read_text()
    assert '<meta name="generator" content="hybridmap ' in page  # by which --overwrite knows it
    assert page.count("data:image/svg+xml;base64,") == 10
    assert "http" not in page.replace("http-equiv", "")
    assert sorted(entry.name for entry in (tmp_path / "cells").iterdir()) == ["metrics.json", "verify.html"]


def test_a_row_that_misses_its_bar_is_exit_code_1(run, tmp_path):
    code, out, _ = run("--out", tmp_path / "cells", "--seed", 3, "--set", "neural.gain=1.02")
    assert code == 1
    assert "miss their bar" in out
    assert "missed" in (tmp_path / "cells" / "verify.html").read_text()
    assert json.loads((tmp_path / "cells" / "metrics.json").read_text())["passed"] is False


def test_errors_are_one_line_and_exit_code_2(run, tmp_path):
    (tmp_path / "notes.txt").write_text("mine")
    code, out, err = run("--out", tmp_path)
    assert (code, out, err.count("\n")) == (2, "", 1)
    assert "notes.txt" in err
    code, out, err = run("--out", tmp_path / "new", "--set", "neural.kernel=printed")
    assert (code, out, err.count("\n")) == (2, "", 1)
    assert "period-two oscillation" in err
    assert not (tmp_path / "new").exists()


def test_a_folder_that_cannot_be_made_is_refused_before_anything_runs(run, tmp_path, monkeypatch):
    monkeypatch.setattr(cells, "verify_cells", lambda *_: pytest.fail("it ran"))
    for place in ("/proc/cells", tmp_path / "a file" / "cells"):
        (tmp_path / "a file").write_text("")
        code, out, err = run("--out", place)
        assert (code, out, err.count("\n")) == (2, "", 1)
        assert "cannot be written" in err


@pytest.mark.parametrize(
    "setting",
    [
        "spacing_min_m=1e-9", "spacing_max_m=1e9", "place.attractor_cell_m=1e-9",
        "place.attractor_side=1000000000", "head_direction_cells=100000000", "sheet_side=1000000000",
    ],
)  # fmt: skip
def test_cells_that_no_machine_could_hold_are_an_error_and_no_missed_bar(run, tmp_path, setting):
    code, out, err = run("--out", tmp_path / "new", "--set", f"neural.{setting}")
    assert (code, out, err.count("\n")) == (2, "", 1)
    assert setting.partition("=")[0].split(".")[-1] in err
    assert not (tmp_path / "new").exists()


@pytest.mark.parametrize("as_json", [False, True])
def test_small_figures_are_shown_as_they_are(capsys, as_json):
    emit({}, [Metric("verify/a", 1.7e-13, "rad", "small", 1e-9, True)], as_json=as_json)
    shown = capsys.readouterr().out
    assert "1.7e-13" in shown


def test_a_verification_is_replaced_only_when_asked(run, tmp_path):
    (tmp_path / "metrics.json").write_text("{}")
    code, _, err = run("--out", tmp_path, "--overwrite")
    assert code == 2
    assert "no verification (it holds 'metrics.json')" in err
    (tmp_path / "verify.html").write_text('<meta name="generator" content="hybridmap 1.0">')
    code, _, err = run("--out", tmp_path)
    assert code == 2
    assert "--overwrite" in err


@pytest.fixture
def lines(tmp_path, monkeypatch):
    monkeypatch.setattr(cells, "verify_along", functools.partial(cells.verify_along, workers=1))
    return write_csv(tmp_path / "lines.csv", *there_and_back())


def test_cells_run_along_a_path_and_their_page_needs_nothing(run, tmp_path, lines):
    out = tmp_path / "cells"
    code, said, _ = run("--out", out, "--trajectory", lines, "--seed", 3, *FEW, "--json")
    shown = json.loads(said)
    assert (code, shown["failed"], shown["trajectory"], shown["heading"]) == (0, [], "lines.csv", "direction of movement")
    assert json.loads((out / "metrics.json").read_text()) == shown
    page = (out / "verify.html").read_text()
    assert page.count("data:image/svg+xml;base64,") == 4
    assert "http" not in page.replace("http-equiv", "")
    assert sorted(entry.name for entry in out.iterdir()) == ["cells.csv", "metrics.json", "verify.html"]
    table = list(csv.DictReader((out / "cells.csv").open()))
    assert {row["kind"] for row in table} == set(SCORES)
    medians = {row["name"]: row["value"] for row in shown["metrics"]}
    langston = sorted(float(row["langston"]) for row in table if row["kind"] == "grid")
    assert medians["verify/grid_langston"] == pytest.approx(langston[len(langston) // 2], abs=1e-4)
    assert all(row["vector_length"] == "" and float(row["spikes"]) > 0 for row in table if row["kind"] == "grid")


def test_a_path_that_the_cells_cannot_follow_is_exit_code_1(run, tmp_path, lines):
    code, out, _ = run("--out", tmp_path / "cells", "--trajectory", lines, *FEW, "--set", "neural.gain=1.02")
    assert code == 1
    assert "verify/path_phase" in out


@pytest.mark.parametrize(
    ("options", "said"),
    [
        (("--nwb",), "--nwb: needs --trajectory"),
        (("--concentration", 5), "--concentration: needs --trajectory"),
        (("--shuffles", 5), "--shuffles: needs --trajectory"),
        (("--trajectory", "none.csv"), "none.csv: no such trajectory"),
        (("--trajectory", "nan.csv"), "nan.csv:3: found NaN"),
        (("--trajectory", "lines.csv", "--concentration", 1e9), "needs 252989 cells"),
    ],
)  # fmt: skip
def test_a_wrong_path_or_option_is_one_line_and_leaves_nothing(run, tmp_path, monkeypatch, lines, options, said):
    monkeypatch.chdir(tmp_path)
    (tmp_path / "nan.csv").write_text("t,x,y\n0,1,2\n1,nan,2\n")
    code, out, err = run("--out", tmp_path / "new", *options)
    assert (code, out, err.count("\n")) == (2, "", 1)
    assert said in err
    assert not (tmp_path / "new").exists()
