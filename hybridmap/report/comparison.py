"""One self-contained page per comparison of back-ends on one graph."""

from __future__ import annotations

import base64
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from importlib.metadata import version
from pathlib import Path
from typing import Any

import numpy as np
import yaml

from hybridmap.backends.comparison import Row
from hybridmap.backends.objective import squared_norms
from hybridmap.config.backends import BackendsConfig
from hybridmap.geometry import Array
from hybridmap.graph.edges import EdgeKind
from hybridmap.graph.gaps import Carry
from hybridmap.graph.pose_graph import PoseGraph
from hybridmap.output import Held, Kind, write_bytes, write_text
from hybridmap.report import comparison_figures as figures
from hybridmap.report import tables
from hybridmap.report.template import is_page, rendered

PICTURE, PAGE = "maps.png", "comparison.html"
COMPARISON = Kind("comparison", (PAGE, PICTURE), lambda folder: is_page(folder / PAGE))
_TEMPLATE = "comparison.html.j2"
_WORST = 6  # edges a row


@dataclass(frozen=True, slots=True)
class Compared:
    """What was compared.

    Attributes:
        title: headline.
        start: what the graph's own poses are, from which batch solutions begin.
        head: facts about the graph, shown as `key: value`.
        graph: the graph.
        rows: the back-ends.
        cells: the table: a line of column titles, then one line a row of `rows`.
        settings: of the back-ends.
        truth: pieces (P, 3) of the true way in the frame of the maps, m and rad; none where it is not known.
        carried: where the robot was carried, so that no line is drawn there.
    """

    title: str
    start: str
    head: Mapping[str, Any]
    graph: PoseGraph
    rows: Sequence[Row]
    cells: Sequence[Sequence[str]]
    settings: BackendsConfig
    truth: Sequence[Array] = ()
    carried: Sequence[Carry] = ()


def write_comparison(place: Held, compared: Compared) -> Path:
    """Write `maps.png` and `comparison.html` into a folder that is held as `COMPARISON`; returns the page.

    Raises:
        OutputError: it cannot be written to.
    """
    graph, rows = compared.graph, compared.rows
    picture = figures.panels(graph, rows, compared.start, compared.carried)
    page = rendered(
        _TEMPLATE,
        title=compared.title,
        start=compared.start,
        chi2_start=tables.number(float(squared_norms(graph, graph.initial).sum())),
        facts=[(key, value) for key, value in compared.head.items() if key not in ("nodes", "edges", "loops")],
        tiles=[(compared.head[key], key) for key in ("nodes", "edges", "loops")],
        columns=compared.cells[0],
        rows=[{"cells": line, "bad": not row.has_map} for row, line in zip(rows, compared.cells[1:], strict=True)],
        messages=[(row.title, row.verdict) for row in rows],
        ways={str(row.way) for row in rows},
        carried=compared.carried,
        of_truth=bool(compared.truth),
        overlay=figures.overlay(rows, compared.truth, compared.carried),
        panels="data:image/png;base64," + base64.b64encode(picture).decode("ascii"),
        convergence=figures.convergence(rows),
        weights=figures.weights(graph, rows),
        residuals=figures.residuals(graph, rows),
        worst=[(row.title, worst_edges(graph, row)) for row in rows if row.has_map],
        without=[row.title for row in rows if not row.has_map],
        settings=yaml.safe_dump(compared.settings.model_dump(mode="json", exclude={"names"}), sort_keys=False),
        version=version("hybridmap"),
    )
    with place.replaced():
        write_bytes(place.path / PICTURE, picture)
        write_text(place.path / PAGE, page)
    return place.path / PAGE


def worst_edges(graph: PoseGraph, row: Row) -> list[str]:
    """The edges that a solution kept and that cost it most, the worst first: number, ends, kind, squared residual."""
    assert row.solution is not None
    squared = squared_norms(graph, row.solution.poses)
    squared[np.isin(graph.edge_ids, row.solution.report.rejected_edge_ids)] = -1.0
    return [
        f"{graph.edge_ids[e]} ({graph.sources[e]} → {graph.targets[e]}, {EdgeKind(graph.kinds[e]).name.lower()}): "
        f"{tables.number(float(squared[e]))}"
        for e in np.argsort(-squared, kind="stable")[:_WORST].tolist()
        if squared[e] >= 0.0
    ]
