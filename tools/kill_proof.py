"""Prove that a map cannot be lost: kill runs, break them off, read sessions while they end; then resume and compare.

    python tools/kill_proof.py SOURCE [--end S] [--config NAME] [--kills N] [--errors M] [--readers R] [--seed S] [--json]

Each run is a process of its own. A kill comes at a random moment of the CPU time of an unbroken run. An error is, in turn, a
message that is damaged, a back-end that crashes, and a disk that is full (the size of files is limited). Afterwards every node
that a reader saw, or that was committed, must be in the map as in an unbroken one, and the resumed run must end with the same
tables, trajectories and hash. Its CPU time is held against what was missing: that of an unbroken run less that of the
run that died. With readers, up to ten processes read a session until after its end. `--json` prints the figures as one object.
"""

from __future__ import annotations

import argparse
import os
import resource
import signal
import sqlite3
import sys
import time
from collections.abc import Callable
from contextlib import suppress
from dataclasses import dataclass, field
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

import numpy as np
from barred import at_least, at_most

from hybridmap import checkpoints, session
from hybridmap.backends.ensemble import Ensemble
from hybridmap.cli.choose import choose
from hybridmap.cli.show import emit
from hybridmap.errors import BackendError, HybridMapError, StoreError, StreamError
from hybridmap.metrics import Metric
from hybridmap.store import MapStore

MOST_RATIO = 1.15
"""CPU time of all resumed runs, in units of what was missing."""
MOST_READERS = 10
_PAUSE_S = 0.005
_UNBROKEN = 3  # runs whose median is the time of an unbroken one: on a busy machine one may take twice as long
_TICK_S = 1.0 / os.sysconf("SC_CLK_TCK")


@dataclass(frozen=True, slots=True)
class Case:
    """What is mapped."""

    source: str
    config: str | None
    end_s: float | None

    def run(self, out: Path, *, resume: bool = False) -> None:
        """Map it into a session folder, and write beside it the CPU time up to its first observation."""
        chosen = choose(self.source, self.config, {}, end_s=self.end_s)

        def begun(done: int, total: int | None) -> None:
            del done, total
            if not _beside(out).exists():
                _beside(out).write_text(str(time.process_time()))

        session.run(chosen.stream, chosen.config, out, resume=resume, progress=begun)


@dataclass(frozen=True, slots=True)
class Ended:
    """How a process ended: its exit code (negative: the signal), CPU time in s, and what it said on standard error."""

    code: int
    cpu_s: float
    said: str


@dataclass(slots=True)
class Tally:
    """Counts of one kind of trial."""

    runs: int = 0
    lost: int = 0
    differing: int = 0
    unclear: int = 0
    begun_anew: int = 0
    spent_s: float = 0.0
    missing_s: float = 0.0
    ratios: list[float] = field(default_factory=list)

    @property
    def summary(self) -> str:
        """The newest run, and the counts so far, for progress."""
        return f"{self.ratios[-1]:.2f} x what was missing; of {self.runs} {self.lost} lost, {self.differing} differ"


def _beside(out: Path) -> Path:
    return out.with_suffix(".begun")


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


def wait(number: int, log: Path) -> Ended:
    """Wait for a process."""
    _, status, used = os.wait4(number, 0)
    return Ended(os.waitstatus_to_exitcode(status), used.ru_utime + used.ru_stime, log.read_text() if log.exists() else "")


def kill_at(number: int, cpu_s: float, out: Path) -> int:
    """Kill a process once it has used so much CPU time; returns how many nodes a reader saw just before."""
    while True:
        fields = Path(f"/proc/{number}/stat").read_text().rpartition(")")[2].split()
        if fields[0] == "Z" or (int(fields[11]) + int(fields[12])) * _TICK_S >= cpu_s:
            break
        time.sleep(_PAUSE_S)
    seen = 0
    with suppress(StoreError), MapStore.open(out) as store:
        seen = store.nodes
    os.kill(number, signal.SIGKILL)
    return seen


def contents(out: Path) -> dict[str, Any]:
    """All that a session holds, but for the times that it took."""
    found: dict[str, Any] = {}
    with sqlite3.connect(out / "map.db") as connection:
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


