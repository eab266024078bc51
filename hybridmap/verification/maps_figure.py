"""Pictures of rate maps on the verification's pages: stripes of band cells, grid cells, place cells, and spikes on a path."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np

from hybridmap.report import style
from hybridmap.verification.physiology import autocorrelogram
from hybridmap.verification.rate_maps import LatticeMaps, PlaceMaps, PlaceResult
from hybridmap.verification.room_fields import RoomFields
from hybridmap.verification.single_cells import BAND, GRID, HEADING, HEADING_BINS, PLACE, SCORES, PathVerification

_RATES, _CORRELATION = "viridis", "RdBu_r"
_LABEL_BOX = {"facecolor": "#000000", "edgecolor": "none", "alpha": 0.55, "pad": 1.0}
_SMALL = 7.0
_TIGHT = {"wspace": 0.07, "hspace": 0.07}
_SPACINGS_SHOWN = 1.9
_ZOOM_M = 0.4
_EXAMPLES = 8
_FIELD = 0.2  # of its peak rate: where a cell fires above that is drawn as its field
_SPIKE_COLOUR, _PATH_COLOUR = "#d40000", "#b8b8b8"
_KIND_COLOURS = {GRID: "#0072b2", BAND: "#e69f00", PLACE: "#009e73", HEADING: "#0072b2"}
_POINT = 3.0


def stripes_figure(lattice: LatticeMaps) -> str:
    """Draw rate maps of one cell of each of the three bands of every module. Returns a `data:` URI."""
    modules = len(lattice.bands)
    with style.figure(style.PAGE_WIDTH_IN, 3.5, (0.03, 0.93, 0.01, 0.945)) as picture:
        panels = picture.subplots(3, modules, gridspec_kw=_TIGHT)
        for m in range(modules):
            for b in range(3):
                _rate_map(panels[b, m], lattice.bands[m, b], f"{100.0 * lattice.spacings_m[m]:.0f} cm" if b == 0 else "")
        _scale_bar(panels[0, 0], 0.5 / lattice.pitch_m, "50 cm")
        _name_rows(panels, ("band at 0°", "60°", "120°"))
        _rate_bar(picture, panels)
        return style.svg_uri(picture)


def grid_figure(lattice: LatticeMaps) -> str:
    """Draw rate maps of two grid cells of every module, each with grid score and peak rate, and their autocorrelograms.

    Returns:
        A `data:` URI.
    """
    modules, cells = lattice.grid.shape[:2]
    shown = min(2, cells)
    with style.figure(style.PAGE_WIDTH_IN, 2.45 * shown, (0.03, 0.93, 0.01, 0.925)) as picture:
        panels = picture.subplots(2 * shown, modules, gridspec_kw={**_TIGHT, "hspace": 0.17})
        for m in range(modules):
            spacing = lattice.spacings_m[m]
            for c in range(shown):
                rates = lattice.grid[m, c]
                module = f"{100.0 * spacing:.0f} cm\n" if c == 0 else ""
                _rate_map(panels[2 * c, m], rates, f"{module}g {lattice.gridness[m, c]:.2f}, peak {rates.max():.2g}")
                lags = _middle_of(autocorrelogram(rates.astype(np.float64)), _SPACINGS_SHOWN * spacing / lattice.pitch_m)
                _picture(panels[2 * c + 1, m], lags, "", _CORRELATION, (-1.0, 1.0))
                _scale_bar(panels[2 * c + 1, m], spacing / lattice.pitch_m, "", colour="#000000")
        _scale_bar(panels[0, 0], 0.5 / lattice.pitch_m, "50 cm")
        _name_rows(panels, [name for c in range(shown) for name in (f"cell {c + 1}", "its correlogram")])
        _rate_bar(picture, panels[:shown])
        _colour_bar(picture, panels[shown:], "correlation", _CORRELATION, (-1.0, 1.0))
        return style.svg_uri(picture)


def place_figure(place: PlaceResult) -> str:
    """Draw the firing fields of place cells that were recruited and of cells that were not, and how many fields each has.

    Returns:
        A `data:` URI.
    """
    groups = (
        ("recruited", place.recruited),
        ("printed rule", place.printed),
        ("sheet, recruited:\ninput", place.sheet["recruited", "input"]),
        ("settled", place.sheet["recruited", "settled"]),
        ("sheet, printed:\ninput", place.sheet["printed", "input"]),
        ("settled", place.sheet["printed", "settled"]),
    )
    with style.figure(style.PAGE_WIDTH_IN, 7.4, (0.065, 0.93, 0.035, 0.98)) as picture:
        looks = {"width_ratios": (*[1] * _EXAMPLES, 0.3, 1.9), "wspace": 0.08, "hspace": 0.22}
        panels = picture.subplots(1 + len(groups), _EXAMPLES + 2, gridspec_kw=looks)  # the last but one is a gap
        _zoomed_row(panels[0], place)
        for gap in panels[:, _EXAMPLES]:
            gap.set_axis_off()
        for row, (_, population) in zip(panels[1:], groups, strict=True):
            _row_of(row[:_EXAMPLES], population.examples)
            _field_counts(row[-1], population)
        for first in panels[1:, 0]:
            _scale_bar(first, 0.5 / place.pitch_m, "50 cm" if first is panels[1, 0] else "")
        panels[1, -1].set_title("% of cells, by fields", fontsize=_SMALL + 1.0, fontweight="normal")
        _name_rows(panels, ("recruited,\nenlarged", *(f"{name}\nn = {len(group.fields)}" for name, group in groups)))
        _rate_bar(picture, panels)
        return style.svg_uri(picture)


def room_figure(room: RoomFields) -> str:
    """Draw the fields of some place cells in the room of 10 x 3 m, one colour each, and how many fields the cells have.

    Returns:
        A `data:` URI.
    """
    import matplotlib

    colours = matplotlib.colormaps["tab20"]
    half = 0.5 * room.pitch_m * np.array(room.sampled.examples.shape[1:])
    with style.figure(style.PAGE_WIDTH_IN, 2.6) as picture:
        hall, counts = picture.subplots(1, 2, gridspec_kw={"width_ratios": (5.2, 1.0)})
        hall.plot(*room.way_m.T, color=_PATH_COLOUR, linewidth=0.4, zorder=1)
        ticks = [np.linspace(-end, end, count) for end, count in zip(half, room.sampled.examples.shape[1:], strict=True)]
        for number, rates in enumerate(room.sampled.examples):
            firing = {"levels": [_FIELD * float(rates.max()), np.inf], "colors": [colours(number)], "zorder": 3}
            hall.contourf(*ticks, rates.T, **firing)
        style.metric_axes(hall, "box")
        hall.set(xlim=(-half[0], half[0]), ylim=(-half[1], half[1]))
        _field_counts(counts, room.sampled)
        counts.set_title(f"% of {len(room.sampled.fields)} cells,\nby fields", fontsize=_SMALL + 1.0, fontweight="normal")
        return style.svg_uri(picture)


def _row_of(row: Any, examples: Any) -> None:
    """One map a panel, with its peak rate; panels without a cell are left empty."""
    for axes, rates in zip(row, examples, strict=False):
        _rate_map(axes, rates, f"peak {rates.max():.2g}")
    for axes in row[len(examples) :]:
        axes.set_axis_off()


def _zoomed_row(row: Any, place: PlaceResult) -> None:
    """The same recruited cells, each with what is around its peak."""
    reach = round(0.5 * _ZOOM_M / place.pitch_m)
    examples = place.recruited.examples[:_EXAMPLES]
    for axes, rates in zip(row, examples, strict=False):
        i, j = np.unravel_index(int(rates.argmax()), rates.shape)
        _rate_map(axes, np.pad(rates, reach, constant_values=np.nan)[i : i + 2 * reach + 1, j : j + 2 * reach + 1])
        axes.set_facecolor("#dddddd")
    for axes in row[len(examples) :]:
        axes.set_axis_off()
    _scale_bar(row[0], 0.1 / place.pitch_m, "10 cm")


def _field_counts(axes: Any, population: PlaceMaps) -> None:
    """Shares of the cells with 0, 1, ... fields."""
    counts = np.bincount(np.minimum(population.fields, 6), minlength=7)
    axes.bar(range(7), 100.0 * counts / max(1, counts.sum()), color=style.PRIMARY, width=0.8)
    axes.set_ylim(0, 100)
    axes.set_xticks(range(7), ["0", "1", "2", "3", "4", "5", "≥6"], fontsize=_SMALL)
    axes.set_yticks((0, 50, 100))
    axes.tick_params(axis="y", labelsize=_SMALL)


def _rate_map(axes: Any, rates: Any, title: str = "") -> None:
    """Rates from zero to the map's own peak."""
    _picture(axes, rates, title, _RATES, (0.0, None))


