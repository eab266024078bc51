"""Checkpoints of a run: the whole state of a drive, written now and then, so that a run that died can be resumed."""

from __future__ import annotations

import logging
import time
from collections.abc import Iterator
from dataclasses import dataclass, field
from importlib.metadata import version
from itertools import islice
from typing import Any

import numpy as np
from pydantic import BaseModel

from hybridmap import provenance
from hybridmap.config import Config
from hybridmap.errors import OutputError, StoreError
from hybridmap.geometry import Array
from hybridmap.mapper import Mapper
from hybridmap.output import is_held
from hybridmap.recorder import Recorder
from hybridmap.store import MapStore, checkpoint
from hybridmap.store.checkpoint import Origin, Parts, UnusableError
from hybridmap.store.session_folder import SessionFolder
from hybridmap.store.tables import Mark
from hybridmap.streams.base import Observation, Sample, SeekableStream, Stream, StreamReport

log = logging.getLogger(__name__)

LEAST_S = 0.1
"""Least CPU time between two checkpoints, s."""
SHARE = 0.04
"""Share of the CPU time of a run that checkpoints may take."""
AHEAD_S = 0.06
"""CPU time that they may take beside that, so that a run which dies early loses little, s."""
SHARE_WAITED = 0.05
"""The same share of time by the clock: a slow disk may not hold up a drive."""
SOON = 5.0
"""Least CPU time between two at the end of the drive, whose steps are long, in units of what one takes."""
_FIRST = 3  # samples whose stamps tell one recording from another


@dataclass(slots=True)
class Drive:
    """A drive under way: all that is needed to go on with it.

    Attributes:
        mapper: with all samples so far.
        recorder: writes what the mapper did.
        taken: number of samples so far.
        observations: how many of them are observations.
        first_ns: stamps of the first few samples, ns, as they were taken.
        report: what reading the stream has found so far.
        mark: how far the map file was written at the last checkpoint.
    """

    mapper: Mapper
    recorder: Recorder
    taken: int = 0
    observations: int = 0
    first_ns: tuple[int, ...] = ()
    report: StreamReport = field(default_factory=StreamReport)
    mark: Mark | None = None

    def rewind(self, store: MapStore) -> None:
        """Take on a map file that is written to the mark or farther: what came after it is removed.

        Raises:
            StoreError: the file cannot be written.
        """
        assert self.mark is not None
        self.recorder.store = store
        store.rewind(self.mark)
        for number, edge in enumerate(self.mapper.map.edges):
            store.put_edge(number, edge)
        store.commit()

    def samples(self, stream: Stream) -> Iterator[Sample]:
        """The samples of the stream that are still to come, counted as they are taken."""
        if self.taken and isinstance(stream, SeekableStream):
            coming = stream.onward(self.taken, self.report)
        else:
            coming = islice(stream, self.taken, None)
        for sample in coming:
            self.taken += 1
            self.observations += isinstance(sample, Observation)
            if len(self.first_ns) < _FIRST:
                self.first_ns = (*self.first_ns, sample.stamp_ns)
            yield sample


@dataclass(frozen=True, slots=True)
class Resumable:
    """A drive as of its last checkpoint, and the parts of it that need not be written again."""

    drive: Drive
    parts: Parts


class Checkpoints:
    """Writes checkpoints of a run, so far apart that they cost little, and removes them at its end.

    A checkpoint that cannot be written, because the disk is full or a front-end is not ours, is only warned of, once.
    """

    def __init__(
        self, folder: SessionFolder, stream: Stream, config: Config, parts: Parts | None = None, *, wanted: bool = True
    ) -> None:
        """Begin before the first checkpoint, or with the parts of earlier ones; none is written unless they are wanted."""
        self._wanted, self._parts = wanted, parts or Parts(folder.checkpoint)
        self._folder, self._stream, self._config = folder, stream, config
        self._sections = _sections(config)
        self._origin: Origin | None = None
        self._begun = self._last = _now()
        self._spent = np.zeros(2)
        self._costs = [np.zeros(2)]  # of the last two: what else the machine does may make one look dear
        self._warned = False

    def follow(self, drive: Drive) -> None:
        """Write a checkpoint if one is due."""
        now, cost = _now(), np.min(self._costs, axis=0)
        allowed = np.array([SHARE, SHARE_WAITED]) * (now - self._begun) + AHEAD_S
        if (now - self._last)[0] >= LEAST_S and (self._spent + cost <= allowed).all():
            self._write(drive)

    def at_the_end(self, drive: Drive) -> None:
        """Write a checkpoint after the last sample, or a step of the end, unless the last one is new."""
        since_s, cost_s = (_now() - self._last)[0], np.min(self._costs, axis=0)[0]
        if since_s >= max(LEAST_S, SOON * cost_s):
            self._write(drive)

    def remove(self) -> None:
        """Remove the checkpoint: the run came to its end."""
        checkpoint.remove(self._folder.checkpoint)

    def _write(self, drive: Drive) -> None:
        if not self._wanted:
            return
        if self._origin is None:  # takes its time once
            self._origin = _origin(self._stream, self._config, drive.first_ns)
        before = _now()
        try:
            self._written(drive, self._origin)
        except (UnusableError, OutputError) as error:
            if not self._warned:
                log.warning("%s; the run cannot be resumed", error)
            self._warned = True
        self._last = _now()
        self._costs = [*self._costs[-1:], self._last - before]
        self._spent += self._costs[-1]

    def _written(self, drive: Drive, origin: Origin) -> None:
        store = drive.recorder.store
        store.sync()
        drive.mark, drive.report = store.mark(), self._stream.report
        known = {"store": store, **self._sections}
        size = checkpoint.write(self._folder.checkpoint, origin, drive, known, self._parts)
        log.info("checkpoint at node %d: %.1f MB", len(drive.mapper.map) - 1, size / 1e6)


