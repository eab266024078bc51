"""A session: stream -> mapper -> map file, with progress, and the figures at its end."""

from __future__ import annotations

import logging
from collections.abc import Callable, Iterator
from contextlib import contextmanager, suppress
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

from hybridmap.backends.base import ODOMETRY
from hybridmap.calibration.clock import ClockOffset
from hybridmap.checkpoints import Checkpoints, Drive, require_same, resumable
from hybridmap.conclusion import figures_of, head_of
from hybridmap.config import Config
from hybridmap.errors import HybridMapError, StoreError, StreamError, counted
from hybridmap.mapper import Mapper
from hybridmap.metrics import Metric
from hybridmap.output import Unfinished
from hybridmap.recorder import Recorder
from hybridmap.store import MapStore
from hybridmap.store.session_folder import SessionFolder
from hybridmap.store.tables import LIVE
from hybridmap.store.track import trajectory_of
from hybridmap.streams.base import Observation, Stream
from hybridmap.trajectory import NS_PER_S

log = logging.getLogger(__name__)

LOOK_M = 40.0
"""Path length after which a first look ends, m: most drives have told the offset of their clocks by then."""

Progress = Callable[[int, int | None], None]
Opened = Callable[[Mapper, MapStore], None]


@dataclass(frozen=True, slots=True)
class Session:
    """A finished session.

    Attributes:
        folder: the session folder.
        head: all keys of `metrics.json` but the list of metrics.
        metrics: the metrics.
    """

    folder: SessionFolder
    head: dict[str, Any]
    metrics: list[Metric]


def run(
    stream: Stream,
    config: Config,
    out: Path,
    *,
    overwrite: bool = False,
    resume: bool = False,
    progress: Progress | None = None,
    opened: Opened | None = None,
    repeatable: bool = True,
) -> Session:
    """Map a stream into a session folder.

    The map file is written as the run proceeds: a run that is killed leaves a readable map up to its last node. An error
    before the first node leaves nothing, and an overwritten session is restored. After it what was mapped stays, marked as
    broken off with the reason, and an overwritten session lies whole in `.previous`. Ctrl-C keeps what was written, unless it
    overwrites a session. `resume` goes on with what stayed, and comes to the same map as an unbroken run.

    Args:
        stream: the samples.
        config: every setting; saved resolved.
        out: the session folder itself.
        overwrite: replace a session that exists.
        resume: go on with a session whose run did not end; map from the beginning, with a warning, if there is no checkpoint
            that can be used. A session that ended is returned as it is.
        progress: called with (observations done, observations expected; None if unknown).
        opened: called with the mapper and the map file before the first sample, for a stream that shows what is mapped.
        repeatable: whether the stream gives the same samples another time; a live one does not, and cannot be resumed.

    Raises:
        StreamError: the stream is damaged or unordered, or has no odometry and views to map.
        OutputError: the folder cannot be used, or another run is writing there.
        StoreError: the session to resume is of another source, configuration or version.
        ConfigError, BackendError: the configuration names a sensor or back-end that does not exist.
    """
    folder = SessionFolder(out)
    if resume and folder.ended:
        require_same(folder, stream, config)
        log.warning("%s: the session is finished, there is nothing to resume; for another part of the source map anew", out)
        read = folder.read_metrics()
        return Session(folder, read.head, read.metrics)
    before = resumable(folder, stream, config) if resume else None
    mapper = Mapper(config, stream.rig) if before is None else before.drive.mapper
    with folder.writing(overwrite=overwrite or (resume and before is None), resume=before is not None) as unfinished:
        store = _begun(folder, stream, config, repeatable=repeatable) if before is None else MapStore.resume(folder.path)
        with store, _kept(folder, store, mapper, unfinished, repeatable=repeatable):
            drive = Drive(mapper, Recorder(mapper, store)) if before is None else before.drive
            if before is not None:
                drive.rewind(store)
                log.info("%s: resumed at node %d", out, len(mapper.map) - 1)
            if opened is not None:
                opened(mapper, store)
            parts = None if before is None else before.parts
            checkpoints = Checkpoints(folder, stream, config, parts, wanted=repeatable)
            _drive(stream, drive, checkpoints, progress)
            session = _conclude(stream, mapper, drive.recorder, folder)
            store.close()
        checkpoints.remove()
        return session


