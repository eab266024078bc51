"""A map of several sessions: finished maps are taken up, and the place of each later one is looked for on those before it.

Each map keeps its nodes and edges as they are. What is new are loops between sessions. They enter once several of them agree,
by the rules for a robot that was kidnapped; until then the maps are pieces, each in a frame of its own.
"""

from __future__ import annotations

import logging
from collections.abc import Callable, Sequence
from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from hybridmap.backends.base import Solution
from hybridmap.backends.pieces import pieces_of, solve_by_piece
from hybridmap.backends.registry import create
from hybridmap.config import Config
from hybridmap.config.backends import BackendsConfig
from hybridmap.edge_book import EdgeBook
from hybridmap.errors import ConfigError
from hybridmap.geometry import Array, RelativePose, between, compose
from hybridmap.graph.edges import Edge, EdgeKind, Lack, Status
from hybridmap.graph.experience_map import ExperienceMap, Node
from hybridmap.graph.paths import covariances_from
from hybridmap.metrics import StageClock
from hybridmap.sessions.part import Arrays, Part
from hybridmap.streams.base import Rig
from hybridmap.trajectory import NS_PER_S
from hybridmap.verdict import Facts, reasons_of
from hybridmap.vision import create_front_end
from hybridmap.vision.base import Belief, MeetingFrontEnd
from hybridmap.vision.relocalising import SUPPORT

log = logging.getLogger(__name__)

Indices = NDArray[np.int64]

APART_S, APART_M = 3600.0, 50.0
"""Time and travel that are put between two sessions where views are compared: none is too recent to be a loop."""
SOLVED_EVERY_M = 10.0
"""Travel after which the pieces are solved together again while loops come in, m; between, motion carries the poses on."""


