"""What every command has in common: help, version, and one clear line for an error."""

from __future__ import annotations

import subprocess
import sys
from importlib.metadata import version

import pytest

COMMANDS = ("demo", "simulate", "inspect", "map", "evaluate", "optimize", "compare", "export")


def run(*arguments: str, cwd=None) -> subprocess.CompletedProcess[str]:
    return subprocess.run(
        [sys.executable, "-c", "from hybridmap.cli import main; main()", *arguments], capture_output=True, text=True, cwd=cwd
    )


def test_version():
    done = run("--version")
    assert (done.returncode, done.stdout.strip()) == (0, f"hybridmap {version('hybridmap')}")


def test_help_lists_every_command():
    text = run("--help").stdout
    assert all(command in text for command in COMMANDS)


@pytest.mark.parametrize("command", COMMANDS)
def test_every_command_explains_itself(command):
    done = run(command, "--help")
    assert done.returncode == 0
    assert "--json" in done.stdout


@pytest.mark.parametrize(
    ("arguments", "expected"),
    [
        (["nonsense"], "nonsense"),
        (["map"], "Missing"),
        (["map", "x.bag"], "--out"),
        (["map", "no-such.bag", "--out", "s"], "no-such.bag"),
        (["map", "office", "--out", "s", "--config", "no-such-config"], "no-such-config"),
        (["map", "office", "--out", "s", "--set", "nodes.distanse_m=1"], "nodes.distanse_m"),
        (["map", "office", "--out", "s", "--set", "nodes.distance_m"], "KEY=VALUE"),
        (["map", "office", "--out", "s", "--backend", "gtsam-magic"], "gtsam-magic"),
        (["map", "office", "--out", "s", "--start", "nan"], "--start"),
        (["map", "office", "--out", "s", "--start", "-5"], "--start"),
        (["map", "office", "--out", "s", "--end", "inf"], "--end"),
        (["map", "office", "--out", "/proc/no/such"], "/proc/no"),
        (["evaluate", "no-such-folder"], "no-such-folder"),
        (["optimize", "no-such.g2o", "--backend", "gtsam-lm"], "no-such.g2o"),
        (["compare", "no-such.g2o", "--backends", "gtsam-lm"], "no-such.g2o"),
        (["export", "no-such-folder", "--format", "tum", "--out", "x"], "no-such-folder"),
        (["inspect", "no-such.mcap"], "no-such.mcap"),
        (["simulate", "atlantis", "--out", "x"], "atlantis"),
    ],
)
def test_an_error_is_one_line_and_exit_code_2(arguments, expected, tmp_path):
    done = run(*arguments, cwd=tmp_path)
    assert done.returncode == 2
    assert done.stdout == ""
    assert done.stderr.startswith("hybridmap: error: ")
    assert done.stderr.count("\n") == 1
    assert expected in done.stderr
    assert not list(tmp_path.iterdir()), "an error leaves no output behind"
