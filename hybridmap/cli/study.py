"""`hybridmap study`: sources x settings x back-ends x false loops x seeds, resumable, here or on a cluster."""

from __future__ import annotations

import os
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

if TYPE_CHECKING:
    from hybridmap.study.pools import Pool
    from hybridmap.study.study import Study

_HEADLINES = ("ate_m", "false_kept", "own_lost")


def study(
    config: Annotated[str, typer.Argument(metavar="CONFIG.yaml", help="A study: a file, or the name of one that comes along.")],
    out: Annotated[Path, typer.Option(metavar="DIR", help="Results; a study that is there is gone on with.")],
    workers: Annotated[int, typer.Option(min=0, help="Processes of this machine, of one thread each; 0: this process.")] = 1,
    scheduler: Annotated[
        str | None, typer.Option(metavar="tcp://HOST:PORT", help="A Dask scheduler whose workers do it (extra `cluster`).")
    ] = None,
    setting: Annotated[list[str] | None, typer.Option("--set", help="KEY=VALUE, e.g. seeds=3.")] = None,
    as_json: Annotated[bool, typer.Option("--json", help="One JSON object on standard output.")] = False,
) -> None:
    """Run a study: ATE (m) against the truth or the clean optimum, chi2, false loops kept, true loops lost, with paired
    statistics over the seeds; tables and a page.

    Killed at any time, it goes on where it was. A cell that fails is a row that says so.
    """
    _one_thread()
    from hybridmap.cli.choose import parse_settings
    from hybridmap.cli.show import emit, progress
    from hybridmap.report.study_page import write_study_page
    from hybridmap.study import StudyConfig
    from hybridmap.study.study import run_study

    chosen = StudyConfig.load(config, parse_settings(setting))
    with progress(f"study {chosen.name}") as advance:
        done = run_study(chosen, out, _pool(workers, scheduler), advance)
    page = write_study_page(done)
    if as_json:
        emit(done.head, done.metrics, as_json=True)
        return
    _show(done)
    typer.echo(f"page: {page}")


def _one_thread() -> None:
    """Pin this process's numerical libraries to one thread, as workers are; they read this when they are loaded."""
    for name in ("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS"):
        os.environ[name] = "1"


def _pool(workers: int, scheduler: str | None) -> Pool:
    from hybridmap.study.pools import LocalProcesses, ThisProcess

    if scheduler is not None:
        from hybridmap.study.cluster import DaskCluster

        return DaskCluster(scheduler)
    return LocalProcesses(workers) if workers else ThisProcess()


def _show(done: Study) -> None:
    from rich.console import Console
    from rich.table import Table

    from hybridmap.report.study_page import remarks
    from hybridmap.study.model import quoted

    console = Console()
    if not console.is_terminal:
        console = Console(width=140)
    known = len({cell.key for cell in done.grid.cells}) - done.computed
    counts = ", ".join(f"{count} {status}" for status, count in done.head["status"].items())
    table = Table(
        title=f"{done.head['study']}: {done.head['cells']} cells ({counts}); {known} known before", title_justify="left"
    )
    table.add_column("source / setting / false loops")
    table.add_column("back-end")
    for column in ("solved", "median ATE (m)", f"mean minus {quoted(done.head['baseline'])} (m)", "false kept", "own lost"):
        table.add_column(column, justify="right")
    for line in _lines(done):
        table.add_row(*line)
    console.print(table)
    for remark in remarks(done):
        where = f"{remark.count} cells {remark.status}: {remark.where}, {remark.backend}"
        console.print(f"note: {where}: {remark.message}", soft_wrap=True, markup=False, highlight=False)


def _lines(done: Study) -> list[list[str]]:
    from hybridmap.report.tables import interval, number

    by_row: dict[tuple[str, str], dict[str, Any]] = {}
    for one in done.summaries:
        if one.measure in _HEADLINES:
            by_row.setdefault((one.label, one.backend), {})[one.measure] = one
    lines = []
    for (label, backend), found in by_row.items():
        ate, kept, lost = (found[name] for name in _HEADLINES)
        apart = ate.difference
        paired = "" if apart is None or not apart.count else interval(apart)
        figures = [number(one.median) if one.solved else "" for one in (ate, kept, lost)]
        lines.append([label, backend, f"{ate.solved}/{ate.cells}", figures[0], paired, figures[1], figures[2]])
    return lines
