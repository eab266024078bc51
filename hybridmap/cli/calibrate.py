"""`hybridmap calibrate`: odometry gains from the closed loops of sessions, or from a reference."""

from __future__ import annotations

from contextlib import nullcontext
from pathlib import Path
from typing import Annotated

import typer


def calibrate(
    folders: Annotated[
        list[Path],
        typer.Argument(metavar="DIR...", help="Session folder; several of one robot (or kind of robot) are fitted together."),
    ],
    reference: Annotated[
        list[Path] | None,
        typer.Option(metavar="GT.tum", help="True trajectory of base_link, one a session, in the same order."),
    ] = None,
    estimator: Annotated[
        str | None, typer.Option(metavar="NAME", help="Without a reference: `alternating` (default) or `joint`.")
    ] = None,
    leg: Annotated[
        float | None,
        typer.Option(help="Length of the compared legs, m, 0.1 or more; not with `joint`. Default: by the drive, 1 to 16."),
    ] = None,
    out: Annotated[
        Path | None, typer.Option(metavar="FILE.yaml", help="Write the session's configuration with the gains.")
    ] = None,
    overwrite: Annotated[bool, typer.Option("--overwrite", help="Replace a file that is there.")] = False,
    as_json: Annotated[bool, typer.Option("--json", help="One JSON object on standard output.")] = False,
) -> None:
    """Linear gain, turn gain and heading bias (rad/m) of odometry, with standard deviations.

    What is written differs from the configuration in use only if the estimate does, by more than three sigma.
    """
    from hybridmap.calibration.estimate import calibrated, changes, metrics_of, verdict
    from hybridmap.calibration.sessions import common_tree, estimate_of, read_drive, require_options
    from hybridmap.cli.show import emit
    from hybridmap.odometry_model import Gains
    from hybridmap.output import staged, write_text
    from hybridmap.trajectory import read_tum

    require_options(len(folders), len(reference or []), estimator, leg)
    with nullcontext() if out is None else staged(out, overwrite=overwrite) as work:
        drives = [read_drive(folder) for folder in folders]
        truths = [read_tum(path) for path in reference or []]
        tree = {} if out is None else common_tree(drives)
        estimate = estimate_of(drives, truths, estimator, leg)
        in_use = Gains.of(drives[0].config.neural)
        if out is not None and work is not None:
            write_text(work / out.name, calibrated(tree, estimate, in_use))
    how = "reference" if truths else estimator or "alternating"
    head = {
        "sessions": [str(folder) for folder in folders],
        "estimator": how,
        "significant": changes(estimate, in_use),
        "message": verdict(estimate, in_use),
    }
    emit(head, metrics_of(estimate, in_use), as_json=as_json, title=f"{', '.join(map(str, folders))}: {how}")
    if not as_json:
        typer.echo(head["message"])
