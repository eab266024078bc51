"""The pictures of drives on the page of a reproduction: maps beside the truth, errors over the seeds, ends of the path."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np

from hybridmap.backends.base import ODOMETRY
from hybridmap.backends.registry import create
from hybridmap.config import Config
from hybridmap.errors import BackendError
from hybridmap.geometry import Array, align, compose, inverse
from hybridmap.graph.pose_graph import PoseGraph, prefix
from hybridmap.report import style
from hybridmap.reproduction.cells import PAPER_NETWORK_M, PAPER_ODOMETRY_M, End
from hybridmap.reproduction.systems import SystemResult
from hybridmap.simulation.worlds import build_world
from hybridmap.study.frozen import Frozen, Mapped

_WALL, _WALL_M = "#c9c9cf", 0.3
_TRUTH = {"color": style.TRUTH, "linewidth": 2.8, "alpha": 0.25, "label": "truth", "zorder": 3}
_ODOMETRY = {
    "color": style.ODOMETRY,
    "linewidth": 2.6,
    "alpha": 0.45,
    "label": "odometry",
    "zorder": 4,
}  # seen beside a map on it
_MAP = {"color": style.PRIMARY, "linewidth": 1.2, "label": "map", "zorder": 5}
_COLUMNS = 2
_GAP_M = 1.0
_FLOOR_M = 1e-4


def maps_figure(world: str, drives: Mapping[str, Frozen]) -> str:
    """Draw the map that each system made of one drive through a world, over its walls, with its odometry and the truth.

    Args:
        world: name of the world.
        drives: name of a system -> its drive; one that was not mapped is left out.

    Returns:
        A `data:` URI; an empty string if no system has a map.
    """
    shown = {system: drive for system, drive in drives.items() if drive.mapped is not None}
    if not shown:
        return ""
    truth = max((drive.reference for drive in shown.values()), key=len)
    columns = min(_COLUMNS, len(shown))
    lines = -(-len(shown) // columns)
    walls = _walls(world)
    span = np.ptp(np.concatenate(walls), axis=0)
    height = style.fitted_size(span, columns)[1] - 0.3
    with style.figure(style.PAGE_WIDTH_IN, height * lines) as picture:
        panels = picture.subplots(lines, columns, squeeze=False).ravel()
        for axes, (system, drive) in zip(panels, shown.items(), strict=False):
            assert drive.mapped is not None
            _draw_walls(axes, walls)
            axes.plot(*truth[:, :2].T, **_TRUTH)
            drawn = {ODOMETRY: _ODOMETRY} | ({drive.mapped.primary: _MAP} if _has_map(drive.mapped) else {})
            for name, looks in drawn.items():
                axes.plot(*_onto(drive.reference, drive.mapped.poses[name]).T, **looks)
            axes.set_title(system if _has_map(drive.mapped) else f"{system}: no map, only odometry")
            style.metric_axes(axes)
        for axes in panels[len(shown) :]:
            axes.set_axis_off()
        shown_lines = {label: line for axes in panels for line, label in zip(*axes.get_legend_handles_labels(), strict=True)}
        picture.legend(list(shown_lines.values()), list(shown_lines), loc="outside upper right", ncols=3)
        return style.svg_uri(picture)


def _has_map(mapped: Mapped) -> bool:
    """Whether the primary back-end ended with a map of its own."""
    return mapped.primary in mapped.poses and mapped.primary not in mapped.lost


def realignment_figure(world: str, drive: Frozen, system: str) -> str:
    """Draw the map of a drive before its first loop closures, after them, and at the end, each over the truth.

    The map is what the system's primary back-end makes of the graph as it was then.

    Args:
        world: name of the world.
        drive: the drive as the system mapped it.
        system: name of the configuration.

    Returns:
        A `data:` URI; an empty string if no loop was closed, or if the back-end fails on a part of the graph.
    """
    graph, settings = drive.graph, Config.load(system).backends
    if graph is None or not graph.is_loop.any():
        return ""
    entered = entries(graph)
    backend = create(settings.names[0], settings)
    moments = {
        "before the first loop closure": int(entered.min()),
        "just after it": int(entered.min()) + 1,
        "after half of the loops": int(np.sort(entered)[len(entered) // 2]) + 1,
        "at the end": graph.n_nodes,
    }
    try:
        maps = [backend.solve(prefix(graph, nodes)).poses for nodes in moments.values()]
    except BackendError:
        return ""
    walls = _walls(world)
    height = style.fitted_size(np.ptp(np.concatenate(walls), axis=0), _COLUMNS)[1] - 0.3
    with style.figure(style.PAGE_WIDTH_IN, 2 * height) as picture:
        panels = picture.subplots(2, _COLUMNS).ravel()
        for axes, (title, nodes), poses in zip(panels, moments.items(), maps, strict=True):
            _draw_walls(axes, walls)
            axes.plot(*drive.reference[:nodes, :2].T, **_TRUTH)
            axes.plot(*_from_start(drive.reference[:nodes], poses).T, **_MAP)
            axes.set_title(f"{title} ({nodes} nodes)")
            style.metric_axes(axes)
        picture.legend(*panels[0].get_legend_handles_labels(), loc="outside upper right", ncols=2)
        return style.svg_uri(picture)


def entries(graph: PoseGraph) -> Array:
    """(L,) node at which each loop entered the graph, which is when the robot was there."""
    return np.asarray(np.maximum(np.maximum(graph.sources, graph.targets), graph.entry_nodes)[graph.is_loop])


def errors_figure(results: Sequence[SystemResult]) -> str:
    """Draw the error of every map: a panel a world, a row a system, a dot a drive and a bar at the median.

    Returns:
        A `data:` URI; an empty string if no map has an error.
    """
    worlds = list(dict.fromkeys(one.world for one in results if one.errors_m))
    if not worlds:
        return ""
    most = max(len([one for one in results if one.world == world]) for world in worlds)
    drawn = [max(error, _FLOOR_M) for one in results for error in (*one.errors_m.values(), one.odometry_m.value)]
    decades = 10.0 ** np.floor(np.log10(np.nanmin(drawn))), 10.0 ** np.ceil(np.log10(np.nanmax(drawn)))
    lines = -(-len(worlds) // _COLUMNS)
    with style.figure(style.PAGE_WIDTH_IN, (0.26 * (most + 1) + 0.9) * lines) as picture:
        panels = picture.subplots(lines, _COLUMNS, squeeze=False).ravel()
        for axes, world in zip(panels, worlds, strict=False):
            _draw_errors(axes, [one for one in results if one.world == world])
            axes.set_title(world)
            axes.set_xlim(*decades)
        for axes in panels[len(worlds) :]:
            axes.set_axis_off()
        return style.svg_uri(picture)


def _draw_errors(axes: Any, results: Sequence[SystemResult]) -> None:
    for row, one in enumerate(results):
        odometry_m = max(one.odometry_m.value, _FLOOR_M)
        axes.plot([odometry_m] * 2, [row - 0.45, row + 0.45], color=style.ODOMETRY, linewidth=1.2, linestyle=(0, (1, 1)))
        for lost, mark in ((False, "."), (True, "x")):
            errors = [max(error, _FLOOR_M) for seed, error in one.errors_m.items() if (seed in one.lost) is lost]
            axes.plot(errors, [row] * len(errors), mark, color=style.PRIMARY, markersize=5.0, alpha=0.6)
        if set(one.errors_m) - one.lost:
            axes.plot([max(one.error_m.value, _FLOOR_M)], [row], "|", color=style.PRIMARY, markersize=13, markeredgewidth=2)
    axes.set_yticks(range(len(results)), [one.system for one in results])
    axes.set_ylim(len(results) - 0.5, -0.5)
    axes.set_xscale("log")
    axes.set_xlabel("error of the map, ATE (m); dotted: its odometry")
    axes.grid(True, axis="x", linewidth=0.5)


def ends_figure(ends: Mapping[int, End]) -> str:
    """Draw where 16.8 m end: by the paper's network and odometry, and by ours for every seed. Returns a `data:` URI."""
    with style.figure(style.PAGE_WIDTH_IN, 3.2) as picture:
        axes = picture.subplots()
        truth = np.array([end.truth for end in ends.values()])
        axes.plot(*truth[0], "+", color=style.TRUTH, markersize=13, markeredgewidth=2, label="truth")
        for points, mark, colour, label in (
            ([end.odometry for end in ends.values()], "o", style.ODOMETRY, "odometry, one point a seed"),
            ([end.network for end in ends.values()], "x", style.PRIMARY, "network, on the same increments"),
            ([PAPER_ODOMETRY_M], "s", style.ODOMETRY, "the paper's odometry"),
            ([PAPER_NETWORK_M], "D", style.PRIMARY, "the paper's network"),
        ):
            hollow = {"markerfacecolor": "none"} if mark == "o" else {}
            axes.plot(*np.array(points).T, mark, color=colour, markersize=7, label=label, linestyle="none", **hollow)
        axes.set(xlabel="along the corridor (m)", ylabel="across it (m)")
        axes.grid(True, linewidth=0.5)
        picture.legend(loc="outside right upper")
        return style.svg_uri(picture)


