"""`hybridmap reproduce`: every item of the paper is on a page that needs nothing, and nothing is computed twice."""

import base64
import csv
import json
import re
from html import unescape
from xml.etree import ElementTree

import pytest

from hybridmap import verification
from hybridmap.cli import main
from hybridmap.reproduction import cells, page, reproduction
from hybridmap.reproduction.equations import equations
from hybridmap.reproduction.paper import CELL_TYPES, OPEN_PARAMETERS, PARAMETERS, PARTS, RESULTS
from hybridmap.study.model import BarConfig
from hybridmap.study.pools import ThisProcess
from hybridmap.verification import verification as verifying
from tests.verification.cells_for_tests import TINY

PICTURES = ("heading", "stripes", "grid", "square", "place", "room", "phase", "modules", "shadow", "noise")
DOT = "data:image/svg+xml;base64," + base64.b64encode(b'<svg xmlns="w3/svg"/>').decode()
SECONDS = {"lab by bionic": 45.0, "lab by paper": 8.0, "corridor by scan-to-map": 8.0}


@pytest.fixture(scope="module")
def patched():
    """The command in small: three short drives, and the verification of the tests."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(verification, "Scale", lambda **_: TINY)
        patch.setattr(cells, "figures_of", lambda _: dict.fromkeys(PICTURES, DOT))
        whole = reproduction.plan
        patch.setattr(reproduction, "plan", lambda seeds: in_small(whole(seeds)))
        for name in ("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS"):
            patch.setenv(name, "1")  # the command sets them: they are put back at the end
        yield patch


def in_small(study):
    sources = [source for source in study.sources if source.title in SECONDS]
    short = tuple(source.model_copy(update={"end_s": SECONDS[source.title]}) for source in sources)
    return study.model_copy(update={"sources": short, "bars": ()})


def run(*arguments):
    """Exit code of the command."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr("sys.argv", ["hybridmap", "reproduce", *map(str, arguments)])
        with pytest.raises(SystemExit) as stopped:
            main()
    return stopped.value.code or 0


def interrupted(*_):
    raise KeyboardInterrupt


@pytest.fixture(scope="module")
def broken_off(patched, tmp_path_factory):
    """Folder of a run that was interrupted before its first drive, and its exit code."""
    out = tmp_path_factory.mktemp("reproduced") / "paper"
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(reproduction, "run_study", interrupted)
        return out, run("--out", out, "--seeds", 1, "--workers", 0)


@pytest.fixture(scope="module")
def made(broken_off):
    """The same folder after a second run, which may not verify the cells again."""
    out, code = broken_off
    assert (code, (out / page.PAGE).exists()) == (130, False)
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(verifying, "verify_cells", lambda *_: pytest.fail("the cells were verified again"))
        assert run("--out", out, "--seeds", 1, "--workers", 0) == 0
    return out


@pytest.fixture(scope="module")
def text(made):
    """What is to be read on the page."""
    html = (made / page.PAGE).read_text()
    return letters(unescape(re.sub(r"<[^>]+>", "", html[html.index("<h1") :])))


def letters(words):
    """A text without spaces and back-ticks."""
    return re.sub(r"[\s`]", "", words)


def test_every_section_is_there_and_every_link_leads_to_one(made):
    html = (made / page.PAGE).read_text()
    assert set(re.findall(r'<h2 id="(\w+)">', html)) == set(page.SECTIONS)
    assert set(re.findall(r'href="([^"]+)"', html)) <= {f"#{anchor}" for anchor in page.SECTIONS}
    assert {item.shown for item in (*RESULTS, *PARTS)} - {""} <= set(page.SECTIONS)


def test_every_item_of_the_paper_is_on_the_page(text):
    said = [word for cell in CELL_TYPES for word in (cell.cells, cell.region, cell.firing, cell.here)]
    said += [f"{one.name} {one.paper or '–'}" for one in (*PARAMETERS, *OPEN_PARAMETERS)]
    said += [f"{item.what} {item.paper}" for item in (*RESULTS, *PARTS)]
    said += [item.why for item in (*RESULTS, *PARTS)]
    said += [f"{one.number} {one.equation} {one.where} {one.status} {one.why}" for one in equations()]
    assert [words for words in said if letters(words) not in text] == []
    assert "{" not in text  # every figure that a text names is filled in


