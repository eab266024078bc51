r"""Carry a robot away unseen, and say how far it drives until its map has it where it is.

    python tools/carried_study.py office --seeds 1 2 3 4 5
    python tools/carried_study.py office --config rgbd --seeds 1 2 3
    python tools/carried_study.py fr079.mcap --reference reference_dense.tum --carry 220:320 390:640 --after 150

In a simulated world the robot is carried as `hybridmap simulate --kidnap` does it. A recording is cut: what lies between two
times, in seconds from its first stamp, is left out, and the odometry is glued together, so that the robot is carried from where
it was to where it drives on.

Found is the first node from which on the pose that the robot is told lies within `--near` of the truth, as seen from the
nearest node of the map of before; known is a place where it has been, within 1 m and 45 degrees. Loops that are wrong by more
than 1 m have no place in the graph, and a simulated robot is to be found within 5 m: exit code 1 where it is otherwise.
"""

from __future__ import annotations

import argparse
import math
import sys
from collections.abc import Iterable, Iterator
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
from barred import at_most
from numpy.typing import NDArray

from hybridmap.config import Config
from hybridmap.geometry import IDENTITY, align, between, compose
from hybridmap.graph.carries import carries
from hybridmap.graph.edges import EdgeKind, Status
from hybridmap.graph.experience_map import ExperienceMap
from hybridmap.mapper import Mapper
from hybridmap.metrics import Metric, to_json
from hybridmap.simulation import SimulatedStream
from hybridmap.streams.base import Sample, SelfMotion
from hybridmap.streams.open import open_stream, world_of
from hybridmap.trajectory import NS_PER_S, Trajectory, read_tum

Floats = NDArray[np.float64]
WRONG_M = 1.0
KNOWN_M, KNOWN_RAD = 1.0, float(np.deg2rad(45.0))


def cut(samples: Iterable[Sample], up_ns: int, down_ns: int, end_ns: int) -> Iterator[Sample]:
    """Leave out the samples between two stamps, and end at a third; the odometry goes on where it was."""
    held, onward = IDENTITY, None
    for sample in samples:
        if sample.stamp_ns > end_ns:
            return
        before, after = sample.stamp_ns <= up_ns, sample.stamp_ns >= down_ns
        if isinstance(sample, SelfMotion) and before:
            held = sample.pose_odom_robot
        elif isinstance(sample, SelfMotion) and after:
            onward = sample.pose_odom_robot if onward is None else onward
            sample = replace(sample, pose_odom_robot=compose(held, between(onward, sample.pose_odom_robot)))
        if before or (after and onward is not None):
            yield sample


@dataclass(frozen=True)
class Outcome:
    """What became of a carried robot.

    Attributes:
        carried_m: how far the pose was off, by the map of before, at the first node after the carry.
        noticed: the node from which on the map has it carried, or lost; None if it has not.
        known_m: way driven since it was put down until it was where it had been before, looking the same way; None: never.
        found_m: the same until it was found for good; None if it was not found.
        rms_m: error of all nodes on the final map, aligned.
        loops, wrong: loops in the graph, and those wrong by more than a metre.
    """

    carried_m: float
    noticed: int | None
    known_m: float | None
    found_m: float | None
    rms_m: float
    loops: int
    wrong: int


def outcome(mapper: Mapper, samples: Iterable[Sample], truth: Trajectory, down_ns: int, near_m: float) -> Outcome:
    """Map a drive in which the robot is put down at a stamp."""
    off = list[float]()
    for sample in samples:
        for update in mapper.add(sample):
            if update.new_node is not None and sample.stamp_ns >= down_ns:
                off.append(off_map_m(mapper, truth, down_ns))
    mapper.finish()
    stamps_ns = [node.stamp_ns for node in mapper.map.nodes]
    nodes, down = truth.at(stamps_ns), int(np.searchsorted(stamps_ns, down_ns))
    way = np.hypot(*np.diff(nodes[down:, :2], axis=0, prepend=truth.at([down_ns])[:, :2]).T).cumsum()
    found = way[int(np.max(np.flatnonzero(np.array(off) >= near_m), initial=-1)) + 1 :]
    known = way[been_before(nodes, down)]
    known_m, found_m = (float(ways[0]) if len(ways) else None for ways in (known, found))
    final = mapper.poses()
    errors = np.hypot(*(compose(align(nodes, final), final) - nodes)[:, :2].T)
    rms_m = float(np.sqrt(np.mean(errors**2)))
    return Outcome(off[0], noticed(mapper), known_m, found_m, rms_m, *judged(mapper.map, nodes))


def off_map_m(mapper: Mapper, truth: Trajectory, down_ns: int) -> float:
    """How far the newest node lies from where it should, by the node before the carry that it is nearest to in truth."""
    stamps_ns = [node.stamp_ns for node in mapper.map.nodes]
    nodes, poses = truth.at(stamps_ns), mapper.poses()
    before = nodes[: np.searchsorted(stamps_ns, down_ns)]
    old = int(np.argmin(np.hypot(*(before[:, :2] - nodes[-1, :2]).T)))
    should, does = between(nodes[old], nodes[-1]), between(poses[old], poses[-1])
    return float(np.hypot(*(does - should)[:2]))


