from __future__ import annotations

import json
import subprocess
import sys

import pytest

from hybridmap.export import FORMATS
from tests.store.sessions import ring_map, write_session


def run(*arguments: object) -> subprocess.CompletedProcess[str]:
    command = [sys.executable, "-c", "from hybridmap.cli import main; main()", *map(str, arguments)]
    return subprocess.run(command, capture_output=True, text=True, check=False)


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    path = tmp_path_factory.mktemp("cli") / "s"
    write_session(path, ring_map())
    return path


def test_json_names_what_was_written(folder, tmp_path):
    done = run("export", folder, "--format", "g2o", "--out", tmp_path / "x.g2o", "--backend", "odometry", "--json")
    assert done.returncode == 0, done.stderr
    tree = json.loads(done.stdout)
    assert tree["files"] == [str(tmp_path / "x.g2o")]
    assert tree["backend"] == "odometry"
    assert {row["name"]: row["value"] for row in tree["metrics"]}["nodes/g2o"] == 60
    assert (tmp_path / "x.g2o").is_file()


def test_help_names_every_format():
    done = run("export", "--help")
    assert done.returncode == 0
    assert all(name in done.stdout for name in FORMATS)


def test_bad_input_is_one_line_and_code_two(folder, tmp_path):
    (tmp_path / "there.tum").write_text("mine")
    for arguments in (
        (folder, "--format", "obj", "--out", tmp_path / "x"),
        (tmp_path / "gone", "--format", "tum", "--out", tmp_path / "x"),
        (folder, "--format", "tum", "--out", tmp_path / "there.tum"),
        (folder, "--format", "tum"),
        (folder, "--format", "g2o", "--out", tmp_path / "x.g2o", "--footprint", "0.3"),
        (folder, "--format", "g2o", "--out", tmp_path / "x.g2o", "--inflation", "0.3"),
    ):
        done = run("export", *arguments)
        assert done.returncode == 2
        assert done.stdout == ""
        assert done.stderr.startswith("hybridmap: error: ")
        assert done.stderr.count("\n") == 1
    assert [path.name for path in tmp_path.iterdir()] == ["there.tum"]
