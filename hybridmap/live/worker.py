"""The process that maps: an ordinary session on a stream that comes through a pipe.

`LiveMapper` starts it, with the number of its end of the pipe. It ends when told so, or when the pipe is closed: then it
concludes what it has, so that a robot whose own process died keeps its map.
"""

from __future__ import annotations

import logging
import signal
import sys
import time
from collections import deque
from collections.abc import Iterator
from contextlib import suppress
from importlib import import_module
from multiprocessing.connection import Connection

import numpy as np

from hybridmap import session
from hybridmap.errors import HybridMapError
from hybridmap.graph.io import graph_hash
from hybridmap.live.inbox import SLOW, source_of
from hybridmap.live.messages import Ask, Begin, Done, Dropped, End, Failed, Ready, Reset, Save, Saved, Snapshot
from hybridmap.mapper import Mapper
from hybridmap.store import MapStore
from hybridmap.streams.base import Observation, Sample, StreamReport
from hybridmap.streams.sensors import kinds

log = logging.getLogger(__name__)

SNAPSHOT_SHARE = 0.05
"""Largest share of the time that goes into snapshots while samples wait."""

_IDLE_S = 0.02
"""With nothing to do for so long, s, the mapper has time for a snapshot: where views are left out, it is idle for less."""
_NEW_SHARE = 0.05
"""Weight of the newest in the mean time for a sample of odometry."""


class _RestartError(HybridMapError):
    """The robot asked for a new map in place of this one."""


class PipedStream:
    """The samples that come through the pipe, as a stream that can be iterated once; between two samples it answers.

    Attributes:
        name, rig, groundtruth, expected_observations, report: see `streams.base.Stream`.
    """

    def __init__(self, pipe: Connection, begin: Begin) -> None:
        self.name, self.rig = begin.name, begin.rig
        self.groundtruth, self.expected_observations = None, None
        self.report = StreamReport()
        self._pipe = pipe
        self._mapper: Mapper | None = None
        self._store: MapStore | None = None
        self._unmapped: deque[int] = deque()  # stamps of views whose step is still to come
        self._consumed, self._told = 0, 0  # samples so far, and those that the robot knows of
        self._mapped, self._busy_s, self._motion_s = 0, 0.0, 0.0  # views since it was told, time for them, time for a motion
        self._shown = 0  # nodes of the newest snapshot
        self._show_after_s = 0.0

    def opened(self, mapper: Mapper, store: MapStore) -> None:
        """The session is set up: samples can come."""
        self._mapper, self._store = mapper, store
        self._send(Ready())

    def __iter__(self) -> Iterator[Sample]:
        """Yield the samples until the end, or until the pipe is closed."""
        while True:
            self._tell()
            try:
                message = self._pipe.recv()
            except (EOFError, OSError):
                log.warning("%s: the robot's process has gone; the map so far is concluded", self.name)
                return
            if isinstance(message, End):
                return
            if isinstance(message, Reset):
                raise _RestartError("a new map was asked for")
            if isinstance(message, Save):
                self._save()
                self._send(Saved(message.number))
            elif isinstance(message, Dropped):
                self._note(message)
            elif isinstance(message, Ask):
                self._say()
            else:
                yield from self._timed(message)

    def _timed(self, sample: Sample) -> Iterator[Sample]:
        """Yield a sample, and note how long its step takes."""
        self.report.count(source_of(sample))
        began_s = time.monotonic()
        yield sample
        took_s = time.monotonic() - began_s
        self._consumed += 1
        is_view, before = isinstance(sample, Observation), self._mapped
        if is_view:
            self._unmapped.append(sample.stamp_ns)
        while self._unmapped and self._unmapped[0] <= self._parts[0].stamp_ns:
            self._unmapped.popleft()
            self._mapped += 1
        if is_view or self._mapped > before:
            self._busy_s += took_s
        else:
            self._motion_s += _NEW_SHARE * (took_s - self._motion_s)

    def _save(self) -> None:
        """Write the maps of all back-ends, and everything else so far, so that readers find a whole session."""
        mapper, store = self._parts
        for name, solution in mapper.backends.solutions.items():
            store.put_solution(name, solution.poses, solution.report)
        store.put_info("primary_backend", mapper.backends.primary)
        store.commit()

    def show(self, *, ended: bool = False) -> None:
        """Send a snapshot of the map as it is now."""
        mapper, began_s = self._parts[0], time.monotonic()
        self._send(snapshot_of(mapper, ended=ended))
        self._shown = len(mapper.map)
        ended_s = time.monotonic()
        self._busy_s += ended_s - began_s
        self._show_after_s = ended_s + (ended_s - began_s) / SNAPSHOT_SHARE

    def _send(self, message: object) -> None:
        with suppress(OSError):  # that the robot's process has gone is seen at the next message
            self._pipe.send(message)

    @property
    def _parts(self) -> tuple[Mapper, MapStore]:
        assert self._mapper is not None
        assert self._store is not None
        return self._mapper, self._store

    def _tell(self) -> None:
        """Tell the robot how far the mapper is with views, and show it the map, where that has changed."""
        mapper = self._parts[0]
        if self._consumed > self._told and (self._unmapped or self._mapped):
            self._say()
        if len(mapper.map) > self._shown and (time.monotonic() >= self._show_after_s or not self._pipe.poll(_IDLE_S)):
            self.show()

    def _say(self) -> None:
        """Tell the robot how far the mapper is."""
        self._send(Done(self._consumed, self._mapped, self._busy_s, self._motion_s, self._parts[0].pose_map_odom))
        self._told, self._mapped, self._busy_s = self._consumed, 0, 0.0 if self._mapped else self._busy_s

    def _note(self, dropped: Dropped) -> None:
        """Count what the robot's process has left out, for the figures and the verdict."""
        self.report.count(f"{dropped.source} left out ({dropped.reason})", dropped.count)
        if dropped.reason == SLOW:
            self.report.dropped[dropped.source] = self.report.dropped.get(dropped.source, 0) + dropped.count


