"""Proof that a study's numbers owe nothing to how it was run: killed, resumed, spread over processes or a Dask cluster.

    python tools/study_proof.py
    python tools/study_proof.py --graph $HYBRIDMAP_DATA/posegraphs/intel.g2o --json

One study of at least 200 cells is run in one process; killed twice (SIGKILL) and gone on with; by two processes, one of
which is killed on the way; and by a Dask scheduler with two workers over loopback TCP, one of which is killed on the
way. Every table and the page must be the same, byte for byte. Exit code 1 where one is not.
"""

from __future__ import annotations

import argparse
import os
import signal
import socket
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from importlib.util import find_spec
from pathlib import Path

import yaml

from hybridmap.metrics import Metric, to_json

COMMAND = (sys.executable, "-P", "-c", "from hybridmap.cli import main; main()")
TABLES = ("cells.csv", "summary.csv", "metrics.json", "study.yaml", "report.html")
ONE_THREAD = {"OMP_NUM_THREADS": "1", "OPENBLAS_NUM_THREADS": "1", "HYBRIDMAP_QUIET": "1"}
PATIENCE_S = 900


def study(graph: Path | None, seeds: int) -> dict[str, object]:
    """24 cells a seed and graph, and as many without false loops as there are back-ends."""
    sources: list[dict[str, object]] = [{"name": "laps", "synthetic": {"nodes": 90, "per_lap": 30}}]
    if graph is not None:
        sources.append({"graph": str(graph.resolve()), "first_nodes": 300})
    backends: list[object] = ["gtsam-lm", "odometry", "relaxation-ratslam", "gtsam-cauchy", "gtsam-gnc"]
    backends.append({"name": "isam2, as driven", "backend": "gtsam-isam2", "way": "replay"})
    rates = {"rates": [0.0, 0.1, 0.4], "kinds": ["random", "aliased"]}
    return {"name": "proof", "seeds": seeds, "sources": sources, "backends": backends, "false_loops": rates}


def start(config: Path, out: Path, *options: str) -> subprocess.Popen[bytes]:
    """`hybridmap study` in a process of its own."""
    words = ["study", str(config), "--out", str(out), *options]
    return subprocess.Popen([*COMMAND, *words], env=os.environ | ONE_THREAD, stdout=subprocess.DEVNULL)


def known(out: Path) -> int:
    """Cells whose results are kept so far."""
    return len(list((out / "cells").glob("*/*.json")))


def wait_for(cells: int, out: Path, run: subprocess.Popen[bytes]) -> None:
    """Until so many cells are known; the run must still be at work then."""
    until = time.monotonic() + PATIENCE_S
    while known(out) < cells:
        if run.poll() is not None or time.monotonic() > until:
            raise SystemExit(f"{out}: the run ended or hung with {known(out)} cells before it could be interrupted at {cells}")
        time.sleep(0.01)


def finish(run: subprocess.Popen[bytes], out: Path) -> dict[str, bytes]:
    """The tables of a run that must end well."""
    if run.wait(PATIENCE_S) != 0:
        raise SystemExit(f"{out}: the run ended with exit code {run.returncode}")
    return {name: (out / name).read_bytes() for name in TABLES}


