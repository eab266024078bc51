"""Prove that a map cannot be lost: kill runs, break them off, read sessions while they end; then resume and compare.

    python tools/kill_proof.py SOURCE [--end S] [--config NAME] [--parts kills errors readers overhead] [--kills N]
        [--errors M] [--readers R] [--pairs P] [--seed S] [--keep FILE] [--json]

Each run is a process of its own, one after the other. A kill comes at a random moment of the CPU time of an unbroken run. An
error is, in turn, a message that is damaged, a back-end that crashes, and a disk that is full (a small one is mounted, or where
that is not allowed the size of files is limited). Afterwards every node that a reader saw, or that was committed, must be in
the map as in an unbroken one, and the resumed run must end with the same tables, trajectories and hash.

Its CPU time, less that of an unbroken run up to its first view, is held against what was missing: the CPU time of an unbroken
run less that of the run that died. As the speed of a machine changes, an unbroken run is timed anew every few trials. With
readers, up to ten processes read a session until after its end. `overhead` maps with and without checkpoints in turn.

`--keep FILE` appends each trial to a file as a line of JSON; the trials that are in it are not made again. `--json` prints
the figures as one object.
"""

from __future__ import annotations

import argparse
import json
import os
import resource
import shutil
import signal
import subprocess
import sys
import time
from contextlib import suppress
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

import numpy as np
from barred import at_least, at_most
from killing import PAUSE_S, Case, Ended, contents, kept, kill_at, read_on, small_disk, start, wait

from hybridmap import checkpoints
from hybridmap.backends.ensemble import Ensemble
from hybridmap.cli.show import emit
from hybridmap.errors import BackendError, StreamError
from hybridmap.metrics import Metric

MOST_RATIO = 1.15
"""CPU time of all resumed runs, in units of what was missing."""
MOST_OVERHEAD = 1.05
"""CPU time with checkpoints, in units of that without."""
MOST_READERS = 10
PARTS = {"kills": 20, "errors": 10, "readers": 20, "overhead": 5}
"""Part of the proof -> number of trials."""
_TIMED_EVERY = 8  # trials after which an unbroken run is timed
_TIMES = 3  # timings before the first trial; the mean of the last ones is used: on a busy machine one may take twice as long
_ATTEMPTS = 5  # for each trial: a run may come to its end before it dies
Trial = dict[str, Any]


