"""A map that another mapper made, as it was recorded: experiences, transitions between them, and dead reckoning."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from hybridmap.errors import GraphError
from hybridmap.geometry import Array, compose, inverse
from hybridmap.store import Track
from hybridmap.trajectory import FARTHEST_M, NS_PER_S


@dataclass(frozen=True, slots=True)
class Link:
    """A transition between two experiences.

    Attributes:
        source, target: numbers of the experiences.
        delta: (3,) pose of the target in the frame of the source, m and rad.
        travel_m, turn_rad: how far the robot drove and turned on the way.
        duration_s: duration as it was recorded; OpenRatSLAM writes the time since the start of its run.
    """

    source: int
    target: int
    delta: Array
    travel_m: float
    turn_rad: float
    duration_s: float


@dataclass(frozen=True, slots=True)
class RecordedMap:
    """The map, with its experiences in the order in which they were made.

    Attributes:
        name: of the file, for people.
        links: E transitions in the order in which they were made.
        stamps_ns: (N,) when each experience was made; never decreasing.
        poses_odom: (N, 3) pose of each by dead reckoning, m and rad.
        travel_m: (N,) path length up to each.
        track: where the robot was.
        poses: (N, 3) poses of the experiences on the recorded map, m and rad; None if it was not recorded.
        templates: (N,) view template of each; -1: unknown.
        actions: rows of `ratslam_bag.Action.row` that made the map; empty if it was not made of actions.
        counts: what was read, by name.
        remarks: assumptions that were made, for people.
    """

    name: str
    links: tuple[Link, ...]
    stamps_ns: NDArray[np.int64]
    poses_odom: Array
    travel_m: Array
    track: Track
    poses: Array | None
    templates: NDArray[np.int64]
    actions: tuple[tuple[int | float, ...], ...]
    counts: dict[str, int]
    remarks: tuple[str, ...]


def made_by(links: Sequence[Link], n_nodes: int, where: str) -> list[int]:
    """Number of the link that made each experience but the first: the first one that joins it to an earlier experience.

    Args:
        links: all transitions, in the order in which they were made.
        n_nodes: number of experiences.
        where: name of the file, for errors.

    Raises:
        GraphError: there is no experience, or a link names one that does not exist, leads from one to itself or holds no finite
            numbers, or an experience is not joined to an earlier one.
    """
    if n_nodes == 0:
        raise GraphError(f"{where}: the map holds no experience; expected at least one")
    makers: dict[int, int] = {}
    for number, link in enumerate(links):
        said = f"{where}: link {number + 1} ({link.source} -> {link.target})"
        if not (0 <= link.source < n_nodes and 0 <= link.target < n_nodes):
            raise GraphError(f"{said} names an unknown experience; expected 0 to {n_nodes - 1}")
        if link.source == link.target:
            raise GraphError(f"{said} leads from an experience to itself; expected two different ones")
        numbers = np.array([*link.delta, link.travel_m, link.turn_rad, link.duration_s])
        if not (np.abs(numbers) <= FARTHEST_M).all() or link.duration_s < 0.0:
            raise GraphError(f"{said} holds NaN, Inf, a number beyond {FARTHEST_M:g} or a negative duration")
        makers.setdefault(max(link.source, link.target), number)
    for node in range(1, n_nodes):
        if node not in makers:
            raise GraphError(f"{where}: no link joins experience {node} to an earlier one; is the map cut off?")
    return [makers[node] for node in range(1, n_nodes)]


def from_links(
    name: str, where: str, poses: Array, templates: NDArray[np.int64], links: Sequence[Link], end_ns: int = 0
) -> RecordedMap:
    """A map that was recorded without odometry: dead reckoning is composed of the links that made the experiences.

    Durations that grow from link to link are times since the start, as OpenRatSLAM writes them, and else times on the way.

    Args:
        name, where: name and path of the file.
        poses: (N, 3) poses of the experiences on the recorded map, m and rad.
        templates: (N,) view template of each; -1: unknown.
        links: the transitions, in the order in which they were made.
        end_ns: stamp of the last experience, ns; the first has 0 or more.

    Raises:
        GraphError: see `made_by`; or a pose is not finite.
    """
    makers = [links[number] for number in made_by(links, len(poses), where)]
    near = (np.abs(poses) <= FARTHEST_M).all(axis=1)
    if not near.all():
        raise GraphError(
            f"{where}: experience {int(np.argmin(near))} has a pose with NaN, Inf or a number beyond {FARTHEST_M:g}"
        )
    durations = np.array([link.duration_s for link in links])
    since_start = len(links) > 1 and bool((np.diff(durations) > 0.0).all())
    times_s = np.array([0.0, *(link.duration_s for link in makers)])
    times_s = np.maximum.accumulate(times_s) if since_start else np.cumsum(times_s)
    stamps_ns = np.round(times_s * NS_PER_S).astype(np.int64)
    stamps_ns += max(end_ns - int(stamps_ns[-1]), 0)
    chain = np.array(poses, dtype=np.float64)
    for node, link in enumerate(makers, start=1):
        onward = link.target == node
        chain[node] = compose(chain[link.source if onward else link.target], link.delta if onward else inverse(link.delta))
    distinct = np.flatnonzero(np.diff(stamps_ns, prepend=-1))
    track = Track(stamps_ns[distinct], distinct, np.zeros((len(distinct), 3)), chain[distinct])
    what = "times since the start" if since_start else "times on the way"
    return RecordedMap(
        name=name,
        links=tuple(links),
        stamps_ns=stamps_ns,
        poses_odom=chain,
        travel_m=np.cumsum([0.0, *(link.travel_m for link in makers)]),
        track=track,
        poses=poses,
        templates=templates,
        actions=(),
        counts={"experiences": len(poses), "links": len(links)},
        remarks=("no odometry recorded: dead reckoning is composed of the links", f"durations are taken for {what}"),
    )
