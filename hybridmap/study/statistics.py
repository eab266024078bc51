"""Medians over the seeds, and of paired differences to the first back-end, with bootstrap intervals and a signed-rank test.

Errors of maps have heavy tails: one lost map of twenty moves the mean and its interval anywhere. So nothing here is of means,
and whether a back-end is better is asked of the ranks of the paired differences.
"""

from __future__ import annotations

import math
import warnings
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cache

import numpy as np
from numpy.typing import NDArray

from hybridmap.errors import counted
from hybridmap.geometry import Array
from hybridmap.study.cell import CellResult
from hybridmap.study.cells import Cell, Grid, Group
from hybridmap.study.measures import OF_ODOMETRY, measures_of, unit_of
from hybridmap.study.model import StatisticsConfig, StudyConfig

LEAST = 5
"""Values that an interval needs: the limits of fewer would be the least and the greatest of them, whatever is asked for."""

SAME = 5e-7
"""Figures that differ by less (m, for an error) are equal: two optimisers that stop at one optimum are parted by rounding."""


@dataclass(frozen=True, slots=True)
class Interval:
    """A median with its confidence interval.

    Attributes:
        value: the median; NaN without any value.
        low, high: limits of the interval; NaN if there are fewer values than it needs (`LEAST`).
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


@dataclass(frozen=True, slots=True)
class Summary:
    """One measure of one back-end over the seeds of one group (source, setting, kind and rate of false loops).

    Attributes:
        cell: first cell of the group; all cells of the group share its labels, except for the seed.
        measure: name of the measure.
        cells, solved: number of cells in the group, and of those that have the measure; the others are left out.
        lost: number of those in which the back-end failed or diverged, so that the figure is that of odometry.
        median: over the seeds that have the measure, with its interval.
        mean: over the same; NaN if there are none.
        baseline: title of the back-end with which this one is compared (`StudyConfig.baseline_of`).
        difference: median over the seeds of this back-end's measure minus the baseline's, for seeds in which both have one;
            None for a baseline itself.
        better: share of these seeds in which this back-end's measure is lower; NaN without any.
        p: of Wilcoxon's signed-rank test of these differences, two-sided, corrected by Holm for all back-ends of the group;
            NaN for a baseline and for fewer than `LEAST` pairs.
    """

    cell: Cell
    measure: str
    cells: int
    solved: int
    lost: int
    median: Interval
    mean: float
    baseline: str
    difference: Interval | None
    better: float
    p: float

    @property
    def verdict(self) -> str:
        """`lower` or `higher` than the baseline if the test says so at the confidence of the intervals; else empty.

        Also empty for a back-end that gave no map at all: its figures are odometry's.
        """
        if self.lost == self.cells or self.difference is None or not self.p < 1.0 - self.difference.confidence:
            return ""
        if not self.difference.value:
            return ""
        return "lower" if self.difference.value < 0.0 else "higher"

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
    groups = grid.groups()
    by_place: dict[Group, list[Summary]] = {}
    for (group, backend), cells in groups.items():
        baseline = grid.study.baseline_of(backend)
        against = None if backend == baseline else groups[group, baseline]
        by_place.setdefault(group, []).extend(
            _summary(cells, against, measure, results, grid.study) for measure in measures_of(grid.study)
        )
    return [one for ones in by_place.values() for one in _corrected(ones)]


def median_of(values: Array, config: StatisticsConfig) -> Interval:
    """Median of (N,) values with the percentile interval of its bootstrap; the same values give the same limits.

    With fewer values than `LEAST` the limits are NaN; if enough values are all equal, the interval has zero width.
    """
    count = len(values)
    median = float(np.median(values)) if count else math.nan
    if count < LEAST:
        return Interval(median, math.nan, math.nan, count, config.confidence)
    tail = 0.5 * (1.0 - config.confidence)
    medians = np.median(values[_drawn(count, config.resamples)], axis=1)
    low, high = np.quantile(medians, [tail, 1.0 - tail])
    return Interval(median, float(low), float(high), count, config.confidence)


def signed_rank(differences: Array) -> float:
    """Two-sided p of Wilcoxon's signed-rank test that (N,) paired differences are symmetric about zero; NaN below `LEAST`.

    Differences of zero speak for neither side and are left out; if all are zero, p is 1.
    """
    from scipy.stats import wilcoxon

    if len(differences) < LEAST:
        return math.nan
    if not np.any(differences):
        return 1.0
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")  # few values with ties: the normal approximation is said to be rough
        return float(wilcoxon(differences[differences != 0.0]).pvalue)


def holm(ps: Sequence[float]) -> list[float]:
    """P values corrected by Holm's step-down method for all of them that are known; NaN stay, and are no part of the family."""
    known = sorted((p, at) for at, p in enumerate(ps) if not math.isnan(p))
    corrected, least = list(ps), 0.0
    for rank, (p, at) in enumerate(known):
        least = max(least, min(1.0, p * (len(known) - rank)))
        corrected[at] = least
    return corrected


@cache
def _drawn(count: int, resamples: int) -> NDArray[np.int64]:
    """(resamples, count) indices of the bootstrap, the same in every run."""
    return np.random.default_rng(0).integers(0, count, (resamples, count))


def _corrected(summaries: Sequence[Summary]) -> list[Summary]:
    """The summaries of one group, their p corrected for the back-ends that are compared by the same measure."""
    by_measure: dict[str, list[int]] = {}
    for at, one in enumerate(summaries):
        by_measure.setdefault(one.measure, []).append(at)
    found = list(summaries)
    for ones in by_measure.values():
        for at, p in zip(ones, holm([summaries[at].p for at in ones]), strict=True):
            found[at] = replace(summaries[at], p=p)
    return found


def _summary(
    cells: Sequence[Cell],
    against: Sequence[Cell] | None,
    measure: str,
    results: Mapping[str, CellResult],
    study: StudyConfig,
) -> Summary:
    values = _figures(cells, measure, results)
    difference, better, p = None, math.nan, math.nan
    if against is not None:
        other = _figures(against, measure, results)
        pairs = np.array([[values[seed], other[seed]] for seed in values if seed in other]).reshape(-1, 2)
        apart = np.where(np.abs(pairs[:, 0] - pairs[:, 1]) < SAME, 0.0, pairs[:, 0] - pairs[:, 1])
        difference, p = median_of(apart, study.statistics), signed_rank(apart)
        better = float(np.mean(apart < 0.0)) if len(apart) else math.nan
    every = np.array(list(values.values()))
    return Summary(
        cell=cells[0],
        measure=measure,
        cells=len(cells),
        solved=len(values),
        lost=sum(results[cell.key].lost for cell in cells) if measure in OF_ODOMETRY else 0,
        median=median_of(every, study.statistics),
        mean=float(np.mean(every)) if len(every) else math.nan,
        baseline=study.baseline_of(cells[0].backend),
        difference=difference,
        better=better,
        p=p,
    )


def _figures(cells: Sequence[Cell], measure: str, results: Mapping[str, CellResult]) -> dict[int | None, float]:
    found = {cell.seed: results[cell.key].figures.get(measure) for cell in cells}
    return {seed: value for seed, value in found.items() if value is not None}
