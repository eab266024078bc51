"""Error over time: against the truth where it is known, else against the final map."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np

from hybridmap.backends.base import ODOMETRY
from hybridmap.geometry import Array, wrap_angle
from hybridmap.graph.edges import EdgeKind, Status
from hybridmap.report import style
from hybridmap.report.scene import ONLINE, Scene
from hybridmap.trajectory import NS_PER_S

_FLOOR_M, _FLOOR_DEG = 1e-3, 1e-2
_INTERVALS = 400
_GAP_S, _GAP = 3.0, 5.0  # a line ends where no error is taken for so long, and for so many times the usual spacing


@dataclass(frozen=True, slots=True)
class ErrorSeries:
    """One back-end's error over time.

    Attributes:
        time_s: (P,) since the beginning of the recording.
        position_m, heading_deg: (P,) absolute errors.
    """

    time_s: Array
    position_m: Array
    heading_deg: Array


def error_series(scene: Scene) -> dict[str, ErrorSeries]:
    """Name -> error: of every back-end's final trajectory and of the primary's online one, against the truth.

    Without a truth: of odometry and of what each back-end believed at the time, against the primary's final trajectory.
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


def error_figure(scene: Scene) -> str | None:
    """Position and heading error over time, with a mark at every accepted loop; a `data:` URI, None without anything."""
    series = error_series(scene)
    if not series:
        return None
    with style.figure(style.PAGE_WIDTH_IN, 5.0) as picture:
        position, heading = picture.subplots(2, 1, sharex=True, height_ratios=(3, 2))
        draw_errors(position, scene, heading=False)
        draw_errors(heading, scene, heading=True)
        _mark_loops(scene, position)
        position.set_xlabel("")
        picture.legend(*position.get_legend_handles_labels(), loc="outside upper left", ncols=5)
        return style.svg_uri(picture)


def draw_errors(axes: Any, scene: Scene, *, heading: bool) -> None:
    """Draw the position error, m, or the heading error, deg, of every back-end over time."""
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
    """Root mean square over `count` equal intervals of time; empty ones are left out."""
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
    """Middles (G,), s, of the times in which no error is taken, as where the robot was carried or the truth was lost."""
    spacing = np.diff(time_s)
    if not len(spacing):
        return spacing
    wide = np.flatnonzero(spacing > max(_GAP_S, _GAP * float(np.median(spacing))))
    return np.asarray(0.5 * (time_s[wide] + time_s[wide + 1]))


def with_gaps(errors: ErrorSeries, gaps_s: Array) -> ErrorSeries:
    """The series with NaN at some times, where its lines end and begin anew."""
    at = np.searchsorted(errors.time_s, gaps_s)
    position, heading = (np.insert(values, at, np.nan) for values in (errors.position_m, errors.heading_deg))
    return ErrorSeries(np.insert(errors.time_s, at, gaps_s), position, heading)


def _mark_loops(scene: Scene, axes: Any) -> None:
    nodes = scene.experiences.nodes
    start_ns = scene.estimates[ODOMETRY].stamps_ns[0]
    loops = (e for e in scene.experiences.edges if e.kind is EdgeKind.LOOP and e.status is Status.ACCEPTED)
    times = sorted({(nodes[e.source].stamp_ns - start_ns) / NS_PER_S for e in loops})
    if times:
        at_bottom = axes.get_xaxis_transform()
        axes.plot(
            times, np.full(len(times), 0.015), transform=at_bottom, linestyle="none", marker="|", markersize=7,
            color=style.ACCEPTED, label="loop accepted", zorder=7,
        )  # fmt: skip
