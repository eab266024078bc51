"""The pictures of a session: trajectories, the graph with its loops, errors over time, and the largest correction."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from hybridmap.backends.base import ODOMETRY
from hybridmap.geometry import Array, wrap_angle
from hybridmap.graph.edges import Edge, EdgeKind, Status
from hybridmap.graph.gaps import Kidnapping, kidnappings, parted, pieces
from hybridmap.metrics import ONLINE
from hybridmap.report import style
from hybridmap.report.outline import Raster, raster
from hybridmap.report.session_scene import Correction, SessionScene
from hybridmap.trajectory import NS_PER_S, Trajectory

_PALE, _GREY = "#efbd97", "#9a9a9a"
_LEGEND_PT = 1.8
_MANY = 200


def trajectories_figure(scene: SessionScene, building: Raster | None) -> str:
    """Draw every back-end's trajectory over the ground truth and the building.

    Args:
        scene: content of the session's page.
        building: picture of the building from above; None without one.

    Returns:
        A `data:` URI.
    """
    shown = [scene.estimates[name].poses for name in scene.backends if name in scene.estimates]
    shown += [scene.truth.poses] if scene.truth is not None else []
    with style.figure(*_size(np.concatenate(shown)[:, :2], building)) as picture:
        draw_trajectories(picture.add_subplot(), scene, building)
        picture.legend(loc="outside upper left", ncols=6)
        return style.svg_uri(picture)


def draw_trajectories(axes: Any, scene: SessionScene, building: Raster | None) -> None:
    """Draw every back-end's trajectory over the ground truth and the building on matplotlib axes.

    Args:
        axes: matplotlib axes.
        scene: content of the session's page.
        building: picture of the building from above; None without one.
    """
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


def known_map_figure(known: Array, way: Trajectory) -> str:
    """Draw the way of a drive, in the frame of the map that it was localised on.

    Args:
        known: (K, 3) poses of the nodes of that map, m and rad; (0, 3) if it is not at hand.
        way: where the drive was on it.

    Returns:
        A `data:` URI.
    """
    shown = np.concatenate([known, way.poses])[:, :2]
    with style.figure(*_size(shown, None)) as picture:
        axes = picture.add_subplot()
        axes.plot(*known[:, :2].T, ".", color=_GREY, markersize=5, label="nodes of the map", zorder=3)
        axes.plot(
            *style.thinned(way.poses)[:, :2].T, color=style.PRIMARY, linewidth=1.8, label="the drive on the map", zorder=6
        )
        axes.plot(
            *way.poses[0, :2], marker="o", markersize=7, color="white", markeredgecolor="black", zorder=8, label="first known"
        )
        style.metric_axes(axes)
        picture.legend(loc="outside upper left", ncols=6)
        return style.svg_uri(picture)


def _draw_ways(axes: Any, trajectory: Trajectory, scene: SessionScene, *, label: str, **looks: Any) -> None:
    """Draw a trajectory; no line is drawn where the robot was kidnapped."""
    for i, piece in enumerate(pieces(trajectory, scene.experiences)):
        axes.plot(*style.thinned(piece.poses)[:, :2].T, label="" if i else label, **looks)


def graph_figure(scene: SessionScene, building: Raster | None) -> str:
    """Draw the graph at the primary back-end's poses: nodes, edges, kidnappings, and loops coloured by their status.

    Args:
        scene: content of the session's page.
        building: picture of the building from above; None without one.

    Returns:
        A `data:` URI.
    """
    with style.figure(*_size(scene.nodes[:, :2], building)) as picture:
        axes = picture.add_subplot()
        style.draw_building(axes, building, darkness=0.35)
        chain, kidnapped = chain_and_kidnappings(scene)
        _draw_edges(axes, scene, chain, color=_GREY, linewidth=0.8, zorder=2)
        looks = {"color": _GREY, "linewidth": 0.8, "linestyle": (0, (4, 4)), "zorder": 2}
        _draw_edges(axes, scene, kidnapped, label=f"kidnapped ({len(kidnapped)})", **looks)
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
    """A legend with visible lines, however thin and pale they are in the picture."""
    legend = picture.legend(loc="outside upper left", ncols=3, markerscale=2.5)
    for line in legend.get_lines():
        line.set_alpha(1.0)
        line.set_linewidth(max(line.get_linewidth(), _LEGEND_PT))


def chain_and_kidnappings(scene: SessionScene) -> tuple[list[Edge], list[Edge]]:
    """The accepted edges that are not loops, in two lists: those the robot drove, and those over which it was carried."""
    aloft = {(kidnapping.before, kidnapping.after) for kidnapping in kidnappings(scene.experiences)}
    motion = [e for e in scene.experiences.edges if e.kind is not EdgeKind.LOOP and e.status is Status.ACCEPTED]
    chain = [edge for edge in motion if (edge.source, edge.target) not in aloft]
    return chain, [edge for edge in motion if (edge.source, edge.target) in aloft]


def loops_by_fate(scene: SessionScene) -> dict[str, list[Edge]]:
    """Words of the legend -> the loop edges of that status, in the order of the legend, for every loop that was considered.

    The keys are always the same. Retracted loops are among the rejected ones.
    """
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


def _draw_edges(axes: Any, scene: SessionScene, edges: list[Edge], **looks: Any) -> None:
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


_FLOOR_M, _FLOOR_DEG = 1e-3, 1e-2
_INTERVALS = 400
_GAP_S, _GAP = 3.0, 5.0  # a line ends where no error is taken for so long, and for so many times the usual spacing


@dataclass(frozen=True, slots=True)
class ErrorSeries:
    """The error of one trajectory over time.

    Attributes:
        time_s: (P,) time since the beginning of the recording.
        position_m, heading_deg: (P,) absolute errors, m and degrees.
    """

    time_s: Array
    position_m: Array
    heading_deg: Array


def error_series(scene: SessionScene) -> dict[str, ErrorSeries]:
    """Name of a trajectory -> its error over time.

    With ground truth: the final trajectory of every back-end, and the online one of the primary back-end, against it.
    Without: odometry and the online trajectory of each back-end, against the primary back-end's final trajectory.
    """
    start_ns = scene.estimates[ODOMETRY].stamps_ns[0]
    if scene.truth is not None:
        wanted = [*scene.backends, scene.primary + ONLINE]
        return {
            name: _series(pairs.stamps_ns - start_ns, pairs.estimate, pairs.reference)
            for name, pairs in ((name, scene.pairs[name]) for name in wanted if name in scene.pairs)
        }
    final = scene.estimates.get(scene.primary)
    if final is None or scene.primary == ODOMETRY:
        return {}
    wanted = [ODOMETRY, *(name + ONLINE for name in scene.backends if name != ODOMETRY)]
    return {
        name: _series(estimate.stamps_ns - start_ns, estimate.poses, final.at(estimate.stamps_ns))
        for name, estimate in ((name, scene.estimates[name]) for name in wanted if name in scene.estimates)
    }


def error_figure(scene: SessionScene) -> str | None:
    """Draw position and heading error over time, with a mark at every accepted loop.

    Returns:
        A `data:` URI; None if no error is known.
    """
    series = error_series(scene)
    if not series:
        return None
    with style.figure(style.PAGE_WIDTH_IN, 5.0) as picture:
        position, heading = picture.subplots(2, 1, sharex=True, height_ratios=(3, 2))
        draw_errors(position, scene, heading=False)
        draw_errors(heading, scene, heading=True)
        mark_loops(scene, position)
        position.set_xlabel("")
        picture.legend(*position.get_legend_handles_labels(), loc="outside upper left", ncols=5)
        return style.svg_uri(picture)


def draw_errors(axes: Any, scene: SessionScene, *, heading: bool) -> None:
    """Draw the errors of `error_series` over time: the heading error, deg, if `heading`, else the position error, m.

    Long series are drawn as root mean squares of intervals, on a logarithmic axis that begins at 1 mm or 0.01 deg. No line is
    drawn across gaps.
    """
    styles = style.line_styles(scene.backends)
    for name, errors in error_series(scene).items():
        looks = dict(styles[name.removesuffix(ONLINE)])
        if name.endswith(ONLINE) and scene.truth is not None:
            looks |= {"linewidth": 0.8, "alpha": 0.6, "zorder": 3, "linestyle": "solid"}
        drawn = with_gaps(over_intervals(errors, _INTERVALS), gaps(errors.time_s))
        error = np.maximum(drawn.heading_deg, _FLOOR_DEG) if heading else np.maximum(drawn.position_m, _FLOOR_M)
        axes.plot(drawn.time_s, error, label=name.replace(ONLINE, ", as believed at the time"), **looks)
    axes.set_yscale("log")
    axes.yaxis.set_major_formatter("{x:g}")
    axes.set_ylabel("heading error (deg)" if heading else "position error (m)")
    against = "ground truth" if scene.truth is not None else "final map"
    axes.set_xlabel(f"time since the start (s); errors against the {against}")
    axes.grid(True, linewidth=0.5)


def _series(since_start_ns: Any, estimate: Array, reference: Array) -> ErrorSeries:
    offset = estimate[:, :2] - reference[:, :2]
    turned = np.degrees(np.abs(wrap_angle(estimate[:, 2] - reference[:, 2])))
    return ErrorSeries(np.asarray(since_start_ns / NS_PER_S), np.hypot(offset[:, 0], offset[:, 1]), turned)


def over_intervals(errors: ErrorSeries, count: int) -> ErrorSeries:
    """Root mean square of the errors over `count` equal intervals of time; intervals without errors are left out.

    No more than `count` errors are returned as they are.
    """
    if len(errors.time_s) <= count:
        return errors
    first, last = errors.time_s[0], errors.time_s[-1]
    interval = np.minimum(((errors.time_s - first) / (last - first) * count).astype(np.int64), count - 1)
    number = np.bincount(interval, minlength=count)
    seen = number > 0
    sums = [np.bincount(interval, weights=values, minlength=count)[seen] for values in (
        errors.time_s, errors.position_m**2, errors.heading_deg**2
    )]  # fmt: skip
    time, position, heading = (total / number[seen] for total in sums)
    return ErrorSeries(time, np.sqrt(position), np.sqrt(heading))


def gaps(time_s: Array) -> Array:
    """Middle (G,), s, of each gap in times (P,), s, longer than 3 s and five times the median one, such as a kidnapping."""
    spacing = np.diff(time_s)
    if not len(spacing):
        return spacing
    wide = np.flatnonzero(spacing > max(_GAP_S, _GAP * float(np.median(spacing))))
    return np.asarray(0.5 * (time_s[wide] + time_s[wide + 1]))


def with_gaps(errors: ErrorSeries, gaps_s: Array) -> ErrorSeries:
    """The errors with NaN inserted at the times `gaps_s` (see `gaps`), so that no line is drawn across them."""
    at = np.searchsorted(errors.time_s, gaps_s)
    position, heading = (np.insert(values, at, np.nan) for values in (errors.position_m, errors.heading_deg))
    return ErrorSeries(np.insert(errors.time_s, at, gaps_s), position, heading)


def mark_loops(scene: SessionScene, axes: Any) -> None:
    """Mark the times of the accepted loops that the newest drive closed, s since it began."""
    nodes = scene.experiences.nodes
    start_ns, newest = scene.estimates[ODOMETRY].stamps_ns[0], scene.experiences.sessions[-1]
    loops = (e for e in scene.experiences.edges if e.kind is EdgeKind.LOOP and e.status is Status.ACCEPTED)
    times = sorted({(nodes[e.source].stamp_ns - start_ns) / NS_PER_S for e in loops if e.source in newest})
    if times:
        at_bottom = axes.get_xaxis_transform()
        axes.plot(
            times, np.full(len(times), 0.015), transform=at_bottom, linestyle="none", marker="|", markersize=7,
            color=style.ACCEPTED, label="loop accepted", zorder=7,
        )  # fmt: skip


def correction_figure(correction: Correction, points_of: Mapping[int, Array], kidnapped: Sequence[Kidnapping]) -> str:
    """Draw the map before and after its largest correction, in two panels on the same axes: nodes and their points.

    Args:
        correction: poses of the nodes before and after.
        points_of: node -> its points, (M, 2) in `base_link`, m.
        kidnapped: the places where the robot was kidnapped; no line is drawn there.

    Returns:
        A `data:` URI.
    """
    both = np.concatenate([correction.before, correction.after])[:, :2]
    low, high = both.min(axis=0) - 1.5, both.max(axis=0) + 1.5
    with style.figure(*style.fitted_size(high - low, panels=2)) as picture:
        left, right = picture.subplots(1, 2)
        _panel(left, "before", correction.before, points_of, kidnapped, style.ODOMETRY)
        _panel(right, "after", correction.after, points_of, kidnapped, style.PRIMARY)
        _draw_shifts(right, correction)
        right.set_ylabel("")
        for axes in (left, right):
            axes.set_xlim(low[0], high[0])
            axes.set_ylim(low[1], high[1])
        return style.svg_uri(picture)


def _panel(
    axes: Any, title: str, poses: Array, points_of: Mapping[int, Array], kidnapped: Sequence[Kidnapping], color: str
) -> None:
    style.draw_building(axes, raster(points_of, poses), darkness=0.6)
    axes.plot(*parted(poses, kidnapped)[:, :2].T, color=color, linewidth=1.0, marker=".", markersize=3, zorder=4)
    axes.plot(*poses[-1, :2], marker="o", markersize=7, color="white", markeredgecolor="black", zorder=6)
    axes.set_title(title)
    style.metric_axes(axes, adjustable="box")


def _draw_shifts(axes: Any, correction: Correction) -> None:
    """Draw how far each node was moved."""
    from matplotlib.collections import LineCollection

    shifts = np.stack([correction.before[:, :2], correction.after[:, :2]], axis=1)
    axes.add_collection(LineCollection(list(shifts), color=style.ODOMETRY, linewidth=0.6, alpha=0.6, zorder=3))
