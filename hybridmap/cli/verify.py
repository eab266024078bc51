"""`hybridmap verify`: check the path integration cells against physiology and exact integration, or run them along a path."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from hybridmap.cli.options import AsJson
from hybridmap.errors import ConfigError

if TYPE_CHECKING:
    from hybridmap.config import Config
    from hybridmap.metrics import Metric
    from hybridmap.output import Held

_SHUFFLES = 100


def verify(
    out: Annotated[
        Path,
        typer.Option(
            metavar="DIR",
            help="Folder for verify.html and metrics.json: new, empty, or with --overwrite one with an earlier verification.",
        ),
    ],
    seed: Annotated[int, typer.Option(help="Random seed of drives, sampled cells, spikes and noise.", min=0)] = 0,
    setting: Annotated[
        list[str] | None,
        typer.Option("--set", help="KEY=VALUE of the cells, e.g. neural.spacing_max_m=0.6. Keys: docs/configuration.md."),
    ] = None,
    trajectory: Annotated[
        Path | None,
        typer.Option(
            metavar="FILE",
            help="Run the cells along this path instead, and let some of them spike: TUM, CSV with t,x,y[,heading] "
            "(s, m, rad), or NWB (needs the extra nwb). Writes cells.csv too.",
        ),
    ] = None,
    nwb: Annotated[
        bool,
        typer.Option("--nwb", help="With --trajectory: also write cells.nwb, with positions, rates and spikes (extra nwb)."),
    ] = False,
    concentration: Annotated[
        float,
        typer.Option(
            help="With --trajectory: concentration (1) of a von Mises tuning of the head-direction cells; 5 is as sharp as "
            "many real cells, 0 is the paper's cosine. The heading is exact with either.",
            min=0.0,
        ),
    ] = 0.0,
    shuffles: Annotated[
        int, typer.Option(help="With --trajectory: how often the spikes of a cell are shifted in time, for chance.", min=1)
    ] = _SHUFFLES,
    overwrite: Annotated[bool, typer.Option("--overwrite", help="Replace an existing verification.")] = False,
    as_json: AsJson = False,
) -> None:
    """Verify the head-direction, band, grid and place cells against stated limits (m, rad, deg, %). Needs no data.

    Writes a table of the values (metrics.json) and a page with pictures (verify.html), also if a value misses its limit.
    """
    from hybridmap.cli.choose import parse_settings
    from hybridmap.config import Config
    from hybridmap.output import held
    from hybridmap.verification.page import VERIFICATION

    config = Config.load(None, parse_settings(setting))
    given = {"--nwb": nwb, "--concentration": concentration > 0.0, "--shuffles": shuffles != _SHUFFLES}
    if trajectory is None and any(given.values()):
        raise ConfigError(f"{next(name for name, is_given in given.items() if is_given)}: needs --trajectory FILE")
    with held(out, VERIFICATION, overwrite=overwrite) as place:
        if trajectory is None:
            title = f"The spatial cells, seed {seed}"
            head, rows = _on_drives(place, config, seed)
        else:
            title = f"The spatial cells along {trajectory.name}, seed {seed}"
            head, rows = _along(place, config, seed, trajectory, concentration, shuffles, nwb=nwb)
    _show(place, head, rows, title, as_json=as_json)


def _on_drives(place: Held, config: Config, seed: int) -> tuple[dict[str, Any], list[Metric]]:
    """Run the experiments on made-up drives and write what they found; the head and the rows."""
    from hybridmap.cli.show import progress
    from hybridmap.verification import Scale, rows_of, verify_cells
    from hybridmap.verification.page import write_verification

    with progress("verifying the cells") as advance:
        result = verify_cells(seed, Scale(), config.neural.model_dump(), advance)
    rows = rows_of(result)
    head = {"seed": seed} | _judged(rows)
    write_verification(place, head, rows, result)
    return head, rows


def _along(
    place: Held, config: Config, seed: int, trajectory: Path, concentration: float, shuffles: int, *, nwb: bool
) -> tuple[dict[str, Any], list[Metric]]:
    """Run the cells along a recorded path and write what their spikes show; the head and the rows."""
    from hybridmap.cli.show import progress
    from hybridmap.verification import path_rows, read_path, verify_along
    from hybridmap.verification.page import write_along

    if nwb:
        from hybridmap.errors import ExportError
        from hybridmap.verification.nwb import pynwb_for

        pynwb_for("--nwb", ExportError)
    recorded = read_path(trajectory)
    with progress("running the cells along the path") as advance:
        settings = config.neural.model_dump()
        result = verify_along(recorded, seed, settings, concentration, shuffles, progress=advance)
    rows = path_rows(result)
    heading = "from the file" if recorded.headings_rad is not None else "direction of movement"
    head = {"trajectory": trajectory.name, "heading": heading, "seed": seed, "shuffles": shuffles} | _judged(rows)
    write_along(place, head, rows, result, nwb=nwb)
    return head, rows


def _judged(rows: list[Metric]) -> dict[str, Any]:
    failed = [row.name for row in rows if row.passed is False]
    return {"passed": not failed, "failed": failed}


def _show(place: Held, head: dict[str, Any], rows: list[Metric], title: str, *, as_json: bool) -> None:
    """Print the table and the verdict.

    Raises:
        Exit: with 1, if a row misses its bar.
    """
    from hybridmap.cli.show import emit
    from hybridmap.verification.page import PAGE

    emit(head, rows, as_json=as_json, title=title)
    failed = head["failed"]
    if not as_json:
        judged = sum(row.passed is not None for row in rows)
        verdict = (
            f"{len(failed)} of {judged} rows miss their bar: {', '.join(failed)}" if failed else f"all {judged} bars are kept"
        )
        typer.echo(f"{verdict}\npage: {place.path / PAGE}")
    if failed:
        raise typer.Exit(1)
