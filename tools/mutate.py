"""Feed spoilt files of every kind to the commands that read them, and count what no bad input may cause.

    python tools/mutate.py --kind mcap --count 1000 --seed 0

A valid file is made by the simulator, spoilt in a reproducible way, and read by the command line in a process with limits.
Counted are tracebacks (any exception that is no error of hybridmap), more than 10 CPU s, more than 1 GB of memory, and files
outside the output folder. Exit code 1 if there was any. `--only NUMBER` repeats one case and shows what it printed.
"""

from __future__ import annotations

import argparse
import io
import json
import os
import resource
import shutil
import sys
import tempfile
import time
import traceback
from collections import Counter
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from mutation_kinds import KINDS, OUT, Arguments, Kind, hybridmap, valid_of

CPU_S, MEMORY_BYTES = 10.0, 1 << 30
_HARD_CPU_S, _HARD_MEMORY_BYTES = 15, 3 << 30
_EXIT_CODES = (0, 1, 2, 3)  # done; done with a result that is bad; refused; done with losses under --strict
_BATCH = 100  # cases of one process
_PAGES = 0.05  # share of the mapped recordings that get their page: it takes the most time, and reads no recording


@dataclass(frozen=True)
class Outcome:
    """What one case did.

    Attributes:
        number: number of the case.
        what: how the file was spoilt.
        command: the last command that was run.
        codes: exit codes of its commands.
        finding: what no input may cause; empty if nothing was wrong.
        detail: where it came from.
    """

    number: int
    what: str
    command: str
    codes: tuple[int, ...]
    finding: str = ""
    detail: str = ""


def run_case(kind: Kind, number: int, seed: int, root: Path, *, show: bool = False) -> Outcome:
    """Spoil one file and read it, in a folder of its own below `root`."""
    rng = np.random.default_rng([seed, number])
    case = root / f"case-{number}" / "in"
    shutil.copytree(valid_of(case), case)
    os.chdir(case)
    what = kind.spoil(case, rng)
    commands = kind.commands(case, rng)
    if not {"map", "study"} & {command[0] for command in commands}:  # these make their output folder themselves
        (case / OUT).mkdir()
    before = _listing(case.parent)
    codes: list[int] = []
    arguments: Arguments = []
    try:
        for arguments in commands:
            code, finding, detail = _measured(arguments, show=show, page=bool(rng.random() < _PAGES))
            codes.append(code)
            strays = sorted(_listing(case.parent) - before)
            if not finding and strays:
                finding, detail = "stray file", ", ".join(strays)
            if finding:
                return Outcome(number, what, " ".join(arguments), tuple(codes), finding, detail)
        return Outcome(number, what, " ".join(arguments), tuple(codes))
    finally:
        os.chdir(root)
        shutil.rmtree(case.parent, ignore_errors=True)


def _listing(folder: Path) -> set[str]:
    """Files and folders outside the output folder, without what `evaluate` and SQLite keep in a session that they read."""
    every = (str(path.relative_to(folder)) for path in folder.rglob("*"))
    return {name for name in every if not name.startswith(f"in/{OUT}") and not name.endswith(("-wal", "-shm", "metrics.json"))}


def _measured(arguments: Arguments, *, show: bool, page: bool) -> tuple[int, str, str]:
    """Exit code of a command, what it did that it must not, and where."""
    started_s, base = time.process_time(), _memory("VmRSS")
    _forget_peak()
    code, detail, finding = 0, "", ""
    with _caught(show) as said, _without_page(page or arguments[0] != "map"):
        try:
            code = hybridmap(*arguments)
        except BaseException as error:  # noqa: BLE001  that is what is looked for
            finding, detail = "traceback", _place(error)
            if show:
                traceback.print_exc(file=sys.__stderr__)
    used_s, grown = time.process_time() - started_s, _memory("VmHWM") - base
    text = said.getvalue().decode("utf-8", "replace")
    if not finding and code not in _EXIT_CODES:
        finding, detail = "exit code", str(code)
    if not finding and code == 2 and text.count("hybridmap: error:") != 1:
        finding, detail = "no message", text[-300:]
    if not finding and used_s > CPU_S:
        finding, detail = "time", f"{used_s:.0f} CPU s"
    if not finding and (grown > MEMORY_BYTES or "not enough memory" in text):
        finding, detail = "memory", f"{grown / 1e9:.1f} GB; {text[-200:]}"
    if not finding and "Warning:" in text:
        finding, detail = "(warning)", next(line for line in text.splitlines() if "Warning:" in line)
    return code, finding, detail


def _place(error: BaseException) -> str:
    """The error and the last line of ours that it came through."""
    frames = traceback.extract_tb(error.__traceback__)
    ours = [frame for frame in frames if "/hybridmap/" in frame.filename]
    at = (ours or frames)[-1]
    return f"{Path(at.filename).name}:{at.lineno} {at.name}: {type(error).__name__}: {' '.join(str(error).split())[:120]}"


class _Kept(io.BytesIO):
    """What was printed; it stays when the stream around it is closed."""

    def close(self) -> None:
        pass


@contextmanager
def _caught(show: bool) -> Iterator[io.BytesIO]:
    """Take what is printed; a name that is not UTF-8 is refused by standard output, as on a terminal."""
    said, printed, out, err = _Kept(), _Kept(), sys.stdout, sys.stderr
    sys.stdout = io.TextIOWrapper(printed, "utf-8", errors="strict", write_through=True)
    sys.stderr = io.TextIOWrapper(said, "utf-8", errors="backslashreplace", write_through=True)
    try:
        yield said
    finally:
        if show:
            print(printed.getvalue().decode("utf-8", "replace")[-3000:], said.getvalue().decode(), file=out)
        sys.stdout, sys.stderr = out, err


