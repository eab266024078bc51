"""The input of an exporter, and the function that writes any format atomically."""

from __future__ import annotations

import logging
from collections.abc import Callable
from dataclasses import dataclass, field
from functools import cached_property
from importlib import import_module
from pathlib import Path

from hybridmap.backends import Solution, create, names
from hybridmap.backends.base import ODOMETRY
from hybridmap.backends.pieces import pieces_of
from hybridmap.config import Config
from hybridmap.errors import ExportError
from hybridmap.export import FORMATS, Format
from hybridmap.export.carving import Footprint, driven
from hybridmap.geometry import Array
from hybridmap.graph.experience_map import ExperienceMap
from hybridmap.metrics import Metric
from hybridmap.output import staged
from hybridmap.store import MapStore, SessionFolder, trajectory_of
from hybridmap.store.track import Track
from hybridmap.trajectory import Trajectory

log = logging.getLogger(__name__)

ROBOT_RADIUS_M = 0.20
"""Radius of a robot whose footprint is not given: that of the small round robots of laboratories (0.17 to 0.22 m)."""


@dataclass(frozen=True, slots=True)
class ExportOptions:
    """Options of an export.

    Attributes:
        resolution_m: cell size of the occupancy grid.
        voxel_m: voxel size of point clouds.
        max_depth_m: larger depth of a camera is left out; ranges of a laser are not.
        obstacle_low_m, obstacle_high_m: depth points between these heights above the floor are obstacles of the grid.
        footprint: the robot; the cells that it drove over are free.
        inflation_m: how far the grid's costs reach beyond an obstacle; None: no costs, but occupied, free and unknown cells.
    """

    resolution_m: float = 0.05
    voxel_m: float = 0.02
    max_depth_m: float = 5.0
    obstacle_low_m: float = 0.10
    obstacle_high_m: float = 1.50
    footprint: Footprint = field(default_factory=lambda: Footprint.disc(ROBOT_RADIUS_M))
    inflation_m: float | None = None


class SessionView:
    """A session opened for export, with the poses of one back-end. What it gives is read or computed when first asked for."""

    def __init__(self, store: MapStore, backend: str, options: ExportOptions) -> None:
        self.store = store
        self.backend = backend
        self.options = options

    @cached_property
    def experiences(self) -> ExperienceMap:
        """The nodes and edges of the session's map."""
        return self.store.map()

    @cached_property
    def poses(self) -> Array:
        """(N, 3) pose of each node in `map` by the chosen back-end, m and rad; for `odometry` the odometry edges in a chain."""
        if self.backend == ODOMETRY:
            return self.experiences.initial
        return self.solution.poses

    @cached_property
    def solution(self) -> Solution:
        """The chosen back-end's solution: the one stored in the session, else the graph of the map file is solved now."""
        stored = self.store.solutions().get(self.backend)
        if stored is not None:
            return stored
        log.warning("%s: no result of %s in it, solving its graph now", self.store.path, self.backend)
        config = Config.stored(self.store.config_yaml, str(self.store.path))
        return create(self.backend, config.backends).solve(self.experiences)

    @cached_property
    def rejected(self) -> frozenset[int]:
        """Numbers of the loop edges that the chosen back-end rejected."""
        return frozenset() if self.backend == ODOMETRY else frozenset(self.solution.report.rejected_edge_ids)

    @cached_property
    def track(self) -> Track:
        """Where the robot was between nodes: of the newest session alone, which is said."""
        count = len(self.experiences.sessions)
        if count > 1:
            log.warning(
                "%s: of %d sessions the way of the newest one is written; those of the others are in trajectory/session-K/",
                self.store.path,
                count,
            )
        return self.store.track()

    @cached_property
    def trajectory(self) -> Trajectory:
        """Poses of `base_link` in `map` at every stamp of the session, by the chosen back-end."""
        track = self.track
        return track.odometry if self.backend == ODOMETRY else trajectory_of(track, self.poses)

    @cached_property
    def driven(self) -> list[Array]:
        """Poses (K, 3) in `map` of each stretch that the robot drove by itself, of all sessions; see `carving.driven`."""
        tracks = [self.store.track(number) for number in range(len(self.store.sessions()))]
        return driven(tracks, self.experiences, self.poses)


