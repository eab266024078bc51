"""Where the motion was not measured: kidnappings, and stretches known by odometry alone (a bare corridor)."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from hybridmap.geometry import Array, loosest_direction
from hybridmap.graph.edges import Edge, EdgeKind, Status
from hybridmap.graph.experience_map import ExperienceMap
from hybridmap.graph.pose_graph import PoseGraph
from hybridmap.trajectory import Trajectory


@dataclass(frozen=True, slots=True)
class Kidnapping:
    """A stretch on which the robot was carried and not driven, found when it was localised elsewhere.

    Attributes:
        before, after: the last node before the kidnapping and the first one after it.
        found_at: number of the newest node when the robot was localised again.
        moved_m: distance between the pose where it was put down and the pose by odometry.
        search_m: path length from `after` to `found_at`.
    """

    before: int
    after: int
    found_at: int
    moved_m: float
    search_m: float

    def __str__(self) -> str:
        put_down = f"put down {self.moved_m:.1f} m from where the odometry has it"
        found = f"localised {self.search_m:.1f} m later, at node {self.found_at}"
        return f"kidnapped between nodes {self.before} and {self.after}: {put_down}; {found}; no error is taken between the two"


def kidnappings(experiences: ExperienceMap) -> tuple[Kidnapping, ...]:
    """Every kidnapping of a drive that was found, in order, read from the accepted edges that lead across them."""
    found = []
    for edge in experiences.edges:
        if edge.status is Status.ACCEPTED and edge.kidnapped_m is not None:
            search_m = experiences.node(edge.since_node).travel_m - experiences.node(edge.target).travel_m
            found.append(Kidnapping(edge.source, edge.target, edge.since_node, edge.kidnapped_m, search_m))
    return tuple(sorted(found, key=lambda one: one.after))


def pieces(trajectory: Trajectory, experiences: ExperienceMap) -> list[Trajectory]:
    """Split a trajectory at the kidnappings, in order of time; poses during a kidnapping and empty pieces are left out.

    A kidnapping lasts from the stamp of the last node before it, whose pose is kept, to that of the first node after it, whose
    pose is left out too.
    """
    number, aloft = np.zeros(len(trajectory), dtype=np.int64), np.zeros(len(trajectory), dtype=bool)
    for one in kidnappings(experiences):
        down = trajectory.stamps_ns > experiences.node(one.after).stamp_ns
        number += down
        aloft |= (trajectory.stamps_ns > experiences.node(one.before).stamp_ns) & ~down
    found = [np.flatnonzero((number == i) & ~aloft) for i in range(int(number.max(initial=0)) + 1)]
    return [Trajectory(trajectory.stamps_ns[rows], trajectory.poses[rows]) for rows in found if len(rows)]


def parted(poses: Array, kidnapped: Sequence[Kidnapping]) -> Array:
    """Poses (K, 3) of the first K nodes with a row of NaN inserted at each kidnapping, which interrupts a plotted line."""
    return np.insert(poses, [one.after for one in kidnapped if one.after < len(poses)], np.nan, axis=0)


def kidnapping_edges(graph: PoseGraph, kidnapped: Sequence[Kidnapping]) -> NDArray[np.bool_]:
    """(E,) which edges of motion join the nodes before and after a kidnapping, so that nobody drove along them; no loops."""
    ends = np.stack([graph.sources, graph.targets], axis=1)
    found = [(ends == (one.before, one.after)).all(axis=1) for one in kidnapped]
    return np.any(found, axis=0) & graph.is_motion if found else np.zeros(graph.n_edges, dtype=np.bool_)


def grounded(trajectory: Trajectory, experiences: ExperienceMap) -> Trajectory:
    """A trajectory without the poses during kidnappings (see `pieces`), which no sensor measures."""
    parts = pieces(trajectory, experiences)
    if len(parts) < 2:
        return trajectory
    return Trajectory(np.concatenate([p.stamps_ns for p in parts]), np.concatenate([p.poses for p in parts]))


FREE = 1.5
"""A registration that is so many times less certain than the odometry leaves the motion to it. One that is as certain as wheels
which proved good still holds it; along a bare wall the factor is 10 and more."""
_ALIKE = 0.7  # mean resultant length of doubled angles from which stretches are said to share a direction


@dataclass(frozen=True, slots=True)
class Unobserved:
    """Path lengths over which the motion from node to node is known by odometry alone, in one direction or in all.

    Attributes:
        sliding_m: length where registration is far less certain than odometry in one direction (a bare corridor).
        blind_m: length where nothing was registered.
        travel_m: length of the whole drive.
        direction_rad: direction in the map that registration leaves free, an axis in [-pi/2, pi/2); mean by length.
        alike: how much the sliding stretches share that direction, 0 to 1.
    """

    sliding_m: float
    blind_m: float
    travel_m: float
    direction_rad: float
    alike: float

    def __str__(self) -> str:
        """One sentence that states these lengths."""
        parts = []
        if self.sliding_m > 0:
            degrees = round(np.degrees(self.direction_rad)) + 0
            where = f"along {degrees} deg of the map" if self.alike > _ALIKE else "in one direction"
            parts.append(f"on {self.sliding_m:.1f} m of {self.travel_m:.1f} m nothing seen held the motion {where}")
        if self.blind_m > 0:
            parts.append(f"on {self.blind_m:.1f} m of {self.travel_m:.1f} m nothing seen held it at all")
        return "; ".join(parts) + ": there the map rests on odometry" if parts else "registration held all of the way"


def unobserved(experiences: ExperienceMap, poses: Array) -> Unobserved | None:
    """Find where the motion from node to node is known by odometry alone.

    A stretch slides where the registration's standard deviation in its loosest direction is at least `FREE` times that of
    the odometry edge in the same direction.

    Args:
        experiences: the map.
        poses: (N, 3) of its nodes, m and rad; they turn directions into the map's frame.

    Returns:
        None if the map has no registrations at all.
    """
    steps = list(_free_steps(experiences))
    if all(step.blind for step in steps):
        return None
    sliding = sum(step.length_m for step in steps if step.direction_rad is not None)
    blind = sum(step.length_m for step in steps if step.blind)
    turned = [
        step.length_m * np.exp(2j * (step.direction_rad + poses[step.node, 2]))
        for step in steps
        if step.direction_rad is not None
    ]
    axis = complex(sum(turned))
    alike = abs(axis) / sliding if sliding > 0 else 0.0
    mean = 0.5 * float(np.angle(axis)) if sliding > 0 else 0.0
    return Unobserved(sliding, blind, sum(step.length_m for step in steps), mean, alike)


def free_lengths(experiences: ExperienceMap) -> Array:
    """Path length (N,) to each node from the one before it where odometry alone knows the motion, m; elsewhere 0.

    That is where nothing was registered, or the registration leaves one direction free (see `unobserved`). At a kidnapping
    the edge that re-attaches the chain counts as the registration, so such a step is seldom 0.
    """
    free = np.zeros(len(experiences))
    for step in _free_steps(experiences):
        free[step.node] = step.length_m if step.blind or step.direction_rad is not None else 0.0
    return free


@dataclass(frozen=True, slots=True)
class _Step:
    """The motion to a node from the one before it.

    Attributes:
        node: the node.
        length_m: path length.
        blind: whether nothing was registered.
        direction_rad: direction in the node's frame that the registration leaves free; None if it leaves none.
    """

    node: int
    length_m: float
    blind: bool
    direction_rad: float | None


def _free_steps(experiences: ExperienceMap) -> Iterator[_Step]:
    steps, registered = _by_target(experiences, EdgeKind.ODOMETRY), _by_target(experiences, EdgeKind.REGISTRATION)
    for node in range(1, len(experiences)):
        edges = [edge for edge in registered.get(node, []) if edge.status is Status.ACCEPTED]
        free = _free_direction(edges, steps.get(node, [])) if edges else None
        yield _Step(node, experiences.node(node).travel_m - experiences.node(node - 1).travel_m, not edges, free)


def _by_target(experiences: ExperienceMap, kind: EdgeKind) -> dict[int, list[Edge]]:
    found: dict[int, list[Edge]] = {}
    for edge in experiences.edges:
        if edge.kind is kind and edge.relative is not None:
            found.setdefault(edge.target, []).append(edge)
    return found


def _free_direction(registrations: list[Edge], odometry: list[Edge]) -> float | None:
    """Direction (rad, in the node's frame) in which the best registration is far less certain than odometry, if any."""
    nearest = max(registrations, key=lambda edge: edge.source)
    assert nearest.relative is not None
    sigma_m, direction = loosest_direction(nearest.relative.covariance)
    along = np.array([np.cos(direction), np.sin(direction)])
    held = [along @ edge.relative.covariance[:2, :2] @ along for edge in odometry if edge.relative is not None]
    return direction if held and sigma_m**2 >= FREE**2 * min(held) else None
