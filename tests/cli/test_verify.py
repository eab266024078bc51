import json

import pytest

from hybridmap.cli import main
from hybridmap.evaluate import cells
from tests.cells_for_tests import TINY


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
    assert page.count("data:image/svg+xml;base64,") == 8
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


def test_a_verification_is_replaced_only_when_asked(run, tmp_path):
    (tmp_path / "metrics.json").write_text("{}")
    code, _, err = run("--out", tmp_path)
    assert code == 2
    assert "--overwrite" in err