def test_its_pictures_are_whole_and_it_needs_nothing_else(made):
    html = (made / page.PAGE).read_text()
    pictures = re.findall(r'<img src="data:image/svg\+xml;base64,([^"]+)" alt="([^"]+)"', html)
    assert len(pictures) == html.count("<img")
    named = {alt for _, alt in pictures}
    assert {"Maps of lab by every system", "Maps of corridor by every system", "Place fields in a room of 10 x 3 m"} <= named
    assert "The map of the laboratory before and after loop closures" in named
    for data, alt in pictures:
        assert ElementTree.fromstring(base64.b64decode(data)).tag.endswith("svg"), alt
    assert "http" not in html


def test_the_tables_hold_what_was_measured(made):
    told = json.loads((made / page.METRICS).read_text())
    assert (told["seeds"], told["passed"], told["failed"]) == ([1], True, [])
    values = {metric["name"]: metric["value"] for metric in told["metrics"]}
    systems = {(row["world"], row["system"]): row for row in csv.DictReader((made / "systems.csv").open())}
    assert set(systems) == {("lab", "paper"), ("lab", "bionic"), ("corridor", "scan-to-map")}
    bionic = systems["lab", "bionic"]
    assert float(bionic["error_m"]) == values["ate_median/lab/bionic"]
    assert float(bionic["error_m"]) < float(bionic["odometry_m"])
    printed = systems["lab", "paper"]
    assert printed["baseline"] == "bionic"
    assert float(printed["difference_m"]) == pytest.approx(float(printed["error_m"]) - float(bionic["error_m"]))
    assert (printed["p_holm"], bionic["baseline"]) == ("", "")  # one drive proves nothing
    assert bionic["without_map"] == "0"
    assert len(list(csv.DictReader((made / "equations.csv").open()))) == len(equations())
    for name in page.TABLES:
        assert list(csv.DictReader((made / name).open())), name


def test_a_third_run_computes_nothing_and_gives_the_same_page(made, monkeypatch):
    before = (made / page.PAGE).read_bytes()
    monkeypatch.setattr(verifying, "verify_cells", lambda *_: pytest.fail("the cells were verified again"))
    monkeypatch.setattr(ThisProcess, "run", lambda _self, _work, tasks: pytest.fail("a drive") if tasks else iter(()))
    assert run("--out", made, "--seeds", 1, "--workers", 0) == 0
    assert (made / page.PAGE).read_bytes() == before


def test_a_missed_limit_is_exit_code_1_and_is_named(patched, made, monkeypatch, capsys):
    bar = BarConfig(figure="ate_m", at_most=1e-6, sources=("lab by bionic",))
    judged = reproduction.plan(1).model_copy(update={"bars": (bar,)})
    monkeypatch.setattr(reproduction, "plan", lambda _: judged)
    assert run("--out", made, "--seeds", 1, "--workers", 0) == 1
    assert "missed: ate_m/lab by bionic" in capsys.readouterr().out
    assert "ate_m/lab by bionic" in (made / page.PAGE).read_text()


@pytest.mark.parametrize(
    ("options", "said"),
    [
        (("--out", "mine"), "no reproduction (it holds 'notes.txt')"),
        (("--out", "new", "--seeds", 0), "--seeds"),
        (("--out", "new", "--workers", -1), "--workers"),
        (("--seeds", 1), "--out"),
    ],
)
def test_wrong_input_is_one_line_and_leaves_nothing(patched, tmp_path, monkeypatch, capsys, options, said):
    monkeypatch.chdir(tmp_path)
    (tmp_path / "mine").mkdir()
    (tmp_path / "mine" / "notes.txt").write_text("mine")
    assert run(*options) == 2
    shown = capsys.readouterr()
    assert (shown.out, shown.err.count("\n")) == ("", 1)
    assert said in shown.err
    assert not (tmp_path / "new").exists()
