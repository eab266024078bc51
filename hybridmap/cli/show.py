"""How the commands show things: tables and JSON from one list of figures, progress on standard error."""

from __future__ import annotations

import os
import sys
from collections.abc import Iterable, Iterator
from contextlib import contextmanager
from typing import Any, Protocol

from hybridmap.metrics import Metric, to_json


class Advance(Protocol):
    """Called as work gets done."""

    def __call__(self, done: int, total: int | None = None) -> None:
        """`done` units of `total`."""


def emit(head: dict[str, Any], metrics: Iterable[Metric], *, as_json: bool, title: str = "") -> None:
    """Print one JSON object, or a table with units, on standard output."""
    rows = list(metrics)
    if as_json:
        sys.stdout.write(to_json(head, rows) + "\n")
        return
    from rich.console import Console
    from rich.table import Table

    table = Table(title=title or None, title_justify="left")
    for column, justify in (("figure", "left"), ("value", "right"), ("unit", "left"), ("meaning", "left")):
        table.add_column(column, justify=justify)  # type: ignore[arg-type]
    for row in rows:
        verdict = "" if row.passed is None else " ✓" if row.passed else " ✗"
        table.add_row(row.name, f"{row.value:.6g}{verdict}", row.unit, row.description)
    Console().print(table)


@contextmanager
def progress(label: str) -> Iterator[Advance]:
    """A progress bar on standard error; silent when standard error is no terminal or `-q` was given."""
    from rich.console import Console
    from rich.progress import BarColumn, MofNCompleteColumn, Progress, TextColumn, TimeElapsedColumn

    console = Console(stderr=True)
    hidden = bool(os.environ.get("HYBRIDMAP_QUIET")) or not console.is_terminal
    columns = (TextColumn("{task.description}"), BarColumn(), MofNCompleteColumn(), TimeElapsedColumn())
    with Progress(*columns, console=console, disable=hidden, transient=True) as bar:
        task = bar.add_task(label, total=None)

        def advance(done: int, total: int | None = None) -> None:
            bar.update(task, completed=done, total=total)

        yield advance
