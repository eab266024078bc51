"""One self-contained page per study."""

from __future__ import annotations

import math
import re
from collections.abc import Sequence
from dataclasses import dataclass
from importlib.metadata import version
from pathlib import Path

from hybridmap.output import write_text
from hybridmap.report import study_figures, tables
from hybridmap.report.study_figures import FLOOR_M, MOST_PANELS
from hybridmap.report.template import rendered
from hybridmap.study.cell import MEASURES, CellResult
from hybridmap.study.folder import PAGE
from hybridmap.study.grid import Cell
from hybridmap.study.model import quoted
from hybridmap.study.statistics import LEAST, Interval, Summary
from hybridmap.study.study import Study

_TEMPLATE = "study.html.j2"
_SOLVED = ("converged", "waiting", "max-iterations")
SHOWN_M = 5e-7
"""Differences below it are shown as 0."""
_NAMED = 4  # places or back-ends that a remark names
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
class Group:
    """A table.

    Attributes:
        label: the group in words.
        lines: of the back-ends that have a map in it.
        without: the other back-ends.
    """

    label: str
    lines: tuple[Line, ...]
    without: tuple[str, ...]


@dataclass(frozen=True, slots=True)
class Remark:
    """Cells that did not come to a good end and say the same."""

    status: str
    where: str
    backend: str
    count: int
    message: str


def write_study_page(study: Study) -> Path:
    """Write `report.html` of a study: one page that needs nothing beside it; the same results give the same page.

    Raises:
        OutputError: it cannot be written.
    """
    page = study.folder.path / PAGE
    write_text(page, _render(study))
    return page


def _render(study: Study) -> str:
    config = study.grid.study
    plan = study_figures.layout(study)
    of_error = study_figures.having(plan, _error)
    kept = [_kept(result) for _, result in study.rows]
    pairs = study_figures.paired_groups(study.summaries)
    groups = groups_of(study.summaries)
    shown = [group for group in groups if group.lines]
    return rendered(
        _TEMPLATE,
        head=study.head,
        baseline=quoted(study.head["baseline"]),
        description=config.description,
        tiles=_tiles(study),
        along=plan.along,
        empty=len(plan.panels) - len(of_error.panels),
        left_out=max(0, len(of_error.panels) - MOST_PANELS),
        floor=tables.length(FLOOR_M),
        of_truth=_reference(study),
        ate=study_figures.merit_figure(study, plan, "ATE (m)", _error, logarithmic=True),
        by_false_loops=any(share is not None for share in kept),
        kept=_shares(study, plan, "false loops kept (%)", _kept) if any(share not in (None, 100.0) for share in kept) else "",
        lost=_shares(study, plan, "own loops lost (%)", _lost) if any(_lost(result) for _, result in study.rows) else "",
        differences=study_figures.difference_figure(pairs),
        pairs_left_out=max(0, len(pairs) - MOST_PANELS),
        confidence=f"{100.0 * config.statistics.confidence:g}",
        method={"t": "Student's t", "bootstrap": "BCa bootstrap"}[config.statistics.method],
        least=LEAST[config.statistics.method],
        groups=shown,
        groups_without=len(groups) - len(shown),
        measures=[(name, unit, text) for name, (unit, text) in MEASURES.items()],
        remarks=remarks(study),
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


def groups_of(summaries: Sequence[Summary]) -> list[Group]:
    """Every group; a line a back-end that has a map there."""
    found: dict[str, dict[str, dict[str, Summary]]] = {}
    for one in summaries:
        found.setdefault(one.label, {}).setdefault(one.backend, {})[one.measure] = one
    return [_group(label, by_backend) for label, by_backend in found.items()]


def _group(label: str, by_backend: dict[str, dict[str, Summary]]) -> Group:
    solved = {backend: by_measure["chi2"].solved for backend, by_measure in by_backend.items()}
    lines = tuple(_line(by_measure) for backend, by_measure in by_backend.items() if solved[backend])
    return Group(label, lines, tuple(quoted(backend) for backend in by_backend if not solved[backend]))


def _line(by_measure: dict[str, Summary]) -> Line:
    ate = by_measure["ate_m"]
    apart = ate.difference
    verdict = ""
    if apart is not None and apart.excludes_zero and abs(apart.value) >= SHOWN_M:
        verdict = "lower" if apart.high < 0.0 else "higher"
    return Line(
        backend=ate.backend,
        solved=f"{ate.solved} of {ate.cells}",
        median=tables.number(ate.median),
        mean=_mean(ate.mean, ate.cells),
        difference="" if apart is None else _mean(apart, ate.cells),
        verdict=verdict,
        better="" if math.isnan(ate.better) else f"{100.0 * ate.better:.0f} %",
        others=tuple(tables.number(by_measure[name].median) for name in _SUMMED),
    )


def _mean(found: Interval, cells: int) -> str:
    """A mean with its interval, or why there is none; a single cell, where nothing is left to chance, needs none."""
    return tables.interval(found) if cells > 1 else tables.number(found.value)


def remarks(study: Study) -> list[Remark]:
    """What did not end well; cells that say the same but for the numbers are one remark, with the words of the first."""
    found: dict[tuple[str, str], list[tuple[Cell, str]]] = {}
    for cell, result in study.rows:
        if result.status not in _SOLVED:
            kind = re.sub(r"\d\S*", "#", result.message)
            found.setdefault((result.status, kind), []).append((cell, result.message))
    every = [variant.title for variant in study.grid.study.backends]
    return [
        Remark(
            status,
            _several([_where(cell) for cell, _ in cells]),
            _several([quoted(cell.backend) for cell, _ in cells], len(every)),
            len(cells),
            cells[0][1],
        )
        for (status, _), cells in found.items()
    ]


def _where(cell: Cell) -> str:
    return f"{cell.source}/{cell.setting}" + (f"/{cell.kind} {100 * cell.rate:g} %" if cell.kind else "")


def _several(names: Sequence[str], of: int = 0) -> str:
    """Names, each once: all of them, `every one` of `of`, or the first ones and how many more."""
    once = list(dict.fromkeys(names))
    if 1 < len(once) == of:
        return "every one"
    more = len(once) - _NAMED
    return ", ".join(once[:_NAMED]) + (f" and {more} more" if more > 0 else "")
