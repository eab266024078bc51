"""`hybridmap verify`: check the path integration cells against physiology and exact integration."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from hybridmap.cli.options import AsJson


def verify(
    out: Annotated[
        Path,
        typer.Option(
            metavar="DIR",
            help="Folder for verify.html and metrics.json: new, empty, or with --overwrite one with an earlier verification.",
        ),
    ],
    seed: Annotated[int, typer.Option(help="Random seed of drives, sampled cells and noise.", min=0)] = 0,
    setting: Annotated[
        list[str] | None,
        typer.Option("--set", help="KEY=VALUE of the cells, e.g. neural.spacing_max_m=0.6. Keys: docs/configuration.md."),
    ] = None,
    overwrite: Annotated[bool, typer.Option("--overwrite", help="Replace an existing verification.")] = False,
    as_json: AsJson = False,
) -> None:
    """Verify the head-direction, band, grid and place cells against stated limits (m, rad, deg, %). Needs no data.

    Writes a table of the values (metrics.json) and a page with pictures (verify.html), also if a value misses its limit.
    """
    from hybridmap.cli.choose import parse_settings
    from hybridmap.cli.show import emit, progress
    from hybridmap.config import Config
    from hybridmap.output import held
    from hybridmap.verification import Scale, rows_of, verify_cells
    from hybridmap.verification.page import VERIFICATION, write_verification

    config = Config.load(None, parse_settings(setting))
    with held(out, VERIFICATION, overwrite=overwrite) as place:
        with progress("verifying the cells") as advance:
            result = verify_cells(seed, Scale(), config.neural.model_dump(), advance)
        rows = rows_of(result)
        failed = [row.name for row in rows if row.passed is False]
        head = {"seed": seed, "passed": not failed, "failed": failed}
        page = write_verification(place, head, rows, result)
    emit(head, rows, as_json=as_json, title=f"The spatial cells, seed {seed}")
    if not as_json:
        judged = sum(row.passed is not None for row in rows)
        verdict = (
            f"{len(failed)} of {judged} rows miss their bar: {', '.join(failed)}" if failed else f"all {judged} bars are kept"
        )
        typer.echo(f"{verdict}\npage: {page}")
    if failed:
        raise typer.Exit(1)