def _begun(folder: SessionFolder, stream: Stream, config: Config, *, repeatable: bool) -> MapStore:
    """The map file of a new session, with what can be written before the drive, so that a killed run can be evaluated."""
    folder.write_config(config.to_yaml())
    if stream.groundtruth is not None:
        folder.write_groundtruth(stream.groundtruth)
    store = MapStore.create(folder.path, config.to_yaml(), stream.rig, stream.name)
    if not repeatable:
        store.put_info(LIVE, True)
        store.commit()
    return store


@contextmanager
def _kept(
    folder: SessionFolder, store: MapStore, mapper: Mapper, unfinished: Unfinished, *, repeatable: bool
) -> Iterator[None]:
    """Context in which an error marks the map as broken off, if anything is on it; a repeatable stream can go on."""
    try:
        yield
    except BaseException as error:
        unfinished.worth_keeping = len(mapper.map) > 0
        with suppress(StoreError):  # the disk may be full: the map up to the last commit is safe all the same
            store.break_off(_reason(error))
            unfinished.worth_keeping = store.nodes > 0
        with suppress(StoreError):
            store.close()
        if unfinished.worth_keeping and repeatable and not isinstance(error, KeyboardInterrupt):
            log.warning("%s: what was mapped is kept; %s", folder.path, folder.what_to_do())
        raise


def _reason(error: BaseException) -> str:
    """Why a run was broken off, on one line."""
    if isinstance(error, HybridMapError):
        return " ".join(str(error).split())
    if isinstance(error, KeyboardInterrupt):
        return "interrupted"
    return f"{type(error).__name__}: {' '.join(str(error).split())}".removesuffix(": ")


def first_look(stream: Stream, config: Config) -> ClockOffset:
    """Estimate how late the views of a stream are stamped, from its first `LOOK_M` metres at most, without writing a map.

    The offset may stay unknown: see `ClockOffset.state`. It comes on top of `sensors.odometry_delay_s`, if that is set.

    Raises:
        StreamError: the stream is damaged or unordered.
        ConfigError: the configuration names a sensor that the stream does not have.
    """
    mapper = Mapper(config, stream.rig, [ODOMETRY])
    clock = mapper.calibration.clock
    for sample in stream:
        mapper.add(sample)
        if clock.offset.known or (len(mapper.map) and mapper.map.nodes[-1].travel_m > LOOK_M):
            break
    if not clock.offset.known and len(mapper.map):
        clock.finish(mapper.map)
    return replace(clock.offset, used_s=0.0)


def _drive(stream: Stream, drive: Drive, checkpoints: Checkpoints, progress: Progress | None) -> None:
    mapper, recorder = drive.mapper, drive.recorder
    for sample in drive.samples(stream):
        updates = mapper.add(sample)
        for update in updates:
            recorder.record(update)
        if progress is not None and isinstance(sample, Observation):
            progress(drive.observations, stream.expected_observations)
        if any(update.new_node is not None or update.followed for update in updates):
            checkpoints.follow(drive)
    for name, (gone, stated) in stream.report.lost.items():
        of = counted(stated, "message")
        log.warning("%s: %s: %d of %s damaged or missing, left out", stream.name, name, gone, of)
    checkpoints.at_the_end(drive)
    for updates in mapper.ending():
        for update in updates:
            recorder.record(update)
        checkpoints.at_the_end(drive)
    recorder.rewrite_odometry()
    if not len(mapper.map):
        counts = ", ".join(f"{count} {name}" for name, count in stream.report.counts.items()) or "no sample"
        raise StreamError(f"{stream.name}: gave nothing to map (found {counts}); expected odometry and views at the same time")


def _conclude(stream: Stream, mapper: Mapper, recorder: Recorder, folder: SessionFolder) -> Session:
    store = recorder.store
    store.put_anchors(mapper.anchors)
    track = store.track()
    folder.write_trajectory(ODOMETRY, track.odometry)
    for name in mapper.backends.names:
        solution = mapper.backends.solutions.get(name)
        if solution is not None:
            store.put_solution(name, solution.poses, solution.report)
            if name != ODOMETRY:
                folder.write_trajectory(name, trajectory_of(track, solution.poses))
            folder.write_trajectory(f"{name}_online", store.online(name))
    head = head_of(mapper, stream)
    duration_s = float(track.stamps_ns[-1] - track.stamps_ns[0]) / NS_PER_S
    metrics = figures_of(mapper, recorder.largest_correction_m, duration_s)
    folder.write_metrics(head, metrics)
    if mapper.known_places.followed:
        store.put_info("known_places", mapper.known_places.account)
    for key in ("graph_hash", "primary_backend"):
        store.put_info(key, head[key])
    return Session(folder, head, metrics)
