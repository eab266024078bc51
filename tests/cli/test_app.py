"""What every command has in common: help, version, and one clear line for an error."""

from __future__ import annotations

import subprocess
import sys
from importlib.metadata import version

import pytest

from hybridmap.cli import main

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
    said = " ".join(done.stdout.split()).partition("Exit codes: ")[2]
    assert [code for code in ("0:", "2:", "130:") if code not in said] == []


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
        (["map", "office", "--out", "s", "--backend", "odometry", "--backend", "odometry"], "found 'odometry' again"),
        (["map", "office", "--out", "s", "--start", "nan"], "--start"),
        (["map", "office", "--out", "s", "--start", "-5"], "--start"),
        (["map", "office", "--out", "s", "--end", "inf"], "--end"),
        (["map", "office", "--out", "/proc/no/such"], "/proc/no"),
        (["map", "office", "--out", "s", "--set", "vision.laser.probes.fit_min=2"], "vision.laser.probes.fit_min"),
        (["map", "office", "--out", ""], "--out: the value is empty"),
        (["map", "office", "--out="], "--out: the value is empty"),
        (["map", "", "--out", "s"], "an argument: the value is empty"),
        (["map", "lab", "--out", "s", "--overwrite", ""], "an argument: the value is empty"),
        (["map", "lab", "--out", "s", "--overwrite="], "does not take a value"),
        (
            ["map", "lab", "--out", "s", "--set", "backends.names=[]"],
            "error: command line: backends.names: expected at least 1",
        ),
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


def test_without_a_command_the_help_is_shown():
    done = run()
    assert (done.returncode, done.stdout) == (2, "")
    assert done.stderr == run("--help").stdout


@pytest.mark.parametrize(
    ("error", "code", "said"),
    [
        (KeyboardInterrupt(), 130, "hybridmap: interrupted\n"),
        (MemoryError("Unable to allocate\n2 TiB"), 2, "hybridmap: error: not enough memory: Unable to allocate 2 TiB\n"),
        (MemoryError(), 2, "hybridmap: error: not enough memory: none is left\n"),
    ],
)
def test_what_ends_a_command_is_one_line(monkeypatch, capsys, tmp_path, error, code, said):
    def choose(*_: object, **__: object) -> None:
        raise error

    monkeypatch.setattr("hybridmap.cli.choose.choose", choose)
    monkeypatch.setattr(sys, "argv", ["hybridmap", "map", "lab", "--out", str(tmp_path / "s")])
    with pytest.raises(SystemExit) as stopped:
        main()
    assert (stopped.value.code, capsys.readouterr().err) == (code, said)


@pytest.mark.parametrize(
    "loaded",
    ["import os, signal\nos.kill(os.getpid(), signal.SIGINT)\n", "raise ImportError('failed') from KeyboardInterrupt()\n"],
)
def test_ctrl_c_while_the_commands_are_loaded_is_one_line_too(tmp_path, loaded):
    """`typer` is the first that the commands import: one that stands in its place lets Ctrl-C come at that moment."""
    (tmp_path / "typer.py").write_text(loaded)
    done = run("map", "lab", "--out", "s", cwd=tmp_path)
    assert (done.returncode, done.stdout, done.stderr) == (130, "", "hybridmap: interrupted\n")


def test_a_library_that_is_missing_is_no_interrupt(tmp_path):
    (tmp_path / "typer.py").write_text("raise ImportError('no such library')\n")
    done = run("map", "lab", "--out", "s", cwd=tmp_path)
    assert done.returncode == 1
    assert "no such library" in done.stderr