def _now() -> Array:
    """CPU time of this process and time by the clock, s."""
    return np.array([time.process_time(), time.perf_counter()])


def resumable(folder: SessionFolder, stream: Stream, config: Config) -> Resumable | None:
    """The drive of a session whose run did not end, as of its last checkpoint.

    Its recorder has no map file yet.

    Returns:
        None if there is no checkpoint that can be used; a warning says why.

    Raises:
        OutputError: the session is being written.
        StoreError: the session is of another source, another configuration or another version of hybridmap.
    """
    if folder.path.is_dir() and is_held(folder.path):
        raise OutputError(f"{folder.path}: is being written by another run; wait for it")
    try:
        return _last(folder, stream, config)
    except UnusableError as error:
        log.warning("%s; mapping from the beginning", error)
        return None


def require_same(folder: SessionFolder, stream: Stream, config: Config) -> None:
    """Check that a session was made from a source of the same name, by the same configuration.

    Raises:
        StoreError: it was not, or its map is damaged.
    """
    with MapStore.open(folder.path) as store:
        if store.config_yaml != config.to_yaml():
            raise _another(folder, f"configuration; its own is {folder.config_yaml}")
        if store.source != stream.name:
            raise _another(folder, f"source: found {stream.name}, expected {store.source}")


def _last(folder: SessionFolder, stream: Stream, config: Config) -> Resumable:
    if not folder.map_db.is_file():
        raise UnusableError(f"{folder.path}: there is no session to resume")
    require_same(folder, stream, config)
    with MapStore.open(folder.path) as store:
        origin = checkpoint.read_origin(folder.checkpoint)
        if origin.code != provenance.mapping():
            raise _another(
                folder, f"hybridmap: found {version('hybridmap')}, expected the same code as before ({origin.version})"
            )
        seekable = isinstance(stream, SeekableStream)  # which is not opened for this
        first = () if seekable else tuple(sample.stamp_ns for sample in islice(stream, len(origin.first_ns)))
        if _origin(stream, config, first) != origin:
            raise _another(folder, f"source: {stream.name} has other samples than before")
        found = checkpoint.read(folder.checkpoint, {"store": None, **_sections(config)})
        drive = found.state
        if not isinstance(drive, Drive) or drive.mark is None:
            raise UnusableError(f"{folder.checkpoint}: damaged: holds no drive")
        now = store.mark()
        if now.nodes < drive.mark.nodes or now.last_ns < drive.mark.last_ns:
            raise UnusableError(f"{folder.map_db}: ends at node {now.nodes - 1}, before the checkpoint")
    return Resumable(drive, found.parts)


def _another(folder: SessionFolder, what: str) -> StoreError:
    return StoreError(f"{folder.path}: cannot be resumed with another {what}; map again with --overwrite")


def _origin(stream: Stream, config: Config, first_ns: tuple[int, ...]) -> Origin:
    return Origin(
        code=provenance.mapping(),
        version=version("hybridmap"),
        config=config.to_yaml(),
        source=stream.name,
        expected=stream.expected_observations,
        first_ns=stream.first_stamps(_FIRST) if isinstance(stream, SeekableStream) else first_ns,
    )


def _sections(section: BaseModel, name: str = "config") -> dict[str, Any]:
    """The configuration and its sections, by name: a state refers to them."""
    found: dict[str, Any] = {name: section}
    for field_name in type(section).model_fields:
        value = getattr(section, field_name)
        if isinstance(value, BaseModel):
            found |= _sections(value, f"{name}.{field_name}")
    return found
