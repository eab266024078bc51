"""`hybridmap optimize`: solve one graph with one back-end."""

from __future__ import annotations

from contextlib import nullcontext
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from hybridmap.cli.options import AsJson, ReplaceFile, SolverConfig, SolverSetting

if TYPE_CHECKING:
    from hybridmap.backends.base import Backend, Solution
    from hybridmap.cli.graphs import GraphSource

_Out = Annotated[
    Path | None, typer.Option(metavar="FILE.g2o", help="File for the optimised graph (m, rad). Default: nothing is written.")
]


def optimize(
    graph: Annotated[Path, typer.Argument(metavar="GRAPH", help="Planar g2o or TORO file, or session folder.")],
    backend: Annotated[
        str, typer.Option(metavar="NAME", help="Back-end, e.g. gtsam-lm. An unknown name gives the list.")
    ] = "gtsam-lm",
    out: _Out = None,
    overwrite: ReplaceFile = False,
    config: SolverConfig = None,
    setting: SolverSetting = None,
    as_json: AsJson = False,
) -> None:
    """Optimise a pose graph. Shows chi2 before, after and at least (proved), status, iterations, CPU seconds, and a verdict.

    The verdict is on the graph alone: what a drive knew beside it, such as lost messages, is in the verdict of `map`. It does
    not change the exit code.

    If the back-end fails, diverges or finds the graph singular, no file is written. The graph that is read is not changed,
    unless --out names its file and --overwrite is given.
    """
    from hybridmap.backends import create
    from hybridmap.backends.comparison import Row, metrics_of
    from hybridmap.backends.judging.certificate import certify
    from hybridmap.cli.graphs import open_graph, settings_of
    from hybridmap.cli.show import emit
    from hybridmap.verdict import Facts, reasons_of, said_of

    source = open_graph(graph)
    solution = _solved(source, create(backend, settings_of(source, config, setting)), out, overwrite=overwrite)
    report = solution.report
    proof = certify(source.graph, solution.poses, report.rejected_edge_ids)
    head = source.head | {
        "backend": backend,
        "status": str(report.status),
        "message": report.summary,
        "chi2_proof": proof.chi2_message,
        "certificate": proof.message,
        "rejected_edge_ids": list(report.rejected_edge_ids),
        "rejected_clusters": [list(cluster) for cluster in report.rejected_clusters],
        **said_of(reasons_of(Facts.of_graph(source.graph, solution))),
    }
    figures = metrics_of([Row(backend, solution, certificate=proof)])
    emit(head, figures, as_json=as_json, title=f"{graph}: {backend}: {report.status}")
    if not as_json:
        typer.echo(f"{report.summary}\nchi2: {proof.chi2_message}\ncertificate of F: {proof.message}")
    if not report.status.has_map:
        raise typer.Exit(1)


def _solved(source: GraphSource, backend: Backend, out: Path | None, *, overwrite: bool) -> Solution:
    """Solve the graph, and write the optimised one if there is a place for it and the back-end has a map."""
    from hybridmap.graph.io import held, write_g2o
    from hybridmap.output import staged
    from hybridmap.store import SessionFolder

    if source.is_session and out is not None:
        SessionFolder(source.path).require_foreign(out)
    with nullcontext() if out is None else staged(out, overwrite=overwrite) as work:
        solution = backend.solve(source.graph)
        if out is not None and work is not None and solution.report.status.has_map:
            write_g2o(work / out.name, source.graph, held(source.graph, solution.poses))
    return solution
