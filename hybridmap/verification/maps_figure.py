"""Pictures of rate maps on the verification's page: stripes of band cells, grid cells and place cells."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np

from hybridmap.report import style
from hybridmap.verification.physiology import autocorrelogram
from hybridmap.verification.rate_maps import LatticeMaps, PlaceMaps, PlaceResult

_RATES, _CORRELATION = "viridis", "RdBu_r"
_LABEL_BOX = {"facecolor": "#000000", "edgecolor": "none", "alpha": 0.55, "pad": 1.0}
_SMALL = 7.0
_TIGHT = {"wspace": 0.07, "hspace": 0.07}
_SPACINGS_SHOWN = 1.9
_ZOOM_M = 0.4
_EXAMPLES = 8


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
