"""The interface of front-ends: they propose edges to the mapper, each with the record of its checks.

A front-end keeps its own templates, keyframes and submaps, by node number. It gets the state of the map as a `Belief`.
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
    """The state of the map, for gating and re-proposal.

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
        """Nodes (P,) seen from nodes (P,), as `agreement.Ways`. Costs a search of the graph for each node in `first`."""
        covariance = np.empty((len(first), 3, 3))
        for node in np.unique(first).tolist():
            covariance[first == node] = self.covariance_from(node)[second[first == node]]
        return RelativePose(between(self.poses_map_node[first], self.poses_map_node[second]), covariance)


@dataclass(frozen=True, slots=True)
class View:
    """The profile and view template of one frame.

    Attributes:
        stamp_ns: of the frame.
        profile: (bands, width) float32, normalised as configured.
        template: number of the view template it matched or founded.
        new_template: the frame founded the template: its view is new, and stable over several frames.
    """

    stamp_ns: int
    profile: NDArray[np.float32]
    template: int
    new_template: bool


class FrontEnd(Protocol):
    """Loop closure and registration for one kind of sensor. The mapper calls in this order:

    `observe` for each frame; if it makes a node of the frame, `add_node`, `track` and `close`; at the end `finish`, again
    while it returns accepted edges.
    """

    def observe(self, frame: Observation, delta_node_robot: Array) -> View:
        """Take in one frame; `delta_node_robot` (3,) is the integrator's motion since the last node (identity at first)."""

    def add_node(self, node: int, view: View) -> None:
        """Make a node of the frame observed last. Nodes are numbered from 0 without gaps."""

    def track(self, node: int, odometry: RelativePose | None) -> list[Edge]:
        """Register the new node to the ones before it; `odometry` is its pose seen from node - 1 (None for the first node)."""

    def close(self, node: int, belief: Belief) -> list[Edge]:
        """Look for loop closures of the new node; may also decide pending proposals."""

    def finish(self, belief: Belief) -> list[Edge]:
        """Re-propose on the optimised map; decide what is pending."""

    @property
    def lost_since(self) -> int | None:
        """First node since a kidnapping or a break of the chain, while the robot is not localised; None otherwise."""

    def keyframe(self, node: int) -> dict[str, NDArray[np.generic]]:
        """What the map file keeps of a node's frame: `profile`, and `ranges_m`, or `color` and `depth_mm` (compact dtypes)."""


@runtime_checkable
class VerifyingFrontEnd(FrontEnd, Protocol):
    """A front-end that can measure loops again that a back-end gave no weight."""

    def verify(self, outliers: Sequence[Edge], belief: Belief) -> list[Edge]:
        """Measure loops again from the map's poses. Each keeps its key; a loop that is not returned stays as it is."""


@runtime_checkable
class DenseFrontEnd(FrontEnd, Protocol):
    """A front-end that can register the frames between nodes to the final map."""

    def dense_trajectory(self, belief: Belief) -> Anchors:
        """Anchors of the dense trajectory: every frame registered to the final map. Called once, after the last `finish`."""
