"""Submaps of the clouds along the chain, their likelihood fields, and their free space."""

from __future__ import annotations

from bisect import bisect_right, insort
from collections import OrderedDict
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from enum import Enum
from itertools import pairwise
from typing import Generic, TypeVar

import numpy as np
from numpy.typing import NDArray

from hybridmap.geometry import IDENTITY, Array, RelativePose, between, compose, compose_relative, inverse
from hybridmap.streams.laser import Laser
from hybridmap.vision.laser.cloud import CELL_M, Cloud, LikelihoodField, Scene, build_field, merged_at

SEARCH_M = 4.5
"""Largest distance of starts from the anchor of a submap, m."""

APART_M = 50.0
"""Distance along the chain between two sessions, m: more than any search looks back, so that no view counts as recent."""

Span = tuple[int, int, int]
Key = TypeVar("Key")
Value = TypeVar("Value")


@dataclass(frozen=True, slots=True)
class Submap:
    """The merged scans of some nodes around one node (the anchor), in that node's frame.

    Attributes:
        anchor: the node whose frame it is.
        nodes: (N,) numbers of the nodes.
        poses: (N, 3) of the nodes in the anchor's frame.
        cloud: the merged points of their scans.
    """

    anchor: int
    nodes: NDArray[np.int64]
    poses: Array
    cloud: Cloud

    def viewpoints(self, count: int) -> NDArray[np.int64]:
        """Indices (n,) into `nodes`, evenly spread from the first to the last, ascending, at most `count`."""
        n = len(self.nodes)
        return np.unique(np.linspace(0, n - 1, min(count, n)).round().astype(np.int64))


class Field(Enum):
    """Kinds of likelihood field of a submap.

    The values are: side of a cell, reach and width of the likelihood (all m), and how many such fields are cached.
    """

    WIDE = (0.2, 0.8, 0.4, 800)
    SHARP = (0.1, 0.5, 0.2, 160)


FINE_KEPT, SUBMAPS_KEPT = 40, 1000
"""Fields for registration, and submaps, that are kept."""


class _Recent(Generic[Key, Value]):
    """A bounded dictionary that drops what was not used for longest."""

    def __init__(self, kept: int) -> None:
        self._kept = kept
        self._items: OrderedDict[Key, Value] = OrderedDict()

    def get(self, key: Key, make: Callable[[], Value]) -> Value:
        if key in self._items:
            self._items.move_to_end(key)
            return self._items[key]
        self._items[key] = value = make()
        while len(self._items) > self._kept:
            self._items.popitem(last=False)
        return value


