"""The map: trajectories of every back-end over the truth, and the graph with its loops by what became of them."""

from __future__ import annotations

from typing import Any

import numpy as np

from hybridmap.backends.base import ODOMETRY
from hybridmap.graph.edges import Edge, EdgeKind, Status
from hybridmap.graph.gaps import carries, pieces
from hybridmap.report import style
from hybridmap.report.outline import Raster
from hybridmap.report.scene import Scene
from hybridmap.trajectory import Trajectory

_PALE, _GREY = "#efbd97", "#9a9a9a"
_LEGEND_PT = 1.8
_MANY = 200


def trajectories_figure(scene: Scene, building: Raster | None) -> str:
    """Every back-end's trajectory over the truth and over what the primary back-end's map shows; a `data:` URI."""
    shown = [scene.estimates[name].poses for name in scene.backends if name in scene.estimates]
    shown += [scene.truth.poses] if scene.truth is not None else []
    with style.figure(*_size(np.concatenate(shown)[:, :2], building)) as picture:
        draw_trajectories(picture.add_subplot(), scene, building)
        picture.legend(loc="outside upper left", ncols=6)
        return style.svg_uri(picture)


def draw_trajectories(axes: Any, scene: Scene, building: Raster | None) -> None:
    """Draw every back-end's trajectory over the truth and the building."""
    style.draw_building(axes, building)
    if scene.truth is not None:
        _draw_ways(axes, scene.truth, scene, color=style.TRUTH, linewidth=3.2, alpha=0.28, label="ground truth", zorder=3)
    styles = style.line_styles(scene.backends)
    for name in scene.backends:
        if name in scene.estimates:
            label = f"{name} (primary)" if name == scene.primary else name
            _draw_ways(axes, scene.estimates[name], scene, label=label, **styles[name])
    start = scene.estimates.get(scene.primary, scene.estimates[ODOMETRY]).poses[0]
    axes.plot(*start[:2], marker="o", markersize=7, color="white", markeredgecolor="black", zorder=8, label="start")
    style.metric_axes(axes)


def _draw_ways(axes: Any, trajectory: Trajectory, scene: Scene, *, label: str, **looks: Any) -> None:
    """What was driven of a trajectory: no line leads through the air."""
    for i, piece in enumerate(pieces(trajectory, scene.experiences)):
        axes.plot(*style.thinned(piece.poses)[:, :2].T, label="" if i else label, **looks)


def graph_figure(scene: Scene, building: Raster | None) -> str:
    """Nodes at the primary back-end's poses, chain, carries, and loops by their fate; a `data:` URI."""
    with style.figure(*_size(scene.nodes[:, :2], building)) as picture:
        axes = picture.add_subplot()
        style.draw_building(axes, building, darkness=0.35)
        chain, carried = chain_and_carries(scene)
        _draw_edges(axes, scene, chain, color=_GREY, linewidth=0.8, zorder=2)
        looks = {"color": _GREY, "linewidth": 0.8, "linestyle": (0, (4, 4)), "zorder": 2}
        _draw_edges(axes, scene, carried, label=f"carried ({len(carried)})", **looks)
        loops = loops_by_fate(scene)
        for fate, looks in _FATES.items():
            many = len(loops[fate]) if fate == "loops rejected" else 0  # thousands of them would hide the building
            alpha = min(1.0, max(0.3, _MANY / max(many, 1)))
            _draw_edges(axes, scene, loops[fate], label=f"{fate} ({len(loops[fate])})", alpha=alpha, **looks)
        axes.plot(
            scene.nodes[:, 0], scene.nodes[:, 1], linestyle="none", marker=".", markersize=1.8, color="#222222",
            label=f"nodes ({len(scene.nodes)})", zorder=7,
        )  # fmt: skip
        style.metric_axes(axes)
        _draw_legend(picture)
        return style.svg_uri(picture)


_FATES: dict[str, dict[str, Any]] = {
    "loops accepted": {"color": style.ACCEPTED, "linewidth": 2.6, "zorder": 6},  # short ones show beside the nodes on them
    "accepted, no weight in the primary back-end": {
        "color": style.UNWEIGHTED,
        "linewidth": 2.0,
        "linestyle": (0, (3, 1)),
        "zorder": 5,
    },
    "loops pending": {"color": style.PENDING, "linewidth": 1.1, "linestyle": (0, (4, 2)), "zorder": 4},
    "loops rejected": {"color": _PALE, "linewidth": 0.4, "zorder": 3},
}


def _draw_legend(picture: Any) -> None:
    """Lines of the legend can be seen, however thin and pale they are in the picture."""
    legend = picture.legend(loc="outside upper left", ncols=3, markerscale=2.5)
    for line in legend.get_lines():
        line.set_alpha(1.0)
        line.set_linewidth(max(line.get_linewidth(), _LEGEND_PT))


def chain_and_carries(scene: Scene) -> tuple[list[Edge], list[Edge]]:
    """The accepted edges that no loops are: those of ways driven, and those that stand for a way through the air."""
    aloft = {(carry.before, carry.after) for carry in carries(scene.experiences)}
    motion = [e for e in scene.experiences.edges if e.kind is not EdgeKind.LOOP and e.status is Status.ACCEPTED]
    chain = [edge for edge in motion if (edge.source, edge.target) not in aloft]
    return chain, [edge for edge in motion if (edge.source, edge.target) in aloft]


def loops_by_fate(scene: Scene) -> dict[str, list[Edge]]:
    """Every loop that was considered, by what became of it, in the order of the legend."""
    report = scene.reports.get(scene.primary)
    unweighted = set(report.rejected_edge_ids) if report is not None else set()
    found: dict[str, list[Edge]] = {fate: [] for fate in _FATES}
    for number, edge in enumerate(scene.experiences.edges):
        if edge.kind is not EdgeKind.LOOP:
            continue
        if edge.status is Status.ACCEPTED:
            fate = "accepted, no weight in the primary back-end" if number in unweighted else "loops accepted"
        else:
            fate = "loops pending" if edge.status is Status.PENDING else "loops rejected"
        found[fate].append(edge)
    return found


def _draw_edges(axes: Any, scene: Scene, edges: list[Edge], **looks: Any) -> None:
    from matplotlib.collections import LineCollection

    if not edges:
        return
    ends = np.array([[edge.source, edge.target] for edge in edges])
    axes.add_collection(LineCollection(list(scene.nodes[ends][:, :, :2]), **looks))


def _size(points: Any, building: Raster | None) -> tuple[float, float]:
    low, high = points.min(axis=0), points.max(axis=0)
    if building is not None:
        low = np.minimum(low, [building.extent[0], building.extent[2]])
        high = np.maximum(high, [building.extent[1], building.extent[3]])
    return style.fitted_size(high - low)
