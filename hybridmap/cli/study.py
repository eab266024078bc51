"""`hybridmap study`: run sources x settings x back-ends x false loops x seeds, here or on a cluster."""

from __future__ import annotations

import math
import os
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from hybridmap.cli.options import AsJson

if TYPE_CHECKING:
    from rich.console import Console

    from hybridmap.study.pools import Pool
    from hybridmap.study.statistics import Summary
    from hybridmap.study.study import Study

_COLUMNS = {"false_kept": "false kept", "own_lost": "own lost", "loop_recall": "recall", "found_m": "found after (m)"}


_Config = Annotated[
    str,
    typer.Argument(
        metavar="CONFIG.yaml",
        help="Study: a YAML file, or a name that comes with hybridmap (an unknown one gives the list).",
    ),
]
_Out = Annotated[
    Path,
    typer.Option(
        metavar="DIR",
        help="Folder for the results. In an existing study folder, stored results of the same cells are used again, and its"
        " tables and page are replaced. A folder with other files is refused.",
    ),
]
_Workers = Annotated[
    int, typer.Option(min=0, help="Worker processes on this machine, one thread each; 0: compute in this process.")
]
_Scheduler = Annotated[
    str | None,
    typer.Option(metavar="tcp://HOST:PORT", help="Compute on the workers of this Dask scheduler (needs the extra `cluster`)."),
]
_Setting = Annotated[
    list[str] | None, typer.Option("--set", help="KEY=VALUE of the study, e.g. seeds=3. Keys: docs/studies.md.")
]


def study(
    config: _Config,
    out: _Out,
    workers: _Workers = 1,
    scheduler: _Scheduler = None,
    setting: _Setting = None,
    as_json: AsJson = False,
) -> None:
    """Run a study: map or solve every combination of source, setting, back-end, false loops and seed; compare the back-ends.

    A cell is one such combination. Metrics: error against ground truth, verified relations or the optimum without false loops;
    chi2; accepted false loops; lost true loops. Differences between back-ends, and between settings,
    are paired by seed.

    Writes study.yaml, tables (cells.csv, timings.csv, summary.csv, effects.csv, bars.csv), metrics.json, the page report.html,
    and every result as soon as it is known: an interrupted study continues when it is run again. A cell without a result
    (`failed`, `unmapped`, `crashed`) keeps its row, with the reason. A back-end that diverged is a result. A cell without the
    figure of a limit (bar) misses it.
    """
    one_thread()
    from hybridmap.cli.choose import parse_settings
    from hybridmap.cli.show import emit, progress
    from hybridmap.report.study_page import write_study_page
    from hybridmap.study import StudyConfig
    from hybridmap.study.study import run_study

    chosen = StudyConfig.load(config, parse_settings(setting))
    with progress(f"study {chosen.name}") as advance:
        done = run_study(chosen, out, pool_of(workers, scheduler), advance)
    page = write_study_page(done)
    if as_json:
        emit(done.head, done.metrics, as_json=True)
    else:
        _show(done)
        typer.echo(f"page: {page}")
    if done.missed or done.without_result:
        raise typer.Exit(1)


def one_thread() -> None:
    """Limit the numerical libraries to one thread, as in workers; they read these variables when they are imported."""
    for name in ("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS"):
        os.environ[name] = "1"


def pool_of(workers: int, scheduler: str | None = None) -> Pool:
    """The workers of a command: a Dask scheduler's, so many processes of this machine, or with 0 of them this process."""
    from hybridmap.study.pools import LocalProcesses, ThisProcess

    if scheduler is not None:
        from hybridmap.study.cluster import DaskCluster

        return DaskCluster(scheduler)
    return LocalProcesses(workers) if workers else ThisProcess()