def been_before(nodes: Floats, down: int) -> NDArray[np.bool_]:
    """Which nodes since one, of the true poses (N, 3), lie so near to one before it that a laser sees much the same."""
    apart = between(nodes[down:, None], nodes[None, :down])
    near = (np.hypot(apart[..., 0], apart[..., 1]) < KNOWN_M) & (np.abs(apart[..., 2]) < KNOWN_RAD)
    return np.asarray(near.any(axis=1))


def noticed(mapper: Mapper) -> int | None:
    """The node from which on the map has it carried, or lost."""
    return next((carry.after for carry in carries(mapper.map)), mapper.lost_since)


def judged(experiences: ExperienceMap, nodes: Floats) -> tuple[int, int]:
    """How many loops are in the graph, and how many of them are wrong."""
    loops = [e for e in experiences.edges if e.kind is EdgeKind.LOOP and e.status is Status.ACCEPTED and e.relative]
    apart = [between(between(nodes[e.source], nodes[e.target]), e.relative.delta) for e in loops if e.relative]
    return len(loops), sum(bool(np.hypot(error[0], error[1]) > WRONG_M) for error in apart)


def simulated(world: str, name: str, seed: int, settings: dict[str, object]) -> tuple[SimulatedStream, Config, int]:
    """A drive through a world, its configuration, and the stamp at which the robot is put down."""
    config = Config.load(name, {"simulation.world": world, "simulation.carried_m": 20.0, **settings})
    stream = SimulatedStream(config.simulation, seed)
    assert stream.carry is not None
    return stream, config, int(stream.groundtruth.stamps_ns[stream.carry.last])


def main() -> None:
    """Parse the command line, map every drive, print."""
    options = _parser().parse_args()
    table, metrics = sys.stderr if options.json else sys.stdout, list[Metric]()
    print("| drive | off, m | noticed at node | known after, m | found after, m | map rms, m | loops | wrong |", file=table)
    print("|---|---:|---:|---:|---:|---:|---:|---:|", file=table)
    for name, found in _outcomes(options):
        ways = " | ".join("never" if way_m is None else f"{way_m:.1f}" for way_m in (found.known_m, found.found_m))
        noticed_at = "never" if found.noticed is None else found.noticed
        figures = f"{found.carried_m:.1f} | {noticed_at} | {ways} | {found.rms_m:.3f} | {found.loops} | {found.wrong}"
        print(f"| {name} | {figures} |", file=table, flush=True)
        metrics += metrics_of(name.replace(" ", "-"), found, bar_m=5.0 if world_of(options.source) else None)
    if options.json:
        print(to_json({"source": options.source, "config": options.config}, metrics))
    raise SystemExit(1 if any(metric.passed is False for metric in metrics) else 0)


def metrics_of(name: str, found: Outcome, bar_m: float | None) -> list[Metric]:
    """Its figures; the bar of the way until it is found is that of a simulated drive."""
    way_m = math.inf if found.found_m is None else found.found_m
    driven = "driven since it was put down until it was found"
    way = Metric(f"found/{name}", way_m, "m", driven) if bar_m is None else at_most(f"found/{name}", way_m, bar_m, driven, "m")
    wrong = at_most(f"wrong_loops/{name}", found.wrong, 0, f"of {found.loops} loops")
    return [way, wrong, Metric(f"map_rms/{name}", found.rms_m, "m", f"of all nodes; carried {found.carried_m:.1f} m")]


def _outcomes(options: argparse.Namespace) -> Iterator[tuple[str, Outcome]]:
    settings: dict[str, object] = {"backends.names": ["gtsam-gnc"]}
    if world := world_of(options.source):
        for seed in options.seeds:
            stream, config, down_ns = simulated(world, options.config, seed, settings)
            yield f"{world} {seed}", outcome(Mapper(config, stream.rig), stream, stream.groundtruth, down_ns, options.near)
        return
    config, truth = Config.load(options.config, settings), read_tum(options.reference)
    for carry in options.carry:
        whole = open_stream(options.source, config)
        start_ns = next(sample.stamp_ns for sample in whole)
        up_ns, down_ns = (start_ns + round(float(part) * NS_PER_S) for part in carry.split(":"))
        samples = cut(whole, up_ns, down_ns, down_ns + round(options.after * NS_PER_S))
        found = outcome(Mapper(config, whole.rig), samples, truth, down_ns, options.near)
        yield f"{Path(options.source).stem} {carry}", found


def _parser() -> argparse.ArgumentParser:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("source", help="a simulated world or a recording")
    parser.add_argument("--seeds", nargs="+", type=int, default=[1], help="of a simulated world")
    parser.add_argument("--reference", type=Path, help="TUM file with the truth of a recording")
    parser.add_argument("--carry", nargs="+", default=[], metavar="UP:DOWN", help="seconds from the recording's first stamp")
    parser.add_argument("--after", type=float, default=150.0, help="seconds that are driven after the carry")
    parser.add_argument("--config", default="laser", help="how it maps: a name or a file (default: laser)")
    parser.add_argument("--json", action="store_true", help="one JSON object on standard output; the table goes to stderr")
    parser.add_argument("--near", type=float, default=0.7, help="how near to the truth it must be, m")
    return parser


if __name__ == "__main__":
    main()