def _picture(axes: Any, values: Any, title: str, cmap: str, limits: tuple[float, float | None]) -> None:
    """A map without axes, x to the right."""
    low, high = limits
    axes.imshow(np.asarray(values).T, origin="lower", cmap=cmap, vmin=low, vmax=high, interpolation="nearest")
    axes.set_xticks([])
    axes.set_yticks([])
    axes.spines[:].set_visible(False)
    axes.set_title(title, fontsize=_SMALL, fontweight="normal", loc="center", pad=2.5)


def _middle_of(correlation: Any, reach: float) -> Any:
    """The lags up to `reach` bins in each direction."""
    middle = np.array(correlation.shape) // 2
    half = min(*middle, round(reach))
    return correlation[middle[0] - half : middle[0] + half + 1, middle[1] - half : middle[1] + half + 1]


def _scale_bar(axes: Any, pixels: float, label: str, colour: str = "#ffffff") -> None:
    """A bar of so many pixels in the lower left corner."""
    side = axes.get_images()[0].get_array().shape[0]
    start, height = 0.06 * side - 0.5, 0.08 * side - 0.5
    axes.plot([start, start + pixels], [height, height], color=colour, linewidth=2.0, solid_capstyle="butt")
    if label:
        axes.text(start, height + 0.04 * side, label, color=colour, fontsize=_SMALL - 0.5, va="bottom", bbox=_LABEL_BOX)
    axes.set_xlim(-0.5, side - 0.5)
    axes.set_ylim(-0.5, side - 0.5)


