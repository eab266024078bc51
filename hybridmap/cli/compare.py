"""`hybridmap compare`: one graph through several back-ends, one table, one referee."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

if TYPE_CHECKING:
    from hybridmap.backends.comparison import Row
    from hybridmap.cli.graphs import GraphSource

_DEFAULT = "odometry,relaxation-ratslam,gtsam-lm,gtsam-cauchy,gtsam-gnc"
_WIDTH = 140  # columns of a table that goes into a file


def compare(
    source: Annotated[Path, typer.Argument(metavar="DIR_OR_GRAPH", help="A session folder, or a planar g2o or TORO file.")],
    backends: Annotated[str, typer.Option(metavar="A,B,...", help="Back-ends, separated by commas.")] = _DEFAULT,
    out: Annotated[Path | None, typer.Option(metavar="DIR", help="Write maps.png and comparison.html here.")] = None,
    incremental: Annotated[
        bool,
        typer.Option("--incremental", help="Replay the graph node by node, as while driving, instead of solving it whole."),
    ] = False,
    config: Annotated[str | None, typer.Option(help="Configuration with the back-ends' settings: a name or a file.")] = None,
    setting: Annotated[list[str] | None, typer.Option("--set", help="KEY=VALUE, e.g. backends.gnc.start=batch.")] = None,
    as_json: Annotated[bool, typer.Option("--json", help="One JSON object on standard output.")] = False,
) -> None:
    """Compare back-ends on one frozen graph: chi2, status, iterations, CPU seconds, rejected loops, proof of
    optimality, ATE (m) if truth is known.

    A back-end that fails is a row that says so.
    """
    from hybridmap.backends import comparison
    from hybridmap.cli.graphs import open_graph, settings_of
    from hybridmap.cli.show import emit, progress
    from hybridmap.errors import BackendError, GraphError
    from hybridmap.metrics import Metric

    opened = open_graph(source)
    settings = settings_of(opened, config, setting)
    names = [name.strip() for name in backends.split(",") if name.strip()]
    if not names:
        raise BackendError("--backends: found no name, expected back-ends separated by commas")
    if out is not None and out.exists() and not out.is_dir():
        raise GraphError(f"{out}: is a file; --out names a folder")
    with progress(f"comparing on {source}") as advance:
        rows = comparison.compare(opened.graph, names, settings, incremental=incremental, certified=True, progress=advance)
    ate = _ate(opened, rows)
    cells = _table(rows, ate)
    if out is not None:
        from hybridmap.report.comparison import write_comparison

        write_comparison(out, f"Back-ends on {source.name}", opened.head, opened.graph, rows, cells)
    if not as_json:
        _show(cells, rows, title=f"{source}: {opened.graph.n_nodes} nodes, {opened.graph.n_edges} edges")
        return
    head = opened.head | {
        "incremental": incremental,
        "backends": names,
        "status": {row.backend: row.status for row in rows},
        "message": {row.backend: row.message for row in rows},
        "certificate": {row.backend: row.certificate.message for row in rows if row.certificate is not None},
    }
    metrics = comparison.metrics_of(rows)
    metrics += [Metric(f"ate_rmse/{name}", value, "m", "RMSE of position after SE(2) alignment") for name, value in ate.items()]
    emit(head, metrics, as_json=True)


def _ate(opened: GraphSource, rows: Sequence[Row]) -> dict[str, float]:
    """ATE of each solved row against the session's own truth; empty without one."""
    if not opened.is_session:
        return {}
    from hybridmap.evaluate.trajectory import absolute_error
    from hybridmap.store import MapStore, SessionFolder, trajectory_of
    from hybridmap.trajectory import read_tum

    truth = SessionFolder(opened.path).groundtruth
    if not truth.is_file():
        return {}
    reference = read_tum(truth)
    with MapStore.open(opened.path) as store:
        track = store.track()
    solved = {row.backend: row.solution.poses for row in rows if row.solution is not None}
    ways = {name: track.odometry if name == "odometry" else trajectory_of(track, poses) for name, poses in solved.items()}
    return {name: absolute_error(way, reference).rmse_m for name, way in ways.items()}


def _table(rows: Sequence[Row], ate: dict[str, float]) -> list[list[str]]:
    """Column titles, then a line of text a row."""
    columns = ["back-end", "chi2 initial", "chi2", *(["ATE (m)"] if ate else []), "status", "iterations", "CPU (s)"]
    table = [[*columns, "rejected loops", "certificate"]]
    for row in rows:
        if row.solution is None:
            table.append([row.backend, "", "", *([""] if ate else []), row.status, "", "", "", ""])
            continue
        report = row.solution.report
        error = [f"{ate[row.backend]:.3f}"] if ate else []
        figures = [f"{report.chi2_initial:.7g}", f"{report.chi2:.7g}", *error, row.status, str(report.iterations)]
        proof = row.certificate.word if row.certificate is not None else ""
        table.append([row.backend, *figures, f"{report.cpu_s:.2f}", str(len(report.rejected_edge_ids)), proof])
    return table


def _show(cells: Sequence[Sequence[str]], rows: Sequence[Row], title: str) -> None:
    from rich.box import SIMPLE
    from rich.console import Console
    from rich.table import Table

    console = Console()
    if not console.is_terminal:
        console = Console(width=_WIDTH)
    table = Table(title=title, title_justify="left", box=SIMPLE)
    for i, column in enumerate(cells[0]):
        table.add_column(column, justify="right" if i else "left")
    for line in cells[1:]:
        table.add_row(*line)
    console.print(table)
    for row in rows:
        typer.echo(f"{row.backend}: {row.message}")
