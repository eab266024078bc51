"""The experience map: nodes and edges in the order in which they were made. It knows no sensor and no solver."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from dataclasses import dataclass, field, replace
from enum import StrEnum

import numpy as np
from numpy.typing import NDArray

from hybridmap.errors import GraphError
from hybridmap.geometry import Array, RelativePose
from hybridmap.graph.pose_graph import EdgeKind, PoseGraph


class Status(StrEnum):
    """What became of an edge; only accepted ones are in the graph."""

    ACCEPTED = "accepted"
    PENDING = "pending"
    REJECTED = "rejected"
    RETRACTED = "retracted"


@dataclass(frozen=True, slots=True)
class Node:
    """An experience e_i = (p_i, V_i, d_i), the paper's section on the cognitive map.

    Attributes:
        stamp_ns: when it was made.
        pose_odom: (3,) pose decoded from the path integrator's activity at that time, in `odom`.
        place_code: (P,) float32 activity that identifies the place.
        template: number of the view template seen there; -1 for none.
        travel_m: path length so far.
    """

    stamp_ns: int
    pose_odom: Array
    place_code: NDArray[np.float32]
    template: int
    travel_m: float


@dataclass(frozen=True, slots=True)
class Edge:
    """A relative pose between two nodes, in the frame of the source, with its fate."""

    source: int
    target: int
    kind: EdgeKind
    status: Status
    reason: str
    relative: RelativePose | None
    scores: Mapping[str, float] = field(default_factory=dict)


class ExperienceMap:
    """Append-only log of nodes and edges; an edge's status may change, nothing is ever deleted."""

    def __init__(self) -> None:
        self._nodes: list[Node] = []
        self._edges: list[Edge] = []
        self._initial: list[Array] = []

    @property
    def nodes(self) -> tuple[Node, ...]:
        """All nodes, by number."""
        return tuple(self._nodes)

    @property
    def edges(self) -> tuple[Edge, ...]:
        """Every edge ever considered, by number."""
        return tuple(self._edges)

    def __len__(self) -> int:
        return len(self._nodes)

    def node(self, number: int) -> Node:
        """One node."""
        return self._nodes[number]

    def edge(self, number: int) -> Edge:
        """One edge."""
        return self._edges[number]

    def add_node(self, node: Node, initial: Array) -> int:
        """Append a node; `initial` (3,) is its pose along the chain of odometry edges. Returns its number."""
        self._nodes.append(node)
        self._initial.append(initial)
        return len(self._nodes) - 1

    def add_edge(self, edge: Edge) -> int:
        """Append an edge and return its number.

        Raises:
            GraphError: an end does not exist, both ends are one node, or an accepted edge carries no measurement.
        """
        if not (0 <= edge.source < len(self) and 0 <= edge.target < len(self)) or edge.source == edge.target:
            raise GraphError(f"map: edge {edge.source} -> {edge.target} needs two different nodes of 0..{len(self) - 1}")
        if edge.status is Status.ACCEPTED and edge.relative is None:
            raise GraphError(f"map: edge {edge.source} -> {edge.target} was accepted without a measurement")
        self._edges.append(edge)
        return len(self._edges) - 1

    def set_status(self, number: int, status: Status, reason: str) -> None:
        """Change what became of an edge, and why."""
        self._edges[number] = replace(self._edges[number], status=status, reason=reason)

    def update_edge(self, number: int, edge: Edge) -> None:
        """Replace an edge by a later measurement or verdict between the same two nodes."""
        before = self._edges[number]
        if (before.source, before.target) != (edge.source, edge.target):
            raise GraphError(
                f"map: edge {number} joins {before.source} -> {before.target}, found {edge.source} -> {edge.target}"
            )
        self._edges[number] = edge

    def accepted(self) -> Iterator[tuple[int, Edge]]:
        """Numbers and edges of the graph, in order of creation."""
        return ((i, e) for i, e in enumerate(self._edges) if e.status is Status.ACCEPTED)

    def pose_graph(self) -> PoseGraph:
        """Freeze the accepted edges into arrays."""
        kept = list(self.accepted())
        relatives = [e.relative for _, e in kept if e.relative is not None]
        n = len(kept)
        return PoseGraph(
            initial=np.array(self._initial, dtype=np.float64).reshape(len(self), 3),
            sources=np.fromiter((e.source for _, e in kept), np.int64, n),
            targets=np.fromiter((e.target for _, e in kept), np.int64, n),
            deltas=np.array([r.delta for r in relatives], dtype=np.float64).reshape(n, 3),
            information=_invert(np.array([r.covariance for r in relatives], dtype=np.float64).reshape(n, 3, 3)),
            kinds=np.fromiter((e.kind for _, e in kept), np.int8, n),
            edge_ids=np.fromiter((i for i, _ in kept), np.int64, n),
        )


def _invert(covariance: Array) -> Array:
    information = np.linalg.inv(covariance)
    return np.asarray(0.5 * (information + information.transpose(0, 2, 1)))
