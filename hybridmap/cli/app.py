"""The command `hybridmap`: its sub-commands, and how an error reaches the user."""

from __future__ import annotations

import io
import logging
import os
import sys
from collections.abc import Callable, Sequence
from importlib.metadata import version
from typing import Annotated, NoReturn

import typer

from hybridmap.cli import INTERRUPTED
from hybridmap.cli.calibrate import calibrate
from hybridmap.cli.compare import compare
from hybridmap.cli.demo import demo
from hybridmap.cli.edit import edit
from hybridmap.cli.evaluate import evaluate
from hybridmap.cli.explain import explain
from hybridmap.cli.export import export
from hybridmap.cli.import_map import import_session
from hybridmap.cli.inspect import inspect
from hybridmap.cli.localize import localize
from hybridmap.cli.map import map_source
from hybridmap.cli.merge import merge
from hybridmap.cli.optimize import optimize
from hybridmap.cli.plan import plan
from hybridmap.cli.reproduce import reproduce
from hybridmap.cli.ros1 import ros1
from hybridmap.cli.ros2 import ros2
from hybridmap.cli.simulate import simulate
from hybridmap.cli.study import study
from hybridmap.cli.verify import verify
from hybridmap.errors import ConfigError, HybridMapError

_EVERY = {2: "a wrong input or an error, in one line on standard error", INTERRUPTED: "interrupted by Ctrl-C"}
"""Exit codes of every command."""

app = typer.Typer(
    name="hybridmap",
    help="A factor-graph hybrid mapper: neural path integration, scanline loop closure, relaxation and GTSAM on one graph.",
    invoke_without_command=True,
    add_completion=False,
    pretty_exceptions_enable=False,
    rich_markup_mode=None,
)


def _show_version(wanted: bool) -> None:
    if wanted:
        typer.echo(f"hybridmap {version('hybridmap')}")
        raise typer.Exit


@app.callback()
def _options(
    context: typer.Context,
    verbose: Annotated[bool, typer.Option("--verbose", "-v", help="Log progress to standard error.")] = False,
    quiet: Annotated[bool, typer.Option("--quiet", "-q", help="Show no progress bars, and log errors only.")] = False,
    _version: Annotated[
        bool, typer.Option("--version", help="Show the version and exit.", callback=_show_version, is_eager=True)
    ] = False,
) -> None:
    if context.invoked_subcommand is None:
        typer.echo(context.get_help(), err=True)
        raise typer.Exit(2)
    level = logging.INFO if verbose else logging.ERROR if quiet else logging.WARNING
    logging.basicConfig(level=level, format="hybridmap: %(levelname)s: %(message)s", stream=sys.stderr, force=True)
    logging.getLogger("matplotlib").setLevel(logging.ERROR)  # where no home can be written to it warns of its own cache
    os.environ["HYBRIDMAP_QUIET"] = "1" if quiet else ""


