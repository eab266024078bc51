"""The pictures of the verification's page: cells as a physiologist shows them, and errors over distance."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np

from hybridmap.evaluate.cells import Verification
from hybridmap.evaluate.cells.path_error import HeadDirectionResult, PathErrors
from hybridmap.evaluate.cells.physiology import autocorrelogram
from hybridmap.evaluate.cells.rate_maps import LatticeMaps, PlaceResult
from hybridmap.evaluate.cells.rows import noise_curve
from hybridmap.report import style

_COLOURS = {"relu": "#0072b2", "softplus": "#009e73"}
_DASHES: dict[float, Any] = {30.0: "solid", 100.0: (0, (4, 1.2))}
_NOISE_COLOURS = ("#fde725", "#5ec962", "#21918c", "#3b528b", "#440154")
_BARS = {"relu": 0.6, "softplus": 0.02}


def _picture(axes: Any, values: Any, title: str = "", *, cmap: str = "jet", low: float | None = None) -> None:
    """A map without axes, x to the right."""
    axes.imshow(np.asarray(values).T, origin="lower", cmap=cmap, vmin=low, interpolation="nearest")
    axes.set_xticks([])
    axes.set_yticks([])
    axes.spines[:].set_visible(False)
    axes.set_title(title, fontsize=8.0, fontweight="normal", loc="center")


def _name_rows(panels: Any, names: Sequence[str]) -> None:
    for axes, name in zip(panels[:, 0], names, strict=True):
        axes.set_ylabel(name, fontsize=8.5)


def heading_figure(heading: HeadDirectionResult) -> str:
    """Tuning of six cells of the ring, and one cell at four turn rates; a `data:` URI."""
    degrees = np.degrees(heading.preferred_rad)
    with style.figure(style.PAGE_WIDTH_IN, 2.7) as picture:
        ring, one = picture.subplots(1, 2)
        for rates in heading.tuning:
            ring.plot(range(360), rates, linewidth=1.4)
        ring.set(title="Six cells of the ring", xlabel="heading (deg)", ylabel="rate")
        for number, (turn_rate, rates) in enumerate(zip(heading.turn_rates_rad_s, heading.rates, strict=True)):
            colour = _NOISE_COLOURS[::-1][number]
            one.plot(degrees, rates, color=colour, linewidth=1.4, label=f"{turn_rate:g} rad/s")
        one.set(title="The population while turning", xlabel="preferred direction (deg)")
        one.legend(title="turn rate", title_fontsize=8.5)
        for axes in (ring, one):
            axes.set_xticks(range(0, 361, 90))
        return style.svg_uri(picture)


def stripes_figure(lattice: LatticeMaps) -> str:
    """Rate maps of the three bands of every module; a `data:` URI."""
    modules = len(lattice.bands)
    with style.figure(style.PAGE_WIDTH_IN, 4.1) as picture:
        panels = picture.subplots(3, modules)
        for m in range(modules):
            for b in range(3):
                title = f"{100.0 * lattice.spacings_m[m]:.0f} cm" if b == 0 else ""
                _picture(panels[b, m], lattice.bands[m, b], title, low=0.0)
        _name_rows(panels, ("band at 0°", "60°", "120°"))
        return style.svg_uri(picture)


def grid_figure(lattice: LatticeMaps) -> str:
    """Rate maps of two cells of every module and the first one's autocorrelogram with its score; a `data:` URI."""
    modules, cells = lattice.grid.shape[:2]
    shown = min(2, cells)
    with style.figure(style.PAGE_WIDTH_IN, 1.35 * (shown + 1)) as picture:
        panels = picture.subplots(shown + 1, modules)
        for m in range(modules):
            for c in range(shown):
                title = f"{100.0 * lattice.spacings_m[m]:.0f} cm" if c == 0 else f"{lattice.gridness[m, c]:.2f}"
                _picture(panels[c, m], lattice.grid[m, c], title, low=0.0)
            full = autocorrelogram(lattice.grid[m, 0].astype(np.float64))
            reach = min(full.shape[0] // 2, round(1.9 * lattice.spacings_m[m] / lattice.pitch_m))
            middle = full.shape[0] // 2
            window = full[middle - reach : middle + reach + 1, middle - reach : middle + reach + 1]
            _picture(panels[shown, m], window, f"{lattice.gridness[m, 0]:.2f}", low=-1.0)
        _name_rows(panels, (*("rate maps", "another cell")[:shown], "autocorrelation"))
        return style.svg_uri(picture)


def place_figure(place: PlaceResult) -> str:
    """Fields of place cells with and without recruitment, and how many fields they have; a `data:` URI."""
    groups = (
        ("with recruitment", place.recruited),
        ("printed rule", place.printed),
        ("sheet, recruited: input", place.sheet["recruited", "input"]),
        ("settled", place.sheet["recruited", "settled"]),
        ("sheet, printed: input", place.sheet["printed", "input"]),
        ("settled", place.sheet["printed", "settled"]),
    )
    with style.figure(style.PAGE_WIDTH_IN, 7.4) as picture:
        panels = picture.subplots(len(groups), 9, width_ratios=(*[1] * 8, 2.1))
        for row, (_, population) in zip(panels, groups, strict=True):
            for axes, rates in zip(row[:8], population.examples, strict=False):
                _picture(axes, rates, low=0.0)
            for axes in row[len(population.examples) : 8]:
                axes.set_axis_off()
            counts = np.bincount(np.minimum(population.fields, 6), minlength=7)
            row[8].bar(range(7), 100.0 * counts / max(1, counts.sum()), color=style.PRIMARY, width=0.8)
            row[8].set_ylim(0, 100)
            row[8].set_xticks(range(7), ["0", "1", "2", "3", "4", "5", "≥6"], fontsize=7)
            row[8].tick_params(axis="y", labelsize=7)
        panels[0, 8].set_title("cells (%) by number of fields", fontsize=8.0, fontweight="normal")
        _name_rows(panels, [name.replace(": ", ":\n").replace(" rec", "\nrec") for name, _ in groups])
        return style.svg_uri(picture)


def phase_figure(result: Verification) -> str:
    """The worst module's phase error and the position error over distance, on every drive; a `data:` URI."""
    with style.figure(style.PAGE_WIDTH_IN, 3.6) as picture:
        phase, position = picture.subplots(1, 2)
        for (rectifier, hz), drives in result.room.items():
            looks = {"color": _COLOURS[rectifier], "linestyle": _DASHES[hz], "linewidth": 0.9, "alpha": 0.85}
            for number, drive in enumerate(drives):
                label = f"{rectifier}, {hz:g} Hz" if number == 0 else None
                phase.plot(drive.distance_m, 100.0 * _highest(drive.module.max(axis=1)), label=label, **looks)
                position.plot(drive.distance_m, 1e3 * _highest(drive.position_m), **looks)
        for rectifier, bar in _BARS.items():
            phase.axhline(bar, color=_COLOURS[rectifier], linewidth=0.8, linestyle=(0, (1, 1.5)))
        position.axhline(0.5, color="#444444", linewidth=0.8, linestyle=(0, (1, 1.5)))
        phase.set(title="Phase, worst module", ylabel="largest error so far (% of spacing)")
        position.set(title="Position, all modules together", ylabel="largest error so far (mm)")
        for axes in (phase, position):
            axes.set(yscale="log", xlabel="driven (m)")
            axes.grid(visible=True, linewidth=0.5)
        picture.legend(*phase.get_legend_handles_labels(), loc="outside upper left", ncols=4)
        return style.svg_uri(picture)


def module_figure(drives: Sequence[PathErrors], spacings_m: Any) -> str:
    """Each module's phase error over distance on one drive; a `data:` URI."""
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


def noise_figure(result: Verification) -> str:
    """RMS position and heading error over distance for every noise; a `data:` URI."""
    with style.figure(style.PAGE_WIDTH_IN, 3.2) as picture:
        position, heading = picture.subplots(1, 2)
        for colour, (share, drives) in zip(_NOISE_COLOURS[1:], result.noise.items(), strict=False):
            distance, error = noise_curve(drives)
            turned = np.sqrt(np.mean([drive.heading_rad[: len(distance)] ** 2 for drive in drives], axis=0))
            position.plot(distance, error, color=colour, linewidth=1.5, label=f"{100.0 * share:g} %")
            heading.plot(distance, np.degrees(turned), color=colour, linewidth=1.5)
        position.set(title="Position", ylabel="RMS error (m)")
        heading.set(title="Heading", ylabel="RMS error (deg)")
        for axes in (position, heading):
            axes.set_xlabel("driven (m)")
            axes.grid(visible=True, linewidth=0.5)
        picture.legend(*position.get_legend_handles_labels(), loc="outside upper left", ncols=5, title="noise of every rate")
        return style.svg_uri(picture)


def _highest(errors: Any) -> Any:
    """Largest error so far, as a curve that a logarithmic axis can show."""
    return np.maximum(np.maximum.accumulate(errors), 1e-9)