def open_view(folder: Path, backend: str | None, options: ExportOptions) -> SessionView:
    """Open a session with the poses of one back-end. Close the `store` of the view after use.

    A back-end without a stored solution (not part of the run, or the run was killed) solves the graph in the map file.

    Args:
        folder: the session folder.
        backend: its name; None for the primary one. `odometry` is dead reckoning.
        options: resolution and limits of the export.

    Raises:
        StoreError: the folder holds no session.
        ExportError: the back-end does not exist, or the map holds no node.
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
            raise ExportError(f"{folder}: the map holds no node, so there is nothing to export")
    except BaseException:
        store.close()
        raise
    return view


Writer = Callable[[SessionView, Path], list[Metric]]


@dataclass(frozen=True, slots=True)
class Exported:
    """The outcome of an export: the written files, the back-end whose poses they hold, and metrics of the files."""

    files: tuple[Path, ...]
    backend: str
    metrics: list[Metric]


def export_session(
    folder: Path,
    format_name: str,
    out: Path,
    *,
    backend: str | None = None,
    overwrite: bool = False,
    options: ExportOptions | None = None,
) -> Exported:
    """Write a session in another format. The same session gives the same bytes.

    Args:
        folder: the session folder.
        format_name: one of `FORMATS`.
        out: the file to write, made with its folder; `grid` writes a `.yaml` and a `.pgm` of that name.
        backend: name of the back-end whose poses to use; None for the primary one.
        overwrite: replace existing files.
        options: resolution and limits.

    Returns:
        The written files with their metrics. On an error nothing is written, and existing files stay.

    Raises:
        StoreError: the folder holds no session.
        ExportError: the format or back-end is unknown, or the session holds no data for the format.
        OutputError: a file exists already, or cannot be written.
    """
    if format_name not in FORMATS:
        raise ExportError(f"unknown format {format_name!r}; expected one of: {', '.join(FORMATS)}")
    chosen = FORMATS[format_name]
    targets = _targets(out, chosen)
    for target in targets:
        SessionFolder(folder).require_foreign(target)
        if chosen.by_suffix and target.suffix != chosen.suffix:
            raise ExportError(f"{target}: Open3D reads a {format_name} by its suffix; name a file that ends in {chosen.suffix}")
    module, function = chosen.writer.split(":")
    writer: Writer = getattr(import_module(f"hybridmap.export.{module}"), function)
    with staged(*targets, overwrite=overwrite) as work:
        view = open_view(folder, backend, options or ExportOptions())
        try:
            if not chosen.of_pieces:
                require_one_piece(folder, view)
            metrics = writer(view, work / targets[0].name)
        finally:
            view.store.close()
    return Exported(targets, view.backend, metrics)


def require_one_piece(folder: Path, view: SessionView) -> None:
    """Refuse a map in pieces: drawn together they would look joined.

    Raises:
        ExportError: says how many there are, and how to take one out.
    """
    count = len(pieces_of(view.experiences.pose_graph()))
    if count > 1:
        raise ExportError(
            f"{folder}: the map is {count} pieces that are not joined, each in its own frame; take out the others first, by "
            f"`hybridmap edit {folder} --remove-session N --out DIR`"
        )


def _targets(out: Path, chosen: Format) -> tuple[Path, ...]:
    if chosen.companion is None:
        return (out,)
    main = out.with_suffix(chosen.suffix) if out.suffix in (chosen.suffix, chosen.companion) else Path(f"{out}{chosen.suffix}")
    return (main, main.with_suffix(chosen.companion))