def resumed(case: Case, out: Path, whole: dict[str, Any], begun_s: float, missing_s: float, tally: Tally) -> None:
    """Resume a run that died, and compare."""
    _beside(out).unlink(missing_ok=True)
    log = out.with_suffix(".resumed")
    ended = wait(start(lambda: case.run(out, resume=True), log), log)
    tally.differing += ended.code != 0 or contents(out) != whole
    tally.begun_anew += "from the beginning" in ended.said
    spent_s = ended.cpu_s - begun_s
    tally.spent_s, tally.missing_s = tally.spent_s + spent_s, tally.missing_s + missing_s
    tally.ratios.append(spent_s / max(missing_s, 1e-9))


def unbroken(case: Case, place: Path) -> tuple[float, float]:
    """Map without a break, as often as it takes for fair times; returns the median CPU time to the first sample, and in all."""
    times = []
    for number in range(_UNBROKEN):
        out, log = place / f"whole{number}", place / f"whole{number}.log"
        cpu_s = wait(start(lambda out=out: case.run(out), log), log).cpu_s  # type: ignore[misc]
        times.append((float(_beside(out).read_text()), cpu_s))
    begun_s, whole_s = np.median(times, axis=0).tolist()
    return begun_s, whole_s


def kills(case: Case, place: Path, count: int, whole: dict[str, Any], times: tuple[float, float], rng: Any) -> Tally:
    """Kill runs at random moments between the first sample and the end, and resume them."""
    tally, (begun_s, whole_s) = Tally(), times
    for number in range(count):
        out, log = place / f"killed{number}", place / f"killed{number}.log"
        at_s = float(rng.uniform(begun_s, whole_s))
        process = start(lambda out=out: case.run(out), log)  # type: ignore[misc]
        seen = kill_at(process, at_s, out)
        ended = wait(process, log)
        if ended.code == 0:
            continue  # it was faster than the unbroken run
        tally.runs += 1
        if seen:
            tally.lost += not kept(out, seen, whole)
        resumed(case, out, whole, begun_s, whole_s - ended.cpu_s, tally)
        _say(f"kill {number} at {at_s:.2f} of {whole_s:.2f} s: {seen} nodes seen, {tally.summary}")
    return tally


def broken(case: Case, out: Path, kind: int, share: float, samples: int, nodes: int) -> None:
    """Map with an error late in the drive."""
    if kind == 0:
        whole_samples = checkpoints.Drive.samples

        def damaged(drive: checkpoints.Drive, stream: Any) -> Any:
            for sample in whole_samples(drive, stream):
                if drive.taken > share * samples:
                    raise StreamError(f"{case.source}: message {drive.taken} is damaged")
                yield sample

        checkpoints.Drive.samples = damaged  # type: ignore[method-assign, assignment]
    elif kind == 1:
        whole_update = Ensemble.update

        def crashing(ensemble: Ensemble, graph: Any) -> None:
            if graph.n_nodes > share * nodes:
                raise BackendError(f"{ensemble.primary}: crashed at node {graph.n_nodes}")
            whole_update(ensemble, graph)

        Ensemble.update = crashing  # type: ignore[method-assign, assignment]
    case.run(out)


def errors(
    case: Case, place: Path, count: int, whole: dict[str, Any], times: tuple[float, float], size: int, rng: Any
) -> Tally:
    """Break runs off by errors of three kinds late in the drive, and resume them."""
    tally, (begun_s, whole_s) = Tally(), times
    samples, nodes = len(whole["track"]), len(whole["nodes"])
    for number in range(count):
        out, log, kind, share = (
            place / f"broken{number}",
            place / f"broken{number}.log",
            number % 3,
            float(rng.uniform(0.5, 0.98)),
        )

        def work(out: Path = out, kind: int = kind, share: float = share) -> None:
            if kind == 2:
                resource.setrlimit(resource.RLIMIT_FSIZE, (int(share * size), resource.RLIM_INFINITY))
            broken(case, out, kind, share, samples, nodes)

        ended = wait(start(work, log), log)
        lines = [line for line in ended.said.splitlines() if line.startswith("hybridmap: error: ")]
        if ended.code == 0:
            continue
        tally.runs += 1
        tally.unclear += ended.code != 2 or len(lines) != 1
        tally.lost += not kept(out, 1, whole)
        resumed(case, out, whole, begun_s, whole_s - ended.cpu_s, tally)
        _say(f"error {number}: {lines[-1:]}, {tally.summary}")
    return tally


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


