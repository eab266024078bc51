"""Which pieces the sessions of several maps make: found in an order of their own, so that it matters little how they are given.

A session is looked for on those that are older, by the stamp of its first node. Loops between sessions are found again from
the beginning whenever maps are merged; a map that was changed by hand is left as it is, and joined as a whole.
"""

from __future__ import annotations

import hashlib
from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from hybridmap.config import Config
from hybridmap.errors import StoreError
from hybridmap.geometry import Array, between, compose, inverse
from hybridmap.graph.edges import Edge, EdgeKind, Lack
from hybridmap.sessions.joint_map import JointMap, joined_sessions
from hybridmap.sessions.part import Part
from hybridmap.store import MapStore
from hybridmap.streams.base import Rig

Indices = NDArray[np.int64]
Key = tuple[int, int]
"""A session: the position of its map among those that are given, and its number there."""


@dataclass(frozen=True, slots=True)
class Piece:
    """Sessions that are on one map.

    Attributes:
        part: their map.
        sessions: which they are, in the order in which `part` has them.
    """

    part: Part
    sessions: tuple[Key, ...]


@dataclass(frozen=True, slots=True)
class Assembly:
    """The sessions of several maps, one map after the other, in the order in which they were given.

    Attributes:
        poses: (N, 3) of all nodes, m and rad; each piece begins where its first session has its first node by motion alone.
        links: the edges between sessions that were found, those that were refused too, by the numbers of all nodes.
    """

    poses: Array
    links: tuple[Edge, ...]


def assembled(maps: Sequence[MapStore], config: Config, rig: Rig, kept: Sequence[int]) -> Assembly:
    """Look for the place of every session on the older ones.

    Args:
        maps: the map files, open.
        config: settings of the front-end and of the back-ends.
        rig: the sensors of all maps.
        kept: positions of the maps whose sessions are not parted; they count as older than all others.

    Raises:
        StoreError: a session is in two of the maps, or a map is not finished or damaged.
        StreamError: the views of a map cannot be taken up.
        ConfigError: there is no front-end, or one that cannot join maps.
    """
    sessions = [(number, one.number) for number, store in enumerate(maps) for one in store.sessions()]
    ages = {key: _age(maps[key[0]], key[1]) for key in sessions}
    _require_different(maps, ages)
    lengths = [len(nodes) for store in maps for nodes in store.map().sessions]
    ends = np.cumsum(lengths).tolist()
    nodes_of = {key: np.arange(end - length, end) for key, length, end in zip(sessions, lengths, ends, strict=True)}
    singles = [Piece(Part.alone(maps[number], own), ((number, own),)) for number, own in sessions if number not in kept]
    singles.sort(key=lambda piece: ages[piece.sessions[0]])
    pieces: list[Piece] = []
    links: list[Edge] = []
    for new in (*(piece for number in kept for piece in _pieces(maps[number], number)), *singles):
        rest: list[Piece] = []
        grown = new
        for piece in pieces:
            both, found, edges = _together(piece, grown, config, rig)
            number = _numbers(both, nodes_of)
            links += [
                replace(edge, source=int(number[edge.source]), target=int(number[edge.target]), since_node=ends[-1] - 1, key=-1)
                for edge in edges
            ]
            grown, rest = (both, rest) if found else (grown, [*rest, piece])
        pieces = sorted([*rest, grown], key=lambda piece: ages[piece.sessions[0]])
    poses = np.zeros((ends[-1], 3))
    for piece in pieces:
        number, part = _numbers(piece, nodes_of), piece.part
        begins = int(np.argmin(number))
        poses[number] = compose(_driven(maps, piece, begins), between(part.poses[begins], part.poses))
    return Assembly(poses, tuple(links))


def changed_by_hand(store: MapStore) -> bool:
    """Whether an edge between two sessions of a map was added or taken out by hand."""
    experiences = store.map()
    session_of = [number for number, nodes in enumerate(experiences.sessions) for _ in nodes]
    return any(
        session_of[edge.source] != session_of[edge.target] and (edge.kind is EdgeKind.MANUAL or edge.lack is Lack.REMOVED)
        for edge in experiences.edges
    )


def _age(store: MapStore, number: int) -> tuple[int, str]:
    """What sessions are ordered by: first stamp, and what was driven."""
    track = store.track(number)
    return int(track.stamps_ns[0]), hashlib.sha256(track.stamps_ns.tobytes() + track.poses_odom.tobytes()).hexdigest()


def _require_different(maps: Sequence[MapStore], ages: dict[Key, tuple[int, str]]) -> None:
    """Refuse a drive that is given twice: each of its loops would count twice."""
    seen: dict[str, Key] = {}
    for key, (_, driven) in ages.items():
        number, own = key
        if driven in seen:
            there, other = seen[driven]
            raise StoreError(
                f"{maps[number].path}: session {own} is the same drive as session {other} of {maps[there].path}; expected"
                f" different ones, as its loops would count twice"
            )
        seen[driven] = key


def _pieces(store: MapStore, number: int) -> list[Piece]:
    """The pieces of a map as they are."""
    numbers = [one.number for one in store.sessions()]
    parts = [[numbers[place] for place in piece] for piece in joined_sessions(store.map())]
    return [Piece(Part.of(store, part), tuple((number, own) for own in part)) for part in parts]


def _driven(maps: Sequence[MapStore], piece: Piece, node: int) -> Array:
    """(3,) the pose of the first node of a session of a piece in the frame in which that was driven, m and rad."""
    first = [session.start for session in piece.part.experiences.sessions]
    number, own = piece.sessions[first.index(node)]
    store = maps[number]
    session = store.sessions()[own]
    pose_map_node = store.map().initial[session.first_node]
    return compose(inverse(session.pose_map_session), pose_map_node) if session.pose_map_session.any() else pose_map_node


def _numbers(piece: Piece, nodes_of: dict[Key, Indices]) -> Indices:
    """(N,) the numbers of the nodes of a piece among all."""
    return np.concatenate([nodes_of[key] for key in piece.sessions])


def _together(older: Piece, newer: Piece, config: Config, rig: Rig) -> tuple[Piece, bool, tuple[Edge, ...]]:
    """Look for a piece on an older one, and if it is not found, for that on it.

    Returns:
        Both in one, whether they are joined, and the edges between them that were found or refused.
    """
    joint = JointMap(config, rig)
    here, there = joint.take_up(older.part), joint.take_up(newer.part)
    edges = len(joint.map.edges)
    found = joint.join(there) is not None
    if not found:
        turned = JointMap(config, rig)
        first, last = turned.take_up(newer.part), turned.take_up(older.part)
        found = turned.join(last) is not None
        if found:
            joint.adopt(turned, np.concatenate([len(here) + np.arange(len(first)), np.arange(len(here))]))
    part = older.part.followed_by(newer.part, joint.map, joint.poses)
    return Piece(part, (*older.sessions, *newer.sessions)), found, joint.map.edges[edges:]
