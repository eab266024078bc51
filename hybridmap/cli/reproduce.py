"""`hybridmap reproduce`: every table and figure of the paper beside ours, on one page."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from hybridmap.cli.options import AsJson

if TYPE_CHECKING:
    from hybridmap.reproduction.reproduction import Reproduction


def reproduce(
    out: Annotated[
        Path,
        typer.Option(
            metavar="DIR",
            help="Folder for report.html, metrics.json, tables and results. In the folder of an earlier reproduction, what is"
            " stored is used again. A folder with other files is refused.",
        ),
    ],
    seeds: Annotated[
        int, typer.Option(help="Number of drives through each world: seeds 1, 2 and so on.", min=1, max=1000)
    ] = 10,
    workers: Annotated[
        int, typer.Option(min=0, help="Worker processes on this machine, one thread each; 0: compute in this process.")
    ] = 1,
    as_json: AsJson = False,
) -> None:
    """Reproduce the paper: its tables, its figures, and its experiments in simulated worlds, beside its own numbers.

    Needs no data. Each world is mapped once for each system and seed. An interrupted run continues when it is run again, after
    the last finished drive; the verification of the cells, the first two minutes, is stored only when it is whole. The
    page lists all that is done, done differently, or missing. Ten seeds are some 35 minutes of computing, half of that on two
    free cores (--workers 2); --seeds 1 is 5 minutes.
    """
    from hybridmap.cli.show import progress
    from hybridmap.cli.study import one_thread, pool_of
    from hybridmap.output import held

    one_thread()
    from hybridmap.reproduction import page, reproduction
    from hybridmap.verification import Scale

    study = reproduction.plan(seeds)
    with held(out, page.REPRODUCTION) as place:
        done = reproduction.reproduce(place, study, Scale(workers=max(1, workers)), pool_of(workers), progress)
        page.write_reproduction(place, done)
    _show(done, out / page.PAGE, as_json=as_json)


def _show(done: Reproduction, page: Path, *, as_json: bool) -> None:
    """Print the table of the systems and what is missed.

    Raises:
        Exit: with 1, if a bar is missed or a drive has no result.
    """
    from rich.console import Console
    from rich.table import Table

    from hybridmap.cli.show import emit
    from hybridmap.reproduction.page import SYSTEM_COLUMNS, system_cells

    if as_json:
        emit(done.head, done.metrics, as_json=True)
    else:
        console = Console()
        if not console.is_terminal:
            console = Console(width=160)
        table = Table(title=f"the paper's experiments, {len(done.head['seeds'])} drives each", title_justify="left")
        for column in SYSTEM_COLUMNS:
            table.add_column(column)
        for one in done.results:
            table.add_row(*system_cells(one))
        console.print(table)
        for name in done.failed:
            console.print(f"missed: {name}", soft_wrap=True, markup=False, highlight=False)
        typer.echo(f"page: {page}")
    if done.failed:
        raise typer.Exit(1)
