"""`hybridmap study`: sources x settings x back-ends x false loops x seeds, resumable, here or on a cluster."""

from __future__ import annotations

import os
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

if TYPE_CHECKING:
    from hybridmap.study.pools import Pool
    from hybridmap.study.statistics import Summary
    from hybridmap.study.study import Study

_ERRORS = {"ate_m": "ATE", "relation_m": "relation error"}
_COLUMNS = {"false_kept": "false kept", "own_lost": "own lost", "loop_recall": "recall", "found_m": "found after (m)"}


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
    """Run a study: errors against the truth, verified relations or the clean optimum, chi2, false loops kept, true loops
    lost, with paired statistics over the seeds; tables and a page.

    Killed at any time, it goes on where it was. A cell that fails is a row that says so. Exit code 1 where a bar is missed.
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
    else:
        _show(done)
        typer.echo(f"page: {page}")
    if done.missed:
        raise typer.Exit(1)


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

    from hybridmap.report.study_page import error_of, remarks
    from hybridmap.study.model import quoted

    console = Console()
    if not console.is_terminal:
        console = Console(width=140)
    known = len({cell.key for cell in done.grid.cells}) - done.computed
    counts = ", ".join(f"{count} {status}" for status, count in done.head["status"].items())
    table = Table(
        title=f"{done.head['study']}: {done.head['cells']} cells ({counts}); {known} known before", title_justify="left"
    )
    measure, others = error_of(done), [name for name in _COLUMNS if _known(done, name)]
    table.add_column("source / setting / false loops")
    table.add_column("back-end")
    for column in ("solved", f"median {_ERRORS[measure]} (m)", f"mean minus {quoted(done.head['baseline'])} (m)"):
        table.add_column(column, justify="right")
    for name in others:
        table.add_column(_COLUMNS[name], justify="right")
    for line in _lines(done, measure, others):
        table.add_row(*line)
    console.print(table)
    for verdict in done.missed:
        unit = "" if verdict.unit == "1" else f" {verdict.unit}"
        missed = f"missed: {verdict.label}: {verdict.bar.figure} {verdict.value:.4g}{unit}, {verdict.said}"
        console.print(missed, soft_wrap=True, markup=False, highlight=False)
    if done.verdicts:
        console.print(f"bars: {len(done.verdicts) - len(done.missed)} of {len(done.verdicts)} kept", highlight=False)
    for remark in remarks(done):
        where = f"{remark.count} cells {remark.status}: {remark.where}, {remark.backend}"
        console.print(f"note: {where}: {remark.message}", soft_wrap=True, markup=False, highlight=False)


def _known(done: Study, measure: str) -> bool:
    return any(one.measure == measure and one.solved for one in done.summaries)


def _lines(done: Study, measure: str, others: list[str]) -> list[list[str]]:
    from hybridmap.report.page_tables import interval, number

    by_row: dict[tuple[str, str], dict[str, Summary]] = {}
    for one in done.summaries:
        by_row.setdefault((one.label, one.backend), {})[one.measure] = one
    lines = []
    for (label, backend), found in by_row.items():
        error = found[measure]
        apart = error.difference
        paired = "" if apart is None or not apart.count else interval(apart)
        median, *figures = (number(one.median) if one.solved else "" for one in (found[name] for name in (measure, *others)))
        lines.append([label, backend, f"{error.solved}/{error.cells}", median, paired, *figures])
    return lines