def _show(done: Study) -> None:
    from rich.console import Console
    from rich.table import Table

    from hybridmap.errors import counted
    from hybridmap.report.study_page import baseline_of, error_of, remarks
    from hybridmap.study.measures import ERRORS

    console = Console()
    if not console.is_terminal:
        console = Console(width=140)
    known = len({cell.key for cell in done.grid.cells}) - done.computed
    counts = ", ".join(f"{count} {status}" for status, count in done.head["status"].items())
    table = Table(
        title=f"{done.head['study']}: {counted(done.head['cells'], 'cell')} ({counts}); {known} computed earlier",
        title_justify="left",
    )
    measure, others = error_of(done), [name for name in _COLUMNS if _known(done, name)]
    error = ERRORS[measure] if sum(_known(done, name) for name in ERRORS) < 2 else "error"
    table.add_column("source / setting / false loops")
    table.add_column("back-end")
    for column in ("own map in", f"median {error} (m)", f"median minus {baseline_of(done)} (m)", "p"):
        table.add_column(column, justify="right")
    for name in others:
        table.add_column(_COLUMNS[name], justify="right")
    for line in _lines(done, others):
        table.add_row(*line)
    console.print(table)
    _show_effects(done, console)
    for verdict in done.missed:
        unit = "" if verdict.unit == "1" else f" {verdict.unit}"
        missed = f"missed: {verdict.label}: {verdict.bar.figure} {verdict.value:.4g}{unit}, {verdict.said}"
        console.print(missed, soft_wrap=True, markup=False, highlight=False)
    if done.verdicts:
        console.print(f"bars: {len(done.verdicts) - len(done.missed)} of {len(done.verdicts)} kept", highlight=False)
    for remark in remarks(done):
        where = f"{counted(remark.count, 'cell')} {remark.status}: {remark.where}, {remark.backend}"
        console.print(f"note: {where}: {remark.message}", soft_wrap=True, markup=False, highlight=False)


def _show_effects(done: Study, console: Console) -> None:
    """Print what each setting changes against the first one, over all of its sources; where it has one, for that."""
    from rich.table import Table

    from hybridmap.errors import counted
    from hybridmap.report.study_page import effect_lines

    several = {one.cell.setting for one in done.effects if one.pooled}
    lines = [line for line in effect_lines(done) if line.pooled or line.setting not in several]
    if not lines:
        return
    first = done.grid.study.settings[0].name
    left_out = len(done.effects) - len(lines)
    more = f"; {counted(left_out, 'row')} of single sources in effects.csv and on the page" if left_out else ""
    table = Table(title=f"settings against {first}{more}", title_justify="left")
    for name in ("setting", "drives", "back-end"):
        table.add_column(name)
    for name in ("pairs", "minus (m)", "ratio", "p", "CPU"):
        table.add_column(name, justify="right")
    for line in lines:
        table.add_row(line.setting, line.where, line.backend, line.pairs, line.difference, line.ratio, line.p, line.cpu)
    console.print(table)


def _known(done: Study, measure: str) -> bool:
    return any(one.measure == measure and one.solved for one in done.summaries)


def _lines(done: Study, others: list[str]) -> list[list[str]]:
    from hybridmap.report.page_tables import interval, number
    from hybridmap.report.study_page import error_in

    by_group: dict[str, dict[str, dict[str, Summary]]] = {}
    for one in done.summaries:
        by_group.setdefault(one.cell.label, {}).setdefault(one.cell.backend, {})[one.measure] = one
    lines = []
    for label, backend, found, measure in (
        (label, backend, found, error_in(done, group)) for label, group in by_group.items() for backend, found in group.items()
    ):
        error = found[measure]
        apart = error.difference
        paired = "" if apart is None or not apart.count else interval(apart)
        p = "" if math.isnan(error.p) else f"{error.p:.2g}"
        each = (found[name] for name in (measure, *others))
        median, *figures = (number(one.median.value) if one.solved else "" for one in each)
        lines.append([label, backend, f"{error.solved - error.lost}/{error.cells}", median, paired, p, *figures])
    return lines