class Atlas:
    """The clouds of all nodes and the poses that scan matching gives them one after the other; makes submaps.

    A new piece begins after a kidnapping, and where nodes are made again after the robot was followed on older ones; no submap
    holds nodes of two pieces.

    Attributes:
        clouds, ranges: of each node's scan, the points in its frame, and the ranges (B,) as received, m.
        chain: pose (3,) of each node in the frame of node 0, by scan matching from node to node, m and rad.
        scatter: covariance (3, 3) of each node's pose relative to the nodes around it, in the node's own frame, m^2 and rad^2.
        travel_m: path length from node 0 to each node along `chain`, m.
        scene: how far the walls are; the scale of clouds that are made now.
        resumed: of each node that was made after the robot was followed on older ones, the one it was seen from last.
    """

    def __init__(self) -> None:
        self._submaps: _Recent[Span, Submap] = _Recent(SUBMAPS_KEPT)
        self._fine: _Recent[Span, LikelihoodField] = _Recent(FINE_KEPT)
        self._scoring: dict[Field, _Recent[Span, LikelihoodField]] = {kind: _Recent(kind.value[3]) for kind in Field}
        self.clouds: list[Cloud] = []
        self.ranges: list[NDArray[np.float32]] = []
        self.chain: list[Array] = []
        self.scatter: list[Array] = []
        self.travel_m: list[float] = []
        self.scene = Scene()
        self.resumed: dict[int, int] = {}
        self._pieces = [0]
        self._moved = IDENTITY  # of the session that is taken up: its chain in this one

    def __len__(self) -> int:
        return len(self.clouds)

    def add(self, cloud: Cloud, ranges_m: NDArray[np.float32], pose: Array, scatter: Array, seen_from: int = -1) -> None:
        """Append a node; where it was not seen from the last node, but from an older one, it begins a new piece.

        Args:
            cloud, ranges_m: its scan, as points and as measured.
            pose: (3,) in the frame of node 0, by scan matching from node to node, m and rad.
            scatter: (3, 3) covariance of its pose relative to the submap to which it was registered, m^2 and rad^2.
            seen_from: the node from which it was seen; -1: the last one.
        """
        step = float(np.hypot(*(pose - self.chain[seen_from])[:2])) if self.chain else 0.0
        if seen_from >= 0 and seen_from != len(self) - 1:
            self.part(len(self))
            self.resumed[len(self)] = seen_from
        self.travel_m.append(self.travel_m[-1] + step if self.travel_m else 0.0)
        self.clouds.append(cloud)
        self.ranges.append(ranges_m)
        self.chain.append(pose)
        self.scatter.append(scatter)

    def take_up(
        self, cloud: Cloud, ranges_m: NDArray[np.float32], pose: Array, scatter: Array, begins: bool, back: int = 1
    ) -> None:
        """Append a node of a finished session.

        Args:
            cloud, ranges_m, scatter: as for `add`.
            pose: (3,) as it was in that session's atlas, m and rad.
            begins: whether nothing joins it to the node before. Then a new piece begins, so far along the chain that no search
                looks back beyond it.
            back: 1, or how many nodes before it the older one was made from which it was seen: then a new piece begins too.
        """
        if back > 1:
            self.add(cloud, ranges_m, compose(self._moved, pose), scatter, len(self) - back)
            return
        if begins and self.chain:
            self.part(len(self))
            self._moved = compose(compose(self.chain[-1], np.array([APART_M, 0.0, 0.0])), inverse(pose))
        self.add(cloud, ranges_m, compose(self._moved, pose), scatter)

    def joining(self, target: int, pose: Array, covariance: Array, probe: int | None = None) -> RelativePose:
        """Turn a registration to a submap into a relative pose of two nodes: the probe's node in the frame of the target's.

        The uncertainty of each node within its submap adds to the covariance.

        Args:
            target: anchor of the submap that was registered to.
            pose, covariance: (3,) and (3, 3) of the moving frame in the target's.
            probe: anchor of the submap that was registered; None for a single scan.
        """
        edge = compose_relative(RelativePose(IDENTITY, self.scatter[target]), RelativePose(pose, covariance))
        return edge if probe is None else compose_relative(edge, RelativePose(IDENTITY, self.scatter[probe]))

    def before(self, node: int) -> int:
        """The node from which a node was seen when it was made: the one before it, or an older one (`resumed`)."""
        return self.resumed.get(node, node - 1)

    def part(self, node: int) -> None:
        """Begin a new piece at a node: the robot was kidnapped before it, or seen from an older node."""
        if node not in self.resumed:
            insort(self._pieces, node)

    def join(self, node: int) -> None:
        """Join the piece that begins at a node with the one before it: the robot was not kidnapped there after all.

        Where the robot was followed on older nodes before, the piece stays.

        Raises:
            ValueError: no piece begins there.
        """
        if node not in self.resumed:
            self._pieces.remove(node)

    @property
    def pieces(self) -> list[range]:
        """The node numbers of each piece; pieces are separated by kidnappings."""
        return [range(a, b) for a, b in pairwise([*self._pieces, len(self)])]

    def piece(self, node: int) -> range:
        """The node numbers of the piece that contains a node; the node may be the next one to be added."""
        return self.pieces[bisect_right(self._pieces, node) - 1]

    def along(self, node: int, before_m: float, after_m: float) -> NDArray[np.int64]:
        """Nodes (n,) from `before_m` of travel before a node to `after_m` after it, ascending, of its own piece only."""
        travel, piece = self.travel_m[node], self.piece(node)
        first = int(np.searchsorted(self.travel_m, travel - before_m - 1e-9))
        stop = int(np.searchsorted(self.travel_m, travel + after_m + 1e-9, side="right"))
        return np.arange(max(first, piece.start), min(stop, piece.stop))

    def submap(self, anchor: int, nodes: NDArray[np.int64] | Sequence[int] | range) -> Submap:
        """Merge the clouds of some nodes in the frame of the node `anchor`; not cached."""
        numbers = np.asarray(nodes, dtype=np.int64)
        poses = between(self.chain[anchor], np.array([self.chain[i] for i in numbers]).reshape(-1, 3))
        cloud = merged_at([self.clouds[i] for i in numbers.tolist()], poses)
        return Submap(anchor, numbers, poses, cloud)

    def around(self, anchor: int, half_m: float) -> Submap:
        """The submap of the nodes within `half_m` of travel from the node `anchor`, either way, of its piece only; cached."""
        nodes = self.along(anchor, half_m, half_m)
        return self._submaps.get(_span(anchor, nodes), lambda: self.submap(anchor, nodes))

    def about(self, pose: Array, nodes: NDArray[np.int64], poses: Array, most: int) -> Submap:
        """The nearest of some nodes (n,), at most so many, merged in the frame of a pose (3,) on the map; not cached.

        `poses` (N, 3) are those of all nodes on that map, m and rad.
        """
        away = np.hypot(*(poses[nodes, :2] - pose[:2]).T)
        nearest = np.sort(nodes[np.argsort(away, kind="stable")[:most]])
        there = between(pose, poses[nearest])
        return Submap(int(nearest[0]), nearest, there, merged_at([self.clouds[i] for i in nearest.tolist()], there))

    def scoring_field(self, target: Submap, kind: Field) -> LikelihoodField:
        """A likelihood field of a submap, on which poses up to `SEARCH_M` from its anchor can be scored; cached.

        Its cells grow with those of the cloud: a field as far as 80 m would else take 20 MB.
        """
        cell_m, reach_m, sigma_m, _ = kind.value
        cell_m *= target.cloud.cell_m / CELL_M
        return self._scoring[kind].get(
            _span(target.anchor, target.nodes), lambda: build_field(target.cloud, cell_m, reach_m, sigma_m, SEARCH_M)
        )

    def fine_field(self, target: Submap) -> LikelihoodField:
        """The likelihood field of a submap to which clouds are registered; cached."""
        return self._fine.get(_span(target.anchor, target.nodes), lambda: build_field(target.cloud))


