"""The command line: one file per command. Each parses its options, calls the library and shows the result."""

from __future__ import annotations

import os
import sys

INTERRUPTED = 130
"""Exit code of a command that Ctrl-C ends, as typer has it."""


def main() -> None:
    """Run the command line on `sys.argv`; it never returns.

    Every error that the user can do something about is one line on standard error, with exit code 2.

    Raises:
        SystemExit: with the exit code (see the help of each command). Where Ctrl-C stops the loading of a library, the process
            ends at once instead.
    """
    try:
        from hybridmap.cli.app import run  # takes half a second, in which Ctrl-C may come as well

        code = run()
    except KeyboardInterrupt:
        code = INTERRUPTED
    except ImportError as error:
        if not isinstance(error.__cause__, KeyboardInterrupt):  # what compiled libraries make of Ctrl-C while they load
            raise
        _say_interrupted()
        os._exit(INTERRUPTED)  # at an ordinary exit, Open3D that is loaded by half may change the code to 1
    if code == INTERRUPTED:
        _say_interrupted()
    raise SystemExit(code)


def _say_interrupted() -> None:
    print("hybridmap: interrupted", file=sys.stderr, flush=True)  # noqa: T201
    sys.stdout.flush()