class JointMap:
    """Several finished maps in one, and the search for the place of one among the others.

    Attributes:
        map: all nodes and edges; those of each part keep their order, and come after those of the parts before it.
        poses: (N, 3) of all nodes, m and rad; those of two pieces cannot be compared.
    """

    def __init__(self, config: Config, rig: Rig) -> None:
        """Start without a map.

        Args:
            config: settings of the front-end and of the back-ends; the first of these solves the pieces.
            rig: the sensors of all parts.

        Raises:
            ConfigError: no front-end, or one that cannot take up a finished map.
        """
        front_end = create_front_end(config.vision, rig, config.seed, StageClock())
        if not isinstance(front_end, MeetingFrontEnd):
            found = "none" if front_end is None else type(front_end).__name__
            raise ConfigError(f"vision: maps can be joined by a laser or an RGB-D camera; found the front-end {found}")
        self._config, self._vision = config.backends, front_end
        self.map = ExperienceMap()
        self.poses: Array = np.zeros((0, 3))
        self._book = EdgeBook(self.map, config.edges)
        self._stamps_s: list[float] = []
        self._travel_m: list[float] = []
        self._shift_s, self._shift_m = 0.0, 0.0  # of the session that is taken up
        self._covariance_from: Callable[[int], Array] | None = None
        self._solved_m = float("-inf")

    def take_up(self, part: Part) -> range:
        """Add a finished map as a piece, or pieces, of its own; returns its node numbers.

        Raises:
            StreamError: its views are not those of this sensor.
        """
        first, own = len(self.map), part.experiences
        begins = {session.start for session in own.sessions}
        broken = {edge.target for edge in own.edges if edge.status is Status.ACCEPTED and edge.kidnapped_m is not None}
        for number, node in enumerate(own.nodes):
            if number in begins:
                self._begin(node)
            self._add_node(node, own.initial[number], part.keyframe(number), part.state(number), number in begins | broken)
        for edge in own.edges:
            self.map.add_edge(moved(edge, first))
        self.poses = np.concatenate([self.poses, part.poses])
        return range(first, len(self.map))

    def _add_node(self, node: Node, initial: Array, keyframe: Arrays, state: Arrays, begins: bool) -> None:
        """Add a node of the session that began last; its pose must be appended to `poses`. See `MeetingFrontEnd.restore`."""
        number = self.map.add_node(node, initial)
        self._vision.restore(number, keyframe, state, begins)
        self._stamps_s.append(node.stamp_ns / NS_PER_S + self._shift_s)
        self._travel_m.append(node.travel_m + self._shift_m)
        self._covariance_from = None

    def meet(self, node: int) -> list[Edge]:
        """Look for loops of a node to the sessions before its own; returns those that were accepted.

        With the first ones comes a loose edge to the first node of the session, a registration.
        """
        return self._enter(self._vision.meet(node, self._belief(node)))

    def join(self, nodes: range, guess: Array | None = None) -> float | None:
        """Look for the place of the map that was taken up last, which has these nodes, on those before it.

        Every node is compared, in order. If it is found, all poses are those of the joint map.

        Args:
            nodes: its nodes.
            guess: (3,) pose of its frame in that of the map before, m and rad, where it is looked for first; None: anywhere.

        Returns:
            Travel from its first node to the one at which its place was known, m; None if it was not found.
        """
        if guess is not None:
            self.poses = self.poses.copy()
            self.poses[nodes.start : nodes.stop] = compose(guess, self.poses[nodes.start : nodes.stop])
        self._vision.arrive(nodes.start, guessed=guess is not None)
        found_m: float | None = None
        for node in nodes:
            accepted = self.meet(node)
            if accepted and found_m is None:
                self._place(nodes, accepted)
                found_m = self._travel_m[node] - self._travel_m[nodes.start]
            if accepted and self._travel_m[node] - self._solved_m > SOLVED_EVERY_M:
                self._solve()
                self._solved_m = self._travel_m[node]
        if found_m is not None:
            self._solve()
        while self._enter(self._vision.meet_again(self._belief(nodes.stop - 1))):
            self._solve()
        return found_m if found_m is not None and self._settled(nodes) else None

    def adopt(self, other: JointMap, number: Indices) -> None:
        """Take over the loops that another joint map found between the same two maps, and where they lie on each other.

        Args:
            other: a joint map of the same nodes, in which the later map here is the earlier one.
            number: (N,) its nodes -> those here.
        """
        first = int(np.flatnonzero(number == 0)[0])  # there: of the map that is the earlier one here
        poses = self.poses.copy()
        poses[number] = compose(self.poses[0], between(other.poses[first], other.poses))
        for edge in other.map.edges:
            if (edge.source < first) == (edge.target < first):
                continue
            ends = int(number[edge.source]), int(number[edge.target])
            if edge.kind is EdgeKind.REGISTRATION and edge.relative is not None:
                seen = next(loop for loop in other.map.edges if _joins(loop, first))
                ends = int(number[seen.source]), int(number[0])
                relative = RelativePose(between(poses[ends[0]], poses[ends[1]]), edge.relative.covariance)
                edge = replace(edge, relative=relative)
            self.map.add_edge(replace(edge, source=ends[0], target=ends[1], since_node=len(self.map) - 1, key=-1))
        self.poses, self._covariance_from = poses, None
        self._solve()

    def solutions(self, names: Sequence[str]) -> dict[str, Solution]:
        """The map by each back-end of these names; pieces that are not joined are solved by themselves."""
        return solutions_of(self.map, self.poses, names, self._config)

    def _refused(self, nodes: range) -> int:
        """How many loops of a map to others agree with each other and were refused all the same: rivals of its place."""
        piece = next(piece for piece in pieces_of(self.map.pose_graph()) if nodes.start in piece)
        session_of = np.repeat(np.arange(len(self.map.sessions)), [len(session) for session in self.map.sessions])
        own, there, _ = self.map.of_sessions(np.unique(session_of[piece]).tolist())
        name = self._config.names[0]
        solution = solutions_of(own, self.poses[there], [name], self._config)[name]
        reasons = reasons_of(Facts.of_drive(own, solution, name))
        return max((reason.count for reason in reasons if reason.kind == "loops refused"), default=0)

    def _begin(self, node: Node) -> None:
        """Begin a session with a node, well after those before it in stamps and travel."""
        self.map.begin_session()
        last_s, last_m = (self._stamps_s[-1], self._travel_m[-1]) if self._stamps_s else (-APART_S, -APART_M)
        self._shift_s, self._shift_m = last_s + APART_S - node.stamp_ns / NS_PER_S, last_m + APART_M - node.travel_m

    def _belief(self, node: int) -> Belief:
        if self._covariance_from is None:
            self._covariance_from = covariances_from(self.map.pose_graph())
        stamps_s, travel_m = np.array(self._stamps_s[: node + 1]), np.array(self._travel_m[: node + 1])
        return Belief(self.poses, stamps_s, travel_m, self._covariance_from)

    def _enter(self, proposals: Sequence[Edge]) -> list[Edge]:
        """Write proposals into the map; returns those that were accepted."""
        self._book.enter(proposals)
        accepted = [edge for edge in proposals if edge.status is Status.ACCEPTED]
        if accepted:
            self._covariance_from = None
        return accepted

    def _place(self, nodes: range, accepted: Sequence[Edge]) -> None:
        """Move the poses of a map to where the loose edge to its first node has it."""
        arrival = next(edge for edge in accepted if edge.kind is EdgeKind.REGISTRATION and edge.target == nodes.start)
        assert arrival.relative is not None
        first = compose(self.poses[arrival.source], arrival.relative.delta)
        own = slice(nodes.start, nodes.stop)
        self.poses = self.poses.copy()
        self.poses[own] = compose(first, between(self.poses[nodes.start], self.poses[own]))

    def _solve(self) -> Solution:
        """Solve the pieces by the primary back-end, from the poses that they have."""
        solution = self.solutions([self._config.names[0]])[self._config.names[0]]
        self.poses = solution.poses
        return solution

    def _settled(self, nodes: range) -> bool:
        """Take back the loops between the sessions that the back-end rejects; all of them, if too few are left.

        So are all, if as many that agree with each other were refused: the map may as well lie there. Returns whether the map
        is joined still.
        """
        between_parts = [
            number
            for number, edge in enumerate(self.map.edges)
            if edge.status is Status.ACCEPTED and (edge.source in nodes) != (edge.target in nodes)
        ]
        rejected = set(self._solve().report.rejected_edge_ids).intersection(between_parts)
        kept = [self.map.edge(number) for number in between_parts if number not in rejected]
        loops = [edge for edge in kept if edge.kind is EdgeKind.LOOP]
        joined = len({edge.source for edge in loops}) >= SUPPORT and self._refused(nodes) < len(loops)
        for number in rejected if joined else between_parts:
            self.map.update_edge(number, replace(self.map.edge(number).settled(lack=Lack.CONTRADICTED), since_node=-1))
        if rejected or not joined:
            self._covariance_from = None
            self._solve()
        return joined


