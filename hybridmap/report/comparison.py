"""One self-contained page per comparison of back-ends on one graph."""

from __future__ import annotations

import base64
import io
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

from jinja2 import Environment

from hybridmap.backends.comparison import Row
from hybridmap.graph.pose_graph import PoseGraph
from hybridmap.plots import map_panels, residual_curves, save_png
from hybridmap.trajectory import write_text_atomic

PICTURE, PAGE = "maps.png", "comparison.html"

_TEMPLATE = """<!doctype html>
<html lang="en"><head><meta charset="utf-8"><title>{{ title }}</title><style>
body { font: 15px/1.5 system-ui, sans-serif; color: #222; max-width: 68rem; margin: 2rem auto; padding: 0 1rem }
table { border-collapse: collapse; width: 100% }
th, td { padding: .3rem .6rem; border-bottom: 1px solid #ddd; text-align: right }
th:first-child, td:first-child { text-align: left } img { max-width: 100% }
.bad { color: #b03a00 } small { color: #666 }
</style></head><body>
<h1>{{ title }}</h1>
<p>{{ facts }}</p>
<table><tr>{% for column in columns %}<th>{{ column }}</th>{% endfor %}</tr>
{% for row in rows %}<tr{% if row.bad %} class="bad"{% endif %}>{% for cell in row.cells %}<td>{{ cell }}</td>{% endfor %}</tr>
{% endfor %}</table>
<ul>{% for line in messages %}<li>{{ line }}</li>{% endfor %}</ul>
<p><small>chi2: the sum of squared Mahalanobis residuals over <em>all</em> edges (SE(2) logarithm), by one referee for every
back-end; a robust back-end that rejects false loops has a high chi2 for a good map. CPU: process time.</small></p>
<h2>Maps</h2>
<p>Blue: chain of consecutive nodes. Green: loops. Orange: loops that the back-end rejected.</p>
<img alt="the map of each back-end" src="{{ maps }}">
<h2>What the edges cost</h2>
<img alt="distribution of squared residuals" src="{{ residuals }}">
</body></html>
"""


def write_comparison(
    folder: Path, title: str, head: Mapping[str, Any], graph: PoseGraph, rows: Sequence[Row], cells: Sequence[Sequence[str]]
) -> Path:
    """Write `maps.png` and `comparison.html` into a folder, which is made; returns the page.

    Args:
        folder: where to.
        title: headline.
        head: facts about the graph, shown as `key: value`.
        graph: the graph that was compared on.
        rows: the back-ends.
        cells: the table: a line of column titles, then one line a row of `rows`.
    """
    solved = {row.backend: row.solution for row in rows if row.solution is not None}
    maps = {"start": graph.initial} | {name: solution.poses for name, solution in solved.items()}
    rejected = {name: solution.report.rejected_edge_ids for name, solution in solved.items()}
    panels = map_panels(graph, maps, rejected)
    save_png(panels, folder / PICTURE)
    page = (
        Environment(autoescape=True)
        .from_string(_TEMPLATE)
        .render(
            title=title,
            facts=", ".join(f"{key}: {value}" for key, value in head.items()),
            columns=cells[0],
            rows=[{"cells": line, "bad": row.solution is None} for row, line in zip(rows, cells[1:], strict=True)],
            messages=[f"{row.backend}: {row.message}" for row in rows],
            maps=_data_uri(panels),
            residuals=_data_uri(residual_curves(graph, maps)),
        )
    )
    write_text_atomic(folder / PAGE, page)
    return folder / PAGE


def _data_uri(figure: Any) -> str:
    data = io.BytesIO()
    figure.savefig(data, format="png", dpi=110, metadata={"Software": None})
    return "data:image/png;base64," + base64.b64encode(data.getvalue()).decode("ascii")
