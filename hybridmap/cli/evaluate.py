"""`hybridmap evaluate`: errors of a session against ground truth and verified relations."""

from __future__ import annotations

import logging
from pathlib import Path
from typing import Annotated

import typer

from hybridmap.cli.options import AsJson

log = logging.getLogger(__name__)


def evaluate(
    folder: Annotated[Path, typer.Argument(metavar="DIR", help="Session folder, as `hybridmap map` writes it.")],
    reference: Annotated[
        Path | None,
        typer.Option(
            metavar="GT.tum",
            help="Ground truth of base_link (TUM format: stamp in s, position in m, quaternion); "
            "default: the session's own reference, if it has one.",
        ),
    ] = None,
    relations: Annotated[
        Path | None, typer.Option(metavar="FILE", help="Verified relative poses, lines `t1 t2 dx dy dyaw` (s, m, rad).")
    ] = None,
    loops: Annotated[
        bool,
        typer.Option("--loops", help="Also evaluate how well the stored views tell places apart (needs ground truth)."),
    ] = False,
    as_json: AsJson = False,
) -> None:
    """Evaluate a session: ATE (m), RPE (m, deg), drift (%), relation errors (m, deg), precision and recall of loop closures.

    Precision: share of the accepted loops whose relative pose is within 1 m and 15 deg of the truth.
    Recall: share of the revisits that were closed. A revisit is a node within 1 m and 30 deg of one at least 10 s older. It
    counts as closed if a correct loop starts at most 3 nodes away.
    The results are printed and stored in the session's metrics.json, where they replace earlier ones of the same name; its
    page report.html is rewritten. Ground truth or relations are needed.
    """
    from hybridmap.cli.show import emit
    from hybridmap.errors import OutputError
    from hybridmap.evaluate import evaluate_session
    from hybridmap.report import write_report
    from hybridmap.store import SessionFolder

    session = SessionFolder(folder)
    metrics = evaluate_session(folder, reference, relations, loops=loops)
    try:
        write_report(session)
    except OutputError as error:
        log.warning("%s%s", error, "; the page stays as it was" if session.report.is_file() else "")
    emit(session.read_metrics().head, metrics, as_json=as_json, title=str(folder))
