"""The verification's output: `metrics.json` and one self-contained page with figures; along a path also its cells as files."""

from __future__ import annotations

from collections.abc import Sequence
from importlib.metadata import version
from pathlib import Path
from typing import Any

import numpy as np

from hybridmap.metrics import Metric, to_json
from hybridmap.output import Held, Kind, write_text
from hybridmap.report import page_tables as tables
from hybridmap.report import style
from hybridmap.report.page_tables import is_page, rendered
from hybridmap.verification import CellVerification, maps_figure
from hybridmap.verification.path_error import HeadDirectionResult, PathErrors
from hybridmap.verification.recorded import RATE_HZ
from hybridmap.verification.rows import PHASE_BAR_PERCENT, ROOM_BAR_MM, noise_curve, recurrence_verdict
from hybridmap.verification.shadow import Cells, Overwriting
from hybridmap.verification.single_cells import CHANCE, SCORES, PathVerification

PAGE, METRICS, CELLS, NWB = "verify.html", "metrics.json", "cells.csv", "cells.nwb"
VERIFICATION = Kind("verification", (PAGE, METRICS, CELLS, NWB), lambda folder: is_page(folder / PAGE))
_TEMPLATE, _PATH_TEMPLATE = "verify.html.j2", "verify_path.html.j2"


def write_verification(place: Held, head: dict[str, Any], rows: Sequence[Metric], result: CellVerification) -> Path:
    """Write `metrics.json` and `verify.html`.

    Args:
        place: the folder, locked against other writers.
        head: facts about the run, by name; they become keys of `metrics.json` and the head of the page.
        rows: the metrics in the table.
        result: results of the experiments, for the pictures.

    Returns:
        The path of the page.

    Raises:
        OutputError: the folder cannot be written to.
    """
    text = _render(head, rows, result)
    with place.replaced():
        write_text(place.path / METRICS, to_json(head, rows) + "\n")
        write_text(place.path / PAGE, text)
    return place.path / PAGE


def write_along(place: Held, head: dict[str, Any], rows: Sequence[Metric], result: PathVerification, *, nwb: bool) -> Path:
    """Write `metrics.json`, `verify.html`, `cells.csv` (a line a cell) and, if asked for, `cells.nwb`.

    Args:
        place: the folder, locked against other writers.
        head: facts about the run, by name; they become keys of `metrics.json` and the head of the page.
        rows: the metrics in the table.
        result: the cells along the path.
        nwb: whether to write `cells.nwb`.

    Returns:
        The path of the page.

    Raises:
        ExportError: pynwb is not installed.
        OutputError: the folder cannot be written to.
    """
    text = rendered(
        _PATH_TEMPLATE,
        **_table_of(head, rows),
        track=result.track,
        concentration=result.heading_concentration,
        chance_percent=f"{100.0 * CHANCE:g}",
        pixel_cm=f"{100.0 * result.arena.pitch_m:.3g}",
        path=maps_figure.recorded_path_figure(result),
        grid=maps_figure.spiking_grid_figure(result),
        others=maps_figure.spiking_others_figure(result),
        chance=maps_figure.chance_figure(result),
    )
    with place.replaced():
        write_text(place.path / METRICS, to_json(head, rows) + "\n")
        write_text(place.path / CELLS, _cells_csv(result))
        if nwb:
            from hybridmap.verification.nwb import write_nwb

            write_nwb(place.path / NWB, result, int(head["seed"]))
        write_text(place.path / PAGE, text)
    return place.path / PAGE


def _cells_csv(result: PathVerification) -> str:
    """Table of the cells, one a line: what it is, its spikes, its scores, those of chance and of its rate; empty: not asked."""
    names = list(dict.fromkeys(name for scores in SCORES.values() for name in scores))
    columns = ["cell", "kind", "module", "spacing_m", "preferred_deg", "spikes", "mean_hz", "peak_hz", "width_deg"]
    lines = [",".join([*columns, *(f"{name}{end}" for name in names for end in ("", "_chance", "_of_rates"))])]
    for number, (cell, fired, found) in enumerate(zip(result.cells, result.spikes, result.results, strict=True)):
        mean_hz = len(fired) * RATE_HZ / len(result.arena.bins)
        angles = np.degrees([cell.preferred_rad, found.width_rad])
        values = [cell.spacing_m, angles[0], len(fired), mean_hz, float(np.nanmax(found.rates)), angles[1]]
        for name in names:
            values += [part.get(name, float("nan")) for part in (found.scores, found.chance, found.true_scores)]
        texts = [f"{value:.6g}" if np.isfinite(value) else "" for value in values]
        lines.append(",".join([str(number), cell.kind, str(cell.module) if cell.module >= 0 else "", *texts]))
    return "\n".join(lines) + "\n"


