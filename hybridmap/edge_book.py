"""The mapper's bookkeeping: where the robot is, and which edge of the map each proposed edge became."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass

import numpy as np

from hybridmap.config.mapping import EdgesConfig
from hybridmap.geometry import IDENTITY, Array, RelativePose, between, compose, compose_relative, inverse
from hybridmap.graph.edges import Edge, EdgeKind
from hybridmap.graph.experience_map import ExperienceMap
from hybridmap.graph.paths import covariances_from, odometry_covariance
from hybridmap.graph.pose_graph import PoseGraph
from hybridmap.motion_edges import MotionEdges
from hybridmap.streams.synchronise import Ready
from hybridmap.trajectory import NS_PER_S
from hybridmap.vision.base import Belief


@dataclass(frozen=True, slots=True)
class Update:
    """What the mapper did at one instant, and why.

    Attributes:
        stamp_ns: time of the step.
        pose_odom_robot: (3,) by the path integrator, m and rad; `odom` begins at the start of the drive.
        pose_map_robot: (3,) on the map of the primary back-end; before the first node, that in `odom`.
        poses_map_robot: (3,) on the map of each back-end, by its name; empty before the first node.
        at_node, delta_node_robot: the node from which the robot is seen (-1 before the first), and its pose (3,) from there.
        new_node: number of the node made now; None if none was made.
        edges: numbers of new and changed edges, whatever their status.
        reason: why a node was made, or why not.
        followed: whether the robot was found at an older node now, so that no new one is needed.
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
    followed: bool = False


@dataclass(frozen=True, slots=True)
class _Found:
    """Where the robot was found at an older node: its pose in the frame of the node, in `odom` (3,), and `Position.driven`."""

    relative: RelativePose
    pose_odom: Array
    driven: tuple[float, float]


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
        followed: whether that node is an older one, at which the robot was found.
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
        self._found: _Found | None = None

    @property
    def followed(self) -> bool:
        """Whether the robot is seen from an older node, at which it was found."""
        return self._found is not None

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
        """The motion from the newest node, at a pose (3,) in `odom`, to here, with the configured noise of odometry.

        Where the robot was found at an older node: the pose from there, with the noise since then and that of finding it.
        """
        found = self._found
        if found is None:
            return RelativePose(between(pose_odom_before, self.pose_odom), odometry_covariance(self._config, *self.driven))
        travel_m, turn_rad = self.driven[0] - found.driven[0], self.driven[1] - found.driven[1]
        since = RelativePose(between(found.pose_odom, self.pose_odom), odometry_covariance(self._config, travel_m, turn_rad))
        return compose_relative(found.relative, since)

    def restart(self) -> None:
        """Set the path length since the last node to zero: a node was made here."""
        self.driven = (0.0, 0.0)

    def attach(self, node: int, pose_odom_node: Array) -> None:
        """From now on, see the robot from a node that lies at a pose (3,) in `odom`."""
        self.at_node, self.pose_odom_at_node, self._found = node, pose_odom_node, None

    def follow(self, node: int, relative: RelativePose) -> None:
        """From now on, see the robot from an older node, in whose frame its pose was measured."""
        self.attach(node, compose(self.pose_odom, inverse(relative.delta)))
        self._found = _Found(relative, self.pose_odom, self.driven)

    def retime(self, pose_odom_newest: Array, pose_odom: Array) -> None:
        """Replace the poses (3,) of the newest node and of the robot in `odom`: odometry was measured again."""
        at_node = pose_odom_newest if self._found is None else compose(pose_odom, inverse(self.moved))
        self.pose_odom_at_node, self.pose_odom = at_node, pose_odom

    def correct(self, poses_of: Mapping[str, Array]) -> None:
        """Take in new poses (N, 3) of all nodes by each back-end, by name."""
        self.pose_map_at_node = {name: poses[self.at_node] for name, poses in poses_of.items()}

    def pose_map(self, pose_odom: Array) -> Array:
        """Transform a pose (3,) in `odom` to the map of the primary back-end."""
        at_node = self.pose_map_at_node.get(self._primary)
        return pose_odom if at_node is None else compose(at_node, between(self.pose_odom_at_node, pose_odom))

    def update(self, reason: str, node: int | None = None, edges: Sequence[int] = (), *, followed: bool = False) -> Update:
        """Make the `Update` of this instant; `node` is the number of the node made now, if any. Nothing changes."""
        moved, pose_map = self.moved, self.pose_map(self.pose_odom)
        on_map = {name: compose(pose, moved) for name, pose in self.pose_map_at_node.items()}
        return Update(
            self.stamp_ns, self.pose_odom, pose_map, on_map, self.at_node, moved, reason, node, tuple(edges), followed
        )


class EdgeBook:
    """Writes edges that the front-end proposes into the map, and gives the front-end the state of the map.

    Attributes:
        tried_again: numbers of the loops that were measured again because a back-end down-weighted them as outliers.
        motion: odometry edges and registrations, weighed by the noise of the wheels.
    """

    def __init__(self, experiences: ExperienceMap, config: EdgesConfig) -> None:
        self._map = experiences
        self._config = config
        self._number_of_key: dict[int, int] = {}
        self._proposed: set[int] = set()
        self.tried_again: tuple[int, ...] = ()
        self.motion = MotionEdges(experiences, config)

    def enter(self, proposals: Sequence[Edge]) -> list[int]:
        """Write proposed edges into the map; a proposal with the key (`Edge.key`) of an earlier one replaces that one's edge.

        A proposal without a key (-1) is always a new edge.

        Returns the numbers of the new and changed edges, odometry edges that a proposal contradicts among them.
        """
        changed = []
        for proposal in proposals:
            number = self._number_of_key.get(proposal.key)
            if number is not None:
                self._map.update_edge(number, proposal)
            else:
                number = self._map.add_edge(proposal)
                self._proposed.add(number)
                if proposal.key >= 0:
                    self._number_of_key[proposal.key] = number
            changed += [number, *self.motion.entered(number, proposal)]
        return changed

    def belief(self, poses_of: Callable[[PoseGraph], Array], outliers: Sequence[int] = ()) -> Belief:
        """Poses of the nodes and their covariances, with which the front-end looks for loops.

        With the setting `edges.gate: odometry` both are those of the odometry edges alone.

        Args:
            poses_of: returns the poses (N, 3) of a graph's nodes, as the primary back-end solves it or as the cells show them.
            outliers: numbers of edges that are left out of the graph.
        """
        own = self._config.gate == "odometry"
        graph = self._map.pose_graph().only(EdgeKind.ODOMETRY) if own else self._map.pose_graph()
        graph = graph.with_edges(~np.isin(graph.edge_ids, outliers)) if len(outliers) else graph
        return Belief(
            poses_map_node=graph.initial if own else poses_of(graph),
            stamps_s=self._map.stamps_ns / NS_PER_S,
            travel_m=self._map.travel_m,
            covariance_from=covariances_from(graph),
        )

    def proposed(self, numbers: Sequence[int]) -> list[Edge]:
        """Of the edges with these numbers, those that the front-end proposed, in the order of the numbers given."""
        return [self._map.edge(number) for number in numbers if number in self._proposed]

    def enter_again(self, proposals: Sequence[Edge]) -> list[int]:
        """Write loops that were measured again into the map, as `enter`, and add their numbers to `tried_again`."""
        changed = self.enter(proposals)
        self.tried_again = tuple(sorted({*self.tried_again, *changed}))
        return changed
