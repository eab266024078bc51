"""`hybridmap demo`: renders its own world, maps it, and says what came out."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from hybridmap.cli.show import emit

_SHOWN = ("nodes", "loops_accepted", "travel", "duration", "largest_correction", "ate_rmse", "ate_rmse_online", "drift", "chi2")


def demo(
    out: Annotated[Path, typer.Option(help="The session folder itself.")] = Path("hybridmap-demo"),
    world: Annotated[str, typer.Option(help="Simulated world.")] = "lab",
    seed: Annotated[int, typer.Option(help="Seed of the drive and its noise.", min=0)] = 0,
    overwrite: Annotated[bool, typer.Option("--overwrite", help="Replace a session that is there.")] = False,
    as_json: Annotated[bool, typer.Option("--json", help="One JSON object on standard output.")] = False,
) -> None:
    """Render a world, map it with relaxation and GTSAM side by side, and write the session folder. Needs no data."""
    from hybridmap.cli.choose import choose
    from hybridmap.cli.map import map_and_report

    chosen = choose(f"sim:{world}", None, {"seed": seed})
    head, metrics = map_and_report(chosen.stream, chosen.config, out, overwrite=overwrite)
    shown = [metric for metric in metrics if metric.name.partition("/")[0] in _SHOWN]
    emit(head, metrics if as_json else shown, as_json=as_json, title=f"simulated {world}")
    if not as_json:
        typer.echo(f"page: {out / 'report.html'}")
