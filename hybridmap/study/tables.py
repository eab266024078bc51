"""The tables: every cell, its time, and the summaries over the seeds. The same results give the same bytes."""

from __future__ import annotations

import csv
import io
import math
from collections.abc import Iterable, Mapping, Sequence
from typing import Any

from hybridmap.study.bars import Verdict
from hybridmap.study.cell import CellResult
from hybridmap.study.cells import Cell
from hybridmap.study.effects import Effect
from hybridmap.study.measures import TIMINGS
from hybridmap.study.statistics import Summary

_LABELS = ("source", "setting", "false_loop_kind", "false_loop_rate", "seed", "backend", "start")
_GROUP_LABELS = tuple(label for label in _LABELS if label != "seed")
_COUNTS = ("nodes", "edges", "own_loops", "false_loops")
SUMMARY_COLUMNS = (
    *_GROUP_LABELS,
    *("measure", "unit", "cells", "solved", "lost", "median", "median_low", "median_high", "mean"),
    *("baseline", "pairs", "difference_median", "difference_low", "difference_high", "share_lower", "p_holm"),
)
"""Of `summary.csv`."""
TIMING_COLUMNS = (*_LABELS, *TIMINGS, "key")
"""Of `timings.csv`."""
EFFECT_COLUMNS = (
    *("setting", "source", "false_loop_kind", "false_loop_rate", "backend", "error", "pairs", "lost"),
    *(
        "difference_median",
        "difference_low",
        "difference_high",
        "ratio_median",
        "ratio_low",
        "ratio_high",
        "p_holm",
        "cpu_ratio",
    ),
)
"""Of `effects.csv`."""
BAR_COLUMNS = (
    *_GROUP_LABELS,
    *("figure", "unit", "statistic", "value", "side", "bar", "passed", "median", "worst", "values"),
)
"""Of `bars.csv`."""


def cells_csv(cells: Sequence[Cell], results: Mapping[str, CellResult], measures: Iterable[str]) -> str:
    """The text of `cells.csv`: a header, then one line per cell, in order; numbers with all digits, empty for a missing figure.

    Args:
        cells: the rows.
        results: `Cell.key` -> result, for every cell.
        measures: names of the figures that get a column, before the counts of the graph.
    """
    names = tuple(dict.fromkeys((*measures, *_COUNTS)))
    columns = (*_LABELS, "status", *names, "message", "key")
    return csv_text(columns, (_cell_row(cell, results[cell.key], names) for cell in cells))


def timings_csv(cells: Sequence[Cell], results: Mapping[str, CellResult]) -> str:
    """The text of `timings.csv`: one line per cell with its process times; a table of its own, as times differ between runs."""
    rows = ((cell, results[cell.key].timings) for cell in cells)
    return csv_text(
        TIMING_COLUMNS, ((*_labels(cell), *(shown(spent.get(n)) for n in TIMINGS), cell.key) for cell, spent in rows)
    )


def bars_csv(verdicts: Sequence[Verdict]) -> str:
    """The text of `bars.csv`: one line per bar, group and back-end. The last column has the value of each seed, or a dash."""
    return csv_text(BAR_COLUMNS, (_bar_row(one) for one in verdicts))


def effects_csv(effects: Sequence[Effect]) -> str:
    """The text of `effects.csv`: a line for each setting but the first, source and back-end, and one over all its sources."""
    return csv_text(EFFECT_COLUMNS, (_effect_row(one) for one in effects))


def shown(value: float | None) -> str:
    """A number with all digits, without a decimal point if whole; empty string for None."""
    if value is None:
        return ""
    return str(int(value)) if float(value).is_integer() and abs(value) < 2**53 else repr(float(value))


def _labels(cell: Cell) -> tuple[str, ...]:
    *group, backend, start = _group_labels(cell)
    return *group, "" if cell.seed is None else str(cell.seed), backend, start


def _group_labels(cell: Cell) -> tuple[str, ...]:
    return cell.source, cell.setting, cell.kind, shown(cell.rate), cell.backend, cell.start


def _cell_row(cell: Cell, result: CellResult, names: Sequence[str]) -> tuple[str, ...]:
    figures = tuple(shown(result.figures.get(name)) for name in names)
    return (*_labels(cell), result.status, *figures, result.message, cell.key)


def csv_text(columns: Sequence[str], rows: Iterable[Sequence[Any]]) -> str:
    """The text of a CSV file: a line of the names of its columns, then a line for each row."""
    out = io.StringIO()
    writer = csv.writer(out, lineterminator="\n")
    writer.writerow(columns)
    writer.writerows(rows)
    return out.getvalue()


def summary_csv(summaries: Sequence[Summary]) -> str:
    """The text of `summary.csv`: one line per group, back-end and measure; empty where a number is not known."""
    return csv_text(SUMMARY_COLUMNS, (_summary_row(one) for one in summaries))


def _summary_row(one: Summary) -> tuple[str, ...]:
    labels = (*_group_labels(one.cell), one.measure, one.unit)
    middle = (_known(value) for value in (one.median.value, one.median.low, one.median.high, one.mean))
    sums = (*map(str, (one.cells, one.solved, one.lost)), *middle, one.baseline)
    if one.difference is None:
        return (*labels, *sums, *[""] * 6)
    apart = one.difference
    paired = tuple(_known(value) for value in (apart.value, apart.low, apart.high, one.better, one.p))
    return (*labels, *sums, str(apart.count), *paired)


def _effect_row(one: Effect) -> tuple[str, ...]:
    cell = one.cell
    where = (cell.setting, one.where if one.pooled else cell.source, cell.kind, shown(cell.rate), cell.backend)
    middles = (_known(value) for each in (one.difference, one.ratio) for value in (each.value, each.low, each.high))
    errors = " ".join(dict.fromkeys(one.measures))
    return (*where, errors, str(one.difference.count), str(one.lost), *middles, _known(one.p), _known(one.cpu_ratio))


def _known(value: float) -> str:
    return shown(value if math.isfinite(value) else None)


def _bar_row(one: Verdict) -> tuple[str, ...]:
    bar = one.bar
    labels = (*_group_labels(one.cell), bar.figure, one.unit)
    values = " ".join("-" if value is None else shown(value) for value in one.values)
    judged = (bar.statistic, _known(one.value), bar.side, _known(one.limit), "yes" if one.passed else "no")
    return (*labels, *judged, _known(one.median), _known(one.worst), values)
