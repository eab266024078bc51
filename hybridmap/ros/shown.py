"""When a topic that shows the whole map is published again."""

from __future__ import annotations

import time

import numpy as np

from hybridmap.graph.edges import EdgeKind
from hybridmap.live import Snapshot

PUBLISH_S = 1.0
"""Shortest time between two messages of a topic that shows the whole map, s."""
_SHARE = 0.05
"""Largest share of the time that goes into making them."""


class Shown:
    """When a topic that shows the whole map is due again: after changes, and so that it costs a small share of the time."""

    def __init__(self, every_s: float) -> None:
        self._every_s = every_s
        self._nodes, self._loops = 0, 0
        self._poses: np.ndarray | None = None
        self._next_s = 0.0
        self._began_s = 0.0

    def is_due(self, snapshot: Snapshot) -> bool:
        """Whether the map has changed and it is time; a new loop closure need not wait for the usual time."""
        now_s = time.monotonic()
        if snapshot.poses is self._poses or not len(snapshot.poses) or now_s < self._next_s:
            return False
        closed = int(np.count_nonzero(snapshot.kinds == EdgeKind.LOOP)) > self._loops
        return closed or now_s - self._began_s >= self._every_s

    def of(self, snapshot: Snapshot) -> Shown:
        """Note what is being shown; the context measures what it costs."""
        self._poses = snapshot.poses
        self._loops = int(np.count_nonzero(snapshot.kinds == EdgeKind.LOOP))
        return self

    def __enter__(self) -> None:
        self._began_s = time.monotonic()

    def __exit__(self, *_: object) -> None:
        now_s = time.monotonic()
        self._next_s = now_s + max(PUBLISH_S, (now_s - self._began_s) / _SHARE)
