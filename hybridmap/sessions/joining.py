"""Stored maps become one: `hybridmap merge`, and `hybridmap map SOURCE --onto MAP`."""

from __future__ import annotations

import shutil
from collections.abc import Mapping, Sequence
from contextlib import ExitStack
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

from hybridmap.backends.base import ODOMETRY, Solution
from hybridmap.conclusion import counts_of, head_of_map, solved
from hybridmap.config import Config
from hybridmap.config.gone import without_gone
from hybridmap.errors import StoreError, counted
from hybridmap.geometry import IDENTITY, Array, compose, inverse
from hybridmap.graph.edges import EdgeKind, Status
from hybridmap.graph.experience_map import ExperienceMap
from hybridmap.metrics import Metric, figure
from hybridmap.output import write_bytes
from hybridmap.session import Progress, run
from hybridmap.sessions.assembly import assembled, changed_by_hand
from hybridmap.sessions.drives import FIGURES, Drives
from hybridmap.sessions.joint_map import joined_sessions, solutions_of
from hybridmap.sessions.part import finished
from hybridmap.store import MapStore
from hybridmap.store.parts import copy_sessions
from hybridmap.store.records import rig_to_json
from hybridmap.store.session_folder import SessionFolder
from hybridmap.store.track import trajectory_of
from hybridmap.streams.base import Rig, Stream
from hybridmap.trajectory import NS_PER_S
from hybridmap.verdict import Facts, Reason, Verdict, reasons_of


@dataclass(frozen=True, slots=True)
class Joined:
    """A map of several sessions that was written.

    Attributes:
        folder: its session folder.
        joined: whether all of its sessions are on one map.
        head, metrics: what `metrics.json` holds.
    """

    folder: SessionFolder
    joined: bool
    head: dict[str, Any]
    metrics: list[Metric]


def merge(maps: Sequence[Path], out: Path, *, overwrite: bool = False) -> Joined:
    """Write a map that holds the sessions of others, and the loops that were found between them.

    The maps are read and not changed. The first one gives the configuration, and the frame of the piece that its first session
    is on. Otherwise their order only says how sessions are numbered: loops between sessions are found as `assembly` says, also
    those between sessions that were joined before. A session that is not found on any other is on the new map in a frame of its
    own.

    Args:
        maps: at least two session folders whose runs came to their end.
        out: the session folder to write.
        overwrite: replace a session that exists there.

    Raises:
        StoreError: a map is missing, damaged or not finished, or its sensors are others than those of the first; or a drive is
            in two of them.
        StreamError: the views of a map cannot be taken up.
        OutputError: the folder cannot be used, or is that of one of the maps, or lies in it.
    """
    return _joined(maps, out, overwrite, onto=False)


def _joined(maps: Sequence[Path], out: Path, overwrite: bool, *, onto: bool) -> Joined:
    """Write the map of several others; with `onto` the first one is continued, and its edges stay as they are."""
    for path in maps:
        SessionFolder(path).require_apart(out)
    with ExitStack() as opened:
        stores = [opened.enter_context(MapStore.open(path)) for path in maps]
        first, config = stores[0], config_of(stores[0])
        for store in stores:
            require_sensors(first, store.rig, str(store.path))
            finished(store)
        kept = [number for number, store in enumerate(stores) if (onto and not number) or changed_by_hand(store)]
        made = assembled(stores, config, first.rig, kept)
        folder = SessionFolder(out)
        with folder.writing(overwrite=overwrite):
            folder.write_config(config.to_yaml())
            with MapStore.create(folder.path, first.config_yaml, first.rig, "") as store:
                for number, (path, part) in enumerate(zip(maps, stores, strict=True)):
                    copied = len(store.sessions()) if store.nodes else 0
                    copy_sessions(part, store, between=number in kept)
                    keep_files(SessionFolder(path), part, folder, store, copied)
                for number, link in enumerate(made.links, start=int(store.one("SELECT COUNT(*) FROM edges", ()))):
                    store.put_edge(number, link)
                describe(store, first, " + ".join(dict.fromkeys(part.source for part in stores)))
                solutions = solutions_of(store.map(), made.poses, config.backends.names, config.backends)
                return conclude(store, folder, solutions, config)


