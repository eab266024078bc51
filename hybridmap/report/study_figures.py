"""The pictures of a study's page: each metric over the quantity that the study varies, and the paired differences."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from hybridmap.report import style
from hybridmap.study.cell import CellResult
from hybridmap.study.cells import Cell
from hybridmap.study.measures import ERRORS
from hybridmap.study.statistics import Summary
from hybridmap.study.study import Study

MOST_PANELS = 12
"""More are not drawn; the tables have everything."""

FLOOR_M = 1e-4
"""Smaller errors are drawn here: a logarithm has no zero."""

_LINEAR_M = 0.01  # differences below are drawn to scale
_MOST_LINES = 9  # with more back-ends each gets a row of its own instead of a line
_COLUMNS = 2
_LEVEL_LETTERS = 45  # longer names of all ticks together would overlap
Figure = Callable[[CellResult], float | None]


@dataclass(frozen=True, slots=True)
class Panel:
    """Results of a study that are drawn on the same axes.

    Attributes:
        title: what the results have in common.
        ticks: names of the positions along the horizontal axis.
        cells: (index into `ticks`, back-end, result) of each cell that belongs to the panel.
    """

    title: str
    ticks: tuple[str, ...]
    cells: tuple[tuple[int, str, CellResult], ...]


@dataclass(frozen=True, slots=True)
class Layout:
    """How the results of a study are divided into panels.

    Attributes:
        panels: in the order in which they are drawn.
        along: the quantity on the axis: `false loops`, `setting` or `back-end`. With `back-end` each back-end has a row, else
            a line.
    """

    panels: tuple[Panel, ...]
    along: str


def layout(study: Study) -> Layout:
    """Divide a study's results into panels, and choose the quantity on their horizontal axis.

    It is the share of false loops if that varies, else the setting if that varies. Otherwise, or with more than nine back-ends,
    it is the back-end.
    """
    config = study.grid.study
    rates = sorted(config.false_loops.rates)
    titles = [variant.title for variant in config.backends]
    if len(titles) > _MOST_LINES or (len(rates) == 1 and len(config.settings) == 1):
        return Layout(
            _gathered([(_group(cell), cell.backend, cell, result) for cell, result in study.rows], titles), "back-end"
        )
    if len(rates) > 1:
        return Layout(_over_rates(study, rates), "false loops")
    settings = [setting.name for setting in config.settings]
    entries = [(_joined(cell.source, _false(cell)), cell.setting, cell, result) for cell, result in study.rows]
    return Layout(_gathered(entries, settings), "setting")


def _over_rates(study: Study, rates: Sequence[float]) -> tuple[Panel, ...]:
    """One panel per source, setting and kind; cells without false loops belong to every kind."""
    entries = [
        (_joined(cell.source, _setting(study, cell), f"{kind} false loops"), _percent(cell.rate), cell, result)
        for cell, result in study.rows
        for kind in study.grid.study.false_loops.kinds
        if cell.kind in ("", kind)
    ]
    return _gathered(entries, [_percent(rate) for rate in rates])


def _gathered(entries: Sequence[tuple[str, str, Cell, CellResult]], ticks: Sequence[str]) -> tuple[Panel, ...]:
    """Panels of (title, tick, cell, result)."""
    by_title: dict[str, list[tuple[int, str, CellResult]]] = {}
    for title, tick, cell, result in entries:
        by_title.setdefault(title, []).append((ticks.index(tick), cell.backend, result))
    return tuple(_panel(title, ticks, cells) for title, cells in by_title.items())


def _panel(title: str, ticks: Sequence[str], cells: Sequence[tuple[int, str, CellResult]]) -> Panel:
    """A panel with the ticks that it has cells for: not every setting is for every source."""
    used = sorted({at for at, _, _ in cells})
    moved = tuple((used.index(at), backend, result) for at, backend, result in cells)
    return Panel(title, tuple(ticks[at] for at in used), moved)


def having(plan: Layout, figure: Figure) -> Layout:
    """The layout without the panels in which no run has a value of the metric that the function `figure` returns."""
    kept = (panel for panel in plan.panels if any(figure(result) is not None for _, _, result in panel.cells))
    return replace(plan, panels=tuple(kept))


def merit_figure(study: Study, plan: Layout, label: str, figure: Figure, *, logarithmic: bool) -> str:
    """Draw one metric of a study, an error or a share in percent: a dot per run, lines or bars through the medians.

    Panels without a value of the metric are left out, and those beyond `MOST_PANELS`.

    Args:
        study: the finished study.
        plan: its panels.
        label: text along the metric's axis.
        figure: function that returns the metric of a run's result.
        logarithmic: whether the metric's axis is logarithmic; if not, it goes from 0 to 100 %.

    Returns:
        A `data:` URI; an empty string if no result has a value.
    """
    shown = having(plan, figure).panels[:MOST_PANELS]
    if not shown:
        return ""
    titles = [variant.title for variant in study.grid.study.backends]
    looks = style.line_styles(titles)
    rows = plan.along == "back-end"
    with _axes(len(shown), 0.24 * len(titles) + 1.0 if rows else 2.9) as (picture, panels):
        for axes, panel in zip(panels, shown, strict=False):
            (_draw_rows if rows else _draw_lines)(axes, panel, figure, looks)
            axes.set_title(panel.title, fontsize=9.0)
            value_axis = axes.xaxis if rows else axes.yaxis
            value_axis.set_label_text(label)
            (axes.set_xscale if rows else axes.set_yscale)("log" if logarithmic else "linear")
            if not logarithmic:
                (axes.set_xlim if rows else axes.set_ylim)(-4.0, 104.0)  # shares, in percent
            axes.grid(True, axis="x" if rows else "y", linewidth=0.5)
            if not rows:
                axes.set_xlabel(plan.along)
        if not rows:
            known: dict[str, Any] = {}
            for axes in panels:
                known |= {name: handle for handle, name in zip(*axes.get_legend_handles_labels(), strict=True)}
            if known:
                picture.legend(known.values(), known, loc="outside upper center", ncols=min(4, len(known)))
        return style.svg_uri(picture)


def paired_groups(summaries: Sequence[Summary], measure: str) -> dict[str, list[Summary]]:
    """Label of a group of cells -> the summaries of its back-ends that have a difference to the baseline, paired by seed.

    A summary with fewer than two pairs, and a group without any, is left out.

    Args:
        summaries: all summaries of a study.
        measure: name of the error that is compared, such as `ate_m`.
    """
    groups: dict[str, list[Summary]] = {}
    for one in summaries:
        if one.measure == measure and one.difference is not None and one.difference.count > 1:
            groups.setdefault(one.cell.label, []).append(one)
    return groups


def difference_figure(groups: Mapping[str, Sequence[Summary]], baseline: str) -> str:
    """Draw the median paired difference of the error to the baseline with its confidence interval, one panel per group.

    A difference without an interval is a single dot. Groups beyond `MOST_PANELS` are left out.

    Args:
        groups: what `paired_groups` returns.
        baseline: what the back-ends are compared with, in words.

    Returns:
        A `data:` URI; an empty string if there is no group.
    """
    if not groups:
        return ""
    shown = list(groups.items())[:MOST_PANELS]
    deepest = max(len(ones) for _, ones in shown)
    with _axes(len(shown), 0.24 * deepest + 1.0) as (picture, panels):
        for axes, (label, ones) in zip(panels, shown, strict=False):
            for row, one in enumerate(ones):
                _draw_interval(axes, row, one)
            axes.axvline(0.0, color="#444444", linewidth=0.8)
            axes.set_xscale("symlog", linthresh=_LINEAR_M)
            axes.set_xlim(*_reach(ones))
            axes.set_yticks(range(len(ones)), [one.cell.backend for one in ones])
            axes.set_ylim(len(ones) - 0.5, -0.5)
            axes.set_title(label, fontsize=9.0)
            axes.set_xlabel(f"{ERRORS[ones[0].measure]} minus that of {baseline} (m)")
            axes.grid(True, axis="x", linewidth=0.5)
            axes.tick_params(axis="x", labelsize=7.5)
        return style.svg_uri(picture)


def _reach(ones: Sequence[Summary]) -> tuple[float, float]:
    """Limits of the axis, m: all that is drawn and some room, and never less than what is linear."""
    drawn = [one.difference for one in ones if one.difference is not None]
    ends = [end for apart in drawn for end in (apart.value, apart.low, apart.high) if np.isfinite(end)]
    return 1.6 * min(-_LINEAR_M, *ends), 1.6 * max(_LINEAR_M, *ends)


def _draw_interval(axes: Any, row: int, one: Summary) -> None:
    apart = one.difference
    assert apart is not None
    colour = {"lower": style.ACCEPTED, "higher": style.REJECTED}.get(one.verdict, "#666666")
    if apart.known:
        axes.plot([apart.low, apart.high], [row, row], color=colour, linewidth=2.2, solid_capstyle="butt")
    axes.plot([apart.value], [row], "o", color=colour, markersize=4.5)


def _draw_lines(axes: Any, panel: Panel, figure: Figure, looks: dict[str, dict[str, Any]]) -> None:
    """One line per back-end through its medians, and a dot per cell."""
    backends = list(dict.fromkeys(backend for _, backend, _ in panel.cells))
    for rank, backend in enumerate(backends):
        offset = 0.24 * ((rank + 0.5) / len(backends) - 0.5)
        medians = []
        for position in range(len(panel.ticks)):
            values = _values(panel, position, backend, figure)
            axes.plot([position + offset] * len(values), values, ".", color=looks[backend]["color"], markersize=3.5, alpha=0.55)
            medians.append(float(np.median(values)) if len(values) else np.nan)
        if np.isfinite(medians).any():
            axes.plot(np.arange(len(medians)) + offset, medians, label=backend, **looks[backend])
    slanted = {"rotation": 30.0, "ha": "right"} if sum(map(len, panel.ticks)) > _LEVEL_LETTERS else {}
    axes.set_xticks(range(len(panel.ticks)), panel.ticks, **slanted)
    axes.set_xlim(-0.3, len(panel.ticks) - 0.7)


def _draw_rows(axes: Any, panel: Panel, figure: Figure, looks: dict[str, dict[str, Any]]) -> None:
    """One row per back-end, a dot per cell, and a bar at the median."""
    for position, backend in enumerate(panel.ticks):
        values = _values(panel, position, backend, figure)
        for lost, mark in ((False, "."), (True, "x")):
            shown = _values(panel, position, backend, figure, lost=lost)
            axes.plot(shown, [position] * len(shown), mark, color=looks[backend]["color"], markersize=5.0, alpha=0.6)
        if len(values):
            axes.plot([np.median(values)], [position], "|", color=looks[backend]["color"], markersize=13, markeredgewidth=2)
        if without := _without(panel, position, backend, figure):
            looks_of_text = {"fontsize": 7.5, "color": style.REJECTED, "va": "center"}
            axes.text(0.01, position, without, transform=axes.get_yaxis_transform(), **looks_of_text)
    axes.set_yticks(range(len(panel.ticks)), panel.ticks)
    axes.set_ylim(len(panel.ticks) - 0.5, -0.5)


def _values(panel: Panel, position: int, backend: str, figure: Figure, lost: bool | None = None) -> Any:
    """The figure in all cells, or only in those whose back-end did (`lost`) or did not end without a map."""
    cells = [result for at, name, result in panel.cells if (at, name) == (position, backend)]
    found = [figure(result) for result in cells if lost is None or result.lost is lost]
    return np.array([value for value in found if value is not None])


@contextmanager
def _axes(count: int, panel_height_in: float) -> Iterator[tuple[Any, list[Any]]]:
    """A figure of panels in two columns; those left over are empty."""
    columns = min(_COLUMNS, count)
    lines = -(-count // columns)
    with style.figure(style.PAGE_WIDTH_IN, panel_height_in * lines + 0.5) as picture:
        panels = list(picture.subplots(lines, columns, squeeze=False).ravel())
        for axes in panels[count:]:
            axes.set_axis_off()
        yield picture, panels


def _without(panel: Panel, position: int, backend: str, figure: Figure) -> str:
    """The number of cells without a figure of their own, and their statuses."""
    cells = [result for at, name, result in panel.cells if (at, name) == (position, backend)]
    statuses = [result.status for result in cells if result.lost or figure(result) is None]
    return ", ".join(f"{statuses.count(status)} of {len(cells)} {status}" for status in sorted(set(statuses)))


def _group(cell: Cell) -> str:
    return _joined(cell.source, cell.setting if cell.setting != "default" else "", _false(cell))


def _setting(study: Study, cell: Cell) -> str:
    return cell.setting if len(study.grid.study.settings) > 1 else ""


def _false(cell: Cell) -> str:
    return f"{_percent(cell.rate)} {cell.kind} false loops" if cell.kind else ""


def _joined(*parts: str) -> str:
    return ", ".join(part for part in parts if part)


def _percent(share: float) -> str:
    return f"{100.0 * share + 0.0:g} %"  # so that -0 reads as 0
