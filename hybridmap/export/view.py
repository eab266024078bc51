"""What an exporter gets: a session opened for reading, with the poses of one back-end chosen."""

from __future__ import annotations

import logging
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path

from hybridmap.backends import Solution, create, names
from hybridmap.backends.base import ODOMETRY
from hybridmap.config import Config
from hybridmap.errors import ExportError
from hybridmap.geometry import Array
from hybridmap.graph.experience_map import ExperienceMap
from hybridmap.store import MapStore, SessionFolder, trajectory_of
from hybridmap.trajectory import Trajectory

log = logging.getLogger(__name__)


@dataclass(frozen=True, slots=True)
class ExportOptions:
    """How fine an export is.

    Attributes:
        resolution_m: side of a cell of the occupancy grid.
        voxel_m: side of the cubes that a cloud is thinned to.
        max_depth_m: depth beyond this is left out.
        obstacle_low_m, obstacle_high_m: depth points between these heights above the floor are obstacles of the grid.
    """

    resolution_m: float = 0.05
    voxel_m: float = 0.02
    max_depth_m: float = 5.0
    obstacle_low_m: float = 0.10
    obstacle_high_m: float = 1.50


class SessionView:
    """A session as one back-end sees it."""

    def __init__(self, store: MapStore, backend: str, options: ExportOptions) -> None:
        self.store = store
        self.backend = backend
        self.options = options

    @cached_property
    def experiences(self) -> ExperienceMap:
        """The map."""
        return self.store.map()

    @cached_property
    def poses(self) -> Array:
        """(N, 3) pose of each node in `map` by the chosen back-end (the chain's for odometry), m and rad."""
        if self.backend == ODOMETRY:
            return self.experiences.initial
        return self.solution.poses

    @cached_property
    def solution(self) -> Solution:
        """The back-end's result: the session's, else solved now from the graph in the map file."""
        stored = self.store.solutions().get(self.backend)
        if stored is not None:
            return stored
        log.warning("%s: no result of %s in it, solving its graph now", self.store.path, self.backend)
        config = Config.stored(self.store.config_yaml, str(self.store.path))
        return create(self.backend, config.backends).solve(self.experiences)

    @cached_property
    def rejected(self) -> frozenset[int]:
        """Numbers of the loop edges that the back-end gave no weight."""
        return frozenset() if self.backend == ODOMETRY else frozenset(self.solution.report.rejected_edge_ids)

    @cached_property
    def trajectory(self) -> Trajectory:
        """Pose of `base_link` in `map` at every stamp."""
        track = self.store.track()
        return track.odometry if self.backend == ODOMETRY else trajectory_of(track, self.poses)


def open_view(folder: Path, backend: str | None, options: ExportOptions) -> SessionView:
    """Open a session as a back-end sees it; without a name, as the primary one does. Close its `store` after use.

    A back-end that was not part of the run (or whose run was killed) gets the graph as the map file has it.

    Raises:
        StoreError: no session there.
        ExportError: there is no such back-end, or the map holds no node.
    """
    SessionFolder(folder).require()
    store = MapStore.open(folder)
    try:
        chosen = backend or store.primary
        known = names()
        if chosen not in known and chosen not in store.solutions():
            raise ExportError(f"{folder}: no result of back-end {chosen!r}; --backend can be: {', '.join(known)}")
        view = SessionView(store, chosen, options)
        if len(view.experiences) == 0:
            raise ExportError(f"{folder}: the map holds no node")
    except BaseException:
        store.close()
        raise
    return view
