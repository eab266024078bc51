"""Summaries over the seeds, and paired differences to the first back-end, each with a confidence interval."""

from __future__ import annotations

import math
import warnings
from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np

from hybridmap.errors import counted
from hybridmap.geometry import Array
from hybridmap.study.cell import CellResult
from hybridmap.study.cells import Cell, Grid
from hybridmap.study.measures import measures_of, unit_of
from hybridmap.study.model import StatisticsConfig, StudyConfig

LEAST = {"t": 3, "bootstrap": 5}
"""Method -> values that an interval needs. Two give Student's t one degree of freedom, hence limits of no use; of a few
values the bootstrap's limits are the least and the greatest of them, whatever the confidence asked for."""


@dataclass(frozen=True, slots=True)
class Interval:
    """A mean with its confidence interval.

    Attributes:
        value: the mean; NaN without any value.
        low, high: limits of the interval; NaN if there are fewer values than the method needs (`LEAST`).
        count: number of values.
        confidence: confidence level of the interval, e.g. 0.95.
    """

    value: float
    low: float
    high: float
    count: int
    confidence: float

    def __str__(self) -> str:
        if not self.known:
            return f"{counted(self.count, 'value')}: no interval"
        return f"{100 * self.confidence:g} % interval {self.low:.4g} to {self.high:.4g} of {self.count}"

    @property
    def known(self) -> bool:
        """Whether there were enough values for limits."""
        return math.isfinite(self.low) and math.isfinite(self.high)

    @property
    def excludes_zero(self) -> bool:
        """Whether the interval has limits and does not contain zero."""
        return self.low > 0.0 or self.high < 0.0


@dataclass(frozen=True, slots=True)
class Summary:
    """One measure of one back-end over the seeds of one group (source, setting, kind and rate of false loops).

    Attributes:
        cell: first cell of the group; all cells of the group share its labels, except for the seed.
        measure: name of the measure.
        cells, solved: number of cells in the group, and of those that have the measure; the others are left out.
        median, mean: median and mean over the seeds that have the measure; NaN if none has.
        baseline: title of the study's first back-end, with which the others are compared.
        difference: mean over the seeds of this back-end's measure minus the baseline's, for seeds in which both have one; None
            for the baseline itself.
        better: share of these seeds in which this back-end's measure is lower; NaN without any.
    """

    cell: Cell
    measure: str
    cells: int
    solved: int
    median: float
    mean: Interval
    baseline: str
    difference: Interval | None
    better: float

    @property
    def unit(self) -> str:
        """Unit of the measure."""
        return unit_of(self.measure)


def summarise(grid: Grid, results: Mapping[str, CellResult]) -> list[Summary]:
    """A summary for each group, back-end and measure, in the order of the grid; also where no cell has the measure.

    Args:
        grid: the cells of the study.
        results: `Cell.key` -> result, for every cell of the grid.
    """
    baseline, groups = grid.study.backends[0].title, grid.groups()
    return [
        _summary(cells, None if backend == baseline else groups[group, baseline], measure, results, grid.study)
        for (group, backend), cells in groups.items()
        for measure in measures_of(grid.study)
    ]


def mean_of(values: Array, config: StatisticsConfig) -> Interval:
    """Mean of (N,) values with its confidence interval, by Student's t or the BCa bootstrap; the result is deterministic.

    With fewer values than `LEAST` the limits are NaN; if enough values are all equal, the interval has zero width.
    """
    count = len(values)
    mean = float(np.mean(values)) if count else math.nan
    if count < LEAST[config.method]:
        return Interval(mean, math.nan, math.nan, count, config.confidence)
    if np.ptp(values) == 0.0:
        return Interval(mean, mean, mean, count, config.confidence)
    low, high = _student(values, config) if config.method == "t" else _bootstrap(values, config)
    return Interval(mean, low, high, count, config.confidence)


def _student(values: Array, config: StatisticsConfig) -> tuple[float, float]:
    from scipy.stats import t

    reach = (
        float(t.ppf(0.5 + 0.5 * config.confidence, len(values) - 1)) * float(np.std(values, ddof=1)) / math.sqrt(len(values))
    )
    mean = float(np.mean(values))
    return mean - reach, mean + reach


def _bootstrap(values: Array, config: StatisticsConfig) -> tuple[float, float]:
    """Bias-corrected and accelerated; plain percentiles if the sample is too degenerate."""
    from scipy.stats import bootstrap

    for method in ("BCa", "percentile"):
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")  # degenerate samples give NaN, which is looked at
            found = bootstrap(
                (values,),
                np.mean,
                n_resamples=config.resamples,
                confidence_level=config.confidence,
                method=method,
                vectorized=True,
                rng=np.random.default_rng(0),
            ).confidence_interval
        if math.isfinite(found.low) and math.isfinite(found.high):
            break
    return float(found.low), float(found.high)


def _summary(
    cells: Sequence[Cell],
    against: Sequence[Cell] | None,
    measure: str,
    results: Mapping[str, CellResult],
    study: StudyConfig,
) -> Summary:
    values = _figures(cells, measure, results)
    difference, better = None, math.nan
    if against is not None:
        other = _figures(against, measure, results)
        pairs = np.array([[values[seed], other[seed]] for seed in values if seed in other]).reshape(-1, 2)
        difference = mean_of(pairs[:, 0] - pairs[:, 1], study.statistics)
        better = float(np.mean(pairs[:, 0] < pairs[:, 1])) if len(pairs) else math.nan
    every = np.array(list(values.values()))
    median = float(np.median(every)) if len(every) else math.nan
    mean, baseline = mean_of(every, study.statistics), study.backends[0].title
    return Summary(cells[0], measure, len(cells), len(values), median, mean, baseline, difference, better)


def _figures(cells: Sequence[Cell], measure: str, results: Mapping[str, CellResult]) -> dict[int | None, float]:
    found = {cell.seed: results[cell.key].figures.get(measure) for cell in cells}
    return {seed: value for seed, value in found.items() if value is not None}
