"""Pictures of graphs: each back-end's map beside the others, and what its edges cost."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np

from hybridmap.backends.objective import squared_norms
from hybridmap.geometry import Array
from hybridmap.graph.pose_graph import PoseGraph

_CHAIN, _LOOP, _REJECTED = "#0072b2", "#009e73", "#d55e00"
_COLUMNS = 3


def map_panels(graph: PoseGraph, maps: Mapping[str, Array], rejected: Mapping[str, tuple[int, ...]]) -> Any:
    """A matplotlib figure with one panel a map: chain, loops and rejected loops, all panels on one scale.

    Args:
        graph: the edges.
        maps: title -> poses (N, 3), m and rad.
        rejected: title -> numbers (`edge_ids`) of rejected loops.
    """
    from matplotlib.figure import Figure

    columns = max(1, min(_COLUMNS, len(maps)))
    lines = -(-len(maps) // columns)
    figure = Figure(figsize=(4.2 * columns, 3.9 * lines), layout="constrained")
    panels = figure.subplots(lines, columns, squeeze=False).ravel()
    for panel, (title, poses) in zip(panels, maps.items(), strict=False):
        lost = np.isin(graph.edge_ids, np.array(rejected.get(title, ()), dtype=np.int64))
        loops = graph.is_loop
        _draw_edges(panel, graph, poses, loops & ~lost, _LOOP, 0.5)
        _draw_edges(panel, graph, poses, ~loops, _CHAIN, 0.9)
        _draw_edges(panel, graph, poses, lost, _REJECTED, 0.8)
        panel.set_title(title, loc="left", fontsize=10, fontweight="bold")
        panel.set_aspect("equal", adjustable="datalim")
        panel.tick_params(labelsize=8)
        panel.grid(visible=True, linewidth=0.4, color="#e4e4e4")
        panel.set_axisbelow(True)
    for panel in panels[len(maps) :]:
        panel.set_axis_off()
    figure.supxlabel("x (m)", fontsize=9)
    figure.supylabel("y (m)", fontsize=9)
    return figure


def residual_curves(graph: PoseGraph, maps: Mapping[str, Array]) -> Any:
    """A matplotlib figure: share of edges (%) whose squared Mahalanobis residual is below a value, a line a map."""
    from matplotlib.figure import Figure

    figure = Figure(figsize=(8.0, 3.6), layout="constrained")
    axes = figure.subplots()
    share = 100.0 * (np.arange(graph.n_edges) + 1) / max(graph.n_edges, 1)
    for title, poses in maps.items():
        axes.plot(np.maximum(np.sort(squared_norms(graph, poses)), 1e-6), share, label=title, linewidth=1.3)
    axes.set_xscale("log")
    axes.set_xlabel("squared Mahalanobis residual of an edge (1)")
    axes.set_ylabel("share of edges below (%)")
    axes.grid(visible=True, linewidth=0.4, color="#e4e4e4")
    axes.legend(fontsize=8, frameon=False)
    return figure


def save_png(figure: Any, path: Path) -> None:
    """Write a figure; the same figure gives the same bytes."""
    path.parent.mkdir(parents=True, exist_ok=True)
    figure.savefig(path, dpi=130, metadata={"Software": None})


def _draw_edges(axes: Any, graph: PoseGraph, poses: Array, which: Any, color: str, width: float) -> None:
    from matplotlib.collections import LineCollection

    segments = np.stack([poses[graph.sources[which], :2], poses[graph.targets[which], :2]], axis=1)
    axes.add_collection(LineCollection(list(segments), colors=color, linewidths=width))
    axes.autoscale_view()
