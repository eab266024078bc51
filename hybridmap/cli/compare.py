"""`hybridmap compare`: solve one graph with several back-ends and show the results in one table."""

from __future__ import annotations

from collections.abc import Sequence
from contextlib import nullcontext
from math import isfinite
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from hybridmap.cli.options import AsJson, SolverConfig, SolverSetting

if TYPE_CHECKING:
    from hybridmap.backends.comparison import Row, Way
    from hybridmap.cli.graphs import GraphSource
    from hybridmap.evaluate.session_errors import Judged
    from hybridmap.metrics import Metric
    from hybridmap.verdict import Reason

_DEFAULT = "odometry,relaxation-ratslam,gtsam-lm,gtsam-cauchy,gtsam-gnc"
_WIDTH = 180  # columns of a table that goes into a file
_ERRORS = {"ate_rmse": "ATE (m)", "relation_trans_mean": "relations (m)", "relation_loop_trans_mean": "of loops (m)"}

_Out = Annotated[
    Path | None,
    typer.Option(
        metavar="DIR",
        help="Folder for maps.png and comparison.html: new, empty, or with --overwrite one with an earlier comparison."
        " Default: nothing is written.",
    ),
]
_Batch = Annotated[
    bool,
    typer.Option(
        "--batch",
        help="Solve the whole graph at once, from dead reckoning (session) or from the poses of the file. Default for files.",
    ),
]
_Incremental = Annotated[
    bool,
    typer.Option(
        "--incremental",
        help="Add the graph node by node, as while driving. Default for session folders: --batch and --incremental.",
    ),
]
_Reference = Annotated[
    Path | None,
    typer.Option(metavar="GT.tum", help="Session: ground truth of base_link (TUM format). Default: its own, if any."),
]
_Relations = Annotated[
    Path | None,
    typer.Option(metavar="FILE", help="Session: verified relative poses, lines `t1 t2 dx dy dyaw` (s, m, rad)."),
]


def compare(
    source: Annotated[Path, typer.Argument(metavar="DIR_OR_GRAPH", help="Session folder, or planar g2o or TORO file.")],
    backends: Annotated[
        str, typer.Option(metavar="A,B,...", help="Back-ends, separated by commas. An unknown name gives the list.")
    ] = _DEFAULT,
    out: _Out = None,
    overwrite: Annotated[bool, typer.Option("--overwrite", help="Replace an existing comparison.")] = False,
    batch: _Batch = False,
    incremental: _Incremental = False,
    reference: _Reference = None,
    relations: _Relations = None,
    config: SolverConfig = None,
    setting: SolverSetting = None,
    as_json: AsJson = False,
) -> None:
    """Compare back-ends on one graph: chi2, status, iterations, CPU seconds, rejected loops.

    Beside the chi2 of each map stands the proved gap to the least chi2 of any map over the edges that the back-end keeps. Each
    map gets a verdict with its reasons, on the graph alone. A session with ground truth or verified relations also gets errors
    (m). A session's graph is solved in batch and incrementally: two rows per back-end. A back-end that fails keeps its row,
    with the reason. The input is not changed.
    """
    from hybridmap.backends import comparison
    from hybridmap.cli.graphs import open_graph, settings_of
    from hybridmap.cli.show import progress
    from hybridmap.errors import EvaluationError
    from hybridmap.output import held
    from hybridmap.report.comparison_page import COMPARISON, Compared, write_comparison

    opened = open_graph(source)
    settings = settings_of(opened, config, setting)
    names = _names(backends)
    if not opened.is_session and (reference or relations):
        raise EvaluationError(f"{source}: a graph file has no stamps; --reference and --relations are for session folders")
    ways = _ways(opened, batch=batch, incremental=incremental)
    with nullcontext() if out is None else held(out, COMPARISON, overwrite=overwrite) as place:
        with progress(f"comparing on {source}") as advance:
            rows = comparison.compare(
                opened.graph, names, settings, ways=ways, certified=True, traced=out is not None, progress=advance
            )
        judged = _judged(opened, rows, reference, relations)
        reasons = _reasons(opened, rows)
        cells = _table(rows, reasons, judged.metrics)
        if place is not None:
            facts = (f"Back-ends on {source.name}", opened.start, opened.head, opened.graph)
            said = {title: [str(reason) for reason in found] for title, found in reasons.items()}
            write_comparison(place, Compared(*facts, rows, cells, settings, judged.truth, opened.kidnapped, said))
    if as_json:
        _emit(opened, ways, rows, reasons, judged.metrics)
    else:
        _show(opened, cells, rows, reasons, _done(opened, ways))


def _names(backends: str) -> list[str]:
    from hybridmap.errors import BackendError

    names = [name.strip() for name in backends.split(",") if name.strip()]
    if not names:
        raise BackendError("--backends: found no name; expected names of back-ends, separated by commas")
    return names


def _judged(opened: GraphSource, rows: Sequence[Row], reference: Path | None, relations: Path | None) -> Judged:
    """Errors of the rows that have a map; none for a graph file."""
    from hybridmap.evaluate.session_errors import Judged, judge_solutions

    if not opened.is_session:
        return Judged(())
    maps = {row.title: row.solution.poses for row in rows if row.solution is not None and row.has_map}
    return judge_solutions(opened.path, maps, reference, relations)


