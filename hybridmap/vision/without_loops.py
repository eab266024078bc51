"""A front-end that closes no loop: what a conventional SLAM without loop closure makes of the same scans or frames."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from hybridmap.geometry import Array, RelativePose
from hybridmap.graph.edges import Edge
from hybridmap.streams.base import Observation
from hybridmap.vision.base import Belief, FrontEnd, View


class WithoutLoops:
    """Registers each node to those just before it, as another front-end does, and nothing else; implements `FrontEnd`.

    It never looks for a loop, takes the robot for lost, or registers anything again at the end of the drive.

    Args:
        inner: the front-end that registers.
    """

    def __init__(self, inner: FrontEnd) -> None:
        self._inner = inner

    def observe(self, frame: Observation, delta_node_robot: Array) -> View:
        """Take in a frame; see `FrontEnd.observe`."""
        return self._inner.observe(frame, delta_node_robot)

    def add_node(self, node: int, view: View) -> None:
        """Make a node of the frame that was observed last; see `FrontEnd.add_node`."""
        self._inner.add_node(node, view)

    def track(self, node: int, odometry: RelativePose | None) -> list[Edge]:
        """Register the new node to those before it; see `FrontEnd.track`."""
        return self._inner.track(node, odometry)

    def close(self, node: int, belief: Belief) -> list[Edge]:
        """No edges: loops are not looked for."""
        del node, belief
        return []

    def finish(self, belief: Belief) -> list[Edge]:
        """No edges: nothing is pending."""
        del belief
        return []

    @property
    def lost_since(self) -> int | None:
        """None: nobody would look for the robot."""

    def keyframe(self, node: int) -> dict[str, NDArray[np.generic]]:
        """Arrays of a node's frame for the map file; see `FrontEnd.keyframe`."""
        return self._inner.keyframe(node)
