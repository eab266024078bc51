"""The mapper's bookkeeping: where the robot is, and which edge of the map each proposed edge became."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np

from hybridmap.config.mapping import EdgesConfig
from hybridmap.geometry import IDENTITY, Array, RelativePose, between, compose, compose_relative
from hybridmap.graph.edges import Edge, EdgeKind, Lack, Method, Search, Status
from hybridmap.graph.experience_map import ExperienceMap
from hybridmap.graph.paths import covariances_from, odometry_covariance
from hybridmap.graph.pose_graph import PoseGraph
from hybridmap.streams.synchronise import Ready
from hybridmap.trajectory import NS_PER_S
from hybridmap.vision.base import Belief, FrontEnd, Overruling
from hybridmap.wheel_noise import WheelNoise


@dataclass(frozen=True, slots=True)
class Update:
    """What the mapper did at one instant, and why.

    Attributes:
        stamp_ns: time of the sample.
        pose_odom_robot: (3,) by the path integrator; `odom` begins at the start of the drive.
        pose_map_robot: (3,) on the map of the primary back-end.
        poses_map_robot: (3,) on the map of each back-end, by its name.
        at_node, delta_node_robot: the node from which the robot is seen (-1 before the first), and its pose (3,) from there.
        new_node: number of the node made now; None if none was made.
        edges: numbers of new and changed edges.
        reason: why a node was made, or why not.
    """

    stamp_ns: int
    pose_odom_robot: Array
    pose_map_robot: Array
    poses_map_robot: Mapping[str, Array]
    at_node: int
    delta_node_robot: Array
    reason: str
    new_node: int | None = None
    edges: tuple[int, ...] = ()


class Position:
    """Pose of the robot in `odom`, seen from a node, and on the map of every back-end.

    Attributes:
        stamp_ns: time of the last motion.
        pose_odom: (3,) in `odom` by the path integrator.
        pose_odom_given: (3,) in the odometry as received.
        travel_m: path length so far.
        driven: path length, m, and angle turned, rad, since the last node was made.
        at_node: the node from which the robot is seen, -1 before the first.
        pose_odom_at_node: (3,) of that node in `odom`.
        pose_map_at_node: (3,) of that node by every back-end, by name.
    """

    def __init__(self, config: EdgesConfig, primary: str) -> None:
        """Start before the first node; `primary` is the name of the back-end that `pose_map` uses."""
        self._config = config
        self._primary = primary
        self.driven = (0.0, 0.0)
        self.stamp_ns = 0
        self.pose_odom: Array = IDENTITY
        self.pose_odom_given: Array = IDENTITY
        self.travel_m = 0.0
        self.at_node = -1
        self.pose_odom_at_node: Array = IDENTITY
        self.pose_map_at_node: Mapping[str, Array] = {}

    @property
    def moved(self) -> Array:
        """(3,) pose of the robot in the frame of the node `at_node`."""
        return between(self.pose_odom_at_node, self.pose_odom)

    def drive(self, ready: Ready, pose_odom: Array) -> None:
        """Add a motion; `pose_odom` (3,) is the path integrator's pose after it."""
        self.stamp_ns, self.pose_odom_given, self.pose_odom = ready.stamp_ns, ready.pose_odom_robot, pose_odom
        travel_m, turn_rad = float(np.hypot(ready.delta_robot[0], ready.delta_robot[1])), abs(float(ready.delta_robot[2]))
        self.travel_m += travel_m
        self.driven = (self.driven[0] + travel_m, self.driven[1] + turn_rad)

    def odometry(self, pose_odom_before: Array) -> RelativePose:
        """The motion from a pose (3,) in `odom` to here, with the configured noise of the way since the last node."""
        return RelativePose(between(pose_odom_before, self.pose_odom), odometry_covariance(self._config, *self.driven))

    def restart(self) -> None:
        """Set the path length since the last node to zero: a node was made here."""
        self.driven = (0.0, 0.0)

    def attach(self, node: int, pose_odom_node: Array) -> None:
        """From now on, see the robot from a node that lies at a pose (3,) in `odom`."""
        self.at_node, self.pose_odom_at_node = node, pose_odom_node

    def retime(self, pose_odom_at_node: Array, pose_odom: Array) -> None:
        """Replace the poses (3,) of the node that the robot is at, and of the robot, in `odom`: odometry was measured again."""
        self.pose_odom_at_node, self.pose_odom = pose_odom_at_node, pose_odom

    def correct(self, poses_of: Mapping[str, Array]) -> None:
        """Take in new poses (N, 3) of all nodes by each back-end, by name."""
        self.pose_map_at_node = {name: poses[self.at_node] for name, poses in poses_of.items()}

    def pose_map(self, pose_odom: Array) -> Array:
        """Transform a pose (3,) in `odom` to the map of the primary back-end."""
        at_node = self.pose_map_at_node.get(self._primary)
        return pose_odom if at_node is None else compose(at_node, between(self.pose_odom_at_node, pose_odom))

    def update(self, reason: str, node: int | None = None, edges: Sequence[int] = ()) -> Update:
        """Make the `Update` of this instant."""
        moved, pose_map = self.moved, self.pose_map(self.pose_odom)
        on_map = {name: compose(pose, moved) for name, pose in self.pose_map_at_node.items()}
        return Update(self.stamp_ns, self.pose_odom, pose_map, on_map, self.at_node, moved, reason, node, tuple(edges))