def _table_of(head: dict[str, Any], rows: Sequence[Metric]) -> dict[str, Any]:
    """What every page of a verification shows at its top, for the template."""
    return {
        "head": head,
        "rows": [(row.name.removeprefix("verify/"), tables.number(row.value), tables.unit(row), row) for row in rows],
        "value": {row.name.removeprefix("verify/"): tables.number(row.value) for row in rows},
        "judged": sum(row.passed is not None for row in rows),
        "version": version("hybridmap"),
    }


def _scale_of(result: CellVerification) -> dict[str, str]:
    """Sizes and numbers for the captions."""
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


def _render(head: dict[str, Any], rows: Sequence[Metric], result: CellVerification) -> str:
    first = next(iter(result.room.values()))
    return rendered(
        _TEMPLATE,
        **_table_of(head, rows),
        **figures_of(result),
        drives=len(first),
        scale=_scale_of(result),
        distance=f"{first[0].distance_m[-1]:.0f}",
        verdict=recurrence_verdict(result.place),
        printed_kernel=result.printed_kernel,
    )


def figures_of(result: CellVerification) -> dict[str, str]:
    """Every picture of the page: its name in the template -> a `data:` URI."""
    return {
        "heading": heading_figure(result.head_direction),
        "stripes": maps_figure.stripes_figure(result.lattice),
        "grid": maps_figure.grid_figure(result.lattice),
        "square": maps_figure.grid_figure(result.square),
        "place": maps_figure.place_figure(result.place),
        "room": maps_figure.room_figure(result.room_fields),
        "phase": phase_figure(result),
        "modules": module_figure(next(iter(result.room.values())), result.lattice.spacings_m),
        "shadow": shadow_figure(result.overwritten["softplus"]),
        "noise": noise_figure(result),
    }


_COLOURS = {"relu": "#0072b2", "softplus": "#009e73"}
_TUNINGS = {"cosine": "cosine", "von_mises": "von Mises"}
_DASHES: dict[float, Any] = {30.0: "solid", 100.0: (0, (4, 1.2))}
_NOISE_COLOURS = ("#fde725", "#5ec962", "#21918c", "#3b528b", "#440154")


def heading_figure(heading: HeadDirectionResult) -> str:
    """Draw tuning curves of head-direction cells, and the ring's activity at four turn rates.

    The curves are of six cells of the paper's ring, and of one cell of it beside one with von Mises's tuning.

    Returns:
        A `data:` URI.
    """
    degrees = np.degrees(heading.preferred_rad)
    with style.figure(style.PAGE_WIDTH_IN, 2.7) as picture:
        ring, one, sharper = picture.subplots(1, 3)
        for rates in heading.tuning:
            ring.plot(range(360), rates, linewidth=1.4)
        ring.set(title="Six cells of the ring", xlabel="heading (deg)", ylabel="rate")
        for number, (turn_rate, rates) in enumerate(zip(heading.turn_rates_rad_s, heading.rates, strict=True)):
            colour = _NOISE_COLOURS[::-1][number]
            one.plot(degrees, rates, color=colour, linewidth=1.4, label=f"{turn_rate:g} rad/s")
        one.set(title="The population while turning", xlabel="preferred direction (deg)")
        one.legend(title="turn rate", title_fontsize=8.5)
        for (name, rates), colour in zip(heading.curves.items(), (style.ODOMETRY, style.PRIMARY), strict=True):
            sharper.plot(range(-180, 180), np.roll(rates, 180), color=colour, linewidth=1.4, label=_TUNINGS[name])
        sharper.set(title="Two kinds of tuning", xlabel="heading (deg)")
        sharper.legend(loc="upper right")
        sharper.set_ylim(top=2.5)
        for axes in (ring, one):
            axes.set_xticks(range(0, 361, 90))
        sharper.set_xticks(range(-180, 181, 90))
        return style.svg_uri(picture)


def phase_figure(result: CellVerification) -> str:
    """Draw the phase error of the worst grid module and the position error over distance, for every drive.

    Returns:
        A `data:` URI.
    """
    with style.figure(style.PAGE_WIDTH_IN, 3.6) as picture:
        phase, position = picture.subplots(1, 2)
        for (rectifier, hz), drives in result.room.items():
            looks = {"color": _COLOURS[rectifier], "linestyle": _DASHES[hz], "linewidth": 0.9, "alpha": 0.85}
            for number, drive in enumerate(drives):
                label = f"{rectifier}, {hz:g} Hz" if number == 0 else None
                phase.plot(drive.distance_m, 100.0 * _highest(drive.module.max(axis=1)), label=label, **looks)
                position.plot(drive.distance_m, 1e3 * _highest(drive.position_m), **looks)
        for rectifier, bar in PHASE_BAR_PERCENT.items():
            phase.axhline(bar, color=_COLOURS[rectifier], linewidth=0.8, linestyle=(0, (1, 1.5)))
        position.axhline(ROOM_BAR_MM, color="#444444", linewidth=0.8, linestyle=(0, (1, 1.5)))
        phase.set(title="Phase, worst module", ylabel="largest error so far (% of spacing)")
        position.set(title="Position, all modules together", ylabel="largest error so far (mm)")
        for axes in (phase, position):
            axes.set(yscale="log", xlabel="driven (m)")
            axes.grid(visible=True, linewidth=0.5)
        picture.legend(*phase.get_legend_handles_labels(), loc="outside upper left", ncols=4)
        return style.svg_uri(picture)


