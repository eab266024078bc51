r"""Map a laser recording again with its wheels or its laser made worse, and hold each map against verified relations.

    python tools/laser_stress.py fr079.mcap --relations relations.txt
    python tools/laser_stress.py aces.bag --relations relations.txt --cases heading-bias laser-8m --seeds 0 1

One configuration for all; what is disturbed is the input. Errors are the mean of all relations, and of those that close a loop
of more than 60 s, for the disturbed odometry and for the primary back-end.
Exit code 1 if a map is worse than its odometry.
"""

from __future__ import annotations

import argparse
import sys
from collections.abc import Callable, Iterator
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
from mapping_runs import judged_session

from hybridmap.cli.choose import parse_settings
from hybridmap.config import Config
from hybridmap.geometry import Array, between, compose
from hybridmap.metrics import Metric, to_json
from hybridmap.store import MapStore
from hybridmap.streams.base import Sample, SelfMotion, Stream
from hybridmap.streams.laser import LaserScan
from hybridmap.streams.open import open_stream

Steps = Callable[[Array, np.random.Generator], Array]
Scans = Callable[[LaserScan, int], LaserScan | None]


def main() -> None:
    """Parse the command line, map every case, print."""
    options = _parser().parse_args()
    settings = parse_settings(options.set)
    table = sys.stderr if options.json else sys.stdout
    print(HEADER, file=table, flush=True)
    worse, metrics = [], []
    for case in options.cases:
        for seed in options.seeds:
            found = outcome(options.source, case, seed, Config.load("laser", settings), options.relations)
            print(f"| {case} | {seed} | {' | '.join(found.cells())} |", file=table, flush=True)
            worse += [case] if found.map_m > found.odometry_m else []
            metrics.append(found.metric(f"{case}-{seed}"))
    print(f"\nworse than odometry: {', '.join(worse) if worse else 'never'}", file=table)
    if options.json:
        print(to_json({}, metrics))
    raise SystemExit(1 if worse else 0)


HEADER = (
    "| case | seed | odometry, m | map, m | loops, m | map, deg | loops in graph | rejected |\n"
    "|---|---:|---:|---:|---:|---:|---:|---:|"
)


@dataclass(frozen=True)
class Outcome:
    """Mean relation errors of one run, m and degrees, and what became of its loops."""

    odometry_m: float
    map_m: float
    loops_m: float
    map_deg: float
    accepted: int
    rejected: int

    def metric(self, name: str) -> Metric:
        """The map's error; its bar is the error of odometry."""
        passed = self.map_m <= self.odometry_m
        return Metric(f"relation_trans_mean/{name}", self.map_m, "m", "of the robust map", self.odometry_m, passed)

    def cells(self) -> list[str]:
        """For a table."""
        metres = [f"{value:.4f}" for value in (self.odometry_m, self.map_m, self.loops_m)]
        return [*metres, f"{self.map_deg:.3f}", str(self.accepted), str(self.rejected)]


@dataclass
class Disturbed:
    """A stream whose steps of odometry and whose scans are changed on the way.

    Attributes:
        stream: what is recorded.
        steps: (K, 3) steps between odometry messages, in the robot's frame, to those of worse wheels.
        scans: a scan and its number to a worse one, None to lose it.
        seed: of the disturbance.
    """

    stream: Stream
    steps: Steps
    scans: Scans
    seed: int

    def __getattr__(self, name: str) -> object:
        """Everything else is the recording's."""
        return getattr(self.stream, name)

    def __iter__(self) -> Iterator[Sample]:
        """The same samples, worse."""
        samples = list(self.stream)
        poses = np.array([sample.pose_odom_robot for sample in samples if isinstance(sample, SelfMotion)])
        steps = self.steps(between(poses[:-1], poses[1:]), np.random.default_rng(self.seed))
        pose, moved, scans = poses[0], iter(steps), 0
        for sample in samples:
            if isinstance(sample, SelfMotion):
                yield replace(sample, pose_odom_robot=pose)
                pose = compose(pose, next(moved, np.zeros(3)))
            elif isinstance(sample, LaserScan):
                if (worse := self.scans(sample, scans)) is not None:
                    yield worse
                scans += 1


