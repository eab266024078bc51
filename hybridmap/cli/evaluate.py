"""`hybridmap evaluate`: a session against a reference and against verified relations."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer


def evaluate(
    folder: Annotated[Path, typer.Argument(metavar="DIR", help="Session folder, as `hybridmap map` writes it.")],
    reference: Annotated[
        Path | None,
        typer.Option(
            metavar="GT.tum",
            help="True trajectory of base_link (TUM format: stamp in s, position in m, quaternion); "
            "default: the session's own reference, if it has one.",
        ),
    ] = None,
    relations: Annotated[
        Path | None, typer.Option(metavar="FILE", help="Verified relative poses, lines `t1 t2 dx dy dyaw` (s, m, rad).")
    ] = None,
    as_json: Annotated[bool, typer.Option("--json", help="Print one JSON object instead of a table.")] = False,
) -> None:
    """ATE, RPE (m, deg), drift (%), relation errors (m, deg), loop precision and recall; also put into metrics.json."""
    from hybridmap.cli.show import emit
    from hybridmap.evaluate import evaluate_session
    from hybridmap.report import write_report
    from hybridmap.store import SessionFolder

    metrics = evaluate_session(folder, reference, relations)
    if SessionFolder(folder).report.is_file():
        write_report(SessionFolder(folder))
    emit(SessionFolder(folder).read_metrics().head, metrics, as_json=as_json, title=str(folder))
