"""Example loop closures: what both nodes saw, both scanlines, and how the two views fit by the measured relative pose."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from hybridmap.geometry import Array, between, transform_points
from hybridmap.graph.experience_map import Edge, Status
from hybridmap.report import style
from hybridmap.report.map_figure import loops_by_fate
from hybridmap.report.outline import outline
from hybridmap.report.scene import ODOMETRY, Scene
from hybridmap.store import MapStore
from hybridmap.trajectory import NS_PER_S

_ACCEPTED_EXAMPLES = 3
_NEW, _OLD = style.PRIMARY, style.ODOMETRY


@dataclass(frozen=True, slots=True)
class Example:
    """One closure as the page shows it.

    Attributes:
        title: which nodes, and the verdict.
        accepted: whether it is in the graph.
        reason: why.
        facts: (name, value with unit) rows.
        photos: colour pictures of the newer and the older node as `data:` URIs; empty without a camera.
        overlay: what both saw from above, one laid over the other; None where there is nothing to lay.
        profiles: both scanline profiles; None where there are none.
    """

    title: str
    accepted: bool
    reason: str
    facts: tuple[tuple[str, str], ...]
    photos: tuple[str, ...]
    overlay: str | None
    profiles: str | None


def examples(scene: Scene, store: MapStore) -> list[Example]:
    """Some accepted closures, spread over the drive, and one that was refused after it had been measured."""
    fates = loops_by_fate(scene)
    chosen = spread(fates["loops accepted"] or fates["accepted, no weight in the primary back-end"], _ACCEPTED_EXAMPLES)
    refused = fates["loops rejected"]
    chosen += spread([edge for edge in refused if edge.relative is not None] or refused, 1)
    return [_example(scene, store, edge) for edge in chosen]


def spread(edges: Sequence[Edge], count: int) -> list[Edge]:
    """`count` of the edges, from the middle of as many equal parts of the list."""
    if len(edges) <= count:
        return list(edges)
    return [edges[(2 * k + 1) * len(edges) // (2 * count)] for k in range(count)]


def _example(scene: Scene, store: MapStore, edge: Edge) -> Example:
    new, old = store.keyframe(edge.source), store.keyframe(edge.target)
    delta = edge.relative.delta if edge.relative is not None else between(scene.nodes[edge.source], scene.nodes[edge.target])
    points = outline(new, store.rig), outline(old, store.rig)
    photos = tuple(style.photo_uri(frame["color"]) for frame in (new, old) if "color" in frame)
    profiles = [frame["profile"] for frame in (new, old) if "profile" in frame]
    return Example(
        title=f"node {edge.source} sees node {edge.target} again" if edge.status is Status.ACCEPTED
        else f"node {edge.source} and node {edge.target}: {edge.status}",
        accepted=edge.status is Status.ACCEPTED,
        reason=edge.reason,
        facts=_facts(scene, edge),
        photos=photos if len(photos) == 2 else (),
        overlay=_overlay(points[0], points[1], delta, measured=edge.relative is not None)
        if len(points[0]) and len(points[1])
        else None,
        profiles=_profiles(profiles[0], profiles[1], round(edge.scores.get("shift", 0.0))) if len(profiles) == 2 else None,
    )  # fmt: skip


def _facts(scene: Scene, edge: Edge) -> tuple[tuple[str, str], ...]:
    nodes = scene.experiences.nodes
    apart_s = abs(nodes[edge.source].stamp_ns - nodes[edge.target].stamp_ns) / NS_PER_S
    rows = [("time apart", f"{apart_s:.1f} s")]
    if edge.relative is not None:
        x, y, yaw = edge.relative.delta
        sigma = np.sqrt(np.diag(edge.relative.covariance))
        rows += [
            ("measured", f"({x:.3f}, {y:.3f}) m, {np.degrees(yaw):.2f}°"),
            ("standard deviation", f"({sigma[0]:.3f}, {sigma[1]:.3f}) m, {np.degrees(sigma[2]):.2f}°"),
        ]
        drift = between(edge.relative.delta, between(nodes[edge.source].pose_odom, nodes[edge.target].pose_odom))
        rows.append((f"{ODOMETRY} disagrees by", f"{np.hypot(drift[0], drift[1]):.3f} m, {np.degrees(abs(drift[2])):.2f}°"))
    rows += [(name.replace("_", " "), f"{value:.4g}") for name, value in edge.scores.items()]
    return tuple(rows)


def _overlay(new: Array, old: Array, delta: Array, *, measured: bool) -> str:
    placed = transform_points(delta, old)
    with style.figure(3.4, 3.0) as picture:
        axes = picture.add_subplot()
        size = {"linestyle": "none", "markersize": 2.2, "alpha": 0.7}
        axes.plot(placed[:, 0], placed[:, 1], marker="s", color=_OLD, label="older node", **size)
        axes.plot(new[:, 0], new[:, 1], marker="o", color=_NEW, label="newer node", **size)
        axes.plot(0, 0, marker=(3, 0, -90), markersize=8, color=_NEW)
        axes.plot(*delta[:2], marker=(3, 0, float(np.degrees(delta[2])) - 90), markersize=8, color=_OLD)
        style.metric_axes(axes)
        axes.set_title("laid over by the measured pose" if measured else "laid over as the map has them", fontsize=8.5)
        picture.legend(loc="outside lower center", ncols=2)
        return style.svg_uri(picture)


def _profiles(new: NDArray[Any], old: NDArray[Any], shift: int) -> str:
    bands, width = new.shape
    spacing = 1.15 * float(max(np.ptp(new, axis=1).max(), np.ptp(old, axis=1).max(), 1e-6))
    column = np.arange(width)
    with style.figure(3.4, 3.0) as picture:
        axes = picture.add_subplot()
        for band in range(bands):
            base = (bands - 1 - band) * spacing
            axes.plot(column + shift, old[band] + base, color=_OLD, linewidth=1.0, linestyle=(0, (4, 1)))
            axes.plot(column, new[band] + base, color=_NEW, linewidth=1.0)
        axes.set_yticks([(bands - 1 - band) * spacing for band in range(bands)], _band_names(bands))
        axes.set_xlabel(f"column; older one shifted by {shift}" if shift else "column")
        axes.set_title("scanline profiles (normalised)", fontsize=8.5)
        return style.svg_uri(picture)


def _band_names(bands: int) -> list[str]:
    """One band: ranges of a laser; else intensity bands and as many depth bands, the upper rows of the image first."""
    if bands == 1:
        return ["range"]
    half = bands // 2
    if half == 1:
        return ["intensity", "depth"]
    return [f"intensity {k + 1}" for k in range(half)] + [f"depth {k + 1}" for k in range(bands - half)]
