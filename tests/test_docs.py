"""The documents: every example of the walk-through is run, every command and link that is named exists."""

import doctest
import json
import re
import shlex
import subprocess
import sys
import typing
from collections.abc import Iterator
from importlib import import_module
from pathlib import Path

import pytest

from hybridmap.config import Config
from hybridmap.config.gone import what_became_of
from hybridmap.config.section import Section

ROOT = Path(__file__).resolve().parents[1]
PAGES = [ROOT / "README.md", *sorted((ROOT / "docs").glob("*.md"))]
COMMAND = (sys.executable, "-c", "from hybridmap.cli import main; main()")
MATCHES = doctest.OutputChecker()
FLAGS = doctest.ELLIPSIS | doctest.NORMALIZE_WHITESPACE


def blocks(page: Path) -> list[tuple[str, str]]:
    return re.findall(r"^```(\w+)\n(.*?)^```$", page.read_text(), re.DOTALL | re.MULTILINE)


def run(*command: str, cwd: Path) -> subprocess.CompletedProcess[str]:
    return subprocess.run(command, cwd=cwd, capture_output=True, text=True, timeout=120)


def check(shown: str, said: str, what: str) -> None:
    assert MATCHES.check_output(shown, said, FLAGS), f"{what}\nshown:\n{shown}\nsaid:\n{said}"


def run_console(text: str, folder: Path) -> None:
    for part in re.split(r"^\$ ", text, flags=re.MULTILINE)[1:]:
        line, _, shown = part.partition("\n")
        program, *arguments = shlex.split(line)
        assert program == "hybridmap", line
        done = run(*COMMAND, *arguments, cwd=folder)
        if shown.startswith("hybridmap: error:"):
            assert (done.returncode, done.stdout) == (2, ""), line
            check(shown, done.stderr, line)
        else:
            assert done.returncode == 0, f"{line}\n{done.stderr}"
            if shown.strip():
                check(shown, done.stdout, line)


def test_walk_through_does_what_it_shows(tmp_path: Path) -> None:
    said = ""
    for language, text in blocks(ROOT / "docs" / "walk-through.md"):
        if language == "console":
            run_console(text, tmp_path)
        elif language == "python":
            done = run(sys.executable, "-c", text, cwd=tmp_path)
            assert done.returncode == 0, f"{text}\n{done.stderr}"
            said = done.stdout
        else:
            check(text, said, "output of the block before")
    assert (tmp_path / "session" / "report.html").is_file()
    described = (ROOT / "docs" / "formats.md").read_text()
    metrics = json.loads((tmp_path / "session" / "metrics.json").read_text())["metrics"]
    measures = {metric["name"].partition("/")[0].replace("_online", "") for metric in metrics}
    assert {measure for measure in measures if f"`{measure}" not in described} == set()
    assert not (tmp_path / "other").exists()


README_INPUT = """
import numpy as np
rng = np.random.default_rng(0)
stamp_s, pose_odom_robot = 1.0, (0.0, 0.0, 0.0)
T_base_camera = np.array([[0, 0, 1, 0.1], [-1, 0, 0, 0], [0, -1, 0, 1.0], [0, 0, 0, 1]], dtype=float)
color = rng.integers(0, 255, (240, 320, 3)).astype(np.uint8)
depth_m = np.full((240, 320), 2.0, dtype=np.float32)
"""


def test_readme_example_runs(tmp_path: Path) -> None:
    (example,) = [text for language, text in blocks(ROOT / "README.md") if language == "python"]
    asked = "\nassert update.new_node == 0 and len(solution.poses) == len(mapper.map) == 1"
    done = run(sys.executable, "-c", README_INPUT + example + asked, cwd=tmp_path)
    assert done.returncode == 0, done.stderr


def test_the_example_of_a_robots_own_loop_runs(tmp_path: Path) -> None:
    (example,) = [text for language, text in blocks(ROOT / "docs" / "live.md") if language == "python"]
    (said,) = [text for language, text in blocks(ROOT / "docs" / "live.md") if language == "text"]
    done = run(sys.executable, "-c", example, cwd=tmp_path)
    assert done.returncode == 0, done.stderr
    check(done.stdout, said, "docs/live.md")
    assert (tmp_path / "drive" / "metrics.json").is_file()


