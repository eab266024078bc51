"""`hybridmap calibrate`: the systematic errors of odometry, from loop closures or a reference trajectory."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Annotated

import typer

from hybridmap.cli.options import AsJson, ReplaceFile

_Leg = Annotated[
    float | None,
    typer.Option(help="Pieces of the drive of this length, m, are compared; not with `joint`. Default: 1/16 of it, 1 to 16 m."),
]

_Reference = Annotated[
    list[Path] | None,
    typer.Option(
        metavar="GT.tum",
        help="Ground truth of base_link (TUM format); repeat the option, one per session, in the same order.",
    ),
]

_Estimator = Annotated[
    str | None,
    typer.Option(
        metavar="NAME",
        help="Method on loop closures, so not with --reference: `alternating` (default), or `joint`, which takes one session.",
    ),
]

_Out = Annotated[
    Path | None,
    typer.Option(
        metavar="FILE.yaml",
        help="Write the configuration of the sessions, corrected as said above, to this file. Default: nothing is written.",
    ),
]


def calibrate(
    folders: Annotated[
        list[Path],
        typer.Argument(metavar="DIR...", help="Session folder. Several sessions of one robot give one estimate for all."),
    ],
    reference: _Reference = None,
    estimator: _Estimator = None,
    leg: _Leg = None,
    out: _Out = None,
    overwrite: ReplaceFile = False,
    as_json: AsJson = False,
) -> None:
    """Estimate the systematic errors of wheel odometry: gain, turn gain, heading bias (rad/m) and delay (s).

    The estimate comes from the loop closures of the sessions, or from reference trajectories if they are given. It is
    printed, with standard deviations; the sessions stay as they are.

    --out writes the configuration that all sessions share, with the values that are replaced. If gain, turn gain or heading
    bias in use differs from the estimate by more than three standard deviations, all three are replaced, but for those that
    the drives do not determine. The delay is decided by itself: its estimate is what is left beside the delay in use, and is
    added to that if it is more than three standard deviations from 0.
    """
    from hybridmap.calibration.estimate import calibrated, changes, metrics_of, verdict
    from hybridmap.calibration.sessions import common_tree, estimate_of, read_drive, require_options
    from hybridmap.cli.show import emit
    from hybridmap.odometry_model import Gains
    from hybridmap.output import write_text
    from hybridmap.trajectory import read_tum

    require_options(len(folders), len(reference or []), estimator, leg)
    with _place(folders, out, overwrite=overwrite) as place:
        drives = [read_drive(folder) for folder in folders]
        truths = [read_tum(path) for path in reference or []]
        tree = {} if out is None else common_tree(drives)
        estimate = estimate_of(drives, truths, estimator, leg)
        in_use = Gains.of(drives[0].config.neural)
        if place is not None:
            write_text(place, calibrated(tree, estimate, in_use, drives[0].delay_s))
    how = "reference" if truths else estimator or "alternating"
    head = {
        "sessions": [str(folder) for folder in folders],
        "estimator": how,
        "significant": changes(estimate, in_use),
        "message": verdict(estimate, in_use),
    }
    emit(head, metrics_of(estimate, in_use, drives[0].delay_s), as_json=as_json, title=f"{', '.join(map(str, folders))}: {how}")
    if not as_json:
        typer.echo(head["message"])


@contextmanager
def _place(folders: list[Path], out: Path | None, *, overwrite: bool) -> Iterator[Path | None]:
    """Where to write the configuration while it is staged; None if none is wanted."""
    from hybridmap.output import staged
    from hybridmap.store import SessionFolder

    if out is None:
        yield None
        return
    for folder in folders:
        SessionFolder(folder).require_foreign(out)
    with staged(out, overwrite=overwrite) as work:
        yield work / out.name
