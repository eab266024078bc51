"""The command line: a command a file, each one parse -> call the library -> show."""

from hybridmap.cli.app import main

__all__ = ["main"]