def test_readme_names_every_back_end() -> None:
    from hybridmap.backends import names

    table = (ROOT / "README.md").read_text().split("The back-ends:")[1].split("## ")[0]
    assert set(re.findall(r"`((?:gtsam|relaxation)-[\w-]+|odometry)`", table)) == set(names())


@pytest.mark.parametrize("page", PAGES, ids=lambda page: page.name)
def test_links_lead_somewhere(page: Path) -> None:
    for target in re.findall(r"\]\(([^)#\s]+)", page.read_text()):
        assert target.startswith("https://") or (page.parent / target).exists(), target


def test_every_command_that_is_named_exists() -> None:
    help_text = run(*COMMAND, "--help", cwd=ROOT).stdout
    there = set(re.findall(r"^  ([a-z]\w*) ", help_text.split("Commands:")[1], re.MULTILINE))
    named = {
        name for page in PAGES for name in re.findall(r"\bhybridmap ([a-z]\w*)\b(?=[^\n`]*(?:--|`|[A-Z]))", page.read_text())
    }
    assert named - there == set()
    assert there - named == set(), "a command that no page names"


def test_every_place_that_the_paper_page_names_exists() -> None:
    text = (ROOT / "docs" / "paper.md").read_text() + (ROOT / "docs" / "architecture.md").read_text()
    places = re.findall(r"`([\w/]+\.py): ([\w.]+)`", text)
    assert len(places) > 20
    for file, name in places:
        source = (ROOT / "hybridmap" / file).read_text()
        for part in name.split("."):
            assert re.search(rf"\b(class|def) {part}\b|\b{part}\b\s*[:=]", source), f"{file}: {name}"


def in_code(page: Path) -> str:
    """What stands between back-ticks on a page, and its blocks."""
    text = page.read_text()
    return "\n".join([*re.findall(r"`([^`\n]+)`", text), *(block for _, block in blocks(page))])


@pytest.mark.parametrize("page", [*PAGES, ROOT / "CHANGELOG.md"], ids=lambda page: page.name)
def test_every_file_that_is_named_exists(page: Path) -> None:
    for name in re.findall(r"[\w/-]+\.py\b", in_code(page)):
        assert (ROOT / name).is_file() or list((ROOT / "hybridmap").rglob(name)), name


def names_of(section: type[Section], above: str = "") -> Iterator[str]:
    """Dotted names of the sections and settings of a section."""
    for name, field in section.model_fields.items():
        yield f"{above}{name}"
        for inner in (field.annotation, *typing.get_args(field.annotation)):
            if isinstance(inner, type) and issubclass(inner, Section):
                yield from names_of(inner, f"{above}{name}.")


@pytest.mark.parametrize("page", [*PAGES, ROOT / "CHANGELOG.md"], ids=lambda page: page.name)
def test_every_setting_that_is_named_exists(page: Path) -> None:
    known = set(names_of(Config))
    sections = "|".join(Config.model_fields)
    shown_as_unknown = {"nodes.distance"}
    for name in re.findall(rf"(?<![\w./*-])(?:{sections})(?:\.[a-z]\w*)+", in_code(page)):
        package, _, rest = name.partition(".")
        python = package in ("backends", "vision") and hasattr(import_module(f"hybridmap.{package}"), rest.partition(".")[0])
        gone = page.name == "CHANGELOG.md" and what_became_of(name) is not None
        assert python or gone or name in known | shown_as_unknown, name


def test_every_table_and_column_of_the_map_file_is_described() -> None:
    from hybridmap.store.schema import TABLES

    text = (ROOT / "docs" / "formats.md").read_text()
    for table, columns in re.findall(r"CREATE TABLE (\w+) \((.*?)\)(?: WITHOUT ROWID)?;", TABLES, re.DOTALL):
        assert f"| `{table}` |" in text
        for column in re.findall(r"(?:^|,)\s*([a-z]\w*) [A-Z]", columns):
            assert f"`{column}`" in text, f"{table}.{column}"


def test_no_page_holds_a_place_that_was_to_be_filled() -> None:
    for page in (ROOT / "README.md", ROOT / "CHANGELOG.md", *(ROOT / "docs").glob("*.md")):
        assert re.findall(r"^[A-Z]+(?:_[A-Z]+)*$", page.read_text(), re.MULTILINE) == [], page.name
