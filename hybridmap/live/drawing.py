"""Occupancy grids of a map that is being made, drawn in a process of their own: neither mapper nor robot waits for it."""

from __future__ import annotations

import sys
import threading
import time
from contextlib import suppress
from multiprocessing.connection import Connection
from pathlib import Path
from typing import Any

from hybridmap.errors import ExportError, HybridMapError, LiveError
from hybridmap.export.formats import ExportOptions, SessionView
from hybridmap.export.keyframes import OccupancyGrid, build_grid
from hybridmap.geometry import Array
from hybridmap.live.process import PipedProcess
from hybridmap.store import MapStore


class Artist:
    """Draws grids of the session in a folder. The process is started with the first one."""

    def __init__(self, out: Path) -> None:
        self._out = out
        self._turn = threading.Lock()
        self._process: PipedProcess | None = None
        self._number = 0

    def grid(self, poses: Array, resolution_m: float, timeout_s: float | None) -> OccupancyGrid:
        """The grid of the first nodes of the session, at the poses (N, 3) in `map`, m and rad.

        Raises:
            ExportError: the nodes show no obstacle.
            LiveError: it is not there in this time, s, or the process has ended.
        """
        if not len(poses):
            raise ExportError("grid: no node yet")
        end_s = None if timeout_s is None else time.monotonic() + timeout_s
        with self._turn:
            self._process = self._process or PipedProcess("hybridmap.live.drawing", yields=True)
            self._number += 1
            self._process.send([(self._number, self._out, poses, resolution_m)])
            found = self._answer(self._process, end_s)
        if isinstance(found, HybridMapError):
            raise found
        if found is None:
            raise LiveError(f"the grid was not there after {timeout_s} s")
        return found

    def close(self) -> None:
        """End the process."""
        if self._process is not None:
            self._process.close()

    def _answer(self, process: PipedProcess, end_s: float | None) -> OccupancyGrid | HybridMapError | None:
        """The answer to the newest question; None if it does not come until a time of the steady clock, s."""
        try:
            while process.pipe.poll(None if end_s is None else max(0.0, end_s - time.monotonic())):
                number, found = process.pipe.recv()
                if number == self._number:
                    answer: OccupancyGrid | HybridMapError = found
                    return answer
        except (EOFError, OSError):
            self._process = None
            return LiveError(f"the process that draws grids ended {process.end()}")
        return None


def draw(out: Path, poses: Array, resolution_m: float) -> OccupancyGrid | HybridMapError:
    """The grid, or the error in place of it; see `Artist.grid`."""
    try:
        with MapStore.open(out) as store, store.at_one_moment():
            view = SessionView(store, store.primary, ExportOptions(resolution_m=resolution_m))
            view.poses = poses
            return build_grid(view)
    except HybridMapError as error:
        return error


def main() -> None:
    """Draw what is asked for through the pipe whose number is the first argument, until it is closed."""
    pipe = Connection(int(sys.argv[1]))
    with suppress(EOFError, OSError):
        while True:
            asked: tuple[Any, ...] = pipe.recv()
            pipe.send((asked[0], draw(*asked[1:])))
