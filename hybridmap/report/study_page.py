"""One self-contained page per study."""

from __future__ import annotations

import math
import re
from collections.abc import Sequence
from dataclasses import dataclass
from importlib.metadata import version
from pathlib import Path

from hybridmap.errors import StudyError
from hybridmap.report import study_figures, tables
from hybridmap.report.study_figures import FLOOR_M, MOST_PANELS
from hybridmap.report.template import rendered
from hybridmap.study.cell import MEASURES, CellResult
from hybridmap.study.folder import PAGE
from hybridmap.study.statistics import Summary
from hybridmap.study.study import Study
from hybridmap.trajectory import write_text_atomic

_TEMPLATE = "study.html.j2"
_SOLVED = ("converged", "waiting", "max-iterations")
SHOWN_M = 5e-7
"""Differences below it are shown as 0."""
_SUMMED = ("chi2_own", "false_kept", "own_lost", "iterations")


@dataclass(frozen=True, slots=True)
class Line:
    """One back-end of a group: texts for the table, and whether its difference to the baseline is beyond chance."""

    backend: str
    solved: str
    median: str
    mean: str
    difference: str
    verdict: str
    better: str
    others: tuple[str, ...]


@dataclass(frozen=True, slots=True)
class Remark:
    """Cells that did not come to a good end for one reason."""

    status: str
    where: str
    backend: str
    count: int
    message: str


def write_study_page(study: Study) -> Path:
    """Write `report.html` of a study: one page that needs nothing beside it; the same results give the same page.

    Raises:
        StudyError: it cannot be written.
    """
    page = study.folder.path / PAGE
    try:
        write_text_atomic(page, _render(study))
    except OSError as error:
        raise StudyError(f"{page}: cannot be written: {error.strerror}") from None
    return page


def _render(study: Study) -> str:
    config = study.grid.study
    plan = study_figures.layout(study)
    by_false_loops = any(cell.rate > 0.0 for cell in study.grid.cells)
    return rendered(
        _TEMPLATE,
        head=study.head,
        description=config.description,
        tiles=_tiles(study),
        along=plan.along,
        left_out=max(0, len(plan.panels) - MOST_PANELS),
        floor=tables.length(FLOOR_M),
        of_truth=_reference(study),
        ate=study_figures.merit_figure(study, plan, "ATE (m)", _error, logarithmic=True),
        kept=_shares(study, plan, "false loops kept (%)", _kept) if by_false_loops else "",
        lost=_shares(study, plan, "own loops lost (%)", _lost) if any(_lost(result) for _, result in study.rows) else "",
        differences=study_figures.difference_figure(study.summaries),
        confidence=f"{100.0 * config.statistics.confidence:g}",
        method={"t": "Student's t", "bootstrap": "BCa bootstrap"}[config.statistics.method],
        groups=_groups(study.summaries),
        measures=[(name, unit, text) for name, (unit, text) in MEASURES.items()],
        remarks=_remarks(study),
        study_yaml=config.to_yaml(),
        version=version("hybridmap"),
    )


def _shares(study: Study, plan: study_figures.Layout, label: str, figure: study_figures.Figure) -> str:
    return study_figures.merit_figure(study, plan, label, figure, logarithmic=False)


def _tiles(study: Study) -> list[tuple[str, str]]:
    config = study.grid.study
    solved = sum("chi2" in result.figures for _, result in study.rows)
    counts = [
        (len(study.grid.cells), "cells"),
        (solved, "cells with a map"),
        (len(config.sources), "source(s)"),
        (len(config.settings), "setting(s)"),
        (len(config.backends), "back-end(s)"),
        (len({(cell.kind, cell.rate) for cell in study.grid.cells}), "mix(es) of false loops"),
        (len(config.seeds), "seed(s)"),
    ]
    return [(str(count), re.sub(r"\((\w+)\)", "" if count == 1 else r"\1", label)) for count, label in counts]


def _reference(study: Study) -> bool:
    """Whether every source knows the truth."""
    return all(source.world or source.synthetic for source in study.grid.study.sources)


def _error(result: CellResult) -> float | None:
    value = result.figures.get("ate_m")
    return None if value is None else max(value, FLOOR_M)


def _kept(result: CellResult) -> float | None:
    return _share(result, "false_kept", "false_loops")


def _lost(result: CellResult) -> float | None:
    return _share(result, "own_lost", "own_loops")


def _share(result: CellResult, part: str, whole: str) -> float | None:
    some, every = result.figures.get(part), result.figures.get(whole)
    return None if some is None or not every else 100.0 * some / every


def _groups(summaries: Sequence[Summary]) -> list[tuple[str, list[Line]]]:
    """Title -> a line a back-end."""
    found: dict[str, dict[str, dict[str, Summary]]] = {}
    for one in summaries:
        found.setdefault(one.label, {}).setdefault(one.backend, {})[one.measure] = one
    return [(label, [_line(by_measure) for by_measure in by_backend.values()]) for label, by_backend in found.items()]


def _line(by_measure: dict[str, Summary]) -> Line:
    ate = by_measure["ate_m"]
    apart = ate.difference
    verdict = ""
    if apart is not None and apart.excludes_zero and apart.count > 1 and abs(apart.value) >= SHOWN_M:
        verdict = "lower" if apart.high < 0.0 else "higher"
    return Line(
        backend=ate.backend,
        solved=f"{ate.solved} of {ate.cells}",
        median=tables.number(ate.median),
        mean=tables.interval(ate.mean.value, ate.mean.low, ate.mean.high),
        difference="" if apart is None else tables.interval(apart.value, apart.low, apart.high),
        verdict=verdict,
        better="" if math.isnan(ate.better) else f"{100.0 * ate.better:.0f} %",
        others=tuple(tables.number(by_measure[name].median) for name in _SUMMED),
    )


def _remarks(study: Study) -> list[Remark]:
    """What did not end well, by status, place and back-end; the message is that of the first such cell."""
    found: dict[tuple[str, str, str], list[str]] = {}
    for cell, result in study.rows:
        if result.status not in _SOLVED:
            where = f"{cell.source}/{cell.setting}" + (f"/{cell.kind} {100 * cell.rate:g} %" if cell.kind else "")
            found.setdefault((result.status, where, cell.backend), []).append(result.message)
    return [Remark(*key, len(messages), messages[0]) for key, messages in found.items()]
