"""Where the robot was carried, as far as its map knows."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from hybridmap.geometry import Array
from hybridmap.graph.edges import Status
from hybridmap.graph.experience_map import ExperienceMap
from hybridmap.graph.pose_graph import PoseGraph
from hybridmap.trajectory import Trajectory


@dataclass(frozen=True, slots=True)
class Carry:
    """A break of the chain after which the robot was found elsewhere.

    Attributes:
        before, after: the last node before it and the first one after.
        found_at: the newest node when it was found.
        moved_m: how far it was found from where the odometry had it.
        search_m: way driven from `after` to `found_at`.
    """

    before: int
    after: int
    found_at: int
    moved_m: float
    search_m: float

    def __str__(self) -> str:
        found = f"found {self.moved_m:.1f} m from where the odometry has it, {self.search_m:.1f} m on, at node {self.found_at}"
        return f"carried between nodes {self.before} and {self.after}: {found}; no error is taken of the way between"


def carries(experiences: ExperienceMap) -> tuple[Carry, ...]:
    """Every carry of a drive, in its order: the edges that a search of the whole map hung in the place of broken ones."""
    found = []
    for edge in experiences.edges:
        if edge.status is Status.ACCEPTED and edge.carried_m is not None:
            search_m = experiences.node(edge.since_node).travel_m - experiences.node(edge.target).travel_m
            found.append(Carry(edge.source, edge.target, edge.since_node, edge.carried_m, search_m))
    return tuple(sorted(found, key=lambda carry: carry.after))


def pieces(trajectory: Trajectory, experiences: ExperienceMap) -> list[Trajectory]:
    """A trajectory before, between and after the carries of a drive, without the poses on the way through the air.

    The motion up to a node belongs to the way before it, so that the pose at the very stamp of `Carry.after` is left out too.
    """
    number, aloft = np.zeros(len(trajectory), dtype=np.int64), np.zeros(len(trajectory), dtype=bool)
    for carry in carries(experiences):
        down = trajectory.stamps_ns > experiences.node(carry.after).stamp_ns
        number += down
        aloft |= (trajectory.stamps_ns > experiences.node(carry.before).stamp_ns) & ~down
    found = [np.flatnonzero((number == i) & ~aloft) for i in range(int(number.max(initial=0)) + 1)]
    return [Trajectory(trajectory.stamps_ns[rows], trajectory.poses[rows]) for rows in found if len(rows)]


def parted(poses: Array, carried: Sequence[Carry]) -> Array:
    """Poses (K, 3) of the first K nodes with a row of NaN in each carry, where a line through them ends and begins anew."""
    return np.insert(poses, [carry.after for carry in carried if carry.after < len(poses)], np.nan, axis=0)


def through_the_air(graph: PoseGraph, carried: Sequence[Carry]) -> NDArray[np.bool_]:
    """(E,) which edges stand for a carry and not for a way that was driven."""
    ends = np.stack([graph.sources, graph.targets], axis=1)
    hung = [(ends == (carry.before, carry.after)).all(axis=1) for carry in carried]
    return np.any(hung, axis=0) & graph.is_motion if hung else np.zeros(graph.n_edges, dtype=np.bool_)


def grounded(trajectory: Trajectory, experiences: ExperienceMap) -> Trajectory:
    """A trajectory without the poses while the robot was carried, which no sensor tells."""
    parts = pieces(trajectory, experiences)
    if len(parts) < 2:
        return trajectory
    return Trajectory(np.concatenate([p.stamps_ns for p in parts]), np.concatenate([p.poses for p in parts]))
