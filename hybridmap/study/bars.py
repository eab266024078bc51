"""Bars: limits for the figures of a study, checked per group over the seeds."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np

from hybridmap.backends.base import ODOMETRY
from hybridmap.study.cell import CellResult
from hybridmap.study.cells import Cell, Grid, Group
from hybridmap.study.measures import OF_ODOMETRY, unit_of
from hybridmap.study.model import BarConfig

_ROUND_OFF = 1e-6  # a map without any loop is that of odometry; by so much may rounding part them


@dataclass(frozen=True, slots=True)
class Verdict:
    """Result of one bar (a limit for a figure) for one group of cells and one back-end.

    Attributes:
        bar: the configured limit that was checked.
        cell: first cell of the group; all cells of the group share its labels, except for the seed.
        values: the figure in each cell of the group, one per seed; None for a missing figure, which misses any bar.
        limits: the limit of each value: the bar's number, or its factor on the figure of the back-end or setting that it names
            in the cell of the same seed (NaN if missing).
        value: the bar's statistic of the values: median, mean, or with `worst` the one farthest on the wrong side of its limit
            (with `nine in ten`, once a tenth of them is left out); NaN if a value is missing.
        limit: what `value` is compared with: the same statistic of `limits`, or the limit of that value.
        passed: whether the value keeps the limit; False if either is NaN.
    """

    bar: BarConfig
    cell: Cell
    values: tuple[float | None, ...]
    limits: tuple[float, ...]
    value: float
    limit: float
    passed: bool

    @property
    def label(self) -> str:
        """Name of the group and the back-end, for people: `source/setting/kind rate %/back-end`, or without the kind."""
        return f"{self.cell.label}/{self.cell.backend}"

    @property
    def unit(self) -> str:
        """Unit of the figure that the bar limits."""
        return unit_of(self.bar.figure)

    @property
    def median(self) -> float:
        """Median of the values; NaN if one is missing."""
        return float(np.median(_whole(self.values)))

    @property
    def worst(self) -> float:
        """Worst of the values: the least for `at_least`, the greatest for `at_most`; NaN if one is missing."""
        return float((np.min if self.bar.side == "at least" else np.max)(_whole(self.values)))

    @property
    def said(self) -> str:
        """One line for people: statistic, number of seeds, missing figures, and limit."""
        over = f" of {len(self.values)} seeds" if len(self.values) > 1 else ""
        missing = sum(value is None for value in self.values)
        lacking = f", {missing} without a figure" if missing else ""
        return f"{self.bar.statistic}{over}{lacking}; {self.bar.side} {self.limit:g}"


def judge(grid: Grid, results: Mapping[str, CellResult]) -> list[Verdict]:
    """Check every bar (limit of a figure) of a study in every group of cells, and for every back-end, to which it applies.

    Args:
        grid: the cells of the study.
        results: `Cell.key` -> result, for every cell of the grid.

    Returns:
        One verdict per bar, group and back-end, in the order of the bars, then of the grid. A missed bar is not an error.
    """
    groups = grid.groups()
    return [
        _verdict(bar, cells, groups, results)
        for bar in grid.study.bars
        for cells in groups.values()
        if _is_for(bar, cells[0], grid)
    ]


def _is_for(bar: BarConfig, cell: Cell, grid: Grid) -> bool:
    named = ((bar.sources, cell.source), (bar.settings, cell.setting), (bar.kinds, cell.kind), (bar.rates, cell.rate))
    if any(chosen and found not in chosen for chosen, found in named):
        return False
    dead_reckoning = {variant.title for variant in grid.study.backends if variant.backend == ODOMETRY}
    return cell.backend in bar.backends if bar.backends else cell.backend not in dead_reckoning


def _verdict(
    bar: BarConfig,
    cells: Sequence[Cell],
    groups: Mapping[tuple[Group, str], Sequence[Cell]],
    results: Mapping[str, CellResult],
) -> Verdict:
    values = tuple(_own(results[cell.key], bar.figure) for cell in cells)
    slack = 0.0
    if isinstance(bar.at_most, str):
        limits, slack = (
            tuple(bar.times * other for other in _others(bar.at_most, bar.figure, cells, groups, results)),
            _ROUND_OFF,
        )
    else:
        limit = bar.at_most if bar.at_least is None else bar.at_least
        assert limit is not None
        limits = (limit,) * len(cells)
    found, held = _whole(values), np.array(limits)
    if bar.statistic in ("worst", "nine in ten"):
        excess = held - found if bar.side == "at least" else found - held
        skipped = len(cells) // 10 if bar.statistic == "nine in ten" else 0
        at = int(np.argsort(excess)[-1 - skipped]) if np.isfinite(excess).all() else int(np.argmax(np.isnan(excess)))
        value, limit = float(found[at]), float(held[at])
    else:
        statistic = np.median if bar.statistic == "median" else np.mean
        value, limit = float(statistic(found)), float(statistic(held))
    passed = value >= limit - slack if bar.side == "at least" else value <= limit + slack
    return Verdict(bar, cells[0], values, limits, value, limit, bool(passed))


def _others(
    title: str,
    figure: str,
    cells: Sequence[Cell],
    groups: Mapping[tuple[Group, str], Sequence[Cell]],
    results: Mapping[str, CellResult],
) -> list[float]:
    """The figure of a back-end, or else of a setting, on the drive of each cell; NaN where it is missing."""
    source, _, kind, rate = cells[0].group
    others = groups.get((cells[0].group, title)) or groups.get(((source, title, kind, rate), cells[0].backend), ())
    by_seed = {other.seed: _own(results[other.key], figure) for other in others}
    found = [by_seed.get(cell.seed, by_seed.get(None)) for cell in cells]
    return [math.nan if other is None else other for other in found]


def _own(result: CellResult, figure: str) -> float | None:
    """A cell's figure; None for one that it has from odometry: who has no map misses every bar."""
    return None if result.lost and figure in OF_ODOMETRY else result.figure(figure)


def _whole(values: Sequence[float | None]) -> np.ndarray:
    """(N,) with NaN for missing values."""
    return np.array([math.nan if value is None else value for value in values])
