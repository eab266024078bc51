"""One self-contained page per study."""

from __future__ import annotations

import math
import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import partial
from importlib.metadata import version
from pathlib import Path

from hybridmap.output import write_text
from hybridmap.report import page_tables as tables
from hybridmap.report import study_figures
from hybridmap.report.page_tables import rendered
from hybridmap.report.study_figures import FLOOR_M, MOST_PANELS
from hybridmap.study.bars import Verdict
from hybridmap.study.cell import CellResult
from hybridmap.study.cells import Cell
from hybridmap.study.folder import PAGE
from hybridmap.study.measures import ERRORS, TIMINGS, measures_of
from hybridmap.study.model import quoted
from hybridmap.study.statistics import LEAST, Interval, Summary
from hybridmap.study.study import Study

_TEMPLATE = "study.html.j2"
_SOLVED = ("converged", "waiting", "max-iterations", "fell-back", "mapped")
_HEADS = ERRORS | {"chi2_own": "χ² own"}
_NAMED = 4  # places or back-ends that a remark names
_SUMMED = (
    *("relation_m", "relation_loop_m", "chi2_own", "loop_recall", "false_kept", "wrong_loops", "own_lost", "iterations"),
    *("loop_chi2_ratio", "found_m", "clock_offset_s", "theta_max", "theta_max_measured", "shrinks", "shrinks_measured"),
)


@dataclass(frozen=True, slots=True)
class Line:
    """One back-end in a table of a study's page; everything is text.

    Attributes:
        backend: title of the back-end.
        start: where it begins.
        solved: in how many of its cells it has a map of its own with the error that the page compares.
        median: of that error, with its confidence interval.
        difference: median of the paired differences to the baseline, with its interval; empty for a baseline.
        verdict: `lower` or `higher` if the signed-rank test says so; else empty.
        p: of that test, corrected for the back-ends of the table; empty if unknown.
        better: share of the seeds in which its error is lower; empty if unknown.
        others: medians of the further figures of the table.
    """

    backend: str
    start: str
    solved: str
    median: str
    difference: str
    verdict: str
    p: str
    better: str
    others: tuple[str, ...]


@dataclass(frozen=True, slots=True)
class Group:
    """One table of a study's page: back-ends under the same conditions.

    Attributes:
        label: the conditions in words: source, setting, false loops.
        error: the error that is compared, which not every source of a study has.
        lines: one row per back-end that has a map in any cell of the group.
        without: names of the other back-ends.
    """

    label: str
    error: str
    lines: tuple[Line, ...]
    without: tuple[str, ...]


@dataclass(frozen=True, slots=True)
class Bar:
    """One row of the table that compares a study's results with their stated limits.

    Attributes:
        what: the figure and the statistic that is compared.
        where: the group of cells and the back-end.
        median, worst: median and worst value over the seeds, as text.
        bar: the limit, as text.
        passed: whether the limit is kept.
    """

    what: str
    where: str
    median: str
    worst: str
    bar: str
    passed: bool


@dataclass(frozen=True, slots=True)
class EffectLine:
    """One row of the table of what the settings change; everything is text.

    Attributes:
        setting, where, backend: the setting, its drives, and the title of the back-end.
        error: which error is compared.
        pairs: number of pairs of drives.
        difference: median of the paired differences to the first setting, m, with its interval.
        ratio: median of the ratios to the first setting's error, with its interval.
        verdict: `lower` or `higher` if the signed-rank test says so; else empty.
        p: of that test, corrected for all settings on the same drives; empty if unknown.
        cpu: ratio of the CPU times of mapping; empty if unknown.
        pooled: whether the row is of several sources.
    """

    setting: str
    where: str
    backend: str
    error: str
    pairs: str
    difference: str
    ratio: str
    verdict: str
    p: str
    cpu: str
    pooled: bool


@dataclass(frozen=True, slots=True)
class Remark:
    """Cells of a study that did not end well, with the same status and message.

    Attributes:
        status: status with which the cells ended, such as `diverged`.
        where, backend: the groups and the back-ends of these cells, as text; of many only the first.
        count: number of cells.
        message: message of the first one.
    """

    status: str
    where: str
    backend: str
    count: int
    message: str


def write_study_page(study: Study) -> Path:
    """Write `report.html` into the study's folder, replacing an earlier one: one self-contained page.

    The same results give the same page. Returns its path.

    Raises:
        OutputError: it cannot be written.
    """
    page = study.folder.path / PAGE
    write_text(page, _render(study))
    return page


