"""The interface of front-ends: they propose edges to the mapper, each with the record of its checks.

A front-end keeps its own templates, keyframes and submaps, by node number. It gets the state of the map as a `Belief`.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass
from typing import Protocol, TypeVar, runtime_checkable

import numpy as np
from numpy.typing import NDArray

from hybridmap.errors import StreamError
from hybridmap.geometry import Array, RelativePose, between
from hybridmap.graph.agreement import Indices
from hybridmap.graph.edges import Check, Edge, Lack
from hybridmap.streams.base import Observation
from hybridmap.trajectory import Anchors

HELD_IMAGES = 100
"""Newest nodes whose images stay in memory; the map file holds all. An image of 640 x 480 with its depth takes 2 MB."""
UNEXPECTED = (None, Lack.UNSUPPORTED, Lack.CONTRADICTED)
"""What a loop may lack that is refused only because the map did not expect it: nothing, or others that agree with it."""


F = TypeVar("F")


def held(frames: Iterable[tuple[int, F]], node: int) -> F:
    """The frame of a node among (node, frame) pairs.

    Raises:
        StreamError: the node's frame is no longer held (see `HELD_IMAGES`); the map file has it.
    """
    found = [frame for number, frame in frames if number == node]
    if not found:
        raise StreamError(
            f"vision: node {node}: only the newest {HELD_IMAGES} images are held, take older ones from the map file"
        )
    return found[0]


@dataclass(frozen=True, slots=True)
class Belief:
    """The state of the map, for gating and re-proposal.

    Attributes:
        poses_map_node: (N, 3) current estimate of every node by the primary back-end (or by odometry or the cells where the
            configuration says so, see `edges.gate`), m and rad.
        stamps_s: (N,) stamp of each node, s.
        travel_m: (N,) path length from node 0 to each node, m.
        covariance_from: node -> (N, 3, 3) covariance of every node's pose relative to that node, m^2 and rad^2, in each node's
            own frame. It is propagated along the shortest path of accepted edges; infinite on the diagonal where there is none.
    """

    poses_map_node: Array
    stamps_s: Array
    travel_m: Array
    covariance_from: Callable[[int], Array]

    def exact_ways(self, first: Indices, second: Indices) -> RelativePose:
        """Return what `ways` does, as if the map were exact: with covariances of 0."""
        delta = between(self.poses_map_node[first], self.poses_map_node[second])
        return RelativePose(delta, np.zeros((len(delta), 3, 3)))

    def ways(self, first: Indices, second: Indices) -> RelativePose:
        """Return the poses of nodes `second` (P,) in the frames of nodes `first` (P,), or of one (1,).

        The covariance of a node seen from itself is 0. Costs a shortest-path search of the graph for each distinct node in
        `first` that is not seen from itself alone.
        """
        out = self.exact_ways(first, second)
        for node in set(first.tolist()):
            seen = np.flatnonzero((first == node) & (second != node))
            if len(seen):
                out.covariance[seen] = self.covariance_from(node)[second[seen]]
        return out


def known_nodes(before: int, node: int, belief: Belief) -> NDArray[np.bool_]:
    """Which (N,) of the nodes before `before` are joined to a node: the poses of all others are in frames of their own."""
    joined = np.isfinite(belief.covariance_from(node)[:, 0, 0])
    joined[before:] = False
    return np.asarray(joined)


@dataclass(frozen=True, slots=True)
class View:
    """The profile and view template of one frame.

    Attributes:
        stamp_ns: time of the frame.
        profile: (bands, width) float32, normalised as configured.
        template: number of the most similar view template, or of the new one made from this frame; -1 if there are none.
        new_template: whether a new view template was made from this frame; with RatSLAM, whether it is of another experience
            than the frame before.
    """

    stamp_ns: int
    profile: NDArray[np.float32]
    template: int
    new_template: bool


class FrontEnd(Protocol):
    """Loop closure and registration for one kind of sensor.

    The mapper calls `observe` for each frame. If it makes a node of the frame, it calls `add_node`, `track` and `close`. At the
    end of the drive it calls `finish`, again and again while that returns accepted edges.
    """

    def observe(self, frame: Observation, delta_node_robot: Array) -> View:
        """Take in one frame; it becomes a node only by `add_node`.

        `delta_node_robot` (3,) is the robot's pose in the frame of the node from which it is seen, usually the last one, by
        the path integrator, m and rad (identity before the first node).
        """

    def add_node(self, node: int, view: View) -> None:
        """Make a node of the frame that was observed last; `view` is what `observe` returned for it.

        Nodes are numbered from 0 without gaps.
        """

    def track(self, node: int, odometry: RelativePose | None) -> list[Edge]:
        """Register the new node to the nodes before it.

        `odometry` is the pose of the new node in the frame of node - 1 (None for the first node).
        Returns the registrations as edges from these nodes to the new one, rejected ones too, and earlier edges that changed.
        """

    def close(self, node: int, belief: Belief) -> list[Edge]:
        """Look for loop closures of the new node; returns new edges, rejected ones too, and earlier ones that changed.

        The newer node is the source of a loop. `belief` contains the new node.
        """

    def finish(self, belief: Belief) -> list[Edge]:
        """At the end of the drive, decide pending edges and propose loops between nodes near each other on the optimised map.

        Returns the new and the changed edges.
        """

    @property
    def lost_since(self) -> int | None:
        """Node from which on the robot's place on the map is unknown, as its motion broke before it (e.g. a kidnapping).

        None if there is no such node. It is also None for a robot that only fails to recognise known places.
        """

    def keyframe(self, node: int) -> dict[str, NDArray[np.generic]]:
        """Arrays of a node's frame for the map file: `profile`, and `ranges_m` (laser) or `color` and `depth_mm` (RGB-D).

        Ask soon after the node was made: a camera keeps the images of the newest nodes only.
        """


@runtime_checkable
class VerifyingFrontEnd(FrontEnd, Protocol):
    """A front-end that can measure again those loops that a back-end down-weighted as outliers."""

    def verify(self, outliers: Sequence[Edge], belief: Belief) -> list[Edge]:
        """Measure outlier loops again, starting from the poses of `belief`, the map without them.

        Returns the loops that changed, each with its key of before, rejected where it does not fit. A loop that is not returned
        stays as it is.
        """


@dataclass(frozen=True, slots=True)
class Division:
    """Where single views divide the chain into the nodes before a kidnapping and those after it.

    Attributes:
        node: the first node after it.
        evidence: how well the views tell; the check fails if they say that the robot was kidnapped there.
    """

    node: int
    evidence: Check


@runtime_checkable
class PartingFrontEnd(FrontEnd, Protocol):
    """A front-end whose loops are measured by the views of several nodes, and which can be told of a kidnapping afterwards."""

    @property
    def reach_m(self) -> float:
        """Travel from a node within which the views of others take part in its loops, m; 0: only its own view does."""

    def way(self, node: int) -> tuple[Check, ...]:
        """Checks of whether what was seen allows that the robot drove to a node from the one before; empty if nothing tells."""

    def unexpected(self, loop: Edge) -> bool:
        """Whether a measured loop was refused for what the map expected and for no other reason: all that was seen fits."""

    def divided(self, place: int, poses: Array) -> Division | None:
        """Ask the views of single nodes on which side of a kidnapping they are.

        Args:
            place: a node near the kidnapping.
            poses: (N, 3) of the nodes on a map whose chain is loose before `place`, m and rad.

        Returns:
            None if no view tells.
        """

    def part(self, node: int) -> None:
        """Note that the robot was kidnapped between a node and the one before: from now on nothing joins views across it."""


@runtime_checkable
class MeetingFrontEnd(FrontEnd, Protocol):
    """A front-end that can take up the nodes of finished sessions, and find loops between one session and earlier ones."""

    def state(self, node: int) -> dict[str, NDArray[np.generic]]:
        """What `restore` needs of a node beside its keyframe; some numbers, however large the view."""

    def restore(
        self, node: int, keyframe: Mapping[str, NDArray[np.generic]], state: Mapping[str, NDArray[np.generic]], begins: bool
    ) -> None:
        """Take up a node of a finished session, in place of `observe`, `add_node` and `track`.

        Args:
            node: its number here; nodes are numbered from 0 without gaps, over all sessions.
            keyframe, state: what `keyframe` and `state` gave of it.
            begins: whether no motion joins it to the node before: a session begins, or the robot was kidnapped.

        Raises:
            StreamError: the arrays are not those of this sensor.
        """

    def arrive(self, first: int, *, guessed: bool = False) -> None:
        """From now on, `meet` looks for loops from the nodes from `first` on to those before it, whose place is known.

        If the poses of the new nodes are guessed, what is near there is compared first. It takes as much to believe it.
        """

    def meet(self, node: int, belief: Belief) -> list[Edge]:
        """Look for loops of one node of the session that arrived, in the order of its nodes; all of them may be restored.

        Until several matches agree, the whole map is searched. Returns new and changed edges. The first accepted ones come with
        a loose edge to the first node of the session.

        Args:
            node: the node.
            belief: the map. Stamps and travel grow from session to session, and those after `node` are left out. The poses of
                the session are right relative to each other, and relative to the others once loops were accepted.
        """

    def meet_again(self, belief: Belief) -> list[Edge]:
        """At the end, decide pending loops, and compare nodes of the session with earlier ones near them on the optimised map.

        Call it again, with the new map, while it returns accepted edges.
        """


@runtime_checkable
class FollowingFrontEnd(FrontEnd, Protocol):
    """A front-end that can follow the robot on nodes that exist, without making new ones."""

    @property
    def follows(self) -> bool:
        """Whether it can tell now where the robot is among the nodes since `lost_since`: not where it doubts that.

        Nor where it does not register nodes.
        """

    def recognise(self, node: int, expected: Array) -> RelativePose | None:
        """Register the frame that was observed last to the views about an older node; nothing is changed.

        `expected` (3,) is the pose of the robot in the frame of that node, m and rad. Returns the measured one; None if the
        views do not fit there.
        """

    def follow(self, node: int) -> None:
        """From now on the robot is seen from an earlier node, until the next `add_node`.

        Then `track` registers the new node to this one, and its `odometry` is the pose in the frame of this one.
        """


@runtime_checkable
class Overruling(Protocol):
    """A front-end that can judge again whether its registrations contradict the odometry."""

    def overrules(self, registration: RelativePose, odometry: RelativePose) -> bool:
        """Whether a good registration of two consecutive nodes says that the odometry between them is wrong.

        Both are the pose of the newer node in the frame of the older one. That the registration is good is taken for granted.
        """


@dataclass(frozen=True, slots=True)
class SeenGain:
    """k_m by the views: metres that the robot came ahead per metre of its self-motion.

    Attributes:
        gain: k_m, 1.
        sigma: its standard deviation.
        steps: number of steps between nodes that told it.
    """

    gain: float
    sigma: float
    steps: int


@runtime_checkable
class GaugingFrontEnd(FrontEnd, Protocol):
    """A front-end that sees how far the robot came, and so measures the gain of its wheels."""

    @property
    def gain(self) -> SeenGain | None:
        """k_m per metre of self-motion as it was told to the front-end; None while unknown."""

    def rescale(self, factor: float) -> None:
        """Take note that ways by self-motion are told longer by a factor from now on, and that earlier ones were too short."""


@runtime_checkable
class DenseFrontEnd(FrontEnd, Protocol):
    """A front-end that can register the frames between nodes to the final map."""

    def dense_trajectory(self, belief: Belief) -> Anchors:
        """Register every frame to `belief`, the final map; returns those that fit. Called once, after the last `finish`."""
