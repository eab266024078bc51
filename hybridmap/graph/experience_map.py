"""The experience map: nodes and edges in the order in which they were made, and when a node is made."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from itertools import pairwise
from typing import Any

import numpy as np
from numpy.typing import NDArray

from hybridmap.config.mapping import NodesConfig
from hybridmap.errors import GraphError
from hybridmap.geometry import Array, RelativePose, between, compose
from hybridmap.graph.edges import Edge, Status
from hybridmap.graph.pose_graph import PoseGraph


@dataclass(frozen=True, slots=True)
class Node:
    """A node of the map: an experience e_i = (p_i, V_i, d_i) of the paper (place code, view template, pose).

    Attributes:
        stamp_ns: time at which the node was made.
        pose_odom: (3,) pose in `odom` by the path integrator at that time, m and rad.
        place_code: (P,) float32 rates of the place cells at that time.
        template: number of the view template seen there; -1 for none.
        travel_m: path length of the drive up to the node.
    """

    stamp_ns: int
    pose_odom: Array
    place_code: NDArray[np.float32]
    template: int
    travel_m: float


class ExperienceMap:
    """Append-only log of nodes and edges; an edge's status may change, nothing is ever deleted.

    Nodes belong to sessions, one drive each. No edge of motion joins two sessions. `Node.pose_odom` and `Node.travel_m` are
    those of the node's own session.
    """

    def __init__(self) -> None:
        self._nodes: list[Node] = []
        self._edges: list[Edge] = []
        self._stamps_ns = _Rows((), np.int64)
        self._travel_m = _Rows((), np.float64)
        self._initial = _Rows((3,), np.float64)
        self._ends = _Rows((2,), np.int64)
        self._deltas = _Rows((3,), np.float64)
        self._information = _Rows((3, 3), np.float64)
        self._kinds = _Rows((), np.int8)
        self._accepted = _Rows((), np.bool_)
        self._since = _Rows((), np.int64)
        self._edges_into: dict[int, list[int]] = {}
        self._sessions = [0]

    @property
    def sessions(self) -> tuple[range, ...]:
        """The node numbers of each session, in order; one session unless `begin_session` was called."""
        return tuple(range(a, b) for a, b in pairwise([*self._sessions, len(self)]))

    def begin_session(self) -> None:
        """Let the next node be the first of a new session; nothing happens before the first node."""
        if len(self) > self._sessions[-1]:
            self._sessions.append(len(self))

    def of_sessions(self, numbers: Sequence[int]) -> tuple[ExperienceMap, NDArray[np.int64], NDArray[np.int64]]:
        """Some sessions by themselves: their nodes, numbered from 0, and the edges between them.

        Returns:
            The map of these sessions, and the numbers here of its nodes (N,) and edges (E,).
        """
        sessions, out = self.sessions, ExperienceMap()
        nodes = [node for number in numbers for node in sessions[number]]
        there, kept = {node: place for place, node in enumerate(nodes)}, []
        for place, node in enumerate(nodes):
            if any(node == session.start for session in sessions):
                out.begin_session()
            assert out.add_node(self._nodes[node], self._initial.view()[node]) == place
        for number, edge in enumerate(self._edges):
            source, target = there.get(edge.source), there.get(edge.target)
            if source is not None and target is not None:
                since = there.get(edge.since_node, max(source, target))
                out.add_edge(replace(edge, source=source, target=target, since_node=since))
                kept.append(number)
        return out, np.array(nodes, dtype=np.int64), np.array(kept, dtype=np.int64)

    @property
    def nodes(self) -> tuple[Node, ...]:
        """All nodes, by number."""
        return tuple(self._nodes)

    @property
    def edges(self) -> tuple[Edge, ...]:
        """Every edge ever proposed, by number, whatever its status."""
        return tuple(self._edges)

    @property
    def stamps_ns(self) -> NDArray[np.int64]:
        """(N,) time at which each node was made; a copy."""
        return self._stamps_ns.view().copy()

    @property
    def travel_m(self) -> Array:
        """(N,) path length of the drive up to each node, m; a copy."""
        return self._travel_m.view().copy()

    @property
    def initial(self) -> Array:
        """(N, 3) pose of each node along the chain of odometry edges, m and rad; a copy."""
        return self._initial.view().copy()

    def __len__(self) -> int:
        return len(self._nodes)

    def node(self, number: int) -> Node:
        """The node of a number."""
        return self._nodes[number]

    def edge(self, number: int) -> Edge:
        """The edge of a number."""
        return self._edges[number]

    def edges_into(self, node: int) -> tuple[int, ...]:
        """Numbers of the edges whose target is the given node, ascending, whatever their status."""
        return tuple(self._edges_into.get(node, ()))

    def add_node(self, node: Node, initial: Array) -> int:
        """Append a node; `initial` (3,) is its pose along the chain of odometry edges, m and rad. Returns its number."""
        self._nodes.append(node)
        self._stamps_ns.append(node.stamp_ns)
        self._travel_m.append(node.travel_m)
        self._initial.append(initial)
        return len(self._nodes) - 1

    def add_edge(self, edge: Edge) -> int:
        """Append an edge of any status and return its number.

        Raises:
            GraphError: a node does not exist, both nodes are the same, or an accepted edge carries no measurement.
        """
        if not (0 <= edge.source < len(self) and 0 <= edge.target < len(self)) or edge.source == edge.target:
            raise GraphError(f"map: edge {edge.source} -> {edge.target} needs two different nodes of 0..{len(self) - 1}")
        _require_measurement(edge)
        self._edges.append(self._dated(edge))
        for rows in (self._ends, self._deltas, self._information, self._kinds, self._accepted, self._since):
            rows.grow()
        self._write(len(self._edges) - 1)
        self._edges_into.setdefault(edge.target, []).append(len(self._edges) - 1)
        return len(self._edges) - 1

    def update_edge(self, number: int, edge: Edge) -> None:
        """Replace an edge by a later measurement or decision; an accepted edge that is replaced by a rejected one is retracted.

        A retracted edge keeps its measurement if the rejected one has none: it is what the edge claimed while in the graph.

        Raises:
            GraphError: the new edge has another source or target, or is accepted without a measurement.
        """
        before = self._edges[number]
        if (before.source, before.target) != (edge.source, edge.target):
            raise GraphError(
                f"map: edge {number} joins {before.source} -> {before.target}, found {edge.source} -> {edge.target}"
            )
        if edge.status is Status.REJECTED and before.status in (Status.ACCEPTED, Status.RETRACTED):
            relative = before.relative if edge.relative is None else edge.relative
            edge = replace(edge, status=Status.RETRACTED, relative=relative)
        _require_measurement(edge)
        self._edges[number] = self._dated(edge)
        self._write(number)

    def move_odometry(self, poses_odom: Array) -> None:
        """Replace the poses (N, 3) in `odom` of all nodes, m and rad, and `initial` but its first pose; no edge changes."""
        self._nodes = [replace(node, pose_odom=pose) for node, pose in zip(self._nodes, poses_odom, strict=True)]
        initial = self._initial.view()
        initial[:] = compose(initial[0], between(poses_odom[0], poses_odom))

    def pose_graph(self, also: Sequence[int] = ()) -> PoseGraph:
        """The pose graph of all nodes and the accepted edges, and those of the numbers `also`, whatever their status.

        Raises:
            GraphError: an edge of `also` was never measured.
        """
        chosen = self._accepted.view().copy()
        chosen[list(also)] = True
        kept = np.flatnonzero(chosen)
        ends, information = self._ends.view()[kept], self._information.view()[kept]
        for number in also:
            information[np.searchsorted(kept, number)] = _invert(_measured(self._edges[number]).covariance)
        return PoseGraph(
            initial=self.initial,
            sources=ends[:, 0],
            targets=ends[:, 1],
            deltas=self._deltas.view()[kept],
            information=information,
            kinds=self._kinds.view()[kept],
            edge_ids=kept,
            entered=self._since.view()[kept],
        )

    def _dated(self, edge: Edge) -> Edge:
        return edge if edge.since_node >= 0 else replace(edge, since_node=len(self) - 1)

    def _write(self, number: int) -> None:
        edge = self._edges[number]
        accepted = edge.status is Status.ACCEPTED
        self._ends.view()[number] = edge.source, edge.target
        self._kinds.view()[number] = edge.kind
        self._accepted.view()[number] = accepted
        self._since.view()[number] = edge.since_node
        if edge.relative is not None:
            self._deltas.view()[number] = edge.relative.delta
            self._information.view()[number] = _invert(edge.relative.covariance) if accepted else 0.0


class _Rows:
    """Rows of an array that grows at its end without a copy at each row."""

    def __init__(self, shape: tuple[int, ...], dtype: type[np.generic]) -> None:
        self._data: NDArray[Any] = np.zeros((64, *shape), dtype=dtype)
        self._count = 0

    def view(self) -> NDArray[Any]:
        return self._data[: self._count]

    def grow(self) -> None:
        if self._count == len(self._data):
            self._data = np.concatenate([self._data, np.zeros_like(self._data)])
        self._count += 1

    def append(self, row: NDArray[Any] | float) -> None:
        self.grow()
        self._data[self._count - 1] = row


def _require_measurement(edge: Edge) -> None:
    if edge.status is Status.ACCEPTED and edge.relative is None:
        raise GraphError(f"map: edge {edge.source} -> {edge.target} was accepted without a measurement (a relative pose)")


def _measured(edge: Edge) -> RelativePose:
    if edge.relative is None:
        raise GraphError(f"map: edge {edge.source} -> {edge.target} was never measured (no relative pose)")
    return edge.relative


def _invert(covariance: Array) -> Array:
    information = np.linalg.inv(covariance)
    return np.asarray(0.5 * (information + information.T))


class Novelty:
    """Decides when a new node is made. It changes only by `remember`, to be called for every node, and by `recalibrate`."""

    def __init__(self, config: NodesConfig) -> None:
        self._config = config
        self._codes: NDArray[Any] = np.zeros((0, 0), dtype=np.float32)
        self._newest: NDArray[np.float32] = np.zeros(0, dtype=np.float32)
        self._count = 0

    def reason(self, delta_node_robot: Array, place_code: Callable[[], NDArray[np.float32]], new_template: bool) -> str | None:
        """Why a new node must be made now, in words; None if none is needed.

        Args:
            delta_node_robot: (3,) pose of the robot in the frame of the node that it is at, m and rad; for the rules
                `travel` and `every-visit`, and the turn since that node for `passage`.
            place_code: returns the present rates (P,) of the place cells; not called under the rules `travel` and `views`.
            new_template: `View.new_template` of the current frame; without effect under the rule `travel`.
        """
        if self._count == 0:
            return "first experience"
        if self._config.rule in ("travel", "every-visit"):
            return self._travelled(delta_node_robot)
        if new_template:
            return "new view template"
        if self._config.rule == "views":
            return None
        if self._config.rule == "passage":
            return self._passed(delta_node_robot, place_code())
        distance = self.distance(place_code())
        return f"place code differs by {distance:.2f} from every node's" if distance > self._config.place_threshold else None

    def distance(self, place_code: NDArray[np.float32]) -> float:
        """Distance (1 - cosine) of a place code (P,) to the nearest one of all nodes; 1 without nodes. S_th is its limit."""
        if self._count == 0:
            return 1.0
        norm = float(np.linalg.norm(place_code))
        similarity = self._codes[: self._count] @ (place_code / norm if norm > 0 else place_code)
        return float(1.0 - similarity.max())

    def remember(self, place_code: NDArray[np.float32]) -> None:
        """Add the place code (P,) of a new node to those that later ones are compared with."""
        if self._count == len(self._codes):
            grown = np.zeros((max(64, 2 * self._count), len(place_code)), dtype=np.float32)
            if self._count:
                grown[: self._count] = self._codes
            self._codes = grown
        norm = float(np.linalg.norm(place_code))
        self._codes[self._count] = self._newest = place_code / norm if norm > 0 else place_code
        self._count += 1

    def recalibrate(self, place_code: NDArray[np.float32]) -> None:
        """Take the place code (P,) that the cells show at the newest node since they were re-anchored there.

        The rule `passage` compares with it, so that the jump of the cells is not taken for motion.
        """
        norm = float(np.linalg.norm(place_code))
        self._newest = place_code / norm if norm > 0 else place_code

    def _passed(self, delta: Array, place_code: NDArray[np.float32]) -> str | None:
        """Cells of place and of head direction together: their populations' cosines multiply."""
        norm = float(np.linalg.norm(place_code))
        distance = 1.0 - float(self._newest @ place_code) / max(norm, 1e-12) * float(np.cos(delta[2]))
        return f"place code differs by {distance:.2f}" if distance >= self._config.place_threshold else None

    def _travelled(self, delta: Array) -> str | None:
        distance, angle = float(np.hypot(delta[0], delta[1])), float(np.rad2deg(abs(delta[2])))
        if distance >= self._config.distance_m:
            return f"{distance:.2f} m since the last node"
        if angle >= self._config.angle_deg:
            return f"{angle:.0f} deg since the last node"
        return None