def outcome(source: str, case: str, seed: int, config: Config, relations: Path) -> Outcome:
    """Map a disturbed recording into a folder that is thrown away, and judge it."""
    stream = Disturbed(open_stream(source, config), *CASES[case], seed)
    with judged_session(stream, config, relations) as (session, found), MapStore.open(session.path) as store:
        loops = int(store.map().pose_graph().is_loop.sum())
        rejected = len(store.solutions()[config.backends.names[0]].report.rejected_edge_ids)
    primary = config.backends.names[0]
    return Outcome(
        found["relation_trans_mean/odometry"],
        found[f"relation_trans_mean/{primary}"],
        found[f"relation_loop_trans_mean/{primary}"],
        found[f"relation_rot_mean/{primary}"],
        loops,
        rejected,
    )


def same_steps(steps: Array, rng: np.random.Generator) -> Array:
    """Wheels as they are."""
    del rng
    return steps


def same_scan(scan: LaserScan, number: int) -> LaserScan | None:
    """The laser as it is."""
    del number
    return scan


def heading_bias(steps: Array, rng: np.random.Generator) -> Array:
    """Two degrees a metre to one side."""
    del rng
    return steps + np.column_stack([np.zeros((len(steps), 2)), np.radians(2.0) * travel(steps)])


def heading_noise(steps: Array, rng: np.random.Generator) -> Array:
    """Heading walks at random by 3 degrees a square root of a metre."""
    return steps + np.column_stack(
        [np.zeros((len(steps), 2)), rng.normal(size=len(steps)) * np.radians(3.0) * np.sqrt(travel(steps))]
    )


def slip(steps: Array, rng: np.random.Generator) -> Array:
    """Every 20 m, on average, a step is wrong by some 0.3 m and 15 degrees."""
    hit = rng.random(len(steps)) < travel(steps) / 20.0
    return steps + hit[:, None] * rng.normal(size=steps.shape) * [0.3, 0.05, np.radians(15.0)]


def wrong_gain(steps: Array, rng: np.random.Generator) -> Array:
    """Wheels of 5 % too small a radius, and turns 10 % too large."""
    del rng
    return steps * [1.05, 1.05, 1.1]


def travel(steps: Array) -> Array:
    """Length (K,) of each step, m."""
    return np.hypot(steps[:, 0], steps[:, 1])


def short_sighted(scan: LaserScan, number: int) -> LaserScan | None:
    """Returns beyond 8 m are lost."""
    del number
    return replace(scan, ranges_m=np.where(scan.ranges_m < 8.0, scan.ranges_m, np.float32(np.nan)))


def noisy_ranges(scan: LaserScan, number: int) -> LaserScan | None:
    """Ranges err by 3 cm, one in ten is lost and one in fifty is short."""
    rng = np.random.default_rng(number)
    ranges = scan.ranges_m + rng.normal(size=scan.ranges_m.shape) * 0.03
    ranges = np.where(rng.random(ranges.shape) < 0.02, ranges * rng.random(ranges.shape), ranges)
    return replace(scan, ranges_m=np.where(rng.random(ranges.shape) < 0.1, np.nan, ranges).astype(np.float32))


def narrow_view(scan: LaserScan, number: int) -> LaserScan | None:
    """The outer thirds of the fan are covered."""
    del number
    n = len(scan.ranges_m)
    ranges = scan.ranges_m.copy()
    ranges[: n // 6] = ranges[n - n // 6 :] = np.nan
    return replace(scan, ranges_m=ranges)


def seldom(scan: LaserScan, number: int) -> LaserScan | None:
    """Three scans out of four are lost."""
    return scan if number % 4 == 0 else None


CASES: dict[str, tuple[Steps, Scans]] = {
    "as-recorded": (same_steps, same_scan),
    "heading-bias": (heading_bias, same_scan),
    "heading-noise": (heading_noise, same_scan),
    "slip": (slip, same_scan),
    "wrong-gain": (wrong_gain, same_scan),
    "laser-8m": (same_steps, short_sighted),
    "laser-noise": (same_steps, noisy_ranges),
    "laser-120deg": (same_steps, narrow_view),
    "laser-seldom": (same_steps, seldom),
}


def _parser() -> argparse.ArgumentParser:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("source")
    parser.add_argument("--relations", type=Path, required=True)
    parser.add_argument("--cases", nargs="+", choices=list(CASES), default=list(CASES))
    parser.add_argument("--seeds", nargs="+", type=int, default=[0])
    parser.add_argument("--json", action="store_true", help="one JSON object on standard output; the table goes to stderr")
    parser.add_argument("--set", action="append", default=[], help="KEY=VALUE on top of the configuration")
    return parser


if __name__ == "__main__":
    main()
