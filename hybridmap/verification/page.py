"""The verification's folder: `metrics.json` and one self-contained page."""

from __future__ import annotations

from collections.abc import Sequence
from importlib.metadata import version
from pathlib import Path
from typing import Any

from hybridmap.metrics import Metric, to_json
from hybridmap.output import Held, Kind, write_text
from hybridmap.report import tables
from hybridmap.report.template import is_page, rendered
from hybridmap.verification import Verification, figures, maps_figure
from hybridmap.verification.rows import recurrence_verdict

PAGE, METRICS = "verify.html", "metrics.json"
VERIFICATION = Kind("verification", (PAGE, METRICS), lambda folder: is_page(folder / PAGE))
_TEMPLATE = "verify.html.j2"


def write_verification(place: Held, head: dict[str, Any], rows: Sequence[Metric], result: Verification) -> Path:
    """Write `metrics.json` and `verify.html` into a folder that is held as `VERIFICATION`; returns the page.

    Raises:
        OutputError: it cannot be written to.
    """
    text = _render(head, rows, result)
    with place.replaced():
        write_text(place.path / METRICS, to_json(head, rows) + "\n")
        write_text(place.path / PAGE, text)
    return place.path / PAGE


def _scale_of(result: Verification) -> dict[str, str]:
    """Sizes and numbers of what the captions speak of."""
    lattice, place = result.lattice, result.place
    noisy = next(iter(result.noise.values()))
    return {
        "arena_m": f"{lattice.grid.shape[-1] * lattice.pitch_m:.2g}",
        "pixel_cm": f"{100.0 * lattice.pitch_m:.3g}",
        "grid_cells": str(lattice.gridness.size),
        "place_arena_m": f"{place.recruited.examples.shape[-1] * place.pitch_m:.2g}",
        "place_pixel_cm": f"{100.0 * place.pitch_m:.3g}",
        "noise_drives": str(len(noisy)),
        "shift_mm": f"{1e3 * result.overwritten['softplus'].shift_m:.0f}",
    }


def _render(head: dict[str, Any], rows: Sequence[Metric], result: Verification) -> str:
    named = {row.name.removeprefix("verify/"): row for row in rows}
    first = next(iter(result.room.values()))
    return rendered(
        _TEMPLATE,
        head=head,
        rows=[(row.name.removeprefix("verify/"), tables.number(row.value), tables.unit(row), row) for row in rows],
        value={name: tables.number(row.value) for name, row in named.items()},
        judged=sum(row.passed is not None for row in rows),
        drives=len(first),
        scale=_scale_of(result),
        distance=f"{first[0].distance_m[-1]:.0f}",
        verdict=recurrence_verdict(result.place),
        heading=figures.heading_figure(result.head_direction),
        stripes=maps_figure.stripes_figure(result.lattice),
        grid=maps_figure.grid_figure(result.lattice),
        square=maps_figure.grid_figure(result.square),
        place=maps_figure.place_figure(result.place),
        phase=figures.phase_figure(result),
        modules=figures.module_figure(first, result.lattice.spacings_m),
        shadow=figures.shadow_figure(result.overwritten["softplus"]),
        noise=figures.noise_figure(result),
        printed_kernel=result.printed_kernel,
        version=version("hybridmap"),
    )
