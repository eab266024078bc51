"""`hybridmap verify`: the spatial cells against physiology and against exact integration."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer


def verify(
    out: Annotated[Path, typer.Option(metavar="DIR", help="Write verify.html and metrics.json here.")],
    seed: Annotated[int, typer.Option(help="Seed of all drives, sampled cells and noises.", min=0)] = 0,
    setting: Annotated[list[str] | None, typer.Option("--set", help="KEY=VALUE, e.g. neural.kernel_gain_first=1.3.")] = None,
    overwrite: Annotated[bool, typer.Option("--overwrite", help="Replace a verification that is there.")] = False,
    as_json: Annotated[bool, typer.Option("--json", help="One JSON object on standard output.")] = False,
) -> None:
    """Verify the spatial cells: a table of figures (m, rad, deg, %) against stated bars, and a page. Needs no data.

    Exit code 1 if a row misses its bar.
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
