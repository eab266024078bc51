"""The self-contained page of a comparison of back-ends on one graph, and its pictures."""

from __future__ import annotations

import base64
import io
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from importlib.metadata import version
from pathlib import Path
from typing import Any

import numpy as np
import yaml

from hybridmap.backends.base import ODOMETRY
from hybridmap.backends.comparison import Row, Way
from hybridmap.backends.objective import squared_norms
from hybridmap.config.backends import BackendsConfig
from hybridmap.errors import counted
from hybridmap.geometry import Array
from hybridmap.graph.edges import EdgeKind
from hybridmap.graph.gaps import Kidnapping, kidnapping_edges, parted
from hybridmap.graph.pose_graph import PoseGraph
from hybridmap.output import Held, Kind, write_bytes, write_text
from hybridmap.report import page_tables as tables
from hybridmap.report import style
from hybridmap.report.page_tables import is_page, rendered

PICTURE, PAGE = "maps.png", "comparison.html"
COMPARISON = Kind("comparison", (PAGE, PICTURE), lambda folder: is_page(folder / PAGE))
_TEMPLATE = "comparison.html.j2"
_WORST = 6  # edges a row


@dataclass(frozen=True, slots=True)
class Compared:
    """The content of the page that compares back-ends on one graph.

    Attributes:
        title: headline.
        start: origin of the graph's initial poses, in words (`dead reckoning`).
        head: facts about the graph, shown as `key: value`; `nodes`, `edges` and `loops` must be among them.
        graph: the graph that was solved.
        rows: one result per back-end and way of solving.
        cells: the table as text: column titles, then one list of cells per entry of `rows`.
        settings: settings of the back-ends.
        truth: pieces (P, 3) of the true path in the frame of the maps, m and rad; empty if unknown.
        kidnapped: the places where the robot was kidnapped; no line is drawn there.
        reasons: title of a row -> reasons against its map, in words; a row without any may be left out.
    """

    title: str
    start: str
    head: Mapping[str, Any]
    graph: PoseGraph
    rows: Sequence[Row]
    cells: Sequence[Sequence[str]]
    settings: BackendsConfig
    truth: Sequence[Array] = ()
    kidnapped: Sequence[Kidnapping] = ()
    reasons: Mapping[str, Sequence[str]] = field(default_factory=dict)


