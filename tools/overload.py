"""A machine that is too slow: a process is slowed down, and its map held against that of the recording."""

from __future__ import annotations

import json
import os
import signal
import subprocess
import sys
import threading
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from pathlib import Path

LAG_S = 2.0
"""Bar: no view lags by more."""
ERROR_RATIO = 2.0
"""Bar: the error of the map is at most so many times that of the recording's."""
_TURN_S = 0.01
_EVALUATE = (sys.executable, "-c", "from hybridmap.cli import main; main()", "evaluate")


def figures(session: Path, reference: Path | None = None) -> dict[str, float]:
    """Name -> value of the figures of a session; with the errors against a reference trajectory."""
    if reference is not None:
        more = [*_EVALUATE, str(session), "--reference", str(reference), "--json"]
        subprocess.run(more, check=True, stdout=subprocess.DEVNULL)
    metrics = json.loads((session / "metrics.json").read_text())["metrics"]
    return {one["name"]: float(one["value"]) for one in metrics if one["value"] is not None}


def error_m(session: Path, reference: Path) -> float:
    """Absolute trajectory error of a session (RMSE), m, by its primary back-end."""
    primary = json.loads((session / "metrics.json").read_text())["primary_backend"]
    return figures(session, reference)[f"ate_rmse/{primary}"]


def slowness(session: Path, rate: float, overload: float) -> float:
    """How many times slower a process must be, so that it needs `overload` times the time that a drive takes.

    Args:
        session: of the whole drive; says how much CPU time mapping needs. Recording comes on top, so the overload is larger.
        rate: times real time at which the drive is played.
        overload: 3: the machine is three times too slow.
    """
    found = figures(session)
    return max(1.0, overload * found["duration"] / rate / found["cpu_s/mapping"])


@contextmanager
def slowed(pid: int, times: float) -> Iterator[None]:
    """Hold a process still after each short turn, so long that it is so many times slower for the CPU time that it uses."""
    ended = threading.Event()
    thread = threading.Thread(target=_hold, args=(pid, times, ended))
    if times > 1.0:
        thread.start()
    try:
        yield
    finally:
        ended.set()
        if times > 1.0:
            thread.join()


def _hold(pid: int, times: float, ended: threading.Event) -> None:
    before_s = _cpu_s(pid)
    while not ended.wait(_TURN_S):
        try:
            now_s = _cpu_s(pid)
            os.kill(pid, signal.SIGSTOP)
            ended.wait((times - 1.0) * (now_s - before_s))
            before_s = now_s
        except OSError:
            return
        finally:
            with suppress(OSError):
                os.kill(pid, signal.SIGCONT)


def _cpu_s(pid: int) -> float:
    """CPU time of all threads of a process, s."""
    return sum(int(path.read_text().split()[0]) for path in Path(f"/proc/{pid}/task").glob("*/schedstat")) / 1e9