class Proof:
    """Makes the trials of one case, and keeps them."""

    def __init__(self, case: Case, place: Path, seed: int, keep: Path | None) -> None:
        """Map once without a break, to compare with, and read the trials that were kept."""
        self._case, self._place, self._seed, self._keep = case, place, seed, keep
        self._times: list[tuple[float, float]] = []
        self._whole: dict[str, Any] = {}
        self._bytes = 0
        self.trials: list[Trial] = []
        if keep is not None and keep.exists():
            self.trials = [json.loads(line) for line in keep.read_text().splitlines()]

    def of(self, part: str) -> list[Trial]:
        """The trials of a part."""
        return [trial for trial in self.trials if trial["part"] == part]

    def make(self, part: str, count: int) -> None:
        """Make the trials of a part that are lacking."""
        trial = {"kills": self._kill, "errors": self._error, "readers": self._readers, "overhead": self._overhead}[part]
        for number in range(_ATTEMPTS * count):
            if len(self.of(part)) >= count:
                return
            if number in {kept_one["number"] for kept_one in self.of(part)}:
                continue
            timed = part in ("kills", "errors")
            again = timed and number % _TIMED_EVERY == 0
            for _ in range(max((_TIMES if timed else 1) - len(self._times), int(again))):
                self._time()
            with TemporaryDirectory(dir=self._place) as folder:
                found = trial(Path(folder) / "s", number, np.random.default_rng([self._seed, list(PARTS).index(part), number]))
            if found is not None:
                self._note({"part": part, "number": number, **found})

    def _note(self, trial: Trial) -> None:
        self.trials.append(trial)
        print(json.dumps(trial), file=sys.stderr, flush=True)
        if self._keep is not None:
            with self._keep.open("a") as file:
                file.write(json.dumps(trial) + "\n")

    def _time(self) -> None:
        """Map without a break."""
        out = self._place / "whole"
        shutil.rmtree(out, ignore_errors=True)
        process, most = self._case.start(out, lambda: self._case.run(out)), 0
        while os.waitid(os.P_PID, process, os.WEXITED | os.WNOHANG | os.WNOWAIT) is None:
            with suppress(FileNotFoundError):
                most = max(most, sum(path.stat().st_size for path in out.glob("map.db*")))
            time.sleep(PAUSE_S)
        ended = wait(process, out)
        if ended.code:
            raise SystemExit(f"the unbroken run failed: {ended.said}")
        self._times.append((self._case.followed.begun_s, ended.cpu_s))
        self._whole, self._bytes = self._whole or contents(out), self._bytes or most

    def _unbroken(self) -> tuple[float, float]:
        """CPU time of an unbroken run up to its first view, and in all, as of late, s."""
        begun_s, whole_s = np.mean(self._times[-2 * _TIMES :], axis=0).tolist()
        return begun_s, whole_s

    def _kill(self, out: Path, number: int, rng: np.random.Generator) -> Trial | None:
        """Kill a run at a random moment between the first view and the end, and resume it."""
        del number
        at_s = float(rng.uniform(*self._unbroken()))
        process = self._case.start(out, lambda: self._case.run(out))
        seen = kill_at(process, at_s, out)
        died = wait(process, out)
        if died.code == 0:
            return None
        lost = bool(seen) and not kept(out, seen, self._whole)
        return {"at_s": at_s, "seen": seen, "lost": lost, **self._resumed(out, died)}

    def _error(self, out: Path, number: int, rng: np.random.Generator) -> Trial | None:
        """Break a run off by an error late in the drive, and resume it."""
        kind, share = ("message", "back-end", "disk")[number % 3], float(rng.uniform(0.5, 0.98))
        out.mkdir()
        with small_disk(out, int(share * self._bytes) if kind == "disk" else 0) as full:

            def work() -> None:
                if kind == "disk" and not full:
                    resource.setrlimit(resource.RLIMIT_FSIZE, (int(share * self._bytes) // 2, resource.RLIM_INFINITY))
                self._broken(out, kind, share)

            died = wait(self._case.start(out, work), out)
            if died.code == 0:
                return None
            if full:
                subprocess.run(["mount", "-o", "remount,size=100%", str(out)], check=True)
            lines = [line for line in died.said.splitlines() if line.startswith("hybridmap: error: ")]
            clear = died.code == 2 and len(lines) == 1
            lost, unclear = not kept(out, 1, self._whole), not clear
            return {"kind": kind, "said": lines[-1:], "lost": lost, "unclear": unclear, **self._resumed(out, died)}

    def _broken(self, out: Path, kind: str, share: float) -> None:
        """Map with an error after a share of the drive."""
        if kind == "message":
            samples, last = checkpoints.Drive.samples, share * len(self._whole["track"])

            def damaged(drive: checkpoints.Drive, stream: Any) -> Any:
                for sample in samples(drive, stream):
                    if drive.taken > last:
                        raise StreamError(f"{self._case.source}: message {drive.taken} is damaged")
                    yield sample

            checkpoints.Drive.samples = damaged  # type: ignore[method-assign, assignment]
        elif kind == "back-end":
            update, most = Ensemble.update, share * len(self._whole["nodes"])

            def crashing(ensemble: Ensemble, graph: Any) -> None:
                if graph.n_nodes > most:
                    raise BackendError(f"{ensemble.primary}: crashed at node {graph.n_nodes}")
                update(ensemble, graph)

            Ensemble.update = crashing  # type: ignore[method-assign, assignment]
        self._case.run(out)

    def _resumed(self, out: Path, died: Ended) -> Trial:
        """Resume a run that died, and compare; right after the death, as how far it came is asked for."""
        followed, (begun_s, whole_s) = self._case.followed, self._unbroken()
        reached = followed.newest
        ended = wait(self._case.start(out, lambda: self._case.run(out, resume=True)), out)
        differs = ended.code != 0 or contents(out) != self._whole
        return {
            "differs": differs,
            "anew": "from the beginning" in ended.said,
            "said_resumed": ended.said.splitlines()[-3:] if differs else [],
            "spent_s": ended.cpu_s - begun_s,
            "missing_s": whole_s - died.cpu_s,
            "begun_s": begun_s,
            "begun_resumed_s": followed.begun_s,
            "reached": reached,
            "again": max(0, reached + 1 - followed.first) if followed.first else 0,
        }

    def _readers(self, out: Path, number: int, rng: np.random.Generator) -> Trial:
        """Map with 1 to `MOST_READERS` processes that read the session until after its end."""
        del number
        process = self._case.start(out, lambda: self._case.run(out))
        seeds = rng.integers(0, 2**31, int(rng.integers(1, MOST_READERS + 1))).tolist()
        reading = [start(lambda seed=seed: read_on(out, seed), out.with_suffix(".read")) for seed in seeds]  # type: ignore[misc]
        ended = wait(process, out)
        if ended.code:
            for one in reading:
                os.kill(one, signal.SIGKILL)
        failed = sum(wait(one, out).code != 0 for one in reading)
        lost = ended.code != 0 or contents(out) != self._whole
        return {"readers": len(reading), "lost": lost, "failed": failed, "said": ended.said.splitlines()[-3:] if lost else []}

    def _overhead(self, out: Path, number: int, rng: np.random.Generator) -> Trial:
        """Map with checkpoints and without, in an order that changes."""
        del rng
        spent = {}
        for wanted in (True, False) if number % 2 else (False, True):
            target = out.with_name(f"s{wanted}")

            def work(target: Path = target, wanted: bool = wanted) -> None:
                if not wanted:
                    checkpoints.Checkpoints.follow = checkpoints.Checkpoints.at_the_end = _nothing  # type: ignore[method-assign, assignment]
                self._case.run(target)

            ended = wait(self._case.start(target, work), target)
            spent[wanted] = ended.cpu_s
        return {"with_s": spent[True], "without_s": spent[False]}


def _nothing(*_: Any) -> None:
    pass


def rows(part: str, trials: list[Trial]) -> list[Metric]:
    """The figures of a part."""
    if part == "overhead":
        ratio = sum(trial["with_s"] for trial in trials) / max(sum(trial["without_s"] for trial in trials), 1e-9)
        return [at_most(part, ratio, MOST_OVERHEAD, f"CPU time with checkpoints over that without, {len(trials)} pairs")]
    count = {name: sum(trial.get(name, 0) for trial in trials) for name in ("lost", "differs", "unclear", "anew", "failed")}
    if part == "readers":
        return [
            at_most(f"{part}/lost", count["lost"], 0, f"of {len(trials)} sessions that were read while they ended"),
            at_most(f"{part}/failed", count["failed"], 0, f"of {sum(trial['readers'] for trial in trials)} readers failed"),
        ]
    spent_s, missing_s = (sum(trial[name] for trial in trials) for name in ("spent_s", "missing_s"))
    ratios = [trial["spent_s"] / max(trial["missing_s"], 1e-9) for trial in trials]
    begin_s = float(
        np.median([trial["begun_resumed_s"] - trial["begun_s"] for trial in trials if trial["begun_resumed_s"]] or [0.0])
    )
    again = sum(trial["again"] for trial in trials) / max(sum(trial["reached"] for trial in trials), 1)
    return [
        at_least(f"{part}/runs", len(trials), 1, "runs that died"),
        at_most(f"{part}/lost", count["lost"], 0, "of them lost a committed node, or are damaged"),
        at_most(f"{part}/differing", count["differs"], 0, "of them, resumed, differ from the unbroken run"),
        at_most(f"{part}/unclear", count["unclear"], 0, "of them did not end with one line and exit code 2"),
        Metric(f"{part}/begun_anew", float(count["anew"]), "1", "of them had no checkpoint yet"),
        at_most(
            f"{part}/cpu_ratio",
            spent_s / max(missing_s, 1e-9),
            MOST_RATIO,
            "CPU time of all resumed runs over what was missing",
        ),
        Metric(f"{part}/cpu_ratio_median", float(np.median(ratios)), "1", "median of the single runs"),
        Metric(f"{part}/views_again", again, "1", "share of the views of the runs that died which were taken in again"),
        Metric(f"{part}/start", begin_s, "s", "CPU time up to the first view, less that of an unbroken run, median"),
    ]


def main() -> None:
    """Do what the command line asks for, print the figures, and exit with 1 if one misses its bar."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("source", help="recording or simulated world")
    parser.add_argument("--config", help="configuration, as for `hybridmap map`")
    parser.add_argument("--end", type=float, help="map only so many seconds")
    parser.add_argument("--parts", nargs="+", choices=PARTS, default=list(PARTS), help="parts of the proof")
    for part, option in zip(PARTS, ("kills", "errors", "readers", "pairs"), strict=True):
        parser.add_argument(f"--{option}", dest=part, type=int, default=PARTS[part], help="number of trials")
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--keep", type=Path, help="file of the trials")
    parser.add_argument("--json", action="store_true")
    given = parser.parse_args()
    found: list[Metric] = []
    with TemporaryDirectory() as folder:
        proof = Proof(Case(given.source, given.config, given.end), Path(folder), given.seed, given.keep)
        for part in given.parts:
            proof.make(part, getattr(given, part))
            found += rows(part, proof.of(part)) if proof.of(part) else []
    emit({}, found, as_json=given.json, title=f"{given.source}: runs that died, and readers")
    sys.exit(any(row.passed is False for row in found))


if __name__ == "__main__":
    main()