def _span(anchor: int, nodes: NDArray[np.int64]) -> Span:
    """What tells one submap of nodes without a gap from another."""
    return anchor, int(nodes[0]), int(nodes[-1])


Marks = NDArray[np.bool_]

MARGIN_M, MARGIN_PER_M = 0.25, 0.03
"""A point is in free space where the range exceeds its distance by so much, m, plus this share of the distance."""
VIEWPOINTS, POINTS = 6, 250
"""Most scans of one submap, and most points of the other, that are compared."""
JUDGED = 10
"""Fewer points in view tell nothing: two or three trees are no walls to look through."""
GRAZING = 0.3
"""Least cosine between a wall's normal and the ray at which the wall is judged."""


def violation(
    walls: Submap, seers: Submap, pose_seers_walls: Array, ranges: Sequence[NDArray[np.float32]], laser: Laser
) -> float:
    """Share of one submap's visible points that most scans of another submap contradict: they lie in the scans' free space.

    It is 0 if fewer than ten points are in view. At most 250 points are tested, by at most six scans.

    Args:
        walls: the submap whose points are tested.
        seers: the submap whose scans test them.
        pose_seers_walls: (3,) frame of `walls` in that of `seers`, m and rad.
        ranges: (B,) ranges of every node's scan, m, indexed by node.
        laser: bearings and mounting.
    """
    cloud = walls.cloud.thinned(POINTS).moved(pose_seers_walls)
    chosen = seers.viewpoints(VIEWPOINTS)
    poses = compose(seers.poses[chosen], laser.pose_base_laser)
    free, hit = _look(cloud, inverse(poses), np.array([ranges[i] for i in seers.nodes[chosen].tolist()]), laser)
    through, seen = free.sum(axis=0), (free | hit).sum(axis=0)
    judged = seen > 0
    return float((2.0 * through > seen)[judged].mean()) if judged.sum() >= JUDGED else 0.0


