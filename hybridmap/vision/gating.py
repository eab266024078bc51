"""Where in the map a robot may be: the nodes whose views are worth comparing."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from hybridmap.geometry import Array, wrap_angle

Indices = NDArray[np.int64]

GATE_FIELDS = ("radius_m", "heading_deg", "older", "inside", "whole_map")
"""What a map file keeps of a node's gate: its widths, how many nodes were old enough, how many of those inside, and whether
all of them were compared (1) because the robot was not sure where it was."""


def nodes_within(poses: Array, node: int, radius_m: float | Array, turn_rad: float, before: int | None = None) -> Indices:
    """Nodes before one of them that lie near it and look nearly the same way.

    A band of x is cut out first, so that a large map costs one comparison a node.

    Args:
        poses: (N, 3) of all nodes, m and rad.
        node: the one in question.
        radius_m: largest distance, m; one for all, or (before,) one for each.
        turn_rad: largest difference of the headings, rad.
        before: only nodes of lower numbers count; default: `node`.

    Returns:
        (n,) node numbers, ascending.
    """
    x, y, yaw = poses[node]
    radius = np.asarray(radius_m, dtype=np.float64)
    across = poses[: node if before is None else before, 0] - x
    band = np.flatnonzero(np.abs(across) <= radius)
    near = radius[band] if radius.ndim else radius
    inside = across[band] ** 2 + (poses[band, 1] - y) ** 2 <= near**2
    chosen = band[inside]
    return np.asarray(chosen[np.abs(wrap_angle(poses[chosen, 2] - yaw)) <= turn_rad])
