"""Places that the map knows from several visits: there the robot is followed on it, and it grows no more."""

from __future__ import annotations

import logging
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from hybridmap.config import Config
from hybridmap.edge_book import Position
from hybridmap.geometry import Array, RelativePose, between, wrap_angle
from hybridmap.trajectory import NS_PER_S
from hybridmap.vision.base import Belief, FollowingFrontEnd, FrontEnd

log = logging.getLogger(__name__)

VISITS = 4
"""Visits that make a place known: loops between so many of them hold it, and no more are needed."""
VISIT_S = 10.0
"""Time between two nodes of one place, s, from which they are of two visits; a newer node is of the present one."""
TRIED = 3
"""Views of a place that are tried, one a visit, the newest first: this bounds the cost."""
OUTDATED = 3
"""A view that was tried so often, and never fitted since, shows what is no longer there. It is not tried again."""
SURE_M = 0.3
"""Largest standard deviation of a known place as seen from where the robot is, m; otherwise a loop has to be closed first."""

Nodes = NDArray[np.int64]


@dataclass(frozen=True, slots=True)
class Found:
    """The robot at an older node: the pose of the robot in the frame of the node."""

    node: int
    relative: RelativePose


class KnownPlaces:
    """Finds the robot at older nodes, where there are nodes of `VISITS` earlier visits within the spacing of nodes.

    The views of these visits are tried, the newest first. Where none fits, a node is made: it shows how the place looks now.

    Attributes:
        followed: number of times that the robot was found.
    """

    def __init__(self, config: Config, vision: FrontEnd | None) -> None:
        """Begin without any; places are only known under the rule `travel`, where the map gates loops, by some front-ends."""
        plain = config.nodes.rule == "travel" and config.edges.hanging == "chain" and config.edges.gate == "map"
        self._vision = vision if plain and isinstance(vision, FollowingFrontEnd) else None
        self._near_m, self._turn_rad = config.nodes.distance_m, float(np.deg2rad(config.nodes.angle_deg))
        self._failures: dict[int, int] = {}
        self.followed = 0

    @property
    def outdated(self) -> list[int]:
        """Numbers of the nodes whose views are not tried any more."""
        return sorted(node for node, times in self._failures.items() if times >= OUTDATED)

    @property
    def account(self) -> dict[str, Any]:
        """What was not added to the map, and what of it is not used any more, for the map file."""
        return {"followed": self.followed, "outdated": self.outdated}

    def find(
        self, stamps_ns: NDArray[np.int64], poses: Array, robot: Position, pose_map_robot: Array, belief: Callable[[], Belief]
    ) -> Found | None:
        """Find the robot at an older node. Where too few are near, this costs one pass over the nodes.

        Args:
            stamps_ns: (N,) of the nodes.
            poses: (N, 3) of the nodes on the map, m and rad.
            robot: the robot, seen from a node.
            pose_map_robot: (3,) its pose on the map, m and rad.
            belief: called for the state of the map where it is dense enough; then a view costs what registering a node does.

        Returns:
            None if the place is not known from enough visits, its place on the map is not sure, or no view fits.
        """
        vision = self._vision
        if vision is None or len(poses) < VISITS or not vision.follows:
            return None
        visits = self._visits(stamps_ns, poses, robot.stamp_ns, pose_map_robot, vision.lost_since or 0)
        if len(visits) < VISITS:
            return None
        covariance = belief().covariance_from(robot.at_node)
        sure = np.trace(covariance[:, :2, :2], axis1=1, axis2=2) <= SURE_M**2
        views = [int(visit[np.argmin(_away_m(poses[visit], pose_map_robot))]) for visit in visits[: -TRIED - 1 : -1]]
        for node in (view for view in views if sure[view]):
            relative = vision.recognise(node, between(poses[node], pose_map_robot))
            if relative is not None:
                self._failures.pop(node, None)
                self.followed += 1
                vision.follow(node)
                return Found(node, relative)
            self._failed(node)
        return None

    def _visits(
        self, stamps_ns: NDArray[np.int64], poses: Array, now_ns: int, pose_map_robot: Array, since: int
    ) -> list[Nodes]:
        """The nodes at the robot's place that are of use, by visit, in the order of time; not those of the present visit.

        Nodes before `since` are of none: the robot was carried since then.
        """
        near = _away_m(poses, pose_map_robot) <= self._near_m
        near &= stamps_ns < now_ns - VISIT_S * NS_PER_S
        near[-1] = False
        near[:since] = False
        nodes = np.flatnonzero(near)
        nodes = nodes[np.abs(wrap_angle(poses[nodes, 2] - pose_map_robot[2])) <= self._turn_rad]
        visits: list[list[int]] = []
        for node in nodes.tolist():
            if self._failures.get(node, 0) >= OUTDATED:
                continue
            if not visits or stamps_ns[node] - stamps_ns[visits[-1][0]] > VISIT_S * NS_PER_S:
                visits.append([])
            visits[-1].append(node)
        return [np.array(visit, dtype=np.int64) for visit in visits]

    def _failed(self, node: int) -> None:
        self._failures[node] = self._failures.get(node, 0) + 1
        if self._failures[node] == OUTDATED:
            log.info("known places: the view of node %d did not fit %d times and is not used any more", node, OUTDATED)


def _away_m(poses: Array, pose: Array) -> Array:
    """Distances (n,) of poses (n, 3) from one (3,), m."""
    return np.asarray(np.hypot(poses[:, 0] - pose[0], poses[:, 1] - pose[1]))
