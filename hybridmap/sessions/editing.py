"""A map that is changed by hand: `hybridmap edit`."""

from __future__ import annotations

import shutil
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass, replace
from pathlib import Path
from tempfile import TemporaryDirectory

import numpy as np

from hybridmap.errors import StoreError, counted
from hybridmap.geometry import Array, RelativePose
from hybridmap.graph.edges import Edge, EdgeKind, Lack, Method, Status
from hybridmap.graph.io import graph_hash
from hybridmap.output import write_bytes, write_text
from hybridmap.sessions.drives import FIGURES
from hybridmap.sessions.joining import Joined, conclude, config_of, describe, write_trajectories
from hybridmap.sessions.joint_map import solutions_of
from hybridmap.sessions.part import finished
from hybridmap.store import MapStore
from hybridmap.store.parts import copy_sessions
from hybridmap.store.schema import MAP_NAME
from hybridmap.store.session_folder import SessionFolder


@dataclass(frozen=True, slots=True)
class Measured:
    """An edge by hand.

    Attributes:
        source, target: numbers of its nodes.
        delta: (3,) pose of the target in the frame of the source, m and rad.
        sigma_m, sigma_rad: standard deviations of its position and heading.
    """

    source: int
    target: int
    delta: Array
    sigma_m: float
    sigma_rad: float


def remove_session(folder: Path, session: int, out: Path, *, overwrite: bool = False) -> Joined:
    """Write a map without one of its sessions, and without all edges that lead there.

    What is left of two sessions is the other one, as it was before they were joined, bit for bit.

    Args:
        folder: session folder of the map.
        session: number of the session.
        out: the session folder to write; it may be `folder`.
        overwrite: replace a session that exists there.

    Raises:
        StoreError: there is no such session, or it is the only one.
    """
    with _read(folder, out) as whole:
        numbers = [one.number for one in whole.sessions()]
        if session not in numbers or len(numbers) == 1:
            found = f"holds {counted(len(numbers), 'session')}, numbered from 0"
            raise StoreError(f"{folder}: {found}; session {session} cannot be removed")
        return _written(whole, SessionFolder(folder), [n for n in numbers if n != session], SessionFolder(out), overwrite, [])


def remove_edge(folder: Path, edge: int, out: Path, *, overwrite: bool = False) -> Joined:
    """Write a map in which an edge is retracted; what it joined alone becomes a piece of its own.

    Args:
        folder, out, overwrite: as for `remove_session`.
        edge: number of the edge.

    Raises:
        StoreError: there is no such edge in the graph, or it is one of motion.
    """
    with _read(folder, out) as whole:
        edges = whole.map().edges
        found = edges[edge] if 0 <= edge < len(edges) else None
        if found is None or found.status is not Status.ACCEPTED or found.kind is EdgeKind.ODOMETRY:
            what = (
                "no such edge" if found is None else f"is {found.status}" if found.kind is not EdgeKind.ODOMETRY else "odometry"
            )
            raise StoreError(
                f"{folder}: edge {edge}: {what}; expected an accepted edge that is not odometry, as explain lists them"
            )
        gone = replace(found.settled(lack=Lack.REMOVED), status=Status.RETRACTED, since_node=-1)
        return _written(whole, SessionFolder(folder), None, SessionFolder(out), overwrite, [(edge, gone)])


def add_edge(folder: Path, measured: Measured, out: Path, *, overwrite: bool = False) -> Joined:
    """Write a map with one more edge, by hand; it may join two pieces.

    Args:
        folder, out, overwrite: as for `remove_session`.
        measured: the edge.

    Raises:
        StoreError: one of its nodes does not exist, or both are one.
    """
    with _read(folder, out) as whole:
        experiences = whole.map()
        ends = measured.source, measured.target
        if not all(0 <= end < len(experiences) for end in ends) or ends[0] == ends[1]:
            raise StoreError(
                f"{folder}: edge {ends[0]} -> {ends[1]}: expected two different nodes of 0..{len(experiences) - 1}"
            )
        covariance = np.diag([measured.sigma_m, measured.sigma_m, measured.sigma_rad]) ** 2
        relative = RelativePose(np.asarray(measured.delta, dtype=np.float64), covariance)
        edge = Edge.decided(*ends, EdgeKind.MANUAL, relative, method=Method.BY_HAND, since_node=len(experiences) - 1)
        return _written(whole, SessionFolder(folder), None, SessionFolder(out), overwrite, [(len(experiences.edges), edge)])


@contextmanager
def _read(folder: Path, out: Path) -> Iterator[MapStore]:
    """The map of a folder; if that is replaced, a copy: SQLite would take the log of the new file for that of the old one."""
    if folder.resolve() != out.resolve():
        with MapStore.open(folder) as whole:
            yield whole
        return
    SessionFolder(folder).require_map()
    with TemporaryDirectory() as aside:
        for file in folder.glob(f"{MAP_NAME}*"):
            shutil.copy2(file, aside)
        try:
            with MapStore.open(Path(aside)) as whole:
                yield whole
        except StoreError as error:
            raise StoreError(str(error).replace(str(Path(aside)), str(folder))) from None


def _written(
    whole: MapStore,
    read: SessionFolder,
    kept: list[int] | None,
    folder: SessionFolder,
    overwrite: bool,
    edges: list[tuple[int, Edge]],
) -> Joined:
    """Write a map with some of its sessions (None: all) and changed edges, and solve it."""
    config, sessions = config_of(whole), whole.sessions()
    numbers = [one.number for one in sessions] if kept is None else kept
    truths = {
        there: path.read_bytes()
        for there, number in enumerate(numbers)
        if (path := read.groundtruth_of(number, newest=number == sessions[-1].number)).is_file()
    }
    primary = finished(whole).poses
    ends = [*(one.first_node for one in sessions[1:]), len(primary)]
    poses = np.concatenate([primary[sessions[number].first_node : ends[number]] for number in numbers])
    alone = read.read_metrics().head
    with folder.writing(overwrite=overwrite):
        folder.write_config(whole.config_yaml)
        for there, truth in truths.items():
            write_bytes(folder.groundtruth_of(there, newest=False) if len(numbers) > 1 else folder.groundtruth, truth)
        with MapStore.create(folder.path, whole.config_yaml, whole.rig, whole.source) as store:
            copy_sessions(whole, store, numbers)
            if kept is not None and len(numbers) == 1 and store.info("graph_hash") == graph_hash(store.map()):
                return _as_before(store, folder)
            for number, edge in edges:
                store.put_edge(number, edge)
            describe(store, whole, " + ".join(one.source for one in store.sessions()))
            solutions = solutions_of(store.map(), poses, config.backends.names, config.backends)
            return conclude(store, folder, solutions, config, alone if len(sessions) == 1 else None)


def _as_before(store: MapStore, folder: SessionFolder) -> Joined:
    """Write what the folder of a single session held beside its map, before it was joined to others."""
    figures = store.one("SELECT value FROM info WHERE key = ?", (FIGURES,))
    store.write("DELETE FROM info WHERE key = ?", (FIGURES,))
    store.commit()
    folder.write_config(store.config_yaml)
    write_trajectories(store, folder, {name: solution.poses for name, solution in store.solutions().items()})
    if figures is not None:
        write_text(folder.metrics_json, figures)
    found = folder.read_metrics()
    return Joined(folder, True, found.head, found.metrics)
