"""The command line: one file per command. Each parses its options, calls the library and shows the result."""

from hybridmap.cli.app import main

__all__ = ["main"]
