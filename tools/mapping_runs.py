"""Map a source in memory, with nothing written, and hold what came out against the truth; what the studies share."""

from __future__ import annotations

import os
import subprocess
import sys
import tempfile
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from hybridmap.backends.base import Solution
from hybridmap.config import Config
from hybridmap.evaluate.edges import normalised_errors
from hybridmap.evaluate.session import evaluate_session
from hybridmap.evaluate.trajectory import absolute_error
from hybridmap.graph.edges import EdgeKind, Status
from hybridmap.graph.experience_map import ExperienceMap
from hybridmap.mapper import Mapper, Update
from hybridmap.metrics import StageClock
from hybridmap.session import run as session_run
from hybridmap.store import SessionFolder
from hybridmap.store.track import Track, trajectory_of
from hybridmap.streams.base import Stream
from hybridmap.streams.open import open_stream
from hybridmap.trajectory import Trajectory

Floats = NDArray[np.float64]

os.environ.setdefault("OPENCV_FOR_THREADS_NUM", "1")  # as the command line has it: costs are those of one core


@dataclass(frozen=True)
class Run:
    """A drive that was mapped.

    Attributes:
        experiences: the map with every edge that was considered.
        solutions: by back-end.
        primary: name of the one that drove.
        track: where the robot was between nodes.
        truth: of `base_link`, None where the source knows none.
        frames: camera frames or scans that came in.
        cpu_s: process time by stage; `rest` is what the mapper spends outside of them.
    """

    experiences: ExperienceMap
    solutions: dict[str, Solution]
    primary: str
    track: Track
    truth: Trajectory | None
    frames: int
    cpu_s: dict[str, float]

    def trajectory(self, backend: str) -> Trajectory:
        """Where the robot was at every stamp, by `odometry` or by a back-end."""
        return self.track.odometry if backend == "odometry" else trajectory_of(self.track, self.solutions[backend].poses)

    def ate_m(self, backend: str) -> float:
        """ATE (RMSE after SE(2) alignment) of odometry or a back-end over the whole recording."""
        assert self.truth is not None
        return absolute_error(self.trajectory(backend), self.truth).rmse_m


@dataclass(frozen=True)
class EdgeErrors:
    """Accepted edges of one kind against the truth.

    Attributes:
        numbers: (E,) of the edges.
        trans_m, rot_deg: (E,) errors.
        chi2: (E,) squared error over the edge's own covariance.
    """

    numbers: NDArray[np.int64]
    trans_m: Floats
    rot_deg: Floats
    chi2: Floats


def map_in_memory(source: str | Path, config: Config) -> Run:
    """Map a recording or a simulated world without a session folder."""
    return map_stream(open_stream(source, config), config)


def map_stream(stream: Stream, config: Config) -> Run:
    """Map a stream without a session folder."""
    mapper, whole, updates = Mapper(config, stream.rig), StageClock(), list[Update]()
    for sample in stream:
        with whole.stage("rest"):
            updates += mapper.add(sample)
    with whole.stage("rest"):
        updates += mapper.finish()
    cpu_s = dict(mapper.clock.cpu_s)
    frames = sum(stream.report.counts.get(name, 0) for name in ("frames", "scans"))
    return Run(
        mapper.map,
        dict(mapper.backends.solutions),
        mapper.backends.primary,
        _track(updates),
        stream.groundtruth,
        frames,
        {**cpu_s, "rest": whole.cpu_s["rest"] - sum(cpu_s.values())},
    )


@contextmanager
def judged_session(stream: Stream, config: Config, relations: Path | None) -> Iterator[tuple[SessionFolder, dict[str, float]]]:
    """Map a stream into a folder that is thrown away; its session and every figure of `hybridmap evaluate`, by name."""
    with tempfile.TemporaryDirectory() as folder:
        session = session_run(stream, config, Path(folder) / "session").folder
        yield session, {metric.name: metric.value for metric in evaluate_session(session.path, relations=relations)}


def edge_errors(run: Run, kind: EdgeKind) -> EdgeErrors:
    """Errors of the accepted edges of a kind."""
    assert run.truth is not None
    poses = run.truth.at([node.stamp_ns for node in run.experiences.nodes])
    edges = {n: e for n, e in enumerate(run.experiences.edges) if e.kind is kind and e.status is Status.ACCEPTED}
    error, squared = normalised_errors(list(edges.values()), poses)
    distance = np.hypot(error[:, 0], error[:, 1])
    return EdgeErrors(np.array(list(edges), dtype=np.int64), distance, np.degrees(np.abs(error[:, 2])), squared)


def recorded(world: str, seed: int, settings: dict[str, object], folder: Path) -> Path:
    """The drive of a simulated world as a recording in `folder`; rendered if it is not there yet."""
    tag = "".join(f"-{value}" for value in settings.values())
    path = folder / f"{world}-{seed}{tag}.mcap"
    if not path.exists():
        folder.mkdir(parents=True, exist_ok=True)
        options = [part for key, value in settings.items() for part in ("--set", f"{key}={value}")]
        program = [sys.executable, "-c", "from hybridmap.cli import main; main()", "simulate", world]
        subprocess.run([*program, "--seed", str(seed), "--out", str(path), *options], check=True, stdout=subprocess.DEVNULL)
    return path


def _track(updates: list[Update]) -> Track:
    """One row a distinct stamp, as a session keeps it."""
    kept: list[Update] = []
    for update in updates:
        if update.at_node >= 0 and (not kept or update.stamp_ns > kept[-1].stamp_ns):
            kept.append(update)
    return Track(
        np.array([update.stamp_ns for update in kept], dtype=np.int64),
        np.array([update.at_node for update in kept], dtype=np.int64),
        np.array([update.delta_node_robot for update in kept]),
        np.array([update.pose_odom_robot for update in kept]),
    )
