"""`hybridmap optimize`: one graph through one back-end."""

from __future__ import annotations

from contextlib import nullcontext
from pathlib import Path
from typing import Annotated

import typer


def optimize(
    graph: Annotated[Path, typer.Argument(metavar="GRAPH", help="A g2o or TORO file (planar), or a session folder.")],
    backend: Annotated[
        str, typer.Option(metavar="NAME", help="Back-end, e.g. gtsam-lm; a wrong name lists them.")
    ] = "gtsam-lm",
    out: Annotated[Path | None, typer.Option(metavar="FILE.g2o", help="Write the optimised graph here (m, rad).")] = None,
    overwrite: Annotated[bool, typer.Option("--overwrite", help="Replace a file that is there.")] = False,
    config: Annotated[str | None, typer.Option(help="Configuration with the back-end's settings: a name or a file.")] = None,
    setting: Annotated[list[str] | None, typer.Option("--set", help="KEY=VALUE, e.g. backends.gnc.start=batch.")] = None,
    as_json: Annotated[bool, typer.Option("--json", help="One JSON object on standard output.")] = False,
) -> None:
    """Optimise a graph: chi2 before and after, status, iterations, CPU seconds, proof of optimality.

    Exit code 1, and no file, where the back-end failed, diverged or found the graph singular.
    """
    from hybridmap.backends import create
    from hybridmap.backends.comparison import Row, metrics_of
    from hybridmap.backends.judging.certificate import certify
    from hybridmap.cli.graphs import open_graph, settings_of
    from hybridmap.cli.show import emit
    from hybridmap.graph.io import held, write_g2o
    from hybridmap.output import staged

    source = open_graph(graph)
    chosen = create(backend, settings_of(source, config, setting))
    with nullcontext() if out is None else staged(out, overwrite=overwrite) as work:
        solution = chosen.solve(source.graph)
        report = solution.report
        solved = report.status.has_map
        if out is not None and work is not None and solved:
            write_g2o(work / out.name, source.graph, held(source.graph, solution.poses))
    proof = certify(source.graph, solution.poses, report.rejected_edge_ids)
    head = source.head | {
        "backend": backend,
        "status": str(report.status),
        "message": report.summary,
        "certificate": proof.message,
        "rejected_edge_ids": list(report.rejected_edge_ids),
        "rejected_clusters": [list(cluster) for cluster in report.rejected_clusters],
    }
    emit(
        head,
        metrics_of([Row(backend, solution, certificate=proof)]),
        as_json=as_json,
        title=f"{graph}: {backend}: {report.status}",
    )
    if not as_json:
        typer.echo(f"{report.summary}\ncertificate: {proof.message}")
    if not solved:
        raise typer.Exit(1)