def _render(study: Study) -> str:
    config = study.grid.study
    plan = study_figures.layout(study)
    measure = error_of(study)
    error = partial(_error, measure)
    of_error = study_figures.having(plan, error)
    others = _others(study)
    kept = [_kept(result) for _, result in study.rows]
    pairs = study_figures.paired_groups(study.summaries, measure)
    groups = groups_of(study)
    shown = [group for group in groups if group.lines]
    return rendered(
        _TEMPLATE,
        head=study.head,
        baseline=baseline_of(study),
        description=config.description,
        tiles=_tiles(study),
        along=plan.along,
        empty=len(plan.panels) - len(of_error.panels),
        left_out=max(0, len(of_error.panels) - MOST_PANELS),
        floor=tables.length(FLOOR_M),
        of_truth=_reference(study),
        measure=_HEADS.get(measure, measure),
        relations=measure == "relation_m",
        others=[_HEADS.get(name, name.replace("_", " ")) for name in others],
        bars=[_bar(verdict) for verdict in study.verdicts],
        missed=len(study.missed),
        solves=any(result.figures.get("own_lost") is not None for _, result in study.rows),
        ate=study_figures.merit_figure(study, plan, f"{_HEADS[measure]} (m)", error, logarithmic=True),
        by_false_loops=any(share is not None for share in kept),
        kept=_shares(study, plan, "false loops kept (%)", _kept) if any(share not in (None, 100.0) for share in kept) else "",
        lost=_shares(study, plan, "own loops lost (%)", _lost) if any(_lost(result) for _, result in study.rows) else "",
        differences=study_figures.difference_figure(pairs, baseline_of(study)),
        pairs_left_out=max(0, len(pairs) - MOST_PANELS),
        confidence=f"{100.0 * config.statistics.confidence:g}",
        least=LEAST,
        groups=shown,
        effects=effect_lines(study),
        clocked=any(line.cpu for line in effect_lines(study)),
        reference=quoted(config.settings[0].name),
        groups_without=len(groups) - len(shown),
        measures=[(name, unit, text) for name, (unit, text) in (measures_of(config) | TIMINGS).items()],
        remarks=remarks(study),
        study_yaml=config.to_yaml(),
        version=version("hybridmap"),
    )


def baseline_of(study: Study) -> str:
    """What each back-end of a study is compared with, in words."""
    config = study.grid.study
    titles = {config.baseline_of(variant.title) for variant in config.backends}
    if len(titles) == 1:
        return quoted(study.head["baseline"])
    return f"{quoted(config.backends[0].backend)} from the same start"


def _shares(study: Study, plan: study_figures.Layout, label: str, figure: study_figures.Figure) -> str:
    return study_figures.merit_figure(study, plan, label, figure, logarithmic=False)


def _tiles(study: Study) -> list[tuple[str, str]]:
    config = study.grid.study
    solved = sum(result.status in _SOLVED or ("chi2" in result.figures and not result.lost) for _, result in study.rows)
    counts = [
        (len(study.grid.cells), "cells"),
        (solved, "cells with a map"),
        (len(config.sources), "source(s)"),
        (len(config.settings), "setting(s)"),
        (len(config.backends), "back-end(s)"),
        (len({(cell.kind, cell.rate) for cell in study.grid.cells if cell.kind}), "mix(es) of false loops"),
        (len({cell.seed for cell in study.grid.cells} - {None}), "seed(s)"),
    ]
    return [(str(count), re.sub(r"\((\w+)\)", "" if count == 1 else r"\1", label)) for count, label in counts if count]


def _reference(study: Study) -> bool:
    """Whether ground truth is known for every source."""
    return all(source.knows_truth for source in study.grid.study.sources)


def error_of(study: Study) -> str:
    """Name of the error that the study's page compares: `ate_m`, or `relation_m` if no cell has an ATE but some have that."""
    known = (name for name in ERRORS if any(result.figures.get(name) is not None for _, result in study.rows))
    return next(known, "ate_m")


def _others(study: Study) -> list[str]:
    """Further figures of the tables: those that some cell has."""
    measure = error_of(study)
    return [
        name for name in _SUMMED if name != measure and any(result.figures.get(name) is not None for _, result in study.rows)
    ]


def _bar(verdict: Verdict) -> Bar:
    unit = "" if verdict.unit == "1" else f" {verdict.unit}"
    limit = f"{verdict.bar.side} {tables.number(verdict.limit)}{unit}"
    beside = f" ({verdict.bar.at_most})" if isinstance(verdict.bar.at_most, str) else ""
    return Bar(
        what=f"{verdict.bar.figure}, {verdict.bar.statistic}",
        where=verdict.label,
        median=tables.number(verdict.median),
        worst=tables.number(verdict.worst),
        bar=limit + beside,
        passed=verdict.passed,
    )


def _error(measure: str, result: CellResult) -> float | None:
    value = result.figures.get(measure)
    return None if value is None else max(value, FLOOR_M)


def _kept(result: CellResult) -> float | None:
    return _share(result, "false_kept", "false_loops")