def killed_twice(config: Path, out: Path, cells: int) -> dict[str, bytes]:
    """Killed after a third and after two thirds of the cells, then left alone."""
    for part in (1, 2):
        run = start(config, out, "--workers", "0")
        wait_for(part * cells // 3, out, run)
        run.kill()
        run.wait()
        print(f"  killed with {known(out)} of {cells} cells known", file=sys.stderr)
    return finish(start(config, out, "--workers", "0"), out)


def two_workers(config: Path, out: Path, cells: int) -> dict[str, bytes]:
    """Two processes, one of them killed after a third of the cells."""
    run = start(config, out, "--workers", "2")
    wait_for(cells // 3, out, run)
    worker = workers_of(run.pid)[0]
    os.kill(worker, signal.SIGKILL)
    print(f"  killed worker {worker} with {known(out)} of {cells} cells known", file=sys.stderr)
    return finish(run, out)


def workers_of(pid: int) -> list[int]:
    """Processes that a run has spawned to work for it."""
    found = []
    for entry in Path("/proc").glob("[0-9]*"):
        try:
            parent = int((entry / "stat").read_text().rpartition(")")[2].split()[1])
            words = (entry / "cmdline").read_bytes()
        except OSError:  # it ended meanwhile
            continue
        if parent == pid and b"spawn_main" in words:
            found.append(int(entry.name))
    return sorted(found)


def dask(config: Path, out: Path, cells: int) -> dict[str, bytes]:
    """A scheduler and two workers, one of them killed after a third of the cells."""
    with cluster(2) as (address, workers):
        run = start(config, out, "--scheduler", address)
        wait_for(cells // 3, out, run)
        workers[0].kill()
        print(f"  killed Dask worker {workers[0].pid} with {known(out)} of {cells} cells known", file=sys.stderr)
        return finish(run, out)


@contextmanager
def cluster(count: int) -> Iterator[tuple[str, list[subprocess.Popen[bytes]]]]:
    """A Dask scheduler on a free port of the loopback interface, and workers of one thread without a nanny."""
    with socket.socket() as probe:
        probe.bind(("127.0.0.1", 0))
        address = f"tcp://127.0.0.1:{probe.getsockname()[1]}"
    tool = (sys.executable, "-m", "dask")
    port = address.rpartition(":")[2]
    with tempfile.TemporaryDirectory() as scratch:

        def started(*words: str) -> subprocess.Popen[bytes]:
            env, none = os.environ | ONE_THREAD, subprocess.DEVNULL
            return subprocess.Popen([*tool, *words], cwd=scratch, env=env, stdout=none, stderr=none)

        running = [started("scheduler", "--host", "127.0.0.1", "--port", port, "--no-dashboard")]
        worker = ("worker", address, "--nthreads", "1", "--no-nanny", "--no-dashboard", "--host", "127.0.0.1")
        running += [started(*worker) for _ in range(count)]
        try:
            require_workers(address, count)
            yield address, running[1:]
        finally:
            for process in reversed(running):
                process.kill()
                process.wait()


def require_workers(address: str, count: int) -> None:
    """Wait until all workers are there."""
    import distributed

    with distributed.Client(address, timeout="60s", set_as_default=False) as client:
        client.wait_for_workers(count, timeout=60)


def main() -> None:
    """Run the proof and say what came out."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--graph", type=Path, default=None, help="a g2o file, of which the first 300 nodes are studied too")
    parser.add_argument("--seeds", type=int, default=8, help="24 cells each on the made-up graph, and 6 without false loops")
    parser.add_argument("--json", action="store_true", help="one JSON object on standard output")
    chosen = parser.parse_args()
    with tempfile.TemporaryDirectory() as scratch:
        metrics = prove(Path(scratch), chosen.graph, chosen.seeds)
    if chosen.json:
        print(to_json({}, metrics))
    else:
        for metric in metrics:
            verdict = "" if metric.passed is None else "  kept" if metric.passed else "  MISSED"
            print(f"{metric.name:28} {metric.value:g} {metric.description}{verdict}")
    raise SystemExit(any(metric.passed is False for metric in metrics))


def prove(folder: Path, graph: Path | None, seeds: int) -> list[Metric]:
    """Run the study in every way; a figure each."""
    config = folder / "proof.yaml"
    config.write_text(yaml.safe_dump(study(graph, seeds)))
    print("in one process, left alone", file=sys.stderr)
    told = finish(start(config, folder / "alone", "--workers", "0"), folder / "alone")
    cells = told["cells.csv"].count(b"\n") - 1
    metrics = [Metric("study_cells", cells, "1", "cells; at least 200", 200, cells >= 200)]
    ways: dict[str, Callable[[Path, Path, int], dict[str, bytes]]] = {"killed_twice": killed_twice, "two_workers": two_workers}
    if find_spec("distributed"):
        ways["dask"] = dask
    else:
        print("dask: distributed is not installed: pip install 'hybridmap[cluster]'", file=sys.stderr)
    for name, way in ways.items():
        print(name.replace("_", " "), file=sys.stderr)
        other = way(config, folder / name, known(folder / "alone"))
        differing = [table for table in TABLES if other[table] != told[table]]
        what = f"tables that differ from the run left alone{': ' + ', '.join(differing) if differing else ''}; at most 0"
        metrics.append(Metric(f"study_differences/{name}", len(differing), "1", what, 0, not differing))
    return metrics


if __name__ == "__main__":
    main()
