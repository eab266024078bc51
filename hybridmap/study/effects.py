"""What a setting changes: its errors against those of the first setting, on the same drives and by the same back-end."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np

from hybridmap.backends.base import ODOMETRY
from hybridmap.geometry import Array
from hybridmap.study.cell import CellResult
from hybridmap.study.cells import Cell, Grid
from hybridmap.study.measures import ERRORS
from hybridmap.study.statistics import SAME, Interval, holm, median_of, signed_rank


@dataclass(frozen=True, slots=True)
class Effect:
    """A setting against the first one of the study.

    Attributes:
        cell: first cell of the setting; its labels are those of all, except for the seed, and for the source where there are
            several.
        sources: titles of the sources that the pairs come from: one, or all for which the setting is.
        measures: names of the errors that are compared (`measures.ERRORS`), one for each source.
        lost: number of pairs in which either drive has no map of its own, so that its error is that of odometry.
        difference: median of this setting's error minus the first one's, m, over seeds and sources that have both; over sources
            with different measures it mixes these.
        ratio: median of this setting's error over the first one's.
        p: of Wilcoxon's signed-rank test of the logarithms of these ratios, two-sided, corrected by Holm for all settings that
            are compared on the same set of sources; NaN for fewer than `statistics.LEAST` pairs. All pairs count alike, and as
            independent of each other, those of one source too.
        cpu_ratio: median of the CPU times of mapping, this setting's over the first one's; NaN if they are not known.
    """

    cell: Cell
    sources: tuple[str, ...]
    measures: tuple[str, ...]
    lost: int
    difference: Interval
    ratio: Interval
    p: float
    cpu_ratio: float

    @property
    def pooled(self) -> bool:
        """Whether the pairs are of several sources."""
        return len(self.sources) > 1

    @property
    def where(self) -> str:
        """The drives in words: the source, or how many."""
        mix = f", {100 * self.cell.rate:g} % {self.cell.kind} false loops" if self.cell.kind else ""
        return (f"all {len(self.sources)}" if self.pooled else self.cell.source) + mix

    @property
    def verdict(self) -> str:
        """`lower` or `higher` than by the first setting, if the test says so at the confidence of the intervals; else empty."""
        if not self.p < 1.0 - self.ratio.confidence or self.ratio.value == 1.0:
            return ""
        return "lower" if self.ratio.value < 1.0 else "higher"


@dataclass(frozen=True, slots=True)
class _Pairs:
    """Errors (N, 2) and CPU times (M, 2) of a setting and of the first one, on the same drives of one source."""

    cell: Cell
    measure: str
    errors: Array
    cpu_s: Array
    lost: int


def effects_of(grid: Grid, results: Mapping[str, CellResult]) -> list[Effect]:
    """Every setting but the first, for each source and over all of its sources, in the order of the settings.

    Args:
        grid: the cells of the study.
        results: `Cell.key` -> result, for every cell of the grid.
    """
    first, *others = [setting.name for setting in grid.study.settings]
    groups = grid.groups()
    dead_reckoning = {variant.title for variant in grid.study.backends if variant.backend == ODOMETRY}
    timed = {variant.title for variant in grid.study.backends if variant.way == "mapped"}
    found: list[Effect] = []
    for setting in others:
        by_mix: dict[tuple[str, str, float], list[_Pairs]] = {}
        for ((source, name, kind, rate), backend), cells in groups.items():
            if name == setting and backend not in dead_reckoning:
                against = groups[(source, first, kind, rate), backend]
                by_mix.setdefault((backend, kind, rate), []).append(_paired(cells, against, results, backend in timed))
        for each in by_mix.values():
            found += [_effect([pairs], grid) for pairs in each]
            found += [_effect(each, grid)] if len(each) > 1 else []
    return _corrected(found)


def _paired(cells: Sequence[Cell], against: Sequence[Cell], results: Mapping[str, CellResult], timed: bool) -> _Pairs:
    ours, theirs = ({cell.seed: results[cell.key] for cell in side} for side in (cells, against))
    seeds: list[int | None] = [seed for seed in (ours if None in theirs else theirs) if seed is not None] or [None]
    pairs = [(_of_seed(ours, seed), _of_seed(theirs, seed)) for seed in seeds]
    known = (name for name in ERRORS if any(other.figures.get(name) is not None for _, other in pairs))
    measure = next(known, next(iter(ERRORS)))
    return _Pairs(
        cells[0],
        measure,
        _both(pairs, measure),
        _both(pairs if timed else [], "cpu_s"),
        sum(one.lost or other.lost for one, other in pairs),
    )


def _of_seed(results: Mapping[int | None, CellResult], seed: int | None) -> CellResult:
    """The result of a seed. Where nothing is random, as in an undisturbed recording, one result serves for all seeds."""
    return results[None] if None in results else results[seed]


def _both(pairs: Sequence[tuple[CellResult, CellResult]], figure: str) -> Array:
    values = [(one.figure(figure), other.figure(figure)) for one, other in pairs]
    return np.array([pair for pair in values if None not in pair], dtype=np.float64).reshape(-1, 2)


def _effect(each: Sequence[_Pairs], grid: Grid) -> Effect:
    errors, cpu_s = (np.concatenate([getattr(pairs, name) for pairs in each]) for name in ("errors", "cpu_s"))
    same = np.abs(errors[:, 0] - errors[:, 1]) < SAME
    apart = np.where(same, 0.0, errors[:, 0] - errors[:, 1])
    logs = np.where(same, 0.0, np.log(np.maximum(errors[:, 0], SAME) / np.maximum(errors[:, 1], SAME)))
    statistics = grid.study.statistics
    ratio = median_of(logs, statistics)
    return Effect(
        cell=each[0].cell,
        sources=tuple(pairs.cell.source for pairs in each),
        measures=tuple(pairs.measure for pairs in each),
        lost=sum(pairs.lost for pairs in each),
        difference=median_of(apart, statistics),
        ratio=replace(ratio, value=math.exp(ratio.value), low=math.exp(ratio.low), high=math.exp(ratio.high)),
        p=signed_rank(logs),
        cpu_ratio=float(np.median(cpu_s[:, 0] / cpu_s[:, 1])) if len(cpu_s) else math.nan,
    )


def _corrected(effects: Sequence[Effect]) -> list[Effect]:
    """The effects, their p corrected for all settings that are compared on the same set of sources."""
    families: dict[tuple[frozenset[str], str, str, float], list[int]] = {}
    for at, one in enumerate(effects):
        families.setdefault((frozenset(one.sources), one.cell.backend, one.cell.kind, one.cell.rate), []).append(at)
    found = list(effects)
    for members in families.values():
        for at, p in zip(members, holm([effects[at].p for at in members]), strict=True):
            found[at] = replace(effects[at], p=p)
    return found