def violation_both_ways(
    here: Submap, there: Submap, pose_there_here: Array, ranges: Sequence[NDArray[np.float32]], laser: Laser
) -> float:
    """The larger one of `violation(here, there)` and `violation(there, here)`: each submap tests the points of the other.

    `pose_there_here` (3,) is the frame of `here` in that of `there`, m and rad; the rest is as for `violation`.
    """
    forth = violation(here, there, pose_there_here, ranges, laser)
    return max(forth, violation(there, here, inverse(pose_there_here), ranges, laser))


def violation_of_step(node: int, motion: Array, atlas: Atlas, laser: Laser) -> float:
    """Share of the walls of a node's scan and of the one before in each other's free space (the larger of both ways).

    `motion` (3,) is the pose of the node in the frame of the one before, m and rad.
    """
    last, here = (alone(atlas.clouds[i], i) for i in (atlas.before(node), node))
    return violation_both_ways(here, last, motion, atlas.ranges, laser)


def alone(cloud: Cloud, number: int) -> Submap:
    """A submap of one scan, that of the node `number`, in its own frame."""
    return Submap(number, np.array([number]), IDENTITY[None], cloud)


def _look(cloud: Cloud, poses_laser_cloud: Array, ranges_m: NDArray[np.float32], laser: Laser) -> tuple[Marks, Marks]:
    """Which points of a cloud are in the free space of each scan, and which are at its ranges; (V, P) each.

    Walls at grazing incidence are left out: there a small error of heading is a large one of range.

    Args:
        cloud: P points.
        poses_laser_cloud: (V, 3) the cloud's frame seen from the laser at each scan.
        ranges_m: (V, B) of the scans.
        laser: bearings.
    """
    x, y = _turned(cloud.points, poses_laser_cloud)
    x, y = x + poses_laser_cloud[:, :1], y + poses_laser_cloud[:, 1:2]
    normal_x, normal_y = _turned(cloud.normals, poses_laser_cloud)
    bearings = laser.bearings_rad
    increment = float(bearings[-1] - bearings[0]) / max(len(bearings) - 1, 1)
    distance = np.hypot(x, y)
    turn = (np.arctan2(y, x) - float(bearings[0])) * np.sign(increment) % (2.0 * np.pi)
    beam = np.round(turn / abs(increment)).astype(np.int64)
    inside = (beam >= 1) & (beam < len(bearings) - 1)
    nearest, farthest = _about(ranges_m)
    beam = beam.clip(1, len(bearings) - 2) - 1
    low, high = np.take_along_axis(nearest, beam, axis=1), np.take_along_axis(farthest, beam, axis=1)
    usable = inside & (np.abs(normal_x * x + normal_y * y) > GRAZING * distance) & np.isfinite(low)
    margin = MARGIN_M + MARGIN_PER_M * distance
    free = usable & (distance < low - margin)
    return free, usable & ~free & (distance < high + margin)


def _turned(vectors: Array, poses: Array) -> tuple[Array, Array]:
    """Components (V, P) each of vectors (P, 2) turned by the headings of V poses."""
    cos, sin = np.cos(poses[:, 2:]), np.sin(poses[:, 2:])
    return cos * vectors[:, 0] - sin * vectors[:, 1], sin * vectors[:, 0] + cos * vectors[:, 1]


def _about(ranges_m: NDArray[np.float32]) -> tuple[NDArray[np.float32], NDArray[np.float32]]:
    """Least and largest (V, B - 2) of each beam and its two neighbours; NaN where one of them has no return."""
    before, at, after = ranges_m[:, :-2], ranges_m[:, 1:-1], ranges_m[:, 2:]
    return np.minimum(np.minimum(before, at), after), np.maximum(np.maximum(before, at), after)
