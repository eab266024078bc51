"""Measure how much calibration improves dead reckoning.

    python tools/calibration_study.py --data ../shared/data/real --out /somewhere [--only fr079]

The calibration is learnt from the first half of each log and tested on the second half. For a laser log it is learnt from the
map of the first half, without a reference. For the robots with motion capture it is learnt from their reference: from each
robot alone, and from all five together.

A window is a stretch of 16.8 m or 70 m of the second half. A new window begins every half metre of the reference. Dead
reckoning and reference start a window at the same pose. The error of the window is the distance between their ends. The
bars are on dead reckoning with the learnt gains and delay. `windows.json` holds the errors of every window.
"""

from __future__ import annotations

import argparse
import json
import sys
from dataclasses import dataclass
from pathlib import Path
from typing import Any, TextIO

import numpy as np
from barred import at_least, at_most

from hybridmap import session
from hybridmap.calibration.estimate import Estimate
from hybridmap.calibration.legs import Motion
from hybridmap.calibration.sessions import Drive, estimate_of, read_drive
from hybridmap.cli.choose import choose
from hybridmap.evaluate.association import PosePairs, travel
from hybridmap.evaluate.trajectory_errors import motion_errors
from hybridmap.geometry import Array
from hybridmap.metrics import Metric, to_json
from hybridmap.odometry_model import NEUTRAL, Gains
from hybridmap.streams.base import SelfMotion, Velocity
from hybridmap.streams.synchronise import Synchroniser
from hybridmap.trajectory import NS_PER_S, Trajectory, known_at, read_tum

LENGTHS_M = (16.8, 70.0)
EVERY_M = 0.5
_OF_RAW = "end error in % of raw"
BARS = {("fr079", 16.8): 0.6, ("aces", 16.8): 0.6, ("fr079", 70.0): 0.7, ("aces", 70.0): 0.7}
Row = dict[str, Any]
COLUMNS = (
    "log",
    "trained on",
    "window",
    "windows",
    "raw m",
    "gain alone",
    "three gains",
    "and delay",
    "gain",
    "turn gain",
    "bias rad/m",
    "delay s",
    "bar",
)
LASER = {"fr079": ("fr079/fr079.mcap", "fr079/reference.tum"), "aces": ("aces/aces.bag", "aces/reference_dense.tum")}
ROBOTS = {f"mrclam6-{k}": (f"mrclam6/robot{k}.csv", f"mrclam6/robot{k}_groundtruth.tum") for k in range(1, 6)}


@dataclass(frozen=True)
class Log:
    """A recording with its raw odometry and its reference. `half_s` is where its second half begins."""

    name: str
    source: Path
    motion: Motion
    reference: Trajectory
    half_s: float

    @property
    def half_ns(self) -> int:
        """Return the stamp at which the second half begins."""
        return int(self.motion.stamps_ns[0]) + round(self.half_s * NS_PER_S)


def read_log(name: str, source: Path, reference: Path) -> Log:
    """Read a recording. Its raw odometry is what the synchroniser gives to the mapper."""
    stream = choose(str(source), None, {}).stream
    synchroniser = Synchroniser()
    steps = [s for sample in stream if isinstance(sample, SelfMotion | Velocity) for s in synchroniser.push(sample)]
    steps += synchroniser.flush()
    stamps = np.array([step.stamp_ns for step in steps])
    motion = Motion(stamps, np.array([step.delta_robot for step in steps])[1:])
    return Log(name, source, motion, read_tum(reference), float(stamps[-1] - stamps[0]) / NS_PER_S / 2.0)


def first_half(log: Log, out: Path) -> Drive:
    """Map the first half of a log. The second half is not read."""
    folder = out / f"{log.name}-first-half"
    if not (folder / "metrics.json").is_file():
        chosen = choose(str(log.source), None, {}, end_s=log.half_s)
        session.run(chosen.stream, chosen.config, folder, overwrite=True)
    return read_drive(folder)


def windows(log: Log, gains: Gains, delay_s: float, length_m: float) -> tuple[Array, Array]:
    """Return the start (s since the start of the log) and the end error (m) of every window of the second half."""
    shift = round(delay_s * NS_PER_S)
    stamps = log.motion.stamps_ns
    used = known_at(log.reference, stamps + shift) & (stamps >= log.half_ns)
    poses = log.motion.poses(gains)[used]
    pairs = PosePairs(stamps[used], poses, log.reference.at(stamps[used] + shift), len(stamps))
    along = travel(pairs.reference)
    first = np.searchsorted(along, np.arange(0.0, max(along[-1] - length_m, 0.0), EVERY_M))
    last = np.searchsorted(along, along[first] + length_m)
    reached = last < len(along)
    first, last = first[reached], last[reached]
    near = along[last] - along[first] < 1.5 * length_m
    errors, _ = motion_errors(pairs, first[near], last[near])
    return (pairs.stamps_ns[first[near]] - stamps[0]) / NS_PER_S, errors


