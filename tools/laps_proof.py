"""Does the map stop growing where the robot drives the same way for ever? Laps of the lab by laser.

    python tools/laps_proof.py [--laps 10] [--seed 1] [--compare LAPS] [--json] [--out FOLDER]

For each lap it says how many nodes the map has and what a frame costs, in CPU time of everything but the simulation: mapping,
recording, checkpoints. From lap 5 on neither may grow by more than a tenth. `--compare` maps the first laps once more with a
node at every visit (`nodes.rule: every-visit`), and says how far the two trajectories lie apart.
"""

from __future__ import annotations

import argparse
import json
import tempfile
from collections.abc import Iterator
from dataclasses import dataclass, field
from pathlib import Path
from time import process_time

import numpy as np
from barred import at_most

from hybridmap.config import Config
from hybridmap.evaluate.trajectory_errors import absolute_error
from hybridmap.geometry import Array
from hybridmap.mapper import Mapper
from hybridmap.metrics import Metric
from hybridmap.session import run
from hybridmap.simulation.stream import SimulatedStream
from hybridmap.simulation.worlds.lab import lab
from hybridmap.store import MapStore
from hybridmap.streams.base import Observation, Sample, SelfMotion
from hybridmap.trajectory import Trajectory, read_tum

FROM_LAP, GROWTH_MAX, MOVED_MAX_M = 5, 1.1, 0.02
"""The bars: from this lap on, largest growth of nodes and of the time of a frame, and largest movement of a pose, m."""
LAPS = 10
"""So many laps are compared, by the least time of a frame: what else the machine does only adds to it."""


@dataclass(slots=True)
class Laps:
    """What the mapper did in each lap, counted while its stream is read.

    Attributes:
        nodes: number of nodes at the end of each lap.
        frame_s: mean CPU time of a frame in each lap, with the odometry before it, s.
        moved_m: largest shift of any node while the robot was followed on nodes that existed, m.
    """

    nodes: list[int] = field(default_factory=list)
    frame_s: list[float] = field(default_factory=list)
    moved_m: float = 0.0


class TimedLaps(SimulatedStream):
    """Laps of the lab; `laps` says what each of them cost."""

    def __init__(self, config: Config, laps: int) -> None:
        super().__init__(config.simulation, config.seed, world=lab(laps))
        self.laps, self._count, self._mapper = Laps(), laps, Mapper(config, self.rig)

    def opened(self, mapper: Mapper, store: MapStore) -> None:
        """Note which mapper maps the stream."""
        del store
        self._mapper = mapper

    def __iter__(self) -> Iterator[Sample]:
        """Yield the samples, and take the time until the next one is asked for."""
        length_m, driven_m, truth = 0.0, np.hypot(*np.diff(self.groundtruth.poses[:, :2], axis=0).T).cumsum(), self.groundtruth
        length_m = float(driven_m[-1]) / self._count
        spent_s, frames = 0.0, 0
        for sample in super().__iter__():
            before = self._poses() if isinstance(sample, SelfMotion) else None
            began_s = process_time()
            yield sample
            spent_s += process_time() - began_s
            frames += isinstance(sample, Observation)
            self._note(before)
            at = int(np.searchsorted(truth.stamps_ns, sample.stamp_ns))
            if driven_m[min(at, len(driven_m) - 1)] >= length_m * (len(self.laps.nodes) + 1) - 1e-6 and frames:
                self._end_lap(spent_s / frames)
                spent_s, frames = 0.0, 0
        if len(self.laps.nodes) < self._count and frames:
            self._end_lap(spent_s / frames)

    def _end_lap(self, frame_s: float) -> None:
        self.laps.nodes.append(len(self._mapper.map))
        self.laps.frame_s.append(frame_s)

    def _poses(self) -> Array | None:
        solution = self._mapper.backends.solutions.get(self._mapper.backends.primary)
        return None if solution is None else solution.poses

    def _note(self, before: Array | None) -> None:
        """Note how far nodes moved although none was made."""
        after = self._poses()
        if before is not None and after is not None and after is not before and len(after) == len(before):
            self.laps.moved_m = max(self.laps.moved_m, float(np.hypot(*(after - before)[:, :2].T).max()))