def _joins(edge: Edge, first: int) -> bool:
    """Whether an edge is an accepted loop from a node from `first` on to one before it."""
    return edge.kind is EdgeKind.LOOP and edge.status is Status.ACCEPTED and edge.source >= first > edge.target


def solutions_of(experiences: ExperienceMap, poses: Array, names: Sequence[str], config: BackendsConfig) -> dict[str, Solution]:
    """Solve a map of several sessions by each back-end of these names, from poses (N, 3), m and rad.

    A piece that is not joined to the first one is solved by itself, in the frame in which its first session was driven.
    """
    graph, initial = experiences.pose_graph(), poses.copy()
    for nodes in pieces_of(graph)[1:]:
        initial[nodes] = compose(experiences.initial[nodes[0]], between(poses[nodes[0]], poses[nodes]))
    graph = replace(graph, initial=initial)
    return {name: solve_by_piece(create(name, config).solve, graph) for name in names}


def joined_sessions(experiences: ExperienceMap) -> list[list[int]]:
    """The numbers of the sessions of each piece that is joined in itself; pieces in the order of their first session."""
    of_node = np.repeat(np.arange(len(experiences.sessions)), [len(session) for session in experiences.sessions])
    return [np.unique(of_node[nodes]).tolist() for nodes in pieces_of(experiences.pose_graph())]


def moved(edge: Edge, by: int) -> Edge:
    """An edge of a part with the node numbers of the joint map."""
    return replace(edge, source=edge.source + by, target=edge.target + by, since_node=edge.since_node + by, key=-1)
