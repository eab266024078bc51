"""`hybridmap demo`: simulate a world, map it, and show the result."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from hybridmap.cli.options import OUT, SEED, AsJson
from hybridmap.cli.show import emit

_SHOWN = ("nodes", "loops_accepted", "travel", "duration", "largest_correction", "ate_rmse", "ate_rmse_online", "drift", "chi2")


def demo(
    out: Annotated[Path, typer.Option(help=OUT)] = Path("hybridmap-demo"),
    world: Annotated[str, typer.Option(help="World to simulate: lab, office, corridor, corridor-landmarks or campus.")] = "lab",
    seed: Annotated[int, typer.Option(help=SEED, min=0)] = 0,
    overwrite: Annotated[bool, typer.Option("--overwrite", help="Replace an existing session.")] = False,
    as_json: AsJson = False,
) -> None:
    """Simulate a drive, map it with relaxation and GTSAM on the same graph, and write a session folder. Needs no data.

    The folder is as by `hybridmap map`: map, trajectories, ground truth, configuration, metrics.json and the page report.html.
    """
    from hybridmap.cli.choose import choose
    from hybridmap.cli.map import map_and_report

    chosen = choose(f"sim:{world}", None, {"seed": seed})
    head, metrics = map_and_report(chosen.stream, chosen.config, out, overwrite=overwrite)
    shown = [metric for metric in metrics if metric.name.partition("/")[0] in _SHOWN]
    emit(head, metrics if as_json else shown, as_json=as_json, title=f"simulated {world}")
    if not as_json:
        typer.echo(f"page: {out / 'report.html'}")
