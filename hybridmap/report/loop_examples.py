"""Example loop closures: the data of both nodes, both scanlines, and both views overlaid by the measured relative pose."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from hybridmap.backends.base import ODOMETRY
from hybridmap.geometry import Array, between, transform_points
from hybridmap.graph.edges import Edge, Status
from hybridmap.report import style
from hybridmap.report.session_figures import loops_by_fate
from hybridmap.report.session_scene import SessionScene
from hybridmap.store import MapStore
from hybridmap.trajectory import NS_PER_S

_ACCEPTED_EXAMPLES = 3
_NEIGHBOURS = 6
_MAX_POINTS = 3000
_SIMILAR_HEADING_RAD = np.radians(40.0)
_APART_S = 20.0
WIDTH_IN, TITLE_PT = 3.8, 8.5
"""Of the pictures of a closure, and of their titles."""
_LEFT = 0.15  # of the overlay: where its axes and its title begin
_OVERLAY_SHAPE = 1.345  # width over height of its axes
_NEW, _OLD = style.PRIMARY, style.ODOMETRY


@dataclass(frozen=True, slots=True)
class Example:
    """One example of a loop closure on a session's page.

    Attributes:
        title: its two nodes, and whether it was accepted, in words.
        accepted: whether it is in the graph.
        reason: why it was accepted or rejected.
        facts: (name, value with unit) of each quantity shown, as text.
        photos: colour images of the newer and the older node as `data:` URIs; empty without a camera.
        overlay: picture of both nodes' points from above, aligned by the measured relative pose; None without points.
        profiles: picture of both scanline profiles; None without profiles.
    """

    title: str
    accepted: bool
    reason: str
    facts: tuple[tuple[str, str], ...]
    photos: tuple[str, ...]
    overlay: str | None
    profiles: str | None


def examples(scene: SessionScene, store: MapStore, points_of: Mapping[int, Array]) -> list[Example]:
    """Choose example loops: up to three accepted ones, spread over the drive, then the rejected one farthest from the map.

    Args:
        scene: content of the session's page.
        store: the session's map file, which holds the keyframes.
        points_of: node -> its points, (M, 2) in `base_link`, m.
    """
    fates = loops_by_fate(scene)
    accepted = fates["loops accepted"] or fates["accepted, no weight in the primary back-end"]
    chosen = spread(_telling(scene, accepted, _ACCEPTED_EXAMPLES), _ACCEPTED_EXAMPLES)
    chosen += sorted(fates["loops rejected"], key=lambda edge: -_contradiction_m(scene, edge))[:1]
    return [_example(scene, store, edge, points_of) for edge in chosen]


def spread(edges: Sequence[Edge], count: int) -> list[Edge]:
    """Choose `count` edges, evenly spaced in the list and in its order; all of them if there are no more than that."""
    if len(edges) <= count:
        return list(edges)
    return [edges[(2 * k + 1) * len(edges) // (2 * count)] for k in range(count)]


def _telling(scene: SessionScene, edges: Sequence[Edge], least: int) -> list[Edge]:
    """Edges by newer node; if there are enough, only measured ones far apart in time with a similar heading."""
    stamps_s = np.array([node.stamp_ns for node in scene.experiences.nodes]) / NS_PER_S
    tests = (
        lambda e: e.relative is not None,
        lambda e: abs(stamps_s[e.source] - stamps_s[e.target]) >= _APART_S,
        lambda e: e.relative is not None and abs(e.relative.delta[2]) < _SIMILAR_HEADING_RAD,
    )
    kept = sorted(edges, key=lambda e: (e.source, e.target))
    for test in tests:
        better = [edge for edge in kept if test(edge)]
        kept = better if len(better) >= least else kept
    return kept


def _contradiction_m(scene: SessionScene, edge: Edge) -> float:
    """Distance between the measured pose and the node on the final map, m; negative without a measurement."""
    if edge.relative is None:
        return -1.0
    off = between(edge.relative.delta, between(scene.nodes[edge.source], scene.nodes[edge.target]))
    return float(np.hypot(off[0], off[1]))


def _example(scene: SessionScene, store: MapStore, edge: Edge, points_of: Mapping[int, Array]) -> Example:
    accepted = edge.status is Status.ACCEPTED
    both = f"node {edge.source} and node {edge.target}"
    frames = store.keyframe(edge.source), store.keyframe(edge.target)
    photos = tuple(style.photo_uri(frame["color"]) for frame in frames if "color" in frame)
    profiles = [frame["profile"] for frame in frames if "profile" in frame]
    return Example(
        title=f"{both}: the same place" if accepted else f"{both}: {edge.status}",
        accepted=accepted,
        reason=edge.reason,
        facts=_facts(scene, edge),
        photos=photos if len(photos) == 2 else (),
        overlay=_overlay(scene, edge, points_of),
        profiles=_profiles(profiles[0], profiles[1], edge.shift) if len(profiles) == 2 else None,
    )


def _facts(scene: SessionScene, edge: Edge) -> tuple[tuple[str, str], ...]:
    nodes = scene.experiences.nodes
    one_drive = any(edge.source in drive and edge.target in drive for drive in scene.experiences.sessions)
    apart_s = abs(nodes[edge.source].stamp_ns - nodes[edge.target].stamp_ns) / NS_PER_S
    rows = [("time apart", f"{apart_s:.1f} s")] if one_drive else [("nodes of", "two drives, which no odometry joins")]
    if edge.relative is not None:
        x, y, yaw = edge.relative.delta
        sigma = np.sqrt(np.diag(edge.relative.covariance))
        rows += [
            ("measured", f"({x:.3f}, {y:.3f}) m, {np.degrees(yaw):.2f}°"),
            ("standard deviation of the edge", f"({sigma[0]:.3f}, {sigma[1]:.3f}) m, {np.degrees(sigma[2]):.2f}°"),
        ]
        drift = between(edge.relative.delta, between(nodes[edge.source].pose_odom, nodes[edge.target].pose_odom))
        if one_drive:
            off = f"{np.hypot(drift[0], drift[1]):.3f} m, {np.degrees(abs(drift[2])):.2f}°"
            rows.append((f"{ODOMETRY} disagrees by", off))
        rows.append(("final map disagrees by", f"{_contradiction_m(scene, edge):.3f} m"))
    else:
        rows.append(("measured", "nothing"))
    return (*rows, *in_words(edge))


def _seen_around(scene: SessionScene, node: int, points_of: Mapping[int, Array]) -> Array:
    """Points of a node and its neighbours along the drive, (M, 2) in the frame of the node, m."""
    nodes = range(max(0, node - _NEIGHBOURS), min(len(scene.nodes), node + _NEIGHBOURS + 1))
    delta = between(scene.nodes[node], scene.nodes)
    seen = [transform_points(delta[k], points_of[k]) for k in nodes if k in points_of]
    points = np.concatenate(seen) if seen else np.zeros((0, 2))
    return points[:: max(1, len(points) // _MAX_POINTS)]


def _overlay(scene: SessionScene, edge: Edge, points_of: Mapping[int, Array]) -> str | None:
    new, old = (_seen_around(scene, node, points_of) for node in (edge.source, edge.target))
    if not len(new) or not len(old):
        return None
    delta = edge.relative.delta if edge.relative is not None else between(scene.nodes[edge.source], scene.nodes[edge.target])
    placed = transform_points(delta, old)
    with style.figure(WIDTH_IN, 3.4, margins=(_LEFT, 0.98, 0.23, 0.92)) as picture:
        axes = picture.add_subplot()
        style.metric_axes(axes, adjustable="box")
        dots: dict[str, Any] = {"linestyle": "none", "marker": ".", "markeredgewidth": 0, "rasterized": True}
        axes.plot(placed[:, 0], placed[:, 1], color=_OLD, markersize=4.0, alpha=0.6, label="older", **dots)
        axes.plot(new[:, 0], new[:, 1], color=_NEW, markersize=2.6, alpha=0.8, label="newer", **dots)
        _draw_robot(axes, delta, _OLD)
        _draw_robot(axes, np.zeros(3), _NEW)
        low, high = np.percentile(np.concatenate([placed, new]), [1.0, 99.0], axis=0)
        center, half = (low + high) / 2.0, (high - low) / 2.0 + 0.5
        half_width = max(half[0], half[1] * _OVERLAY_SHAPE)
        axes.set_xlim(center[0] - half_width, center[0] + half_width)
        axes.set_ylim(center[1] - half_width / _OVERLAY_SHAPE, center[1] + half_width / _OVERLAY_SHAPE)
        axes.set_title(overlay_title(edge), fontsize=TITLE_PT)
        legend = picture.legend(loc="lower center", ncols=2, markerscale=3.0)
        for handle in legend.legend_handles:
            handle.set_alpha(1.0)
        return style.svg_uri(picture)


def overlay_title(edge: Edge) -> str:
    """Title of the picture of both views of a loop: aligned by the measured pose, or by the map if nothing was measured."""
    return f"laid over each other {'as the map has them' if edge.relative is None else 'by the measured pose'}"


def _draw_robot(axes: Any, pose: Array, color: str) -> None:
    marker = (3, 0, float(np.degrees(pose[2])) - 90.0)
    axes.plot(*pose[:2], marker=marker, markersize=10, color=color, markeredgecolor="white", zorder=6)


def _profiles(new: NDArray[Any], old: NDArray[Any], shift: int) -> str:
    bands, width = new.shape
    spacing = 1.15 * float(max(np.ptp(new, axis=1).max(), np.ptp(old, axis=1).max(), 1e-6))
    column = np.arange(width)
    with style.figure(WIDTH_IN, 3.4, margins=(0.22, 0.98, 0.15, 0.92)) as picture:
        axes = picture.add_subplot()
        for band in range(bands):
            base = (bands - 1 - band) * spacing
            axes.plot(column + shift, old[band] + base, color=_OLD, linewidth=1.0, linestyle=(0, (4, 1)))
            axes.plot(column, new[band] + base, color=_NEW, linewidth=1.0)
        axes.set_yticks([(bands - 1 - band) * spacing for band in range(bands)], _band_names(bands))
        axes.set_xlabel(f"column; the older one moved by {shift}" if shift else "column")
        axes.set_title("scanline profiles, normalised", fontsize=TITLE_PT)
        return style.svg_uri(picture)


def _band_names(bands: int) -> list[str]:
    """One band: ranges of a laser; else intensity bands and as many depth bands, the upper rows of the image first."""
    if bands == 1:
        return ["range"]
    half = bands // 2
    if half == 1:
        return ["intensity", "depth"]
    return [f"intensity {k + 1}" for k in range(half)] + [f"depth {k + 1}" for k in range(bands - half)]


_WORDS: dict[str, tuple[str, str]] = {
    "profile_G": ("difference of the scanlines (G)", ""),
    "shift": ("scanlines shifted by", "columns"),
    "map_distance_m": ("apart on the map at the time", "m"),
    "matches": ("features matched", ""),
    "feature_inliers": ("features that agree on the pose", ""),
    "feature_inliers_reverse": ("that agree the other way round", ""),
    "feature_inliers_both": ("that agree both ways round", ""),
    "height_m": ("measured off the floor by", "m"),
    "tilt_deg": ("measured tilt", "deg"),
    "reverse_m": ("the two ways round differ by", "m"),
    "reverse_deg": ("and in heading by", "deg"),
    "depth_inliers": ("share of the common depth that fits", ""),
    "depth_residual_m": ("distance of the surfaces there (RMS)", "m"),
    "overlap": ("share of the depth in common view", ""),
    "points": ("points of depth in common view", ""),
    "slack_m": ("standard deviation of the depth alone, in its loosest direction", "m"),
    "start": ("score of the coarse search (1 is best)", ""),
    "near": ("near: share of points with a partner", ""),
    "fit": ("fit: share of these that lie close", ""),
    "rms_m": ("distance of those that lie close (RMS)", "m"),
    "gate_sigma_m": ("standard deviation of the expected position", "m"),
    "off_m": ("off the expected position by", "m"),
    "off_deg": ("off the expected heading by", "deg"),
    "loosest_m": ("standard deviation of the registration alone, in its loosest direction", "m"),
    "ambiguity": ("ambiguity: likelihood left when slid that way", ""),
    "violation": ("share of points seen through", ""),
    "inliers": ("share of all points that lie close", ""),
    "off_features_m": ("depth is off the features' pose by", "m"),
    "off_features_deg": ("and in heading by", "deg"),
    "map_sigma": ("off the map, in standard deviations of it", ""),
    "supporting": ("other edges that agree", ""),
    "agreeing": ("loops that put the robot there", ""),
    "probes": ("probes that agree", ""),
    "span_m": ("travel that they cover", "m"),
    "rival": ("score of the best rival, as a share", ""),
    "mismatch": ("mismatch (0 fits perfectly)", ""),
}


def in_words(edge: Edge) -> list[tuple[str, str]]:
    """(description, value with unit) of each quantity stored with an edge, those that decided about it first.

    A quantity without a description is listed by its name.
    """
    figures = {check.figure: check.value for check in edge.checks} | dict(edge.figures)
    figures |= {"shift": edge.shift} if edge.shift else {}
    rows = []
    for name, value in figures.items():
        said, unit = _WORDS.get(name, (name.replace("_", " "), ""))
        rows.append((said, f"{value:.4g} {unit}".rstrip()))
    return rows
