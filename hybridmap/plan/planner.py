"""From a pose to a goal: onto the experience graph, along it by the values of the replay, and pulled taut in free space."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property

import numpy as np
from numpy.typing import NDArray

from hybridmap.errors import PlanError
from hybridmap.geometry import Array
from hybridmap.graph.gaps import Kidnapping
from hybridmap.graph.pose_graph import PoseGraph
from hybridmap.plan.free_space import Approach, FreeSpace
from hybridmap.plan.links import Cost, Links, links_of
from hybridmap.plan.replay import ReplayPlanner
from hybridmap.plan.shortening import length_m, shortened

_JOINED = 60
"""As many of the nearest nodes are tried as ends of the route on the graph."""
_ENTRIES = 9
"""Coarse cells round a place that are tried."""
_ROUND_ABOUT = 1.09
"""A way over cells, of whose neighbours there are eight, is at most 1 / cos(pi / 8) times as long as the straight one."""
_PLACE_M = 1e-6
"""Goals so near each other are one."""


@dataclass(frozen=True, slots=True)
class Plan:
    """A way to a goal.

    Attributes:
        poses: (K, 3) in `map`, m and rad, at the ends of its straights. Each heading is that of the straight that begins there,
            the last one that of the straight that ends there; the robot turns on the spot.
        length_m: length of the way.
        nodes: nodes of the experience graph along which it was found; empty if it is straight, or led where no node is.
        backups: how many values were set to find it.
    """

    poses: Array
    length_m: float
    nodes: tuple[int, ...]
    backups: int


class Planner:
    """Plans ways over one map. Values of the goal are kept: from another place to the same goal no backup is needed.

    Attributes:
        space: where the robot can be, with what was blocked taken out.
        replay: the values of the nodes.
    """

    def __init__(self, space: FreeSpace, poses: Array, links: Links, *, speed_m_s: float | None = None) -> None:
        """Plan on what is given.

        Args:
            space: where the robot can be.
            poses: (N, 3) of the nodes in `map`, m and rad.
            links: ways between the nodes. By time, `speed_m_s` is the speed between ends and nodes; None: costs are m.
        """
        self.space, self.replay = space, ReplayPlanner(links)
        self._poses, self._links = poses, links
        self._speed, self._per_m = speed_m_s, 1.0 if speed_m_s is None else 1.0 / speed_m_s
        self._over_cells: Approach | None = None
        self._goal: Array | None = None
        self._goal_ways: dict[int, Array] = {}

    @classmethod
    def of(
        cls,
        graph: PoseGraph,
        poses: Array,
        stamps_ns: NDArray[np.int64],
        space: FreeSpace,
        *,
        kidnapped: Sequence[Kidnapping] = (),
        cost: Cost = Cost.LENGTH,
    ) -> Planner:
        """A planner on a map: see `links.links_of`."""
        links = links_of(graph, poses, stamps_ns, space, kidnapped=kidnapped, cost=cost)
        if cost is Cost.LENGTH:
            return cls(space, poses, links)
        off = poses[links.ends[:, 1], :2] - poses[links.ends[:, 0], :2]
        return cls(space, poses, links, speed_m_s=float(np.median(np.hypot(off[:, 0], off[:, 1]) / links.costs)))

    def block(self, point: Array, radius_m: float) -> int:
        """Take a disc round a point (2,) in `map`, m, out of the free space: something stands there. Returns the backups."""
        self.space = self.space.without(point, radius_m)
        self.__dict__.pop("_approach", None)
        ends = self._poses[self._links.ends, :2]
        backups = self.replay.block(np.flatnonzero(~self.space.sees(ends[:, 0], ends[:, 1])).tolist())
        if self._goal is not None:
            self._over_cells = self._ways_over_cells(self._goal)
        if any(self._crosses(way) for way in self._goal_ways.values()):
            self._goal = None
        return backups

    def plan(self, start: Array, goal: Array) -> Plan:
        """The way from a point or pose (2 or 3,) in `map` to another one, m and rad; headings of both are kept if given.

        Raises:
            PlanError: one of them is not in known free space, or no way is known between them.
        """
        for name, point in (("start", start), ("goal", goal)):
            if self.space.cell(point[:2]) is None:
                raise PlanError(f"{name} {_at(point)}: {self._why(point[:2])}")
        backups = self._aim(goal[:2])
        if self.space.sees(start[None, :2], goal[None, :2])[0]:
            return _plan(np.stack([start[:2], goal[:2]]), (), start, goal, backups)
        along = self._along_nodes(start[:2])
        across = self._across(start[:2], goal[:2], np.inf if along is None else length_m(along[0]))
        if across is not None:
            return _plan(across, (), start, goal, backups)
        if along is None:
            raise PlanError(f"goal {_at(goal)}: no way through known free space is known from {_at(start)}")
        return _plan(along[0], along[1], start, goal, backups)

    def _along_nodes(self, start: Array) -> tuple[Array, tuple[int, ...]] | None:
        """The way to the goal over the graph, pulled taut, and its nodes; None if there is none."""
        values, joins = self.replay.values, self._join(start)
        costs = {node: values[node] + self._per_m * length_m(way) for node, way in joins.items()}
        first = min(costs, key=lambda node: (costs[node], node), default=None)
        if first is None or not np.isfinite(costs[first]):
            return None
        nodes = self.replay.way(first)
        onward = self._goal_ways[nodes[-1]][::-1]
        points = np.concatenate([joins[first][:-1], self._poses[nodes, :2], onward[1:]])
        return shortened(points, self.space), tuple(nodes)

    def _across(self, start: Array, goal: Array, known_m: float) -> Array | None:
        """A way through free space where the robot never drove, if one is shorter than the way that is known.

        It is looked for over coarse cells, whose ways are up to `_ROUND_ABOUT` times as long as when they are pulled taut, and
        over all cells where no way is known.
        """
        if self._speed and np.isfinite(known_m):
            return None  # how long it takes to drive is known of driven ways alone
        if np.isfinite(known_m):
            entry = self._entry(start)
            found = None if entry is None or self._over_cells is None else self._over_cells.way(entry)
        else:
            found = self.space.ways_to(goal[None]).way(start)
        if found is None:
            return None
        points = np.vstack([start, found[1], goal])
        if length_m(points) > _ROUND_ABOUT * known_m:
            return None
        points = shortened(points, self.space)
        return points if length_m(points) < known_m else None

    def _ways_over_cells(self, goal: Array) -> Approach | None:
        """Ways to a goal over coarse cells, from all of them."""
        entry = self._entry(goal)
        return None if entry is None else self.space.coarse.ways_to(entry[None])

    def _entry(self, point: Array) -> Array | None:
        """Middle (2,) of the nearest coarse cell that the robot can drive to straight from a point, if there is one."""
        cells = self.space.coarse.middles(np.flatnonzero(self.space.coarse.room))
        near = cells[np.argsort(np.hypot(*(cells - point).T), kind="stable")[:_ENTRIES]]
        seen = near[self.space.sees(np.broadcast_to(point, near.shape), near)]
        return seen[0] if len(seen) else None

    @cached_property
    def _approach(self) -> Approach:
        """Ways over cells to the nodes, for places from which none is in sight."""
        return self.space.ways_to(self._poses[:, :2])

    def _aim(self, goal: Array) -> int:
        """Bring the values of all nodes to a goal; returns the backups, none if they are there already."""
        if self._goal is not None and np.hypot(*(self._goal - goal)) < _PLACE_M:
            return 0
        self._goal, self._goal_ways, self._over_cells = goal, self._join(goal), self._ways_over_cells(goal)
        return self.replay.aim({node: self._per_m * length_m(way) for node, way in self._goal_ways.items()})

    def _join(self, point: Array) -> dict[int, Array]:
        """Ways (K, 2) from a point to nodes: straight to those in sight of the nearest, else over cells to one; m."""
        off = self._poses[:, :2] - point
        near = np.argsort(np.hypot(off[:, 0], off[:, 1]), kind="stable")[:_JOINED]
        seen = near[self.space.sees(np.broadcast_to(point, (len(near), 2)), self._poses[near, :2])]
        if len(seen):
            return {int(node): np.stack([point, self._poses[node, :2]]) for node in seen}
        found = self._approach.way(point)
        return {} if found is None else {found[0]: np.vstack([found[1], self._poses[found[0], :2]])}

    def _crosses(self, way: Array) -> bool:
        return not self.space.sees(way[:-1], way[1:]).all()

    def _why(self, point: Array) -> str:
        off_m = self.space.nearest_m(point)
        return f"a robot of {self.space.radius_m:g} m radius has no room there in the free space that the map knows; " + (
            f"the nearest place for it is {off_m:.2f} m away" if np.isfinite(off_m) else "it has none anywhere"
        )


def _at(point: Array) -> str:
    return f"({point[0]:.2f}, {point[1]:.2f})"


def _plan(points: Array, nodes: tuple[int, ...], start: Array, goal: Array, backups: int) -> Plan:
    step = np.diff(points, axis=0)
    yaw = np.arctan2(step[:, 1], step[:, 0])
    poses = np.column_stack([points, np.append(yaw, yaw[-1])])
    for row, given in ((0, start), (-1, goal)):
        if len(given) == 3:
            poses[row, 2] = given[2]
    return Plan(poses, length_m(points), nodes, backups)