def readers(case: Case, place: Path, count: int, rng: Any) -> Tally:
    """Map with 1 to `MOST_READERS` processes that read the session until after its end."""
    tally, expected = Tally(), place / "alone"
    wait(start(lambda: case.run(expected), place / "alone.log"), place / "alone.log")
    whole = contents(expected)
    for number in range(count):
        out, log = place / f"read{number}", place / f"read{number}.log"
        process = start(lambda out=out: case.run(out), log)  # type: ignore[misc]
        seeds = rng.integers(0, 2**31, int(rng.integers(1, MOST_READERS + 1))).tolist()
        reading = [start(lambda seed=seed, out=out: read_on(out, seed), place / "reader.log") for seed in seeds]  # type: ignore[misc]
        ended = wait(process, log)
        tally.runs += 1
        tally.lost += ended.code != 0 or contents(out) != whole
        if ended.code:
            for one in reading:
                os.kill(one, signal.SIGKILL)
        tally.unclear += sum(wait(one, place / "reader.log").code != 0 for one in reading)
        _say(f"readers {number}: {len(reading)} of them, exit code {ended.code}")
    return tally


def rows(name: str, tally: Tally) -> list[Metric]:
    """The figures of runs that died."""
    found = [
        at_least(f"{name}/runs", tally.runs, 1, "runs that died"),
        at_most(f"{name}/lost", tally.lost, 0, "of them lost a committed node, or are damaged"),
        at_most(f"{name}/differing", tally.differing, 0, "of them, resumed, differ from the unbroken run"),
        at_most(f"{name}/unclear", tally.unclear, 0, "of them did not end with one line and exit code 2"),
        Metric(f"{name}/begun_anew", float(tally.begun_anew), "1", "of them had no checkpoint yet"),
    ]
    if tally.missing_s > 0.0:
        ratio, said = tally.spent_s / tally.missing_s, "CPU time of all resumed runs, in units of what was missing"
        found.append(at_most(f"{name}/cpu_ratio", ratio, MOST_RATIO, said))
        found.append(Metric(f"{name}/cpu_ratio_median", float(np.median(tally.ratios)), "1", "median of the single runs"))
    return found


def _say(line: str) -> None:
    print(line, file=sys.stderr, flush=True)


def main() -> None:
    """Do what the command line asks for, print the figures, and exit with 1 if one misses its bar."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("source", help="recording or simulated world")
    parser.add_argument("--config", help="configuration, as for `hybridmap map`")
    parser.add_argument("--end", type=float, help="map only so many seconds")
    for name, what in (
        ("kills", "runs that are killed"),
        ("errors", "runs with a late error"),
        ("readers", "runs with readers"),
    ):
        parser.add_argument(f"--{name}", type=int, default=0, help=what)
    parser.add_argument("--readers-end", type=float, default=30.0, help="seconds that are mapped with readers")
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--json", action="store_true")
    given = parser.parse_args()
    case, rng, found = Case(given.source, given.config, given.end), np.random.default_rng(given.seed), list[Metric]()
    with TemporaryDirectory() as folder:
        place = Path(folder)
        if given.kills or given.errors:
            out, times = place / "whole0", unbroken(case, place)
            whole = contents(out)
            found += rows("kills", kills(case, place, given.kills, whole, times, rng)) if given.kills else []
            size = (out / "map.db").stat().st_size
            found += rows("errors", errors(case, place, given.errors, whole, times, size, rng)) if given.errors else []
        if given.readers:
            tally = readers(Case(given.source, given.config, given.readers_end), place, given.readers, rng)
            found.append(at_most("readers/lost", tally.lost, 0, f"of {tally.runs} sessions that were read while they ended"))
            found.append(at_most("readers/failed", tally.unclear, 0, "readers that failed"))
    emit({}, found, as_json=given.json, title=f"{given.source}: runs that died, and readers")
    sys.exit(any(row.passed is False for row in found))


if __name__ == "__main__":
    main()
