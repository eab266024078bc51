"""How far cells are from what blocks them, and the costs that planners take instead of occupied and free."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

LETHAL, INSCRIBED, UNKNOWN_COST = 100, 99, 255
"""Costs of an occupied cell, of one in which the middle of the robot cannot be, and of an unknown one."""
_HIGHEST = 98.0
_DECAY_PER_M = 3.0
"""How fast costs fall with the distance, as `cost_scaling_factor` of nav2's inflation layer does by default."""


def clearance_m(blocked: NDArray[np.bool_], resolution_m: float) -> NDArray[np.float32]:
    """Distance (H, W) from the middle of each cell to the nearest blocked cell, m; half a side for the cell next to it.

    It is infinite where nothing is blocked.
    """
    import cv2

    if not blocked.any():
        return np.full(blocked.shape, np.inf, np.float32)
    cells = cv2.distanceTransform((~blocked).astype(np.uint8), cv2.DIST_L2, cv2.DIST_MASK_PRECISE)
    return np.asarray(np.maximum(cells - np.float32(0.5), 0.0) * np.float32(resolution_m), dtype=np.float32)


def fits(clearance: NDArray[np.float32], resolution_m: float, radius_m: float) -> NDArray[np.bool_]:
    """(H, W) cells in which the middle of a robot of this radius can be, to half a cell: where it drove, it fits."""
    return clearance + 0.5 * resolution_m >= radius_m


def costs(
    occupied: NDArray[np.bool_], free: NDArray[np.bool_], resolution_m: float, radius_m: float, inflation_m: float
) -> NDArray[np.uint8]:
    """Costs (H, W) of cells, 0 to 100, or 255 for unknown: what `map_server` publishes of a map in mode `raw`.

    An occupied cell costs 100, and a free one in which the robot does not fit 99. Beyond, the cost falls by exp(-3 d) with the
    distance d from there in m, as in nav2's inflation layer, and is 0 from `inflation_m` off the obstacle.

    Args:
        occupied, free: (H, W) cells; the others are unknown, and are no obstacles here.
        resolution_m: side of a cell.
        radius_m: radius of the robot.
        inflation_m: how far from an obstacle free cells have costs.
    """
    clearance = clearance_m(occupied, resolution_m)
    falling = np.rint(_HIGHEST * np.exp(-_DECAY_PER_M * np.maximum(clearance - radius_m, 0.0)))
    found = np.where(clearance <= inflation_m, falling, 0.0).astype(np.uint8)
    found[~fits(clearance, resolution_m, radius_m)] = INSCRIBED
    found[occupied] = LETHAL
    found[~occupied & ~free] = UNKNOWN_COST
    return found