class EdgeBook:
    """Writes edges that the front-end proposes into the map, and gives the front-end the state of the map.

    Attributes:
        tried_again: numbers of the loops that were measured again because a back-end down-weighted them as outliers.
        wheels: the noise of the wheels, learnt from the edges.
    """

    def __init__(self, experiences: ExperienceMap, config: EdgesConfig) -> None:
        self._map = experiences
        self._config = config
        self._edge_of_proposal: dict[int, int] = {}
        self._driven: dict[int, tuple[float, float]] = {}  # of each odometry edge
        self._measured: dict[int, Edge] = {}  # registrations as they were proposed
        self._contradicted: set[int] = set()  # odometry edges
        self.tried_again: tuple[int, ...] = ()
        self.wheels = WheelNoise(config)

    def enter(self, proposals: Sequence[Edge]) -> list[int]:
        """Write proposed edges into the map; a proposal with the key of an earlier one replaces that one's edge.

        Returns the numbers of the new and changed edges.
        """
        changed = []
        for proposal in proposals:
            if proposal.key in self._edge_of_proposal:
                number = self._edge_of_proposal[proposal.key]
                self._measured.pop(number, None)
                self._map.update_edge(number, proposal)
            else:
                number = self._edge_of_proposal[proposal.key] = self._map.add_edge(proposal)
            changed.append(number)
            if proposal.kind is EdgeKind.REGISTRATION and proposal.relative is not None and proposal.kidnapped_m is None:
                self._note_registration(number, proposal)
            if proposal.contradicts_odometry and self._config.drop_contradicted:
                changed += self._contradict(proposal)
        return changed

    def join(self, source: int, target: int, delta: Array, driven: tuple[float, float]) -> list[int]:
        """Add the odometry edge from the node that the robot was at to a new node, with the noise that was learnt.

        Args:
            source, target: the two nodes.
            delta: (3,) the motion between them, m and rad.
            driven: path length of the motion, m, and angle turned, rad.

        Returns:
            The number of the new edge, then those of edges that changed because the noise of the wheels was learnt anew.
        """
        odometry = RelativePose(delta, self.wheels.covariance(*driven))
        edge = Edge.decided(source, target, EdgeKind.ODOMETRY, odometry, method=Method.ODOMETRY, search=Search.CHAIN)
        number = self._map.add_edge(edge)
        self._driven[number] = driven
        changes = self.wheels.drive(*driven, delta)
        return [number, *(self._weigh_again() if changes else [])]

    def belief(self, poses_of: Callable[[PoseGraph], Array], outliers: Sequence[int] = ()) -> Belief:
        """Poses of the nodes and their covariances, with which the front-end looks for loops.

        Args:
            poses_of: solves a graph with the primary back-end; returns the poses (N, 3) of its nodes.
            outliers: numbers of edges that are left out of the graph.
        """
        own, nodes = self._config.gate == "odometry", self._map.nodes
        graph = self._map.pose_graph().only(EdgeKind.ODOMETRY) if own else self._map.pose_graph()
        graph = graph.with_edges(~np.isin(graph.edge_ids, outliers)) if len(outliers) else graph
        return Belief(
            poses_map_node=graph.initial if own else poses_of(graph),
            stamps_s=np.array([node.stamp_ns for node in nodes]) / NS_PER_S,
            travel_m=np.array([node.travel_m for node in nodes]),
            covariance_from=covariances_from(graph),
        )

    def proposed(self, numbers: Sequence[int]) -> list[Edge]:
        """Of the edges with these numbers, those that the front-end proposed."""
        proposed = set(self._edge_of_proposal.values())
        return [self._map.edge(number) for number in numbers if number in proposed]

    def enter_again(self, proposals: Sequence[Edge]) -> list[int]:
        """Write loops that were measured again into the map, as `enter`, and add their numbers to `tried_again`."""
        changed = self.enter(proposals)
        self.tried_again = tuple(sorted({*self.tried_again, *changed}))
        return changed

    def retime(self, poses_odom: Array, vision: FrontEnd | Overruling | None) -> list[int]:
        """Measure the odometry of the whole chain again; where no registration contradicts it any more, it counts again.

        Args:
            poses_odom: (N, 3) new poses of all nodes in `odom`.
            vision: judges whether the registrations still contradict the odometry.

        Returns:
            The numbers of the changed edges.
        """
        self._map.move_odometry(poses_odom)
        changed: list[int] = []
        for number in self._driven:
            edge = self._map.edge(number)
            delta = between(poses_odom[edge.source], poses_odom[edge.target])
            edge = replace(edge, relative=RelativePose(delta, self.wheels.covariance(*self._driven[number])))
            if number in self._contradicted and isinstance(vision, Overruling):
                changed += self._judge_again(number, edge, vision)
            else:
                self._map.update_edge(number, edge)
        deltas = between(poses_odom[:-1], poses_odom[1:])
        changed += self._weigh_again() if self.wheels.measure_again(deltas) else []
        return sorted({*self._driven, *changed})

    def _judge_again(self, number: int, odometry: Edge, vision: Overruling) -> list[int]:
        """Write a contradicted odometry edge, measured again; it counts again if no registration contradicts it any more."""
        assert odometry.relative is not None
        against = [n for n in self._map.edges_into(odometry.target) if self._contradicts(n, odometry.source)]
        measured = [self._measured[n].relative for n in against]
        if any(one is not None and vision.overrules(one, odometry.relative) for one in measured):
            self._map.update_edge(number, odometry)
            return []
        self._contradicted.discard(number)
        back = odometry if odometry.lack is not Lack.OVERRULED else replace(odometry.settled(), since_node=-1)
        self._map.update_edge(number, back)
        for n in against:
            self._measured[n] = replace(self._measured[n], contradicts_odometry=False)
            self._map.update_edge(n, replace(self._map.edge(n), contradicts_odometry=False))
        return against

    def _contradicts(self, number: int, source: int) -> bool:
        """Whether an edge from a node is a registration that contradicts the odometry."""
        return (
            number in self._measured and self._measured[number].contradicts_odometry and self._map.edge(number).source == source
        )

    def _note_registration(self, number: int, proposal: Edge) -> None:
        """Weigh a registration against the wheels, and let their noise be learnt from it."""
        assert proposal.relative is not None
        self._measured[number] = proposal
        if self.wheels.trusted:
            self._weigh_registration(number)
        newest = len(self._map) - 1
        if proposal.status is Status.ACCEPTED and proposal.target == newest and proposal.source == newest - 1:
            self.wheels.register(proposal.relative)

    def _weigh_again(self) -> list[int]:
        """Give all edges of motion the covariance that the noise of the wheels now says; returns the edges that changed."""
        changed = [number for number in self._driven if self._weigh_odometry(number)]
        return changed + [number for number in self._measured if self._weigh_registration(number)]

    def _weigh_odometry(self, number: int) -> bool:
        edge = self._map.edge(number)
        assert edge.relative is not None
        covariance = self.wheels.covariance(*self._driven[number])
        weighed = replace(edge, relative=RelativePose(edge.relative.delta, covariance))
        lack = None if self.wheels.trusted else Lack.OVERRULED
        if number in self._contradicted and edge.lack in (None, Lack.OVERRULED) and edge.lack is not lack:
            weighed = replace(weighed.settled(lack=lack), since_node=-1)
        return self._write(number, weighed)

    def _weigh_registration(self, number: int) -> bool:
        proposal = self._measured[number]
        assert proposal.relative is not None
        wheels = RelativePose(IDENTITY, np.zeros((3, 3)))
        for node in range(proposal.source + 1, proposal.target + 1):
            number_of_step = self._own_odometry(node)
            if number_of_step is None:
                return False
            step = self._map.edge(number_of_step).relative
            assert step is not None
            wheels = compose_relative(wheels, RelativePose(step.delta, self.wheels.covariance(*self._driven[number_of_step])))
        relative = self.wheels.beside(proposal.relative, wheels)
        return self._write(number, replace(self._map.edge(number), relative=relative))

    def _write(self, number: int, edge: Edge) -> bool:
        """Replace an edge if its covariance or status differs; returns whether it did."""
        before = self._map.edge(number)
        assert before.relative is not None
        assert edge.relative is not None
        if edge.status is before.status and np.array_equal(edge.relative.covariance, before.relative.covariance):
            return False
        self._map.update_edge(number, edge)
        return True

    def _own_odometry(self, node: int) -> int | None:
        """Number of the odometry edge from the node before to a node; None if there is none."""
        return next((n for n in self._map.edges_into(node) if n in self._driven and self._map.edge(n).source == node - 1), None)

    def _contradict(self, proposal: Edge) -> list[int]:
        """Drop the odometry edges that an edge contradicts; where the wheels are trusted, only a kidnapped robot's."""
        ends = {proposal.source, proposal.target}
        dropped = []
        for number in self._map.edges_into(max(ends)):
            edge = self._map.edge(number)
            if edge.kind is not EdgeKind.ODOMETRY or edge.source not in ends:
                continue
            if proposal.kidnapped_m is None:
                self._contradicted.add(number)
            else:
                self._contradicted.discard(number)
            if proposal.kidnapped_m is not None or not self.wheels.trusted:
                self._map.update_edge(number, replace(edge.settled(lack=Lack.OVERRULED), since_node=-1))
                dropped.append(number)
        return dropped
