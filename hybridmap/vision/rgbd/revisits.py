"""Which earlier nodes are worth another look while driving, because a closure has moved them."""

from __future__ import annotations

import numpy as np

from hybridmap.geometry import Array, wrap_angle
from hybridmap.vision.base import Belief

MAP_SIGMA_M, MAP_SIGMA_DEG = 0.15, 3.0
"""How far an optimised map may be off between nodes that lie side by side (one standard deviation), m and degrees."""


class Revisits:
    """The nodes between one closure and the next: where that moved them, what was out of reach may lie near them now."""

    def __init__(self) -> None:
        self._waiting: list[tuple[int, Array]] = []

    def closed(self, node: int, since_m: float, belief: Belief) -> None:
        """A node closed a loop after `since_m` of travel without one; `belief` is that of the map before the closure."""
        behind = np.flatnonzero(belief.travel_m[:node] > since_m)
        self._waiting += [(int(n), belief.poses_map_node[n].copy()) for n in behind]

    def next_moved(self, belief: Belief) -> int | None:
        """Take the newest of the nodes that lie elsewhere now; None if there is none left."""
        while self._waiting:
            node, before = self._waiting.pop()
            now = belief.poses_map_node[node]
            moved_m, turned = float(np.hypot(*(now - before)[:2])), float(abs(wrap_angle(now[2] - before[2])))
            if moved_m > MAP_SIGMA_M or turned > np.deg2rad(MAP_SIGMA_DEG):
                return node
        return None
