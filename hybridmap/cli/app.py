"""The command `hybridmap`: its sub-commands, and how an error reaches the user."""

from __future__ import annotations

import io
import logging
import os
import sys
from collections.abc import Sequence
from importlib.metadata import version
from typing import Annotated, NoReturn

import typer

from hybridmap.cli.calibrate import calibrate
from hybridmap.cli.compare import compare
from hybridmap.cli.demo import demo
from hybridmap.cli.evaluate import evaluate
from hybridmap.cli.explain import explain
from hybridmap.cli.export import export
from hybridmap.cli.inspect import inspect
from hybridmap.cli.map import map_source
from hybridmap.cli.optimize import optimize
from hybridmap.cli.simulate import simulate
from hybridmap.cli.study import study
from hybridmap.cli.verify import verify
from hybridmap.errors import ConfigError, HybridMapError

_INTERRUPTED = 130  # what typer makes of Ctrl-C

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


app.command("demo")(demo)
app.command("map")(map_source)
app.command("evaluate")(evaluate)
app.command("explain")(explain)
app.command("export")(export)
app.command("optimize")(optimize)
app.command("compare")(compare)
app.command("study")(study)
app.command("calibrate")(calibrate)
app.command("simulate")(simulate)
app.command("inspect")(inspect)
app.command("verify")(verify)


def main() -> None:
    """Run the command line. Every error is printed as one line on standard error, with exit code 2."""
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
    if code == _INTERRUPTED:
        print("hybridmap: interrupted", file=sys.stderr)  # noqa: T201
    raise SystemExit(code if isinstance(code, int) else 0)


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