def _rate_bar(picture: Any, panels: Any) -> None:
    _colour_bar(picture, panels, "rate (share of the map's peak)", _RATES, (0.0, 1.0))


def _colour_bar(picture: Any, panels: Any, label: str, cmap: str, limits: tuple[float, float]) -> None:
    """One colour bar to the right of the panels, as high as they are."""
    from matplotlib.cm import ScalarMappable
    from matplotlib.colors import Normalize

    top, bottom = panels.flat[0].get_position().y1, panels.flat[-1].get_position().y0
    space = picture.add_axes((panels.flat[-1].get_position().x1 + 0.012, bottom, 0.009, top - bottom))
    scale = ScalarMappable(Normalize(*limits), cmap)
    bar = picture.colorbar(scale, cax=space, ticks=(*limits, 0.5 * sum(limits)))
    bar.set_label(label, fontsize=_SMALL + 1.0)
    bar.ax.tick_params(labelsize=_SMALL)
    bar.outline.set_visible(False)


def _name_rows(panels: Any, names: Sequence[str]) -> None:
    for axes, name in zip(panels[:, 0], names, strict=True):
        axes.set_ylabel(name, fontsize=8.0)


def recorded_path_figure(result: PathVerification) -> str:
    """Draw a recorded path, the time spent in each bin, and the error of the decoded position over distance.

    Returns:
        A `data:` URI.
    """
    arena, errors = result.arena, result.errors
    with style.figure(style.PAGE_WIDTH_IN, 3.1) as picture:
        path, time, error = picture.subplots(1, 3)
        path.plot(*result.track.poses[:, :2].T, color="#444444", linewidth=0.4, rasterized=True)
        path.set(title="The path", xlabel="x (m)", ylabel="y (m)", aspect="equal")
        left, bottom = arena.corner_m
        extent = (left, left + arena.pitch_m * arena.dwell_s.shape[0], bottom, bottom + arena.pitch_m * arena.dwell_s.shape[1])
        dwell = np.where(arena.reached, arena.smoothed_s, np.nan).T
        image = time.imshow(dwell, origin="lower", extent=extent, cmap=_RATES, vmin=0.0, interpolation="nearest")
        picture.colorbar(image, ax=time, label="s in a bin, smoothed", shrink=0.8)
        time.set(title="Time", xlabel="x (m)")
        error.plot(errors.distance_m, 1e3 * errors.position_m, color=style.PRIMARY, linewidth=0.9)
        error.set(title="Error of the decoded position", xlabel="moved (m)", ylabel="mm")
        error.set_ylim(bottom=0.0)
        error.grid(visible=True, linewidth=0.5)
        return style.svg_uri(picture)


