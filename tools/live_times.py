"""Feed a recording to a live mapper as a robot would, and print how fast it answers, how far it lags and what it maps.

    python tools/live_times.py SOURCE [--config NAME] [--rate 1] [--end S] [--late 0.1] [--overload 3]
                               [--reference FILE] [--out DIR] [--json]

Every source comes with a delay of its own, from 0 to `--late` seconds of the recording. `--overload N` makes the mapping
process so slow that it needs N times the time that the drive takes at this rate. The exit code is 1 if nothing was left out
and the maps differ, if views lag by more than 2 s, or if the map's error is more than twice that of the recording's.
"""

from __future__ import annotations

import argparse
import json
import sys
import tempfile
import threading
import time
from pathlib import Path
from typing import Any

import numpy as np
from overload import ERROR_RATIO, LAG_S, error_m, slowed, slowness

from hybridmap import session
from hybridmap.config import Config
from hybridmap.live import LiveMapper
from hybridmap.live.inbox import source_of
from hybridmap.streams.open import open_stream
from hybridmap.trajectory import NS_PER_S

_READ_S = 0.01


class Reader:
    """Reads the pose all the time, as a robot's navigation does, and keeps how long it took and how large the lag was."""

    def __init__(self, mapper: LiveMapper) -> None:
        self.reads_s: list[float] = []
        self.lags_s: list[float] = []
        self.stop = threading.Event()
        self._mapper = mapper
        self._thread = threading.Thread(target=self._run)
        self._thread.start()

    def _run(self) -> None:
        while not self.stop.wait(_READ_S):
            began_s = time.perf_counter()
            self._mapper.pose_map_robot()
            self.reads_s.append(time.perf_counter() - began_s)
            self.lags_s.append(self._mapper.report.lag_s)

    def join(self) -> None:
        """Stop reading."""
        self.stop.set()
        self._thread.join()


def percentiles(times_s: list[float]) -> dict[str, float]:
    """Median, 99 % and maximum, ms."""
    return {name: round(1e3 * float(np.percentile(times_s, q)), 3) for name, q in (("p50", 50), ("p99", 99), ("max", 100))}


def main() -> None:
    """Map a source twice and compare."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("source")
    parser.add_argument("--config", default="laser")
    parser.add_argument("--rate", type=float, default=1.0)
    parser.add_argument("--end", type=float)
    parser.add_argument("--late", type=float, default=0.1)
    parser.add_argument("--overload", type=float, default=0.0)
    parser.add_argument("--reference", type=Path, help="true trajectory (TUM), for the errors of both maps")
    parser.add_argument("--out", type=Path, help="folder in which both sessions are kept")
    parser.add_argument("--json", action="store_true")
    args = parser.parse_args()
    config = Config.load(args.config)
    stream = open_stream(args.source, config, end_s=args.end)
    samples = list(stream)
    with tempfile.TemporaryDirectory() as temporary:
        folder = Path(args.out or temporary)
        began_s = time.perf_counter()
        recorded = session.run(stream, config, folder / "recorded")
        found: dict[str, Any] = {"offline_s": round(time.perf_counter() - began_s, 2), "samples": len(samples)}
        delays = {name: args.late * number for number, name in enumerate(sorted({source_of(one) for one in samples}))}
        arrivals = sorted(samples, key=lambda one: one.stamp_ns / NS_PER_S + delays[source_of(one)])
        with LiveMapper(config, stream.rig, folder / "live") as mapper:
            reader, adds_s, first_s = Reader(mapper), [], time.perf_counter()
            slow = slowness(folder / "recorded", args.rate, args.overload)
            found["slower"] = round(slow, 2)
            with slowed(mapper.pid, slow):
                for sample in arrivals:
                    due_s = ((sample.stamp_ns - arrivals[0].stamp_ns) / NS_PER_S + delays[source_of(sample)]) / args.rate
                    time.sleep(max(0.0, first_s + due_s - time.perf_counter()))
                    began_s = time.perf_counter()
                    mapper.add(sample)
                    adds_s.append(time.perf_counter() - began_s)
            found["drive_s"] = round(time.perf_counter() - first_s, 2)
            reader.join()
            began_s = time.perf_counter()
            finished = mapper.finish()
            found |= {
                "finish_s": round(time.perf_counter() - began_s, 2),
                "add_ms": percentiles(adds_s),
                "pose_ms": percentiles(reader.reads_s),
                "largest_lag_s": round(max(*reader.lags_s, mapper.report.largest_lag_s), 3),
                "dropped": mapper.report.dropped,
                "same_map": finished.head["graph_hash"] == recorded.head["graph_hash"],
                "doctor": mapper.doctor(),
            }
        if args.reference is not None:
            found["error_m"], found["error_recorded_m"] = (
                error_m(folder / name, args.reference) for name in ("live", "recorded")
            )
    if args.json:
        print(json.dumps(found))
    else:
        for name, value in found.items():
            print(f"{name:14} {value}")
    worse = found.get("error_m", 0.0) > ERROR_RATIO * found.get("error_recorded_m", 0.0)
    sys.exit(bool(found["largest_lag_s"] > LAG_S or worse or not (found["dropped"] or found["same_map"])))


if __name__ == "__main__":
    main()