def judge(log: Log, how: str, estimate: Estimate, table: TextIO) -> list[Row]:
    """Return one row for each length of window: the errors of raw and of calibrated dead reckoning."""
    rows: list[Row] = []
    for length in LENGTHS_M:
        start, raw = windows(log, NEUTRAL, 0.0, length)
        if not len(raw):
            continue
        _, gain_alone = windows(log, Gains(gain=estimate.gains.gain), 0.0, length)
        _, gains = windows(log, estimate.gains, 0.0, length)
        _, timed = windows(log, estimate.gains, estimate.delay_s, length)
        row = {
            "log": log.name,
            "trained": how,
            "length_m": length,
            "windows": len(raw),
            "raw_mean_m": float(raw.mean()),
            "raw_median_m": float(np.median(raw)),
            "gain_alone_mean": float(gain_alone.mean() / raw.mean()),
            "gains_mean": float(gains.mean() / raw.mean()),
            "gains_median": float(np.median(gains) / np.median(raw)),
            "delay_mean": float(timed.mean() / raw.mean()),
            "delay_median": float(np.median(timed) / np.median(raw)),
            "gain": estimate.gains.gain,
            "turn_gain": estimate.gains.turn_gain,
            "heading_bias_rad_m": estimate.gains.heading_bias_rad_m,
            "delay_s": estimate.delay_s,
            "sigmas": estimate.sigmas.tolist(),
            "every_window": {
                "start_s": start.tolist(),
                "raw_m": raw.tolist(),
                "gains_m": gains.tolist(),
                "delay_m": timed.tolist(),
            },
        }
        rows.append(row)
        print(line(row), flush=True, file=table)
    return rows


def line(row: Row) -> str:
    """Format one row of the table."""
    bar = BARS.get((row["log"], row["length_m"]))
    s, met = row["sigmas"], bar is not None and row["delay_mean"] <= bar
    cells = [
        f"{row['log']}",
        f"{row['trained']}",
        f"{row['length_m']} m",
        f"{row['windows']}",
        f"{row['raw_mean_m']:.2f} ({row['raw_median_m']:.2f})",
        f"{row['gain_alone_mean']:.0%}",
        f"{row['gains_mean']:.0%} ({row['gains_median']:.0%})",
        f"{row['delay_mean']:.0%} ({row['delay_median']:.0%})",
        f"{row['gain']:.3f} +- {s[0]:.3f}",
        f"{row['turn_gain']:.3f} +- {s[1]:.3f}",
        f"{row['heading_bias_rad_m']:.4f} +- {s[2]:.4f}",
        f"{row['delay_s']:.2f} +- {s[3]:.2f}",
        "" if bar is None else f"{bar:.0%}, {'met' if met else 'missed'}",
    ]
    return f"| {' | '.join(cells)} |"


def judged(rows: list[Row]) -> list[Metric]:
    """Return the figures with a bar.

    They are the end error of calibrated dead reckoning in % of the raw one, and the number of robots whose error shrinks.
    Dead reckoning uses the learnt gains and the delay, not rounded. `calibrate --out` writes these and the mapper applies them.
    """
    metrics = []
    for found in rows:
        length = found["length_m"]
        bar = BARS.get((found["log"], length))
        if bar is not None:
            name = f"end_error/{found['log']}-{length:g}m-{found['trained']}"
            metrics.append(at_most(name, 100.0 * found["delay_mean"], 100.0 * bar, f"{_OF_RAW}, mean over all windows", "%"))
    for how in ("reference", "reference, all robots"):
        ratios = [r["delay_mean"] for r in rows if r["trained"] == how and r["length_m"] == LENGTHS_M[0]]
        if ratios:
            name = f"mrclam6-{how.replace(', ', '-').replace(' ', '-')}"
            median, better = 100.0 * float(np.median(ratios)), sum(ratio < 1.0 for ratio in ratios)
            metrics.append(at_most(f"end_error/{name}", median, 75.0, f"{_OF_RAW}, median over the robots", "%"))
            metrics.append(at_least(f"better/{name}", better, 4.0, f"of {len(ratios)} robots that calibration improves"))
    return metrics


def main() -> None:
    """Run the study."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--data", type=Path, required=True, help="folder of real recordings")
    parser.add_argument("--out", type=Path, required=True, help="folder for the sessions and windows.json")
    parser.add_argument("--only", default="", help="run the logs whose name contains this text")
    parser.add_argument("--estimators", nargs="+", default=["alternating", "joint"], help="estimators for the laser logs")
    parser.add_argument("--json", action="store_true", help="print the figures with a bar as JSON")
    options = parser.parse_args()
    rows: list[Row] = []
    table = sys.stderr if options.json else sys.stdout
    print(f"| {' | '.join(COLUMNS)} |\n|{'---|' * len(COLUMNS)}", flush=True, file=table)
    for name, (source, reference) in LASER.items():
        if options.only in name:
            log = read_log(name, options.data / source, options.data / reference)
            drive = first_half(log, options.out)
            for estimator in options.estimators:
                rows += judge(log, estimator, estimate_of([drive], [], estimator), table)
    robots = [read_log(n, options.data / s, options.data / r) for n, (s, r) in ROBOTS.items() if options.only in n]
    drives = [first_half(log, options.out) for log in robots]
    for log, drive in zip(robots, drives, strict=True):
        rows += judge(log, "reference", estimate_of([drive], [log.reference]), table)
    if len(robots) > 1:
        together = estimate_of(drives, [log.reference for log in robots])
        for log in robots:
            rows += judge(log, "reference, all robots", together, table)
    if options.json:
        print(to_json({}, judged(rows)))
    else:
        print("\n".join(f"{m.name}: {m.value:.3g} {m.unit}, {m.description}" for m in judged(rows)))
    (options.out / "windows.json").write_text(json.dumps(rows, indent=1))


if __name__ == "__main__":
    main()