def spiking_grid_figure(result: PathVerification) -> str:
    """Draw the spikes of one grid cell of every module on the path, its rate map and its autocorrelogram.

    Returns:
        A `data:` URI.
    """
    grid = result.of_kind(GRID)
    shown = [next(entry for entry in grid if entry[1].module == module) for module in range(len(result.spacings_m))]
    with style.figure(style.PAGE_WIDTH_IN, 4.0, (0.03, 0.93, 0.01, 0.93)) as picture:
        panels = picture.subplots(3, len(shown), gridspec_kw={**_TIGHT, "hspace": 0.16}, squeeze=False)
        for column, (number, cell, found) in zip(panels.T, shown, strict=True):
            _spikes_on_path(column[0], result, number, f"{100.0 * cell.spacing_m:.0f} cm")
            scores = ", ".join(f"{name[0].upper()} {_said(found.scores[name])}" for name in ("sargolini", "langston"))
            _rate_map(column[1], _squared(found.rates), f"{scores}\npeak {np.nanmax(found.rates):.2g} Hz")
            lags = _middle_of(autocorrelogram(found.rates), _SPACINGS_SHOWN * cell.spacing_m / result.arena.pitch_m)
            _picture(column[2], lags, "", _CORRELATION, (-1.0, 1.0))
        _scale_bar(panels[1, 0], 0.5 * float(result.spacings_m.max()) / result.arena.pitch_m, "")
        _name_rows(panels, ("spikes", "rate", "correlogram"))
        _rate_bar(picture, panels[1:2])
        _colour_bar(picture, panels[2:], "correlation", _CORRELATION, (-1.0, 1.0))
        return style.svg_uri(picture)


