"""A finished map, as it is taken up again from its map file."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any

from numpy.typing import NDArray

from hybridmap.backends.base import Solution
from hybridmap.errors import StoreError
from hybridmap.geometry import Array
from hybridmap.graph.experience_map import ExperienceMap
from hybridmap.store import MapStore

Arrays = Mapping[str, NDArray[Any]]


@dataclass(frozen=True, slots=True)
class Part:
    """A map to be joined to others.

    Attributes:
        name: of the map, for messages.
        experiences: its nodes and edges.
        poses: (N, 3) of its nodes by its primary back-end, m and rad.
        keyframe, state: a node's arrays for the front-end (`vision.base.MeetingFrontEnd.restore`).
    """

    name: str
    experiences: ExperienceMap
    poses: Array
    keyframe: Callable[[int], Arrays]
    state: Callable[[int], Arrays]

    @classmethod
    def of(cls, store: MapStore, sessions: Sequence[int] | None = None) -> Part:
        """Some sessions of a map file, all if None. The file must stay open: keyframes are read as they are asked for.

        Raises:
            StoreError: the run did not come to its end, its primary back-end has no map, or the file is damaged.
        """
        solution, experiences = finished(store), store.map()
        chosen = range(len(experiences.sessions)) if sessions is None else sessions
        own, nodes, _ = experiences.of_sessions(chosen)
        number = nodes.tolist().__getitem__
        return cls(
            str(store.path),
            own,
            solution.poses[nodes],
            lambda node: store.keyframe(number(node)),
            lambda node: store.state(number(node)),
        )

    @classmethod
    def alone(cls, store: MapStore, session: int) -> Part:
        """One session of a map file as it was before it was joined to others; as for `of`.

        Raises:
            StoreError: as for `of`.
        """
        part, found = cls.of(store, [session]), store.solutions_alone(session).get(store.primary)
        return part if found is None or len(found.poses) != len(part.poses) else replace(part, poses=found.poses)

    def followed_by(self, other: Part, experiences: ExperienceMap, poses: Array) -> Part:
        """This map and another one in one, whose nodes follow; `experiences` and `poses` (N, 3) are those of both."""
        count = len(self.experiences)
        return Part(
            f"{self.name} + {other.name}",
            experiences,
            poses,
            lambda node: self.keyframe(node) if node < count else other.keyframe(node - count),
            lambda node: self.state(node) if node < count else other.state(node - count),
        )


def finished(store: MapStore) -> Solution:
    """The map of the primary back-end.

    Raises:
        StoreError: the run did not come to its end, or its primary back-end has no map.
    """
    solution = store.solutions().get(store.primary)
    if not store.ended or solution is None:
        raise StoreError(f"{store.path}: has no finished map; expected one of a run that came to its end")
    return solution
