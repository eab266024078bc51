"""Where a robot that is driving is on a finished map, which stays as it is; looked for in a process of its own.

The drive is mapped as ever. Again and again its map so far is joined to the finished one, as `sessions.localizing` does it for
a drive that is over.
"""

from __future__ import annotations

import sys
import threading
from collections.abc import Callable
from contextlib import suppress
from dataclasses import replace
from multiprocessing.connection import Connection
from pathlib import Path
from typing import Any

from hybridmap.errors import HybridMapError, LiveError
from hybridmap.geometry import Array, compose, inverse
from hybridmap.graph.experience_map import ExperienceMap
from hybridmap.live.process import PipedProcess
from hybridmap.sessions.joining import config_of, require_sensors
from hybridmap.sessions.joint_map import JointMap
from hybridmap.sessions.localizing import on_map
from hybridmap.sessions.part import Part
from hybridmap.store import MapStore

FIRST_NODES = 5
"""Nodes of the drive at the first search."""
GROWTH = 1.25
"""A search costs as much as the drive has nodes, so the next one comes when they are so many times more: all searches together
cost no more than five times the last one."""


class Locator:
    """Looks for a drive on a finished map while it goes on.

    Attributes:
        base: session folder of the finished map.
        pose_base_map: (3,) pose of the map of the drive in the frame of the finished one, m and rad; None while unknown.
        error: why the search has ended; None while it goes on.
    """

    def __init__(self, base: Path, out: Path, poses: Callable[[], Array]) -> None:
        """Start.

        Args:
            base: session folder of the finished map.
            out: session folder of the drive.
            poses: gives the poses (N, 3) of the nodes of the drive so far, m and rad.

        Raises:
            StoreError: the map is missing, damaged or not finished, or of other sensors.
        """
        require_map(base)
        with MapStore.open(base) as known, MapStore.open(out) as drive:
            require_sensors(known, drive.rig, "the drive")
        self.base = base
        self.pose_base_map: Array | None = None
        self.error: HybridMapError | None = None
        self._folders, self._poses = (base, out), poses
        self._guess: Array | None = None
        self._news, self._ended = threading.Event(), False
        self._process = PipedProcess("hybridmap.live.locating", yields=True)
        threading.Thread(target=self._run, name="hybridmap-locate", daemon=True).start()

    def look(self) -> None:
        """There may be new nodes."""
        self._news.set()

    def guess(self, pose_base_map: Array) -> None:
        """Look at once, and first where the map of the drive is said to be, (3,) m and rad; believed only if views agree."""
        self._guess = pose_base_map
        self._news.set()

    def close(self) -> None:
        """End the search."""
        self._ended = True
        self._news.set()
        self._process.close()

    def _run(self) -> None:
        wanted = FIRST_NODES
        while not self._ended:
            self._news.wait()
            self._news.clear()
            poses = self._poses()
            guess = self._guess
            if self._ended or len(poses) < (wanted if guess is None else 1):
                continue
            wanted, self._guess = int(GROWTH * len(poses)) + 1, None
            self._process.send([(*self._folders, poses, guess)])
            try:
                found = self._process.pipe.recv()
            except (EOFError, OSError):
                found = LiveError(f"the process that looks for the robot ended {self._process.end()}")
            if isinstance(found, HybridMapError):
                self.error, self._ended = None if self._ended else found, True
                return
            if found is not None or guess is None:  # too few views, or a wrong guess, are no reason to give a place up
                self.pose_base_map = found


def require_map(base: Path) -> None:
    """Check that a robot can be looked for on the map of a session folder.

    Raises:
        StoreError: the map is missing, damaged or not finished.
    """
    with MapStore.open(base) as known:
        Part.of(known)


def locate(base: Path, out: Path, poses: Array, guess: Array | None = None) -> Array | HybridMapError | None:
    """(3,) pose of the map of a drive in the frame of a finished one, m and rad; None if it is not found.

    Args:
        base: session folder of the finished map.
        out: session folder of the drive, which may go on.
        poses: (N, 3) of its first nodes, m and rad.
        guess: (3,) where the map of the drive may be, m and rad; None: nothing is known.
    """
    try:
        with MapStore.open(base) as known, MapStore.open(out) as drive:
            config = config_of(known)
            joint = JointMap(config, known.rig)
            joint.take_up(Part.of(known))
            nodes = joint.take_up(Part("the drive", _first(drive.map(), len(poses)), poses, drive.keyframe, drive.state))
            if joint.join(nodes, guess) is None:
                return None
            there, sure = on_map(joint, nodes, config)
    except HybridMapError as error:
        return error
    newest = int(sure.nonzero()[0][-1]) if sure.any() else len(poses) - 1
    return compose(there[newest], inverse(poses[newest]))


def _first(experiences: ExperienceMap, count: int) -> ExperienceMap:
    """The first nodes of a map, and the edges between them."""
    first = ExperienceMap()
    for number in range(count):
        first.add_node(experiences.node(number), experiences.initial[number])
    for edge in experiences.edges:
        if max(edge.source, edge.target) < count:
            first.add_edge(replace(edge, since_node=min(edge.since_node, count - 1)))
    return first


def main() -> None:
    """Search as asked for through the pipe whose number is the first argument, until it is closed."""
    pipe = Connection(int(sys.argv[1]))
    with suppress(EOFError, OSError):
        while True:
            asked: tuple[Any, ...] = pipe.recv()
            pipe.send(locate(*asked))