def spiking_others_figure(result: PathVerification) -> str:
    """Draw rate maps of band cells and place cells along the path, and tuning curves of head-direction cells.

    Returns:
        A `data:` URI.
    """
    with style.figure(style.PAGE_WIDTH_IN, 4.6, (0.05, 0.93, 0.1, 0.95)) as picture:
        panels = picture.subplots(3, _EXAMPLES, gridspec_kw={**_TIGHT, "hspace": 0.25}, squeeze=False)
        for row, kind in zip(panels, (BAND, PLACE), strict=False):
            entries = result.of_kind(kind)
            for axes, (_, _, found) in zip(row, entries[:: max(1, len(entries) // _EXAMPLES)], strict=False):
                information = f"{found.scores['information']:.1f} bits"
                _rate_map(axes, _squared(found.rates), f"{information}, {np.nanmax(found.rates):.2g} Hz")
        for axes in (*panels[:2].flat, *panels[2]):
            axes.set_axis_off() if not axes.get_images() else None
        _name_rows(panels[:2], ("band cells", "place cells"))
        _rate_bar(picture, panels[:2])
        _tuning_curves(picture.add_subplot(3, 1, 3), result)
        return style.svg_uri(picture)


def chance_figure(result: PathVerification) -> str:
    """Draw each score of every cell beside what its own shuffled spikes reach. Returns a `data:` URI."""
    names = {
        "sargolini": "Grid score, Sargolini",
        "langston": "Grid score, Langston",
        "information": "Spatial information (bits/spike)",
        "vector_length": "Mean vector length",
    }
    with style.figure(style.PAGE_WIDTH_IN, 2.8) as picture:
        panels = picture.subplots(1, len(names))
        for axes, (name, title) in zip(panels, names.items(), strict=True):
            start = 0
            for kind in (kind for kind, scores in SCORES.items() if name in scores):
                found = [scores for _, _, scores in result.of_kind(kind)]
                at = np.arange(start, start + len(found))
                looks = {"color": _KIND_COLOURS[kind], "linestyle": "none", "marker": "o", "markersize": _POINT}
                axes.plot(at, [scores.scores[name] for scores in found], label=kind, **looks)
                axes.plot(at, [scores.chance[name] for scores in found], color="#444444", drawstyle="steps-mid", linewidth=1.0)
                start += len(found) + 2
            axes.set_title(title, fontsize=9.0)
            axes.set_xticks([])
            axes.set_ylim(bottom=min(0.0, axes.get_ylim()[0]))
            axes.grid(visible=True, linewidth=0.5, axis="y")
            axes.legend(loc="best", fontsize=_SMALL)
        return style.svg_uri(picture)


def _spikes_on_path(axes: Any, result: PathVerification, number: int, title: str) -> None:
    """The path in grey, and a dot where a cell fired."""
    known = result.track.poses[result.track.known, :2]
    axes.plot(*result.track.poses[:, :2].T, color=_PATH_COLOUR, linewidth=0.25, rasterized=True)
    axes.plot(
        *known[result.spikes[number]].T, color=_SPIKE_COLOUR, linestyle="none", marker=".", markersize=1.2, rasterized=True
    )
    sides = result.arena.pitch_m * np.array(result.arena.dwell_s.shape)
    middle, half = result.arena.corner_m + 0.5 * sides, 0.5 * sides.max()
    limits = [(centre - half, centre + half) for centre in middle]
    axes.set(xlim=limits[0], ylim=limits[1], aspect="equal", xticks=[], yticks=[])
    axes.spines[:].set_visible(False)
    axes.set_title(title, fontsize=_SMALL, fontweight="normal", loc="center", pad=2.5)


def _squared(rates: Any) -> Any:
    """A rate map with empty bins around it, so that it is as wide as high."""
    lacking = max(rates.shape) - np.array(rates.shape)
    return np.pad(rates, [(count // 2, count - count // 2) for count in lacking], constant_values=np.nan)


def _said(score: float) -> str:
    return f"{score:.2f}" if np.isfinite(score) else "–"


def _tuning_curves(axes: Any, result: PathVerification) -> None:
    """Rate over heading of every head-direction cell."""
    degrees = 360.0 * np.arange(HEADING_BINS) / HEADING_BINS
    for _, _, found in result.of_kind(HEADING):
        axes.plot(degrees, found.tuning, linewidth=1.2)
    axes.set(xlabel="heading (deg)", ylabel="head-direction cells (Hz)", xlim=(0.0, 354.0))
    axes.set_xticks(range(0, 360, 90))
    axes.set_ylim(bottom=0.0)
