import json

import pytest

import hybridmap.verification as cells
from hybridmap.cli import main
from hybridmap.cli.show import emit
from hybridmap.metrics import Metric
from tests.verification.cells_for_tests import TINY


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
    assert page.count("data:image/svg+xml;base64,") == 9
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