_COMMANDS: dict[str, tuple[Callable[..., None], dict[int, str]]] = {
    "demo": (demo, {0: "the session is written, whatever its verdict"}),
    "map": (
        map_source,
        {0: "the session is written, whatever its verdict", 3: "it is written, but --strict found lost or skipped messages"},
    ),
    "merge": (merge, {0: "the map of both is written, whether or not they could be joined"}),
    "import": (import_session, {0: "the session is written, whatever its verdict"}),
    "ros1": (ros1, {0: "the session is written, whatever its verdict"}),
    "ros2": (ros2, {0: "the session is written, whatever its verdict"}),
    "localize": (localize, {0: "the session of the drive is written, whether or not it was found on the map"}),
    "edit": (edit, {0: "the changed map is written, whatever its verdict"}),
    "evaluate": (evaluate, {0: "evaluated, even if metrics.json or the page cannot be written, which is only warned of"}),
    "explain": (explain, {0: "explained"}),
    "export": (export, {0: "written"}),
    "plan": (plan, {0: "a way was found", 2: f"there is none through known free space, or {_EVERY[2]}"}),
    "optimize": (
        optimize,
        {
            0: "solved, whatever the verdict",
            1: "the back-end failed, diverged or found the graph singular: it is shown, and no file is written",
            2: f"the back-end gave up, or {_EVERY[2]}",
        },
    ),
    "compare": (compare, {0: "compared, even if a back-end failed"}),
    "study": (
        study,
        {
            0: "every cell has a result, and no bar (limit) of the study is missed",
            1: "a cell has no result or a bar is missed, and everything is written all the same",
        },
    ),
    "calibrate": (
        calibrate,
        {0: "estimated, whether or not a value changes", 2: f"the drives do not determine the values, or {_EVERY[2]}"},
    ),
    "simulate": (simulate, {0: "written"}),
    "inspect": (inspect, {0: "inspected, even if it cannot be mapped", 3: "inspected, but --strict found lost messages"}),
    "verify": (
        verify,
        {0: "every value keeps its limit", 1: "a value misses its limit, and everything is written all the same"},
    ),
    "reproduce": (
        reproduce,
        {
            0: "every drive has a result, and no limit is missed",
            1: "a drive has no result or a limit is missed, and everything is written all the same",
        },
    ),
}
"""Name -> the command, and what its exit codes mean, beside those of every command."""

for _name, (_command, _codes) in _COMMANDS.items():
    _said = "; ".join(f"{code}: {meaning}" for code, meaning in sorted((_EVERY | _codes).items()))
    app.command(_name, epilog=f"Exit codes: {_said}.")(_command)


def run() -> int:
    """Run the command line on `sys.argv`; returns the exit code.

    Raises:
        SystemExit: an error that the user can do something about, after its line on standard error; the exit code is 2.
    """
    os.environ.setdefault("OPENCV_FOR_THREADS_NUM", "1")  # pictures are small: a second thread costs more than it gives
    os.environ.setdefault("OPENCV_LOG_LEVEL", "SILENT")  # a damaged picture is reported by our own line
    os.environ.setdefault("OPENCV_IO_MAX_IMAGE_PIXELS", str(1 << 26))  # as `streams.cameras.MOST_PIXELS`, for every format
    _print_every_name()
    try:
        _refuse_empty(sys.argv[1:])
        code = app(prog_name="hybridmap", standalone_mode=False)
    except OSError as error:
        _fail(f"{error.filename}: {error.strerror}" if error.filename else str(error))
    except MemoryError as error:
        _fail(f"not enough memory: {' '.join(str(error).split()) or 'none is left'}")
    except HybridMapError as error:
        _fail(" ".join(str(error).split()))
    except Exception as error:
        if not hasattr(error, "format_message"):  # click's usage errors, wherever typer has them from
            raise
        _fail(" ".join(error.format_message().split()))
    return code if isinstance(code, int) else 0


def _print_every_name() -> None:
    """Let names of files that are not in the terminal's encoding be printed, with their bytes as numbers."""
    for stream in (sys.stdout, sys.stderr):
        if isinstance(stream, io.TextIOWrapper):
            stream.reconfigure(errors="backslashreplace")


def _refuse_empty(arguments: Sequence[str]) -> None:
    """Refuse an empty argument: as a path it would mean the current folder."""
    for before, argument in zip(("", *arguments), arguments, strict=False):
        option, given, value = argument.partition("=") if argument.startswith("--") else (before, "=", argument)
        if given and not value:
            known = option in _options_with_values()
            if argument and not known:
                continue  # a flag, or no option at all: refused when it is read
            name = option if known else "an argument"
            raise ConfigError(f"{name}: the value is empty; expected a value")


def _options_with_values() -> set[str]:
    commands = vars(typer.main.get_command(app))["commands"].values()
    options = [option for command in commands for option in command.params if not getattr(option, "is_flag", True)]
    return {name for option in options for name in option.opts}


def _fail(message: str) -> NoReturn:
    print(f"hybridmap: error: {message}", file=sys.stderr)  # noqa: T201
    raise SystemExit(2)