def _reasons(opened: GraphSource, rows: Sequence[Row]) -> dict[str, Sequence[Reason]]:
    """Title of each row with a solution -> reasons against its map."""
    from hybridmap.verdict import Facts, reasons_of

    solved = {row.title: row.solution for row in rows if row.solution is not None}
    return {title: reasons_of(Facts.of_graph(opened.graph, one)) for title, one in solved.items()}


def _emit(
    opened: GraphSource,
    ways: Sequence[Way],
    rows: Sequence[Row],
    reasons: dict[str, Sequence[Reason]],
    judged: Sequence[Metric],
) -> None:
    from hybridmap.backends.comparison import metrics_of
    from hybridmap.cli.show import emit
    from hybridmap.verdict import said_of

    said = {title: said_of(found) for title, found in reasons.items()}
    head = opened.head | {
        "start": opened.start,
        "ways": [str(way) for way in ways],
        "backends": [row.title for row in rows],
        "status": {row.title: row.status for row in rows},
        "verdicts": {title: one["verdict"] for title, one in said.items()},
        "reasons": {title: one["reasons"] for title, one in said.items()},
        "message": {row.title: row.message for row in rows},
        "chi2_proof": {row.title: row.certificate.chi2_message for row in rows if row.certificate is not None},
        "certificate": {row.title: row.certificate.message for row in rows if row.certificate is not None},
    }
    emit(head, [*metrics_of(rows), *judged], as_json=True)


def _ways(opened: GraphSource, *, batch: bool, incremental: bool) -> list[Way]:
    """The requested ways; by default both for a session, and batch alone for a file, which may be large."""
    from hybridmap.backends.comparison import Way

    asked = [way for way, given in ((Way.BATCH, batch), (Way.INCREMENTAL, incremental)) if given]
    return asked or ([Way.BATCH, Way.INCREMENTAL] if opened.is_session else [Way.BATCH])


def _done(opened: GraphSource, ways: Sequence[Way]) -> str:
    from hybridmap.backends.comparison import Way

    words = {Way.BATCH: f"batch from {opened.start}", Way.INCREMENTAL: "incremental from the first node on"}
    return ", ".join(words[way] for way in ways)


def _table(rows: Sequence[Row], reasons: dict[str, Sequence[Reason]], judged: Sequence[Metric]) -> list[list[str]]:
    """Column titles, then one list of cells per row."""
    from hybridmap.report.page_tables import number
    from hybridmap.verdict import verdict_of

    by_name = {metric.name: f"{metric.value:.4f}" if isfinite(metric.value) else "–" for metric in judged}
    errors = {name: title for name, title in _ERRORS.items() if any(key.startswith(f"{name}/") for key in by_name)}
    columns = [
        "back-end",
        "way",
        "chi2",
        "gap of chi2",
        "unit variance",
        *errors.values(),
        "status",
        "verdict",
        "iterations",
        "CPU (s)",
    ]
    table = [[*columns, "rejected loops", "certificate of F"]]
    for row in rows:
        if row.solution is None:
            table.append([row.backend, str(row.way), "", "", "", *("" for _ in errors), row.status, "", "", "", "", ""])
            continue
        report = row.solution.report
        against = [by_name.get(f"{name}/{row.title}", "") for name in errors]
        variance = "" if report.unit_variance is None else number(report.unit_variance)
        proof = row.certificate
        figures = [
            f"{report.chi2:.7g}",
            proof.chi2_word if proof is not None else "",
            variance,
            *against,
            row.status,
            str(verdict_of(reasons[row.title])),
            str(report.iterations),
            f"{report.cpu_s:.2f}",
        ]
        isotropic = proof.word if proof is not None else ""
        table.append([row.backend, str(row.way), *figures, str(len(report.rejected_edge_ids)), isotropic])
    return table


def _show(
    opened: GraphSource,
    cells: Sequence[Sequence[str]],
    rows: Sequence[Row],
    reasons: dict[str, Sequence[Reason]],
    done: str,
) -> None:
    from rich.box import SIMPLE
    from rich.console import Console
    from rich.table import Table

    from hybridmap.cli.show import print_title
    from hybridmap.errors import counted

    console = Console()
    if not console.is_terminal:
        console = Console(width=_WIDTH)
    for remark in opened.head.get("remarks", ()):
        typer.echo(f"note: {remark}")
    size = f"{counted(opened.graph.n_nodes, 'node')}, {counted(opened.graph.n_edges, 'edge')}"
    print_title(console, f"{opened.path}: {size}; {done}")
    table = Table(box=SIMPLE)
    for i, column in enumerate(cells[0]):
        table.add_column(column, justify="right" if i > 1 else "left", no_wrap=i < 2)
    for line in cells[1:]:
        table.add_row(*line)
    console.print(table)
    for row in rows:
        typer.echo(f"{row.title}: {row.remark}")
    for title, found in reasons.items():
        for reason in found:
            typer.echo(f"{title}: reason: {reason}")
