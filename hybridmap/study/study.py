"""Run a whole study: make the grid, compute what is missing, write tables and figures."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from hybridmap import provenance
from hybridmap.errors import counted
from hybridmap.metrics import Metric, to_json
from hybridmap.output import held, write_text
from hybridmap.study import bars, tables
from hybridmap.study.bars import Verdict
from hybridmap.study.cell import CellResult
from hybridmap.study.cells import Cell, Grid, lay_out
from hybridmap.study.effects import Effect, effects_of
from hybridmap.study.folder import (
    BARS_CSV,
    CELLS_CSV,
    EFFECTS_CSV,
    METRICS,
    STUDY,
    STUDY_FOLDER,
    SUMMARY_CSV,
    TIMINGS_CSV,
    StudyFolder,
)
from hybridmap.study.measures import measures_of
from hybridmap.study.model import StudyConfig, quoted
from hybridmap.study.pools import Pool
from hybridmap.study.runner import WITHOUT_RESULT, Progress, run
from hybridmap.study.statistics import Summary, summarise


@dataclass(frozen=True, slots=True)
class Study:
    """A finished study.

    Attributes:
        folder: the folder of the study.
        grid: the cells of the study.
        results: cache key of a result -> the result, for every cell of the grid.
        summaries: summaries over the seeds, one per group, back-end and measure.
        effects: each setting against the first, one per source and back-end and one over all sources.
        verdicts: one verdict per bar, group and back-end.
        computed: number of results that this run computed, see `runner.Outcomes`.
        head: keys of `metrics.json` besides its list of metrics, with their values.
        metrics: the list of metrics in `metrics.json`.
    """

    folder: StudyFolder
    grid: Grid
    results: dict[str, CellResult]
    summaries: list[Summary]
    effects: list[Effect]
    verdicts: list[Verdict]
    computed: int
    head: dict[str, Any]
    metrics: list[Metric]

    @property
    def rows(self) -> list[tuple[Cell, CellResult]]:
        """Every cell with its result, in the order of the tables."""
        return [(cell, self.results[cell.key]) for cell in self.grid.cells]

    @property
    def missed(self) -> list[Verdict]:
        """Verdicts of the bars that are missed."""
        return [verdict for verdict in self.verdicts if not verdict.passed]

    @property
    def without_result(self) -> list[Cell]:
        """The cells that an error left without a result; a back-end that diverged is a result."""
        return [cell for cell, result in self.rows if result.status in WITHOUT_RESULT]


def run_study(study: StudyConfig, out: Path, pool: Pool, progress: Progress | None = None) -> Study:
    """Run or continue a study; results stored by an earlier run in the same folder are not computed again.

    The folder gets `study.yaml`, `cells.csv`, `timings.csv`, `summary.csv`, `effects.csv`, `bars.csv` and `metrics.json`, which
    replace those of an earlier run, but no page (`report.study_page`). A cell that fails keeps its row; a bar may be missed
    without an error.

    Args:
        study: the study.
        out: folder of a study, empty, or to be made.
        pool: runs the tasks.
        progress: called with the number of graphs and cells done and their total, see `runner.run`.

    Raises:
        OutputError: the folder cannot be used, or another run is writing there.
        StudyError: the workers cannot be used.
        GraphError, StoreError, StreamError, ConfigError: a source cannot be used; nothing is written then.
    """
    folder = StudyFolder(out)
    with held(out, STUDY_FOLDER):
        grid = lay_out(study)
        outcomes = run(grid, folder, pool, progress)
        summaries = summarise(grid, outcomes.results)
        effects = effects_of(grid, outcomes.results)
        head = _head(grid, outcomes.results)
        verdicts = bars.judge(grid, outcomes.results)
        metrics = _metrics(summaries, effects, verdicts)
        texts = {
            STUDY: study.to_yaml(),
            CELLS_CSV: tables.cells_csv(grid.cells, outcomes.results, measures_of(study)),
            TIMINGS_CSV: tables.timings_csv(grid.cells, outcomes.results),
            SUMMARY_CSV: tables.summary_csv(summaries),
            EFFECTS_CSV: tables.effects_csv(effects),
            BARS_CSV: tables.bars_csv(verdicts),
            METRICS: to_json(head, metrics) + "\n",
        }
        for name, text in texts.items():
            write_text(out / name, text)
    return Study(folder, grid, outcomes.results, summaries, effects, verdicts, outcomes.computed, head, metrics)


def _head(grid: Grid, results: dict[str, CellResult]) -> dict[str, Any]:
    found = [results[cell.key].status for cell in grid.cells]
    return {
        "study": grid.study.name,
        "study_hash": provenance.digest({"cells": [cell.key for cell in grid.cells]}),
        "backends": [variant.title for variant in grid.study.backends],
        "baseline": grid.study.backends[0].title,
        "cells": len(grid.cells),
        "status": {status: found.count(status) for status in sorted(set(found))},
    }


def _metrics(summaries: Sequence[Summary], effects: Sequence[Effect], verdicts: Sequence[Verdict]) -> list[Metric]:
    """Median and mean of each measure, the median difference to the baseline, and every bar: `<figure>/<group>/<back-end>`.

    `effect/<setting>/<source>/<back-end>` is what a setting changes against the first one, m.
    """
    metrics = []
    for one in summaries:
        stage = f"{one.cell.label}/{one.cell.backend}"
        stem = _stem(one.measure, one.unit)
        of = f"{one.solved} of {counted(one.cells, 'cell')}" + (f", {one.lost} lost" if one.lost else "")
        metrics.append(Metric(f"{stem}_median/{stage}", one.median.value, one.unit, f"median of {of}, {one.median}"))
        metrics.append(Metric(f"{stem}_mean/{stage}", one.mean, one.unit, f"mean of {counted(one.solved, 'value')}"))
        if one.difference is not None:
            what = f"median of the paired differences to {quoted(one.baseline)}, {one.difference}"
            what += "" if math.isnan(one.p) else f"; Wilcoxon's p, by Holm, {one.p:.3g}"
            metrics.append(Metric(f"{stem}_difference/{stage}", one.difference.value, one.unit, what))
    for effect in effects:
        what = f"median of the paired differences to the first setting, {effect.difference}; ratio {effect.ratio.value:.4g}"
        what += "" if math.isnan(effect.p) else f"; Wilcoxon's p, by Holm, {effect.p:.3g}"
        name = f"effect/{effect.cell.setting}/{effect.where}/{effect.cell.backend}"
        metrics.append(Metric(name, effect.difference.value, "m", what))
    for verdict in verdicts:
        name = f"{_stem(verdict.bar.figure, verdict.unit)}_{verdict.bar.statistic}/{verdict.label}"
        metrics = [metric for metric in metrics if metric.name != name]
        limit = verdict.limit if math.isfinite(verdict.limit) else None
        metrics.append(Metric(name, verdict.value, verdict.unit, verdict.said, limit, verdict.passed))
    return metrics


def _stem(measure: str, unit: str) -> str:
    return measure.removesuffix(f"_{unit}")