@contextmanager
def _without_page(page: bool) -> Iterator[None]:
    import hybridmap.report as report

    whole = report.write_report
    if not page:
        report.write_report = lambda *_args, **_named: Path()
    try:
        yield
    finally:
        report.write_report = whole


def _memory(name: str) -> int:
    status = Path("/proc/self/status").read_text()
    return 1024 * int(status.split(f"{name}:")[1].split()[0])


def _forget_peak() -> None:
    Path("/proc/self/clear_refs").write_text("5")


# ---------------------------------------------------------------------- many cases


def run_all(kind: Kind, numbers: range, seed: int, root: Path) -> Iterator[Outcome]:
    """Run the cases in forked processes; one that dies counts for the case it was at."""
    todo = list(numbers)
    while todo:
        reading, writing = os.pipe()
        child = os.fork()
        if child == 0:
            os.close(reading)
            _work(kind, todo[:_BATCH], seed, root, writing)
        os.close(writing)
        done = 0
        with os.fdopen(reading) as lines:
            for line in lines:
                fields = json.loads(line)
                yield Outcome(**{**fields, "codes": tuple(fields["codes"])})
                done += 1
        _, status = os.waitpid(child, 0)
        if done < len(todo[:_BATCH]):
            died = f"the process ended with {os.waitstatus_to_exitcode(status)}"
            yield Outcome(todo[done], "", "", (), "died", died)
            done += 1
        todo = todo[done:]


def _work(kind: Kind, numbers: list[int], seed: int, root: Path, writing: int) -> None:
    quiet = os.open(os.devnull, os.O_WRONLY)
    os.dup2(quiet, 1)
    os.dup2(quiet, 2)
    with os.fdopen(writing, "w", buffering=1) as out:
        for number in numbers:
            used_s = int(time.process_time())
            resource.setrlimit(resource.RLIMIT_CPU, (used_s + _HARD_CPU_S, resource.RLIM_INFINITY))
            limit = _memory("VmSize") + _HARD_MEMORY_BYTES
            resource.setrlimit(resource.RLIMIT_AS, (limit, resource.RLIM_INFINITY))
            outcome = run_case(kind, number, seed, root)
            out.write(json.dumps(outcome.__dict__, default=str) + "\n")
    os._exit(0)


def main() -> int:
    """Run the cases of one kind, or of all; print what was found."""
    parser = argparse.ArgumentParser(description="Feed spoilt files to the commands that read them.")
    parser.add_argument("--kind", choices=[*KINDS, "all"], default="all")
    parser.add_argument("--count", type=int, default=100)
    parser.add_argument("--first", type=int, default=0, help="number of the first case")
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--valid", type=Path, help="folder that keeps the valid files for the next run")
    parser.add_argument("--only", type=int, help="repeat this case and show what it prints")
    arguments = parser.parse_args()
    for name in ("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "OPENCV_FOR_THREADS_NUM"):
        os.environ[name] = "1"
    chosen = list(KINDS) if arguments.kind == "all" else [arguments.kind]
    rows = []
    for name in chosen:
        with tempfile.TemporaryDirectory(prefix="mutate-") as place:
            root = Path(place)
            if arguments.valid is not None:
                (root / "valid").symlink_to(arguments.valid.resolve() / name)
            _prepare(KINDS[name], (root / "valid").resolve())
            if arguments.only is not None:
                print(run_case(KINDS[name], arguments.only, arguments.seed, root, show=True))
                continue
            started_s = time.monotonic()
            numbers = range(arguments.first, arguments.first + arguments.count)
            rows.append((name, _told(run_all(KINDS[name], numbers, arguments.seed, root)), time.monotonic() - started_s))
    columns = ("traceback", "time", "memory", "stray file", "exit code", "no message", "died", "(warning)")
    print("  ".join(["kind".ljust(9), "cases", "read", "refused", *columns, "s"]))
    for name, (counts, codes), took_s in rows:
        cells = [str(counts[column]).rjust(len(column)) for column in columns]
        read, total = codes[0] + codes[1] + codes[3], sum(counts.values())
        print(
            "  ".join([name.ljust(9), str(total).rjust(5), str(read).rjust(4), str(codes[2]).rjust(7), *cells, f"{took_s:.0f}"])
        )
    return int(any(counts[column] for _, (counts, _), _ in rows for column in columns if column[0] != "("))


def _told(outcomes: Iterator[Outcome]) -> tuple[Counter[str], Counter[int]]:
    """Count the findings and the last exit codes, and print each finding."""
    counts: Counter[str] = Counter()
    codes: Counter[int] = Counter()
    for outcome in outcomes:
        counts[outcome.finding] += 1
        codes[outcome.codes[-1] if outcome.codes else -1] += 1
        if outcome.finding:
            text = f"{outcome.number}: {outcome.finding}: {outcome.detail} | {outcome.what} | {outcome.command}"
            print(text.encode("utf-8", "backslashreplace").decode(), flush=True)
    return counts, codes


def _prepare(kind: Kind, valid: Path) -> None:
    """Write the valid files in a process of its own, and load what the cases need, so that none pays for it."""
    if not valid.exists():
        valid.mkdir(parents=True)
        child = os.fork()
        if child == 0:
            os.dup2(os.open(os.devnull, os.O_WRONLY), 1)
            kind.seed(valid)
            os._exit(0)
        os.waitpid(child, 0)
    import cv2
    import gtsam
    import matplotlib.pyplot
    import open3d
    import rosbags.rosbag1
    import rosbags.rosbag2
    import scipy.optimize

    import hybridmap.cli.app
    import hybridmap.session  # noqa: F401

    del cv2, gtsam, matplotlib, open3d, rosbags, scipy


if __name__ == "__main__":
    raise SystemExit(main())
