"""The map just before and just after its largest correction."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np

from hybridmap.geometry import Array
from hybridmap.graph.gaps import Carry, parted
from hybridmap.report import style
from hybridmap.report.outline import raster
from hybridmap.report.scene import Correction


def correction_figure(correction: Correction, points_of: Mapping[int, Array], carried: Sequence[Carry]) -> str:
    """Two panels on the same axes: nodes and what they saw, before and after; a `data:` URI. The way ends at a carry."""
    both = np.concatenate([correction.before, correction.after])[:, :2]
    low, high = both.min(axis=0) - 1.5, both.max(axis=0) + 1.5
    with style.figure(*style.fitted_size(high - low, panels=2)) as picture:
        left, right = picture.subplots(1, 2)
        _panel(left, "before", correction.before, points_of, carried, style.ODOMETRY)
        _panel(right, "after", correction.after, points_of, carried, style.PRIMARY)
        _draw_shifts(right, correction)
        right.set_ylabel("")
        for axes in (left, right):
            axes.set_xlim(low[0], high[0])
            axes.set_ylim(low[1], high[1])
        return style.svg_uri(picture)


def _panel(axes: Any, title: str, poses: Array, points_of: Mapping[int, Array], carried: Sequence[Carry], color: str) -> None:
    style.draw_building(axes, raster(points_of, poses), darkness=0.6)
    axes.plot(*parted(poses, carried)[:, :2].T, color=color, linewidth=1.0, marker=".", markersize=3, zorder=4)
    axes.plot(*poses[-1, :2], marker="o", markersize=7, color="white", markeredgecolor="black", zorder=6)
    axes.set_title(title)
    style.metric_axes(axes, adjustable="box")


def _draw_shifts(axes: Any, correction: Correction) -> None:
    """How far each node was moved."""
    from matplotlib.collections import LineCollection

    shifts = np.stack([correction.before[:, :2], correction.after[:, :2]], axis=1)
    axes.add_collection(LineCollection(list(shifts), color=style.ODOMETRY, linewidth=0.6, alpha=0.6, zorder=3))
