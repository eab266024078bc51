"""Runs that are followed, killed and read from outside, for `kill_proof.py`."""

from __future__ import annotations

import mmap
import os
import signal
import sqlite3
import subprocess
import sys
import time
from collections.abc import Callable, Iterator
from contextlib import closing, contextmanager, suppress
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from hybridmap import session
from hybridmap.cli.choose import choose
from hybridmap.errors import HybridMapError, StoreError
from hybridmap.mapper import Mapper
from hybridmap.store import MapStore

PAUSE_S = 0.005
"""Between two looks at a process, s."""
_TICK_S = 1.0 / os.sysconf("SC_CLK_TCK")


class Followed:
    """What a run says of itself to the process that started it: its first and newest view, and its CPU time at the first."""

    def __init__(self) -> None:
        self._values = np.frombuffer(mmap.mmap(-1, 24), dtype=np.float64)

    def clear(self) -> None:
        """Before a run."""
        self._values[:] = 0.0

    def progress(self, done: int, total: int | None) -> None:
        """Take note of a view."""
        del total
        if not self._values[0]:
            self._values[:] = done, done, time.process_time()
        self._values[1] = done

    @property
    def first(self) -> int:
        """Number of the first view that was taken in, from 1."""
        return int(self._values[0])

    @property
    def newest(self) -> int:
        """Number of the newest one."""
        return int(self._values[1])

    @property
    def begun_s(self) -> float:
        """CPU time up to the first one, s."""
        return float(self._values[2])


class Case:
    """What is mapped. The source is opened, and compiled code loaded, once for all processes that `start` begins."""

    def __init__(self, source: str, config: str | None, end_s: float | None) -> None:
        """Open the source."""
        self.source, self.followed = source, Followed()
        self._chosen = choose(source, config, {}, end_s=end_s)
        Mapper(self._chosen.config, self._chosen.stream.rig)

    def run(self, out: Path, *, resume: bool = False) -> None:
        """Map it into a session folder."""
        session.run(self._chosen.stream, self._chosen.config, out, resume=resume, progress=self.followed.progress)

    def start(self, out: Path, work: Callable[[], None]) -> int:
        """Begin a run in a process of its own; returns its number."""
        self.followed.clear()
        return start(work, log_of(out))


@dataclass(frozen=True, slots=True)
class Ended:
    """How a process ended: its exit code (negative: the signal), CPU time in s, and what it said on standard error."""

    code: int
    cpu_s: float
    said: str


def log_of(out: Path) -> Path:
    """The file of what a run says."""
    return out.with_suffix(".log")


def start(work: Callable[[], None], log: Path) -> int:
    """Run something in a process of its own; returns its number. An error of ours gives one line and exit code 2."""
    number = os.fork()
    if number:
        return number
    code = 1
    try:
        handle = os.open(log, os.O_WRONLY | os.O_CREAT | os.O_TRUNC)
        os.dup2(handle, 1)
        os.dup2(handle, 2)
        work()
        code = 0
    except HybridMapError as error:
        print(f"hybridmap: error: {error}", file=sys.stderr, flush=True)
        code = 2
    finally:
        os._exit(code)


def wait(number: int, out: Path) -> Ended:
    """Wait for a process."""
    _, status, used = os.wait4(number, 0)
    log = log_of(out)
    return Ended(os.waitstatus_to_exitcode(status), used.ru_utime + used.ru_stime, log.read_text() if log.exists() else "")


def kill_at(number: int, cpu_s: float, out: Path) -> int:
    """Kill a process once it has used so much CPU time; returns how many nodes a reader saw just before."""
    while True:
        fields = Path(f"/proc/{number}/stat").read_text().rpartition(")")[2].split()
        if fields[0] == "Z" or (int(fields[11]) + int(fields[12])) * _TICK_S >= cpu_s:
            break
        time.sleep(PAUSE_S)
    seen = 0
    with suppress(StoreError), MapStore.open(out) as store:
        seen = store.nodes
    os.kill(number, signal.SIGKILL)
    return seen


def contents(out: Path) -> dict[str, Any]:
    """All that a session holds, but for the times that it took."""
    found: dict[str, Any] = {}
    with closing(sqlite3.connect(out / "map.db")) as connection:
        for (table,) in connection.execute("SELECT name FROM sqlite_master WHERE type = 'table'").fetchall():
            columns = [row[1] for row in connection.execute(f"PRAGMA table_info({table})") if row[1] != "report"]
            found[table] = sorted(connection.execute(f"SELECT {', '.join(columns)} FROM {table}").fetchall(), key=repr)
    return found | {path.name: path.read_bytes() for path in sorted((out / "trajectory").iterdir())}


def kept(out: Path, seen: int, whole: dict[str, Any]) -> bool:
    """Whether a session that did not end is sound and has the nodes of the whole one, as many as were seen or more."""
    with MapStore.open(out) as store:
        store.check()
        nodes, stamps = store.nodes, [row[0] for row in store.rows("SELECT stamp_ns FROM nodes ORDER BY number")]
        arrays = store.rows("SELECT * FROM arrays WHERE part = 'keyframe' ORDER BY 1, 2, 3")
    expected = [row for row in sorted(whole["arrays"]) if row[1] == "keyframe" and row[0] < nodes]
    all_stamps = [row[1] for row in sorted(whole["nodes"])]
    return seen <= nodes == len(stamps) and stamps == all_stamps[:nodes] and arrays == expected


@contextmanager
def small_disk(folder: Path, size: int) -> Iterator[bool]:
    """Context in which a folder is a disk of its own of so many bytes, if that is wanted (size > 0) and allowed."""
    command = ["mount", "-t", "tmpfs", "-o", f"size={size}", "tmpfs", str(folder)]
    mounted = size > 0 and subprocess.run(command, check=False, capture_output=True).returncode == 0
    try:
        yield mounted
    finally:
        if mounted:
            subprocess.run(["umount", "--lazy", str(folder)], check=True)


def read_on(out: Path, seed: int) -> None:
    """Read a session again and again from its first node until after its end, with one connection that stays open."""
    rng, standing, ended = np.random.default_rng(seed), None, False
    while not ended:
        time.sleep(float(rng.uniform(0.02, 0.4)))
        with suppress(StoreError):
            standing = standing or MapStore.open(out)
            standing.rows("SELECT COUNT(*) FROM track")
            with MapStore.open(out) as store:
                ended = store.ended
                store.map()