def module_figure(drives: Sequence[PathErrors], spacings_m: Any) -> str:
    """Draw the phase error of each grid module over distance, on the first of the drives. Returns a `data:` URI."""
    with style.figure(style.PAGE_WIDTH_IN, 2.6) as picture:
        axes = picture.subplots()
        colours = np.linspace(0.0, 0.9, len(spacings_m))
        import matplotlib

        viridis = matplotlib.colormaps["viridis"]
        for spacing, error, colour in zip(spacings_m, drives[0].module.T, colours, strict=True):
            axes.plot(
                drives[0].distance_m, 100.0 * error, color=viridis(colour), linewidth=0.9, label=f"{100 * spacing:.0f} cm"
            )
        axes.set(xlabel="driven (m)", ylabel="phase error (% of spacing)", title="Every module on one drive, relu, 30 Hz")
        axes.set_ylim(bottom=0.0)
        axes.grid(visible=True, linewidth=0.5)
        picture.legend(*axes.get_legend_handles_labels(), loc="outside right upper", title="spacing")
        return style.svg_uri(picture)


def noise_figure(result: CellVerification) -> str:
    """Draw RMS position and heading error over distance for every level of neuron noise, with quartiles over the drives.

    Returns:
        A `data:` URI.
    """
    with style.figure(style.PAGE_WIDTH_IN, 3.4) as picture:
        position, heading = picture.subplots(1, 2)
        for colour, (share, drives) in zip(_NOISE_COLOURS[1:], result.noise.items(), strict=False):
            away, turned = noise_curve(drives), noise_curve(drives, "heading_rad")
            for axes, curve, unit in ((position, away, 1.0), (heading, turned, np.degrees(1.0))):
                axes.fill_between(curve.distance_m, *(unit * curve.quartiles), color=colour, alpha=0.18, linewidth=0)
                axes.plot(curve.distance_m, unit * curve.rms, color=colour, linewidth=1.5, label=f"{100.0 * share:g} %")
        position.set(title="Position", ylabel="error (m)")
        heading.set(title="Heading", ylabel="error (deg)")
        for axes in (position, heading):
            axes.set_xlabel("driven (m)")
            axes.set_ylim(bottom=0.0)
            axes.grid(visible=True, linewidth=0.5)
        picture.legend(*position.get_legend_handles_labels(), loc="outside upper left", ncols=5, title="noise of every rate")
        return style.svg_uri(picture)


def shadow_figure(overwriting: Overwriting) -> str:
    """Draw how the decoded pose responds when the cells' activity is shifted and the robot drives on. Returns a `data:` URI."""
    names: dict[Cells, str] = {"both": "rings and sheets", "rings": "rings alone", "sheets": "sheets alone"}
    colours: dict[Cells, str] = {"both": "#000000", "rings": style.PRIMARY, "sheets": style.ODOMETRY}
    with style.figure(style.PAGE_WIDTH_IN, 2.8) as picture:
        panels = picture.subplots(1, 2, sharey=True)
        for axes, stripes in zip(panels, (True, False), strict=True):
            for cells, name in names.items():
                share = overwriting.shown[cells, stripes]
                looks = {"color": colours[cells], "linestyle": (0, (5, 3)) if cells == "both" else "solid", "linewidth": 1.6}
                axes.plot(1e3 * overwriting.shift_m * share, label=name, zorder=4 if cells == "both" else 3, **looks)
            axes.set_xlabel("steps since cells were overwritten")
            axes.grid(visible=True, linewidth=0.5)
        panels[0].set(title="With the stripes of the rings", ylabel="shift seen in the pose (mm)")
        panels[1].set(title="Without them (band_drive 0)")
        picture.legend(*panels[0].get_legend_handles_labels(), loc="outside upper left", ncols=3, title="overwritten")
        return style.svg_uri(picture)


def _highest(errors: Any) -> Any:
    """Largest error so far, as a curve that a logarithmic axis can show."""
    return np.maximum(np.maximum.accumulate(errors), 1e-9)
