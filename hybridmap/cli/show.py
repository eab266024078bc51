"""Output of the commands: tables or JSON from one list of metrics on standard output, progress on standard error."""

from __future__ import annotations

import os
import sys
from collections.abc import Iterable, Iterator
from contextlib import contextmanager
from typing import TYPE_CHECKING, Any, Protocol

from hybridmap.metrics import Metric, to_json

if TYPE_CHECKING:
    from rich.console import Console
    from rich.table import Table


class Advance(Protocol):
    """Function that is called as work progresses, with the units of work done so far and, if known, the total."""

    def __call__(self, done: int, total: int | None = None) -> None:
        """`done` units of `total` are done; a total of None is not known."""


def emit(head: dict[str, Any], metrics: Iterable[Metric], *, as_json: bool, title: str = "") -> None:
    """Print results on standard output: one JSON object, or tables with units and the remarks of the run.

    Args:
        head: facts about the run, the keys of the JSON object beside `metrics`. As text only its `remarks`, `reasons` and
            `verdict` are shown, below the tables; metrics of its `backends` get a table with a column for each, headed by
            its name or what `titles` calls it.
        metrics: the values to print.
        as_json: print JSON.
        title: title of the tables; not in JSON.
    """
    rows = list(metrics)
    if as_json:
        sys.stdout.write(to_json(head, rows) + "\n")
        return
    from rich.console import Console

    from hybridmap.backends.base import ODOMETRY

    console = Console(width=None if sys.stdout.isatty() else 140)
    columns = [str(name) for name in (ODOMETRY, *head["backends"])] if "backends" in head else []
    columns = [name for name in dict.fromkeys(columns) if any(_stage(row) == name for row in rows)]
    plain = [row for row in rows if _stage(row) not in columns]
    print_title(console, title)
    if plain:
        console.print(_plain_table(plain))
    if columns:
        console.print(_table_by_backend([row for row in rows if row not in plain], columns, head.get("titles", {})))
    lines = [f"note: {remark}" for remark in head.get("remarks", ())]
    lines += [f"reason: {reason['words']}" for reason in head.get("reasons", ())]
    lines += [f"verdict: {head['verdict']}"] if "verdict" in head else []
    for line in lines:
        console.print(line, soft_wrap=True, markup=False, highlight=False)


def print_title(console: Console, title: str) -> None:
    """Print the title of a table in one line, even if the table is narrower; prints nothing for an empty title."""
    from rich.text import Text

    if title:
        console.print(Text(title, style="italic"), soft_wrap=True)


def _stage(row: Metric) -> str:
    return row.name.partition("/")[2]


def _plain_table(rows: list[Metric]) -> Table:
    from rich.table import Table

    from hybridmap.report.page_tables import shown

    table = Table()
    table.add_column("figure", no_wrap=True)
    table.add_column("value", justify="right", no_wrap=True)
    table.add_column("unit")
    table.add_column("meaning")
    for row in rows:
        table.add_row(row.name, shown(row), row.unit, row.description)
    return table


def _table_by_backend(rows: list[Metric], columns: list[str], titles: dict[str, str]) -> Table:
    from rich.table import Table

    from hybridmap.report.page_tables import shown

    table = Table()
    table.add_column("figure", no_wrap=True)
    table.add_column("unit")
    for column in columns:
        table.add_column(titles.get(column, column), justify="right")
    by_name = {row.name: row for row in rows}
    for measure in dict.fromkeys(row.name.partition("/")[0] for row in rows):
        cells = [by_name.get(f"{measure}/{column}") for column in columns]
        unit = next(cell.unit for cell in cells if cell is not None)
        table.add_row(measure, unit, *("" if cell is None else shown(cell) for cell in cells))
    return table


@contextmanager
def progress(label: str) -> Iterator[Advance]:
    """Show a progress bar on standard error, unless standard error is no terminal or `-q` was given.

    Yields:
        The function to call as work progresses; without a bar it does nothing.
    """
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