def _walls(world: str) -> list[Array]:
    """The walls and furniture of a world from above: ends (2, 2) of every upright surface that stands on the floor, m."""
    upright = [face for face in build_world(world).surfaces if face.up[2] > 0.0 and not face.decal]
    low = [face for face in upright if face.corner[2] < _WALL_M]
    return [np.array([face.corner[:2], face.corner[:2] + face.along[:2]]) for face in low]


def _draw_walls(axes: Any, walls: Sequence[Array]) -> None:
    from matplotlib.collections import LineCollection

    axes.add_collection(LineCollection(list(walls), colors=_WALL, linewidths=0.7, zorder=1))
    low, high = np.concatenate(walls).min(axis=0), np.concatenate(walls).max(axis=0)
    axes.update_datalim([low, high])
    axes.autoscale_view()


def _onto(reference: Array, poses: Array) -> Array:
    """A line through the poses after one rigid alignment to the reference, which is how errors are measured."""
    known = np.isfinite(reference).all(axis=1)
    return _line(reference, compose(align(reference[known], poses[known]), poses))


def _from_start(reference: Array, poses: Array) -> Array:
    """A line through the poses, put to begin where the reference does: so a closure shows as a shift of the map."""
    return _line(reference, compose(compose(reference[0], inverse(poses[0])), poses))


def _line(reference: Array, poses: Array) -> Array:
    """Positions (N, 2) of poses; NaN between nodes that are too far apart for a straight line to be the way between them."""
    far = np.flatnonzero(np.hypot(*np.diff(reference[:, :2], axis=0).T) > _GAP_M)
    return np.insert(poses[:, :2], far + 1, np.nan, axis=0)