def write_comparison(place: Held, compared: Compared) -> Path:
    """Write `maps.png` and `comparison.html`, which replace those of an earlier comparison.

    Args:
        place: the folder, locked against other writers.
        compared: content of the page.

    Returns:
        The path of the page.

    Raises:
        OutputError: the folder cannot be written to.
    """
    graph, rows = compared.graph, compared.rows
    picture = panels(graph, rows, compared.start, compared.kidnapped)
    page = rendered(
        _TEMPLATE,
        title=compared.title,
        start=compared.start,
        chi2_start=tables.number(float(squared_norms(graph, graph.initial).sum())),
        facts=[(key, value) for key, value in compared.head.items() if key not in ("nodes", "edges", "loops")],
        tiles=[counted(compared.head[f"{noun}s"], noun).split() for noun in ("node", "edge", "loop")],
        columns=compared.cells[0],
        rows=[{"cells": line, "bad": not row.has_map} for row, line in zip(rows, compared.cells[1:], strict=True)],
        messages=[(row.title, row.remark, compared.reasons.get(row.title, ())) for row in rows],
        ways={str(row.way) for row in rows},
        kidnapped=compared.kidnapped,
        of_truth=bool(compared.truth),
        overlay=overlay(rows, compared.truth, compared.kidnapped),
        panels="data:image/png;base64," + base64.b64encode(picture).decode("ascii"),
        convergence=convergence(rows),
        weights=weights(graph, rows),
        residuals=residuals(graph, rows),
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
    """Describe the few edges with the largest squared residuals, worst first: number, end nodes, kind, squared residual.

    Edges that the back-end rejected are left out. The row must have a solution.
    """
    assert row.solution is not None
    squared = squared_norms(graph, row.solution.poses)
    squared[np.isin(graph.edge_ids, row.solution.report.rejected_edge_ids)] = -1.0
    return [
        f"{graph.edge_ids[e]} ({graph.sources[e]} → {graph.targets[e]}, {EdgeKind(graph.kinds[e]).name.lower()}): "
        f"{tables.number(float(squared[e]))}"
        for e in np.argsort(-squared, kind="stable")[:_WORST].tolist()
        if squared[e] >= 0.0
    ]


_CHAIN, _LOOP, _REJECTED = style.PRIMARY, style.ACCEPTED, style.REJECTED
_COLUMNS = 3
_THICK_PT, _THIN_PT = 4.4, 1.1  # of the first line and the last
_MARGIN = 0.05  # round a map, of its size
_SHARP = 24  # lines of an image for each bar: smoothing along the loops must not run from bar to bar
_BAR_IN = 0.34  # height of a back-end's bar of weights


def solved(rows: Sequence[Row]) -> dict[str, Array]:
    """Title -> poses (N, 3) of the results that have a map. A back-end that diverged has none, only its initial poses."""
    return {row.title: row.solution.poses for row in rows if row.has_map and row.solution is not None}


def overlay(rows: Sequence[Row], truth: Sequence[Array], kidnapped: Sequence[Kidnapping]) -> str:
    """Draw the maps of all results in one frame, each as a line through its nodes, over the true path if known.

    The picture shows all maps but dead reckoning whole, which may run out of it.

    Args:
        rows: one result per back-end and way of solving.
        truth: pieces (P, 3) of the true path, m and rad; empty if unknown.
        kidnapped: the places where the robot was kidnapped; no line is drawn there.

    Returns:
        A `data:` URI; an empty string if no result has a map.
    """
    maps = solved(rows)
    if not maps:
        return ""
    framed = [poses for title, poses in maps.items() if title != ODOMETRY] or list(maps.values())
    low, high = _box([*framed, *truth])
    with style.figure(*style.fitted_size(high - low)) as picture:
        axes = picture.subplots()
        for i, piece in enumerate(truth):
            label = "" if i else "ground truth"
            axes.plot(*piece[:, :2].T, color=style.TRUTH, linewidth=3.2, alpha=0.28, label=label, zorder=3)
        looks = _looks(rows)
        for title, poses in maps.items():
            axes.plot(*parted(poses, kidnapped)[:, :2].T, label=title, **looks[title])
        style.metric_axes(axes, "box")
        axes.set_xlim(low[0], high[0])
        axes.set_ylim(low[1], high[1])
        picture.legend(loc="outside upper left", ncols=4)
        return style.svg_uri(picture)


def panels(graph: PoseGraph, rows: Sequence[Row], start: str, kidnapped: Sequence[Kidnapping]) -> bytes:
    """Draw each map with its loops and its rejected loops, one panel per result. The same input gives the same bytes.

    Args:
        graph: the graph that was solved; its edges are drawn.
        rows: one result per back-end and way of solving; one without a map gets no panel.
        start: title of a first panel with the graph's initial poses; it is left out if a result equals them.
        kidnapped: the places where the robot was kidnapped; no line is drawn there.

    Returns:
        The bytes of a PNG file; nothing is written.
    """
    maps = solved(rows)
    if not any(np.allclose(poses, graph.initial) for poses in maps.values()):
        maps = {start: graph.initial} | maps
    rejected = {row.title: row.solution.report.rejected_edge_ids for row in rows if row.solution is not None}
    driven = graph.with_edges(~kidnapping_edges(graph, kidnapped))
    columns = max(1, min(_COLUMNS, len(maps)))
    lines = -(-len(maps) // columns)
    with style.figure(style.PAGE_WIDTH_IN, 0.4 + 3.1 * lines) as picture:
        places = picture.subplots(lines, columns, squeeze=False).ravel()
        for axes, (title, poses) in zip(places, maps.items(), strict=False):
            draw_map(axes, driven, poses, rejected.get(title, ()))
            axes.set_title(title)
        for axes in places[len(maps) :]:
            axes.set_axis_off()
        content = io.BytesIO()
        picture.savefig(content, format="png", dpi=160, metadata={"Software": None})
    return content.getvalue()


def convergence(rows: Sequence[Row]) -> str:
    """Draw how each result converged (`Row.curve`): chi2 over the iterations (batch), unit variance over nodes (incremental).

    Results without a curve or a map, and dead reckoning, are left out.

    Returns:
        A `data:` URI; an empty string if no result recorded its convergence.
    """
    traced = [row for row in rows if row.has_map and row.curve is not None and row.backend != ODOMETRY]
    ways = [way for way in Way if any(row.way is way for row in traced)]
    if not ways:
        return ""
    looks = _looks(rows)
    with style.figure(style.PAGE_WIDTH_IN, 3.6 + 0.25 * np.ceil(len(traced) / 4)) as picture:
        panels = picture.subplots(1, len(ways), squeeze=False).ravel()
        for axes, way in zip(panels, ways, strict=True):
            for row in traced:
                if row.way is way:
                    _draw_curve(axes, row, looks[row.title])
            axes.grid(True, linewidth=0.5)
            axes.set_title(str(way))
        picture.legend(loc="outside upper left", ncols=4)
        return style.svg_uri(picture)


def weights(graph: PoseGraph, rows: Sequence[Row]) -> str:
    """Draw the weight of every loop in the order of the graph, for each result with weights or rejected loops.

    A rejected loop has weight 0, one without a stated weight 1.

    Returns:
        A `data:` URI; an empty string if there is no such result.
    """
    ids = graph.edge_ids[graph.is_loop].tolist()
    bars: dict[str, list[float]] = {}
    for row in rows:
        report = row.solution.report if row.solution is not None and row.has_map else None
        if report is not None and (report.weights or report.rejected_edge_ids):
            out = set(report.rejected_edge_ids)
            bars[row.title] = [0.0 if edge in out else report.weights.get(edge, 1.0) for edge in ids]
    if not bars or not ids:
        return ""
    with style.figure(style.PAGE_WIDTH_IN, 1.1 + _BAR_IN * len(bars)) as picture:
        axes = picture.subplots()
        looks = {"aspect": "auto", "interpolation": "antialiased", "cmap": "cividis", "vmin": 0.0, "vmax": 1.0}
        drawn = axes.imshow(np.repeat(list(bars.values()), _SHARP, axis=0), extent=(0, len(ids), len(bars), 0), **looks)
        axes.set_yticks(np.arange(len(bars)) + 0.5, list(bars))
        axes.set_xlabel("loops, in the order of the log")
        for line in range(1, len(bars)):
            axes.axhline(line, color="white", linewidth=1.5)
        picture.colorbar(drawn, ax=axes, label="weight (1)")
        return style.svg_uri(picture)


def residuals(graph: PoseGraph, rows: Sequence[Row]) -> str:
    """Draw the share of edges (%) whose squared Mahalanobis residual is below a value, one line per result with a map.

    Rejected loops count as well.

    Returns:
        A `data:` URI; an empty string if no result has a map.
    """
    if not solved(rows):
        return ""
    share = 100.0 * (np.arange(graph.n_edges) + 1) / max(graph.n_edges, 1)
    looks = _looks(rows)
    with style.figure(style.PAGE_WIDTH_IN, 3.6) as picture:
        axes = picture.subplots()
        for title, poses in solved(rows).items():
            axes.plot(np.maximum(np.sort(squared_norms(graph, poses)), 1e-6), share, label=title, **looks[title])
        axes.set_xscale("log")
        axes.set_xlabel("squared Mahalanobis residual of an edge (1)")
        axes.set_ylabel("share of edges below (%)")
        axes.grid(True, linewidth=0.5)
        axes.legend()
        return style.svg_uri(picture)


def _looks(rows: Sequence[Row]) -> Mapping[str, dict[str, Any]]:
    """Title -> style of its line: one colour per back-end, dashes for the incremental way.

    Each line is thinner than the previous ones and drawn above them, so that coinciding lines stay visible.
    """
    colors = (style.PRIMARY, *style.OTHERS)
    names = [name for name in dict.fromkeys(row.backend for row in rows) if name != ODOMETRY]
    color_of = {ODOMETRY: style.ODOMETRY} | {name: colors[i % len(colors)] for i, name in enumerate(names)}
    width = dict(zip((row.title for row in rows), np.linspace(_THICK_PT, _THIN_PT, len(rows)), strict=True))
    return {
        row.title: {
            "color": color_of[row.backend],
            "zorder": 5,
            **(
                {"linewidth": _THIN_PT, "linestyle": (0, (1, 1)), "zorder": 4}
                if row.backend == ODOMETRY
                else {"linewidth": width[row.title], "linestyle": (0, (4, 1.6)) if row.way is Way.INCREMENTAL else "-"}
            ),
        }
        for row in rows
    }


def _box(maps: Sequence[Array]) -> tuple[Array, Array]:
    """Lower left and upper right corner (2,) of some maps, with a margin."""
    points = np.concatenate([poses[:, :2] for poses in maps])
    low, high = points.min(axis=0), points.max(axis=0)
    margin = _MARGIN * max(float((high - low).max()), 1.0)
    return low - margin, high + margin


def draw_map(axes: Any, graph: PoseGraph, poses: Array, rejected: tuple[int, ...]) -> None:
    """Draw the edges of one map: rejected loops lowest, the other loops over them, edges between consecutive nodes on top.

    Args:
        axes: matplotlib axes.
        graph: the graph.
        poses: (N, 3) poses of its nodes, m and rad.
        rejected: `edge_ids` of the loops that the back-end rejected.
    """
    lost, loops = np.isin(graph.edge_ids, np.array(rejected, dtype=np.int64)), graph.is_loop
    _draw_edges(axes, graph, poses, lost, color=_REJECTED, linewidths=0.4, alpha=0.6, zorder=1.1)
    _draw_edges(axes, graph, poses, loops & ~lost, color=_LOOP, linewidths=0.6, zorder=1.2)
    _draw_edges(axes, graph, poses, ~loops, color=_CHAIN, linewidths=0.9, zorder=1.3)
    style.metric_axes(axes)


def _draw_edges(axes: Any, graph: PoseGraph, poses: Array, which: Any, **looks: Any) -> None:
    from matplotlib.collections import LineCollection

    segments = np.stack([poses[graph.sources[which], :2], poses[graph.targets[which], :2]], axis=1)
    axes.add_collection(LineCollection(list(segments), **looks))
    axes.autoscale_view()


def _draw_curve(axes: Any, row: Row, looks: dict[str, Any]) -> None:
    assert row.curve is not None
    effort, value = row.curve.T
    axes.plot(effort, np.maximum(value, 1e-12), label=row.title, **looks)
    axes.set_yscale("log")
    if row.way is Way.BATCH:
        axes.set_xscale("symlog", linthresh=1.0)
        axes.set_xlabel("iterations or sweeps")
        axes.set_ylabel("chi2 of the edges kept in the end (1)")
    else:
        axes.set_xlabel("nodes")
        axes.set_ylabel("unit variance of what it keeps (1)")
