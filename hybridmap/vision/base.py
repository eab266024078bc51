"""What the visual side gives to the mapper, said once: proposals of edges, each measured or refused with a reason.

A front-end keeps its own templates, keyframes and submaps, addressed by node number. It never sees the graph or a
solver: what they know reaches it as a `Belief`.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Protocol, runtime_checkable

import numpy as np
from numpy.typing import NDArray

from hybridmap.geometry import Array, RelativePose, between
from hybridmap.graph.agreement import Indices
from hybridmap.graph.edges import Edge
from hybridmap.streams.base import Observation
from hybridmap.trajectory import Anchors


@dataclass(frozen=True, slots=True)
class Belief:
    """What the map believes, for gating and re-proposal.

    Attributes:
        poses_map_node: (N, 3) current estimate of every node by the primary back-end (or the integrator's own poses where
            the configuration says `gate: odometry`), m and rad.
        stamps_s: (N,) creation time of each node.
        travel_m: (N,) path length at each node.
        covariance_from: node -> (N, 3, 3) covariance of every node's pose relative to that node, propagated along the
            shortest graph path (accepted edges only).
    """

    poses_map_node: Array
    stamps_s: Array
    travel_m: Array
    covariance_from: Callable[[int], Array]

    def ways(self, first: Indices, second: Indices) -> RelativePose:
        """The way between nodes (P,) and nodes (P,), as `agreement.Ways`. Searches the graph once for each node in `first`."""
        covariance = np.empty((len(first), 3, 3))
        for node in np.unique(first).tolist():
            covariance[first == node] = self.covariance_from(node)[second[first == node]]
        return RelativePose(between(self.poses_map_node[first], self.poses_map_node[second]), covariance)


@dataclass(frozen=True, slots=True)
class View:
    """What one frame looks like.

    Attributes:
        stamp_ns: of the frame.
        profile: (bands, width) float32 scanline profile(s), normalised as the configuration says.
        template: number of the view template it matched or founded.
        new_template: the frame founded a template (a new view, stable over several frames).
    """

    stamp_ns: int
    profile: NDArray[np.float32]
    template: int
    new_template: bool


class FrontEnd(Protocol):
    """Scanline loop closure and refined self-motion for one kind of sensor. Calls come in this order:

    `observe` for each frame; when the mapper makes a node of that frame, `add_node`, then `track`, then `close`;
    once, at the end, `finish` (and again while it returns something new, as often as the configuration allows).
    """

    def observe(self, frame: Observation, delta_node_robot: Array) -> View:
        """Take in one frame; `delta_node_robot` (3,) is the integrator's motion since the last node (identity at first)."""

    def add_node(self, node: int, view: View) -> None:
        """Make a node of the frame observed last. Nodes are numbered from 0 without gaps."""

    def track(self, node: int, odometry: RelativePose | None) -> list[Edge]:
        """Register the new node to the ones before it; `odometry` is its pose seen from node - 1 (None for the first node)."""

    def close(self, node: int, belief: Belief) -> list[Edge]:
        """Look for loop closures of the new node; may also settle proposals that were pending."""

    def finish(self, belief: Belief) -> list[Edge]:
        """Re-propose on the optimised map; settle what is pending."""

    @property
    def lost_since(self) -> int | None:
        """First node from which on the robot may be elsewhere than the map has it, as its chain broke there; None: none."""

    def keyframe(self, node: int) -> dict[str, NDArray[np.generic]]:
        """What the map file keeps of a node's frame: `profile`, and `ranges_m`, or `color` and `depth_mm` (compact dtypes)."""


@runtime_checkable
class VerifyingFrontEnd(FrontEnd, Protocol):
    """A front-end that can measure loops again."""

    def verify(self, doubted: Sequence[Edge], belief: Belief) -> list[Edge]:
        """Measure loops again from where their nodes lie on the map; each keeps its key. What is left out stays as it is."""


@runtime_checkable
class RetracingFrontEnd(FrontEnd, Protocol):
    """A front-end that can also say, once the map is final, where the robot was between nodes."""

    def retrace(self, belief: Belief) -> Anchors:
        """Measure every frame on the final map; called once, after the last `finish`."""