def map_onto(
    stream: Stream,
    config: Config,
    base: Path,
    out: Path,
    *,
    overwrite: bool = False,
    resume: bool = False,
    progress: Progress | None = None,
) -> Joined:
    """Map a drive, and look for its place on a map that exists; the new map holds both.

    The drive is mapped as it would be alone, and then looked for on the map, whose edges stay as they are. That costs the same
    however many sessions the map has, where `merge` finds the loops between all of them again.

    The session of the drive alone lies in `OUT-drive`, beside `out`, until the new map is written. It stays there if the run
    is killed or breaks off, and `resume` goes on with it.

    Args:
        stream, config, progress: as for `session.run`.
        base: session folder of the map that exists; it is not changed.
        out: the session folder to write.
        overwrite: replace a session that exists there, or in `OUT-drive`.
        resume: go on with the drive in `OUT-drive`, as `session.run` does.

    Raises:
        What `session.run` and `merge` raise. What can be told before the drive is told before it; nothing is written then.
    """
    SessionFolder(base).require_apart(out)
    with MapStore.open(base) as known:
        require_sensors(known, stream.rig, stream.name)
        finished(known)
    SessionFolder(out).require_free(overwrite=overwrite)
    out.absolute().parent.mkdir(parents=True, exist_ok=True)
    drive = drive_alone(out)
    run(stream, config, drive, overwrite=overwrite, resume=resume, progress=progress)
    joined = _joined([base, drive], out, overwrite, onto=True)
    shutil.rmtree(drive)
    return joined


def drive_alone(out: Path) -> Path:
    """The folder of a drive that `map_onto` maps, until it is on the map in the session folder `out`."""
    return out.with_name(f"{out.name}-drive")


def conclude(
    store: MapStore,
    folder: SessionFolder,
    solutions: Mapping[str, Solution],
    config: Config,
    alone: dict[str, Any] | None = None,
) -> Joined:
    """Write what is known of a map of several sessions once it is solved: frames, solutions, trajectories, figures, verdict.

    Args:
        store: its nodes, edges and sessions.
        folder: where it is.
        solutions: poses of all nodes by each back-end.
        config: names the back-ends; the first is the primary one.
        alone: of a map of one session, what its `metrics.json` held beside the metrics.
    """
    primary = config.backends.names[0]
    _write_frames(store, solutions[primary].poses)
    experiences, drives = store.map(), Drives.of(store, alone)
    pieces = joined_sessions(experiences)
    for name, solution in solutions.items():
        store.put_solution(name, solution.poses, solution.report)
    write_trajectories(store, folder, {name: solution.poses for name, solution in solutions.items()})
    show_truth(folder, len(store.sessions()))
    lost = {name: (gone, stated) for name, (gone, stated) in drives.origin.lost.items()}
    head = head_of_map(
        experiences,
        _reasons(experiences, solutions[primary], primary, pieces, lost),
        [primary, *(name for name in solutions if name != primary)],
        store.source,
        replace(drives.origin, remarks=[*([_not_joined(store, pieces)] if len(pieces) > 1 else []), *drives.origin.remarks]),
    )
    head["reasons"] = [*head["reasons"], *drives.doubts]
    verdicts = [Verdict(reason["verdict"]) for reason in head["reasons"]]
    head["verdict"] = str(max(verdicts, key=lambda verdict: verdict.grade, default=Verdict.TRUSTED))
    if len(store.sessions()) > 1:
        head |= {"sessions": _sessions(store, pieces), "joined": len(pieces) == 1}
    metrics = _figures(store, experiences, pieces, solutions)
    folder.write_metrics(head, metrics)
    for key in ("graph_hash", "primary_backend"):
        store.put_info(key, head[key])
    store.commit()
    return Joined(folder, len(pieces) == 1, head, metrics)


def show_truth(folder: SessionFolder, sessions: int) -> None:
    """Make the truth of the newest of several sessions that of the folder, if it is known; that of another judges nothing."""
    newest = folder.groundtruth_of(sessions - 1, newest=False)
    if newest.is_file():
        write_bytes(folder.groundtruth, newest.read_bytes())


def write_trajectories(store: MapStore, folder: SessionFolder, poses_of: Mapping[str, Array]) -> None:
    """Write the trajectory of every session by each back-end, given its poses (N, 3) of all nodes."""
    sessions = store.sessions()
    for session in sessions:
        track, place = store.track(session.number), "" if session is sessions[-1] else f"session-{session.number}/"
        folder.write_trajectory(f"{place}{ODOMETRY}", track.odometry)
        for name, poses in poses_of.items():
            if name != ODOMETRY:
                folder.write_trajectory(f"{place}{name}", trajectory_of(track, poses))
    for name in store.online_backends() if len(sessions) == 1 else ():
        folder.write_trajectory(f"{name}_online", store.online(name))


