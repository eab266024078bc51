"""When a pair of view cell and place on the pose cells is an experience of its own, and when one that was had before."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from hybridmap.geometry import Array
from hybridmap.neural.pose_cells import apart_cells


@dataclass(frozen=True, slots=True)
class Experience:
    """An experience.

    Attributes:
        node: node of the map that was made with it.
        view: number of its view cell.
        place: (3,) place of the packet on the pose cells, cells.
    """

    node: int
    view: int
    place: Array


@dataclass(frozen=True, slots=True)
class Decision:
    """What the present view and place are.

    Attributes:
        changed: whether the experience is another one than before.
        again: the older experience that it is; None for a new one, and where nothing changed.
        apart_cells: distance of the place from that of the experience, cells; 0 for a new one.
    """

    changed: bool
    again: Experience | None
    apart_cells: float


class Experiences:
    """All experiences, and the one that the robot is in.

    Args:
        reach_cells: places on the pose cells within this distance are one place.
    """

    def __init__(self, reach_cells: float) -> None:
        self._reach_cells = reach_cells
        self._of_view: dict[int, list[Experience]] = {}
        self._current: Experience | None = None

    def decide(self, view: int, place: Array) -> Decision:
        """Compare a view cell and a place (3,) with the current experience, then with all others of the same view cell.

        The current one is kept while its view cell is active and its place is near. The cost grows with the experiences of the
        view cell.
        """
        current = self._current
        if current is not None and current.view == view and apart_cells(current.place, place) <= self._reach_cells:
            return Decision(False, None, 0.0)
        alike = self._of_view.get(view, [])
        if not alike:
            return Decision(True, None, 0.0)
        apart = apart_cells([one.place for one in alike], place)
        nearest = int(np.argmin(apart))
        if apart[nearest] > self._reach_cells:
            return Decision(True, None, 0.0)
        return Decision(True, alike[nearest], float(apart[nearest]))

    def enter(self, experience: Experience) -> None:
        """Take an experience, a new one or one of before, as the current one."""
        alike = self._of_view.setdefault(experience.view, [])
        if not any(one.node == experience.node for one in alike):
            alike.append(experience)
        self._current = experience