def config_of(rule: str, seed: int) -> Config:
    """The configuration `laser` in the lab, with a rule of nodes."""
    return Config.load("laser", {"simulation.world": "lab", "nodes.rule": rule, "seed": seed, "backends.names": ["gtsam-gnc"]})


def mapped(rule: str, laps: int, seed: int, out: Path) -> tuple[Laps, Trajectory, Trajectory]:
    """Map so many laps; returns what each did, the trajectory, and the true one."""
    config = config_of(rule, seed)
    stream = TimedLaps(config, laps)
    done = run(stream, config, out, overwrite=True, opened=stream.opened)
    return stream.laps, read_tum(done.folder.trajectory / "gtsam-gnc.tum"), stream.groundtruth


def compared(laps: int, seed: int, out: Path) -> list[Metric]:
    """How far the trajectory with reused nodes is from that with a node at every visit."""
    (_, ours, truth), (_, other, _) = (mapped(rule, laps, seed, out / rule) for rule in ("travel", "every-visit"))
    apart_m = np.hypot(*(ours.poses - other.at(ours.stamps_ns))[:, :2].T)
    return [
        Metric("compared_laps", laps, "1", "laps mapped both ways"),
        Metric("apart_median", float(np.median(apart_m)), "m", "distance of the two trajectories, median"),
        Metric("apart_max", float(apart_m.max()), "m", "distance of the two trajectories, largest"),
        Metric("ate_reused", absolute_error(ours, truth).rmse_m, "m", "absolute trajectory error, nodes reused"),
        Metric("ate_every_visit", absolute_error(other, truth).rmse_m, "m", "absolute trajectory error, a node at every visit"),
    ]


def figures(laps: Laps, error_m: float) -> list[Metric]:
    """The figures, with their bars."""
    since = min(FROM_LAP, len(laps.nodes)) - 1
    early_s, late_s = min(laps.frame_s[since : since + LAPS]), min(laps.frame_s[since:][-LAPS:])
    return [
        Metric("laps", len(laps.nodes), "1", "laps driven"),
        Metric("nodes", laps.nodes[-1], "1", "nodes of the map at the end"),
        at_most(
            "nodes_growth", laps.nodes[-1] / laps.nodes[since], GROWTH_MAX, f"nodes at the end over those of lap {FROM_LAP}"
        ),
        Metric("frame_early", 1e3 * early_s, "ms", f"CPU time of a frame, least of {LAPS} laps from lap {FROM_LAP} on"),
        Metric("frame_late", 1e3 * late_s, "ms", f"CPU time of a frame, least of the last {LAPS} laps"),
        at_most("frame_growth", late_s / early_s, GROWTH_MAX, "the second over the first"),
        at_most("moved_max", laps.moved_m, MOVED_MAX_M, "largest shift of a node while no node was made", "m"),
        Metric("ate", error_m, "m", "absolute trajectory error after alignment, RMSE"),
    ]


def main() -> None:
    """Drive the laps and print the figures."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--laps", type=int, default=10)
    parser.add_argument("--seed", type=int, default=1)
    parser.add_argument("--compare", type=int, default=0, metavar="LAPS")
    parser.add_argument("--json", action="store_true")
    parser.add_argument("--out", type=Path)
    asked = parser.parse_args()
    with tempfile.TemporaryDirectory() as temporary:
        out = asked.out or Path(temporary)
        laps, ours, truth = mapped("travel", asked.laps, asked.seed, out / "laps")
        metrics = figures(laps, absolute_error(ours, truth).rmse_m)
        if asked.compare:
            metrics += compared(asked.compare, asked.seed, out)
    if asked.json:
        by_lap = {"nodes": laps.nodes, "frame_ms": [1e3 * one for one in laps.frame_s]}
        print(json.dumps({"by_lap": by_lap, "metrics": [metric.to_json() for metric in metrics]}, indent=2))
        return
    for number, (nodes, frame_s) in enumerate(zip(laps.nodes, laps.frame_s, strict=True), start=1):
        print(f"lap {number:3d}: {nodes:5d} nodes, {1e3 * frame_s:6.1f} ms a frame")
    for metric in metrics:
        print(f"{metric.name:16s} {metric.value:10.4g} {metric.unit:3s} {metric.description}{_verdict(metric)}")


def _verdict(metric: Metric) -> str:
    return "" if metric.passed is None else ("; ok" if metric.passed else "; MISSED")


if __name__ == "__main__":
    main()
