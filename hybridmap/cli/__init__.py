"""The command line: one file per command. Each parses its options, calls the library and shows the result."""

from __future__ import annotations

import sys

INTERRUPTED = 130  # what typer makes of Ctrl-C
"""Exit code of a command that Ctrl-C ends."""


def main() -> None:
    """Run the command line on `sys.argv`; it never returns.

    Every error that the user can do something about is one line on standard error, with exit code 2.

    Raises:
        SystemExit: always, with the exit code (see the help of each command).
    """
    try:
        from hybridmap.cli.app import run  # takes half a second, in which Ctrl-C may come as well

        code = run()
    except KeyboardInterrupt:
        code = INTERRUPTED
    except ImportError as error:
        if not isinstance(error.__cause__, KeyboardInterrupt):  # what compiled libraries make of Ctrl-C while they load
            raise
        code = INTERRUPTED
    if code == INTERRUPTED:
        print("hybridmap: interrupted", file=sys.stderr)  # noqa: T201
    raise SystemExit(code)
