"""What an exporter gets: a session opened for reading, with the poses of one back-end chosen."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property
from pathlib import Path

from hybridmap.errors import ExportError
from hybridmap.geometry import Array
from hybridmap.graph.experience_map import ExperienceMap
from hybridmap.store import MapStore, SessionFolder, trajectory_of
from hybridmap.trajectory import Trajectory

ODOMETRY = "odometry"


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
        return self.store.solutions()[self.backend].poses

    @cached_property
    def rejected(self) -> frozenset[int]:
        """Numbers of the loop edges that the back-end gave no weight."""
        solution = self.store.solutions().get(self.backend)
        return frozenset() if solution is None else frozenset(solution.report.rejected_edge_ids)

    @cached_property
    def trajectory(self) -> Trajectory:
        """Pose of `base_link` in `map` at every stamp."""
        track = self.store.track()
        return track.odometry if self.backend == ODOMETRY else trajectory_of(track, self.poses)


def open_view(folder: Path, backend: str | None, options: ExportOptions) -> SessionView:
    """Open a session as a back-end sees it; without a name, as the primary one does. Close its `store` after use.

    Raises:
        StoreError: no session there.
        ExportError: the session has no result of that back-end, or no node.
    """
    SessionFolder(folder).require()
    store = MapStore.open(folder)
    try:
        known = [ODOMETRY, *(name for name in store.solutions() if name != ODOMETRY)]
        chosen = backend or store.primary
        if chosen not in known:
            hint = "the run did not finish; " if len(known) == 1 else ""
            raise ExportError(f"{folder}: no result of back-end {chosen!r}; {hint}--backend can be: {', '.join(known)}")
        view = SessionView(store, chosen, options)
        if len(view.experiences) == 0:
            raise ExportError(f"{folder}: the map holds no node")
    except BaseException:
        store.close()
        raise
    return view
