"""A planner on the map of a session."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from hybridmap.errors import PlanError
from hybridmap.export.formats import SessionView
from hybridmap.export.keyframes import build_grid
from hybridmap.geometry import Array
from hybridmap.graph.gaps import kidnappings
from hybridmap.plan.free_space import FreeSpace
from hybridmap.plan.links import Cost
from hybridmap.plan.planner import Planner

_FAR_M = 1e9
"""No place is so far away; grids are counted in whole cells."""


def planner_on(view: SessionView, cost: Cost = Cost.LENGTH) -> Planner:
    """A planner on a session's map, with the poses of one back-end. Of a polygon, the largest disc round `base_link` must fit.

    Args:
        view: the session, with footprint and cell size among its options. The map must be one piece.
        cost: what routes are the least of.

    Raises:
        ExportError: the session's keyframes hold no obstacle, so that nothing is known to be free.
    """
    experiences = view.experiences
    space = FreeSpace.of(build_grid(view), view.options.footprint.radius_m)
    stamps_ns = np.array([node.stamp_ns for node in experiences.nodes], dtype=np.int64)
    carried = kidnappings(experiences)
    return Planner.of(experiences.pose_graph(), view.poses, stamps_ns, space, kidnapped=carried, cost=cost)


def place(text: str, poses: Array) -> Array:
    """The place that a text names: `X,Y` or `X,Y,YAW` in `map`, m and degrees, or the number of a node.

    Args:
        text: what was given.
        poses: (N, 3) of the nodes in `map`, m and rad.

    Returns:
        A point (2,), m, or a pose (3,), m and rad.

    Raises:
        PlanError: it names none.
    """
    if text.isdecimal():
        if int(text) >= len(poses):
            raise PlanError(f"node {text} does not exist, expected one of 0..{len(poses) - 1}")
        return np.asarray(poses[int(text)])
    try:
        values = np.array([float(number) for number in text.split(",")])
    except ValueError:
        values = np.zeros(0)
    if len(values) not in (2, 3) or not (np.abs(values) < _FAR_M).all():
        raise PlanError(f"place {text!r}: expected X,Y or X,Y,YAW in m and degrees, or the number of a node")
    if len(values) == 3:
        values[2] = np.deg2rad(values[2])
    return values


def discs(texts: Sequence[str]) -> list[tuple[Array, float]]:
    """Middles (2,) in `map` and radii, m, of discs that are given as `X,Y,R`.

    Raises:
        PlanError: a text is no disc.
    """
    found = []
    for text in texts:
        try:
            x, y, radius_m = (float(number) for number in text.split(","))
        except ValueError:
            x = y = radius_m = np.nan
        if not (0.0 < radius_m < np.inf and np.isfinite((x, y)).all()):
            raise PlanError(f"blocked {text!r}: expected X,Y,R in m, with a radius above 0")
        found.append((np.array([x, y]), radius_m))
    return found