def describe(store: MapStore, like: MapStore, source: str) -> None:
    """Write the facts of a map as a whole that do not depend on its solution; sensors and settings are those of another map."""
    for key, value in (("config_yaml", like.config_yaml), ("rig", like.info("rig")), ("source", source)):
        store.put_info(key, value)


def keep_files(part: SessionFolder, source: MapStore, folder: SessionFolder, store: MapStore, first: int) -> None:
    """Keep what a part's folder has beside its map: the ground truth of its sessions, and the figures of a single one.

    Args:
        part, source: the folder of the part, and its map.
        folder, store: the map that it became part of.
        first: number there of its first session.
    """
    count = len(source.sessions())
    if count == 1 and part.metrics_json.is_file():
        store.write_rows("info", [(first, FIGURES, part.metrics_json.read_text(encoding="utf-8"))])
    for number in range(count):
        own = part.groundtruth_of(number, newest=number == count - 1)
        if own.is_file():
            write_bytes(folder.groundtruth_of(first + number, newest=False), own.read_bytes())


def config_of(store: MapStore) -> Config:
    """The configuration of a map, without settings that this version has no more."""
    return Config.from_tree(without_gone(store.config_tree), str(store.path))


def _not_joined(store: MapStore, pieces: list[list[int]]) -> str:
    """That the sessions of a map are not joined, in words."""
    names = {one.number: f"{one.number} ({one.name})" for one in store.sessions()}
    said = "; ".join(", ".join(names[number] for number in piece) for piece in pieces)
    return f"not joined: {counted(len(pieces), 'piece')}, each in its own frame, of the sessions {said}"


def require_sensors(known: MapStore, rig: Rig, name: str) -> None:
    """Refuse a drive or a map of other sensors than those of a map.

    Args:
        known: the map.
        rig: the other sensors.
        name: whose sensors they are.

    Raises:
        StoreError: the sensors differ.
    """
    if rig_to_json(rig) != rig_to_json(known.rig):
        raise StoreError(f"{name}: has other sensors than {known.path}; only what one kind of robot saw can be joined")


def _piece_of(session: int, pieces: list[list[int]]) -> int:
    return next(number for number, piece in enumerate(pieces) if session in piece)


def _write_frames(store: MapStore, poses: Array) -> None:
    """Write where the frame of each session lies on the map: its first node, as driven, lies where the map has it."""
    for session in store.sessions():
        row = store.rows("SELECT initial_x_m, initial_y_m, initial_yaw_rad FROM nodes WHERE number = ?", (session.first_node,))
        first, there = IDENTITY + row[0], poses[session.first_node]
        frame = IDENTITY if (first == there).all() else compose(there, inverse(first))
        store.write("UPDATE sessions SET x_m = ?, y_m = ?, yaw_rad = ? WHERE number = ?", (*frame.tolist(), session.number))


def _reasons(
    experiences: ExperienceMap, solution: Solution, primary: str, pieces: list[list[int]], lost: dict[str, tuple[int, int]]
) -> Sequence[Reason]:
    if len(pieces) > 1:
        return [Reason("not joined", float(len(pieces)), 1.0)]
    return reasons_of(Facts.of_drive(experiences, solution, primary, lost=lost))


def _sessions(store: MapStore, pieces: list[list[int]]) -> list[dict[str, Any]]:
    return [
        {"number": one.number, "name": one.name, "source": one.source, "piece": _piece_of(one.number, pieces)}
        for one in store.sessions()
    ]


def _figures(
    store: MapStore, experiences: ExperienceMap, pieces: list[list[int]], solutions: Mapping[str, Solution]
) -> list[Metric]:
    of_node = {node: number for number, session in enumerate(experiences.sessions) for node in session}
    accepted = [edge for edge in experiences.edges if edge.kind is EdgeKind.LOOP and edge.status is Status.ACCEPTED]
    stamps_ns = [store.track(one.number).stamps_ns for one in store.sessions()]
    return [
        figure("sessions", len(experiences.sessions)),
        figure("pieces", len(pieces)),
        *counts_of(experiences),
        figure("loops_between_sessions", sum(of_node[edge.source] != of_node[edge.target] for edge in accepted)),
        figure("travel", sum(experiences.node(session[-1]).travel_m for session in experiences.sessions)),
        figure("duration", sum(float(stamps[-1] - stamps[0]) / NS_PER_S for stamps in stamps_ns if len(stamps))),
        *solved(experiences, solutions),
    ]
