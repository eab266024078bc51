"""Tables and templates that all pages share."""

from __future__ import annotations

import html
import math
import re
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from hybridmap.metrics import PROVED, Metric, proved
from hybridmap.study.statistics import Interval

_FIRST = ("ate", "relation")


@dataclass(frozen=True, slots=True)
class TableRow:
    """One row of a table of metrics.

    Attributes:
        measure, unit, meaning: name of the metric, its unit and its description.
        cells: one text per column; empty where there is no value.
    """

    measure: str
    unit: str
    meaning: str
    cells: tuple[str, ...]


def by_backend(metrics: Sequence[Metric], backends: Sequence[str]) -> list[TableRow]:
    """Table of the metrics that belong to a back-end: one row per measure, one cell per back-end.

    Errors come first, the other measures in their order in the list. Metrics of other stages are left out.

    Args:
        metrics: metrics named `<measure>/<back-end>`.
        backends: the columns.
    """
    measures: dict[str, dict[str, Metric]] = {}
    for metric in metrics:
        measure, _, stage = metric.name.partition("/")
        if stage in backends:
            measures.setdefault(measure, {})[stage] = metric
    rows = []
    for measure, found in sorted(measures.items(), key=lambda item: not item[0].startswith(_FIRST)):
        last = next(found[name] for name in reversed(backends) if name in found)
        cells = tuple(shown(found[name]) if name in found else "" for name in backends)
        rows.append(TableRow(measure, unit(last), last.description, cells))
    return rows


def of_session(metrics: Sequence[Metric], backends: Sequence[str]) -> list[TableRow]:
    """Table of the metrics that belong to none of the back-ends, one row and one cell each, in their order."""
    return [
        TableRow(metric.name, unit(metric), metric.description, (shown(metric),))
        for metric in metrics
        if metric.name.partition("/")[2] not in backends
    ]


def shown(metric: Metric) -> str:
    """The value of a metric with four significant digits, and a tick or cross if it has a limit. Bounds stay bounds."""
    verdict = "" if metric.passed is None else " ✓" if metric.passed else " ✗"
    measure = metric.name.partition("/")[0]
    value = proved(metric.value, 4, at_least=PROVED[measure]) if measure in PROVED else metric.value
    return number(value) + verdict


def number(value: float) -> str:
    """A number with four significant digits, below 1e7 with all digits before the point; a dash for NaN or infinity."""
    if not math.isfinite(value):
        return "–"
    if value == round(value) and abs(value) < 1e7:
        return f"{value:.0f}"
    return f"{value:.0f}" if 1e4 <= abs(value) < 1e7 else f"{value:.4g}"


def interval(found: Interval) -> str:
    """A median with its confidence interval, with as many decimals as the interval justifies, at most six.

    Without an interval: the median, and why there is none.
    """
    if not found.count:
        return number(found.value)
    if not found.known:
        return f"{number(found.value if abs(found.value) >= 5e-7 else 0.0)} ({found})"
    width = 0.5 * (found.high - found.low)
    decimals = min(6, max(0, 2 - math.floor(math.log10(width)))) if width > 0.0 else 6
    figures = [round(figure, decimals) + 0.0 for figure in (found.value, found.low, found.high)]
    middle, left, right = (f"{figure:.{decimals if any(figures) else 0}f}" for figure in figures)
    return f"{middle} [{left}, {right}]"


def length(value_m: float) -> tuple[str, str]:
    """Format a length in m: (digits, unit), below a metre in cm; a dash for NaN or infinity."""
    if not math.isfinite(value_m):
        return "–", "m"
    value, name = (100.0 * value_m, "cm") if abs(value_m) < 1.0 else (value_m, "m")
    return f"{value:.0f}" if abs(value) >= 100 else f"{value:.2g}" if abs(value) < 10 else f"{value:.3g}", name


def duration(value_s: float) -> tuple[str, str]:
    """Format a duration in s: (digits, unit), beyond two minutes in minutes."""
    return (f"{value_s:.0f}", "s") if not value_s > 120.0 else (f"{value_s / 60.0:.1f}", "min")


def unit(metric: Metric) -> str:
    """The unit of a metric; an empty string for a plain number."""
    return "" if metric.unit == "1" else metric.unit


_MARK = '<meta name="generator" content="hybridmap '  # in the head of the pages that have a folder of their own


def is_page(path: Path) -> bool:
    """Whether a file is a page that hybridmap wrote outside of a session or study folder."""
    return path.is_file() and _MARK in path.read_text(encoding="utf-8", errors="replace")


def rendered(template: str, **content: Any) -> str:
    """Fill in the template of a page; returns its HTML.

    Args:
        template: file name of the template.
        content: values by name; text in them is escaped for HTML. A missing name is an error.
    """
    from jinja2 import Environment, PackageLoader, StrictUndefined

    environment = Environment(
        loader=PackageLoader("hybridmap", "report"),
        autoescape=True,
        undefined=StrictUndefined,
        trim_blocks=True,
        lstrip_blocks=True,
    )
    environment.filters["code"] = _code
    return environment.get_template(template).render(content)


def _code(text: str) -> str:
    """A text as HTML; what it has between backticks is shown as code."""
    return re.sub("`([^`]+)`", r"<code>\1</code>", html.escape(text))