def snapshot_of(mapper: Mapper, *, ended: bool) -> Snapshot:
    """The map as it is now. Costs a search of the shortest paths from the first node."""
    graph, node = mapper.map.pose_graph(), len(mapper.map) - 1
    return Snapshot(
        stamp_ns=mapper.stamp_ns,
        stamps_ns=np.array([node.stamp_ns for node in mapper.map.nodes], dtype=np.int64),
        poses=mapper.poses().copy(),
        edges=np.stack([graph.sources, graph.targets], axis=1),
        kinds=graph.kinds.copy(),
        pose_map_odom=mapper.pose_map_odom,
        covariance=mapper.belief().covariance_from(0)[node] if node >= 0 else None,
        lost=mapper.lost_since is not None,
        graph_hash=graph_hash(mapper.map) if ended else None,
    )


def work(pipe: Connection) -> None:
    """Map what comes through the pipe into a session, and say how it ended."""
    _load()
    begin: Begin = pipe.recv()
    overwrite = begin.overwrite
    while True:
        stream = PipedStream(pipe, begin)
        try:
            finished = session.run(stream, begin.config, begin.out, overwrite=overwrite, opened=stream.opened, repeatable=False)
        except _RestartError:
            overwrite = True
            continue
        stream.show(ended=True)
        pipe.send(finished)
        return


def _load() -> None:
    """Load what a mapper needs, for a robot that says later what to map with: a drive then begins at once."""
    for kind in kinds():
        if isinstance(kind.front_end, str):
            import_module(kind.front_end.partition(":")[0])
    import_module("hybridmap.compiled")
    import_module("gtsam")


def main() -> None:
    """Run `work` on the pipe whose number is the first argument, and pass every error on to the robot's process.

    A service manager that stops the robot's program sends SIGTERM to this process too, at the same moment. It is left to that
    program to finish; without it the closed pipe ends the drive.
    """
    signal.signal(signal.SIGTERM, signal.SIG_IGN)
    pipe = Connection(int(sys.argv[1]))
    try:
        work(pipe)
    except (BrokenPipeError, ConnectionResetError, EOFError):
        log.warning("the robot's process has gone")
    except HybridMapError as error:
        _fail(pipe, type(error).__name__, str(error))
    except BaseException as error:
        _fail(pipe, "LiveError", f"the mapping process ended by {type(error).__name__}: {error}")
        raise


def _fail(pipe: Connection, error: str, words: str) -> None:
    with suppress(OSError):
        pipe.send(Failed(error, words))
