"""When an experience is made: the paper's novelty rule, and the plain rule by travel."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numpy as np
from numpy.typing import NDArray

from hybridmap.config.mapping import NodesConfig
from hybridmap.geometry import Array


class Novelty:
    """Says whether here and now is a new experience, and why."""

    def __init__(self, config: NodesConfig) -> None:
        self._config = config
        self._codes: NDArray[Any] = np.zeros((0, 0), dtype=np.float32)
        self._count = 0

    def reason(self, delta_node_robot: Array, place_code: Callable[[], NDArray[np.float32]], new_template: bool) -> str | None:
        """Why a node is due, or None.

        Args:
            delta_node_robot: (3,) motion since the node that the robot is at.
            place_code: gives the current activity (P,); asked only where the rule needs it.
            new_template: the current frame founded a view template.
        """
        if self._count == 0:
            return "first experience"
        if self._config.rule == "travel":
            return self._travelled(delta_node_robot)
        if new_template:
            return "new view template"
        distance = self.distance(place_code())
        return f"place code differs by {distance:.2f} from every node's" if distance > self._config.place_threshold else None

    def distance(self, place_code: NDArray[np.float32]) -> float:
        """Least distance, 1 - cosine, of a place code to that of every node (the paper's S_th is compared with it)."""
        if self._count == 0:
            return 1.0
        norm = float(np.linalg.norm(place_code))
        similarity = self._codes[: self._count] @ (place_code / norm if norm > 0 else place_code)
        return float(1.0 - similarity.max())

    def remember(self, place_code: NDArray[np.float32]) -> None:
        """Take in the place code of a new node."""
        if self._count == len(self._codes):
            grown = np.zeros((max(64, 2 * self._count), len(place_code)), dtype=np.float32)
            if self._count:
                grown[: self._count] = self._codes
            self._codes = grown
        norm = float(np.linalg.norm(place_code))
        self._codes[self._count] = place_code / norm if norm > 0 else place_code
        self._count += 1

    def _travelled(self, delta: Array) -> str | None:
        distance, angle = float(np.hypot(delta[0], delta[1])), float(np.rad2deg(abs(delta[2])))
        if distance >= self._config.distance_m:
            return f"{distance:.2f} m since the last node"
        if angle >= self._config.angle_deg:
            return f"{angle:.0f} deg since the last node"
        return None