def _lost(result: CellResult) -> float | None:
    return _share(result, "own_lost", "own_loops")


def _share(result: CellResult, part: str, whole: str) -> float | None:
    some, every = result.figures.get(part), result.figures.get(whole)
    return None if some is None or not every else 100.0 * some / every


def groups_of(study: Study) -> list[Group]:
    """The tables of a study's page: one per source, setting, and kind and share of false loops, in the order of the study.

    A back-end that has a map in any cell of the group gets a row; the others are in `Group.without`.
    """
    others = _others(study)
    found: dict[str, dict[str, dict[str, Summary]]] = {}
    for one in study.summaries:
        found.setdefault(one.cell.label, {}).setdefault(one.cell.backend, {})[one.measure] = one
    return [_group(label, by_backend, error_in(study, by_backend), others) for label, by_backend in found.items()]


def error_in(study: Study, by_backend: Mapping[str, Mapping[str, Summary]]) -> str:
    """Name of the error by which the back-ends of one group are compared: that of the study, or the one that the group has."""
    known = (name for name in ERRORS if any(name in one and one[name].solved for one in by_backend.values()))
    return next(known, error_of(study))


def _group(label: str, by_backend: dict[str, dict[str, Summary]], measure: str, others: Sequence[str]) -> Group:
    solved = {backend: any(one.solved for one in by_measure.values()) for backend, by_measure in by_backend.items()}
    lines = tuple(_line(by_measure, measure, others) for backend, by_measure in by_backend.items() if solved[backend])
    return Group(
        label, _HEADS.get(measure, measure), lines, tuple(quoted(backend) for backend in by_backend if not solved[backend])
    )


def effect_lines(study: Study) -> list[EffectLine]:
    """The table of what each setting changes against the first one; those without any pair are left out."""
    return [
        EffectLine(
            setting=one.cell.setting,
            where=one.where,
            backend=one.cell.backend,
            error=", ".join(dict.fromkeys(ERRORS[name] for name in one.measures)),
            pairs=str(one.difference.count) + (f", {one.lost} lost" if one.lost else ""),
            difference=_with_limits(one.difference),
            ratio=_with_limits(one.ratio),
            verdict=one.verdict,
            p="" if math.isnan(one.p) else f"{one.p:.2g}",
            cpu="" if math.isnan(one.cpu_ratio) else f"{one.cpu_ratio:.2f}",
            pooled=one.pooled,
        )
        for one in study.effects
        if one.difference.count
    ]


def _with_limits(found: Interval) -> str:
    """A median, with its interval if it has one."""
    return tables.interval(found) if found.known else tables.number(found.value)


def _line(by_measure: dict[str, Summary], measure: str, others: Sequence[str]) -> Line:
    ate = by_measure[measure]
    apart = ate.difference
    return Line(
        backend=ate.cell.backend,
        start=ate.cell.start,
        solved=f"{ate.solved - ate.lost} of {ate.cells}",
        median=_median(ate.median, ate.cells),
        difference="" if apart is None else _median(apart, ate.cells),
        verdict=ate.verdict,
        p="" if math.isnan(ate.p) else f"{ate.p:.2g}",
        better="" if math.isnan(ate.better) else f"{100.0 * ate.better:.0f} %",
        others=tuple(tables.number(by_measure[name].median.value) for name in others),
    )


def _median(found: Interval, cells: int) -> str:
    """A median with its interval, or why there is none; a single cell, where nothing is left to chance, needs none."""
    return tables.interval(found) if cells > 1 else tables.number(found.value)


def remarks(study: Study) -> list[Remark]:
    """The cells of a study that did not end well, such as `failed`, `diverged`, `stalled` or `crashed`, in groups.

    Cells of one status whose messages differ only in numbers are one remark.
    """
    found: dict[tuple[str, str], list[tuple[Cell, str]]] = {}
    for cell, result in study.rows:
        if result.status not in _SOLVED:
            kind = re.sub(r"\d\S*", "#", result.message)
            found.setdefault((result.status, kind), []).append((cell, result.message))
    every = [variant.title for variant in study.grid.study.backends]
    return [
        Remark(
            status,
            _several([cell.label for cell, _ in cells]),
            _several([quoted(cell.backend) for cell, _ in cells], len(every)),
            len(cells),
            cells[0][1],
        )
        for (status, _), cells in found.items()
    ]


def _several(names: Sequence[str], of: int = 0) -> str:
    """Names, each once: all of them, `every one` of `of`, or the first ones and how many more."""
    once = list(dict.fromkeys(names))
    if 1 < len(once) == of:
        return "every one"
    more = len(once) - _NAMED
    return ", ".join(once[:_NAMED]) + (f" and {more} more" if more > 0 else "")
