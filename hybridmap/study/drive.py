"""Mapping a drive for a study: a recording or a simulated world, disturbed, and the errors of its map."""

from __future__ import annotations

import math
from collections.abc import Iterable, Iterator, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from hybridmap.backends.base import ODOMETRY, Solution, SolveStatus
from hybridmap.conclusion import facts_of
from hybridmap.config import Config
from hybridmap.edge_book import Update
from hybridmap.errors import StudyError, counted
from hybridmap.evaluate.edge_errors import ClosureLimits, closure_errors, edge_errors, normalised_errors
from hybridmap.evaluate.relations import Relations, relation_errors, relations_of
from hybridmap.evaluate.trajectory_errors import absolute_error
from hybridmap.geometry import Array, between
from hybridmap.graph.edges import EdgeKind, Status
from hybridmap.graph.gaps import grounded
from hybridmap.mapper import Mapper
from hybridmap.metrics import StageClock
from hybridmap.simulation import SimulatedStream
from hybridmap.store.track import Track, trajectory_of
from hybridmap.streams import open_stream
from hybridmap.streams.base import Observation, Sample, Stream
from hybridmap.study.disturb import KIDNAPPED, disturbed
from hybridmap.study.frozen import Figures, Frozen, Mapped
from hybridmap.study.measures import KEPT, WRONG_DEG, WRONG_M
from hybridmap.trajectory import NS_PER_S, Trajectory, known_at, read_tum
from hybridmap.verdict import Verdict, reasons_of, verdict_of

LIMITS = ClosureLimits(right_m=WRONG_M, right_deg=WRONG_DEG)

_FOUND_M = 0.7  # a pose this close to where it should be is right: within it the next loops are looked for
_KNOWN_M, _KNOWN_RAD = 1.0, math.radians(45.0)  # so close to where it was before, a laser sees much the same


@dataclass(frozen=True, slots=True)
class MappedDrive:
    """A drive to be mapped; on a cluster, every worker needs the recording at the same path.

    Attributes:
        source: name of a simulated world, or path of a recording.
        config: configuration of the mapping, as plain values.
        start_s, end_s: map only this part, seconds from the first stamp; None: no limit.
        disturb: name of a disturbance -> strength; None: none.
        seed: seed of the disturbances; that of a simulated world is in `config`.
        reference: path of the ground truth; empty string: the stream's own ground truth, if it has one.
        relations: path of a file of true relative poses; empty string: none.
    """

    source: str
    config: Mapping[str, Any]
    start_s: float | None = None
    end_s: float | None = None
    disturb: Mapping[str, float | tuple[float, ...]] | None = None
    seed: int = 0
    reference: str = ""
    relations: str = ""

    def make(self) -> Frozen:
        """Map the drive once and freeze the accepted edges.

        Returns:
            The graph, the true poses of its nodes (NaN where unknown), and the figures of each back-end's map of the drive.

        Raises:
            HybridMapError: the stream cannot be read or mapped, or gives no edge.
            FileNotFoundError: the recording or a file beside it is not on this machine.
        """
        config = Config.from_tree(self.config, "study")
        if Path(self.source).is_absolute():
            _there(self.source)
        stream = open_stream(self.source, config, start_s=self.start_s, end_s=self.end_s)
        truth = read_tum(_there(self.reference)) if self.reference else stream.groundtruth
        mapper, clock = Mapper(config, stream.rig), StageClock()
        watch = _Watch(mapper, truth, self._put_down_ns(stream))
        updates, views = list[Update](), 0
        for sample in disturbed(stream, stream.rig, self.disturb or {}, self.seed):
            views += isinstance(sample, Observation)
            with clock.stage("mapping"):
                new = mapper.add(sample)
            watch.look(sample, new)
            updates += new
        with clock.stage("mapping"):
            updates += mapper.finish()
        graph = mapper.map.pose_graph()
        if not graph.n_edges:
            raise StudyError(
                f"{stream.name}: the drive gave {counted(graph.n_nodes, 'node')} and no edge; drive longer (end_s)"
            )
        track = _track(mapper, updates)
        relations = relations_of(_there(self.relations), track.odometry) if self.relations else None
        reference = truth_at(truth, _stamps(mapper)) if truth is not None else np.full((graph.n_nodes, 3), np.nan)
        verdict = verdict_of(reasons_of(facts_of(mapper, stream.report)))
        mapped = Mapped(
            mapper.backends.primary,
            _figures(mapper, track, truth, relations, {**watch.figures(), **_of_session(mapper, verdict)}),
            _timings(clock.cpu_s["mapping"], float(track.stamps_ns[-1] - track.stamps_ns[0]) / NS_PER_S, views),
            _poses(mapper),
            _lost(mapper),
        )
        return Frozen(graph, reference, of_truth=truth is not None, mapped=mapped)

    def _put_down_ns(self, stream: Stream) -> int | None:
        """Stamp at which a kidnapped robot is put down; None if it is not kidnapped."""
        if isinstance(stream, SimulatedStream):
            return None if stream.carry is None else int(stream.groundtruth.stamps_ns[stream.carry.last])
        times_s = (self.disturb or {}).get(KIDNAPPED)
        if not isinstance(times_s, tuple):
            return None
        return next(iter(stream)).stamp_ns + round(times_s[1] * NS_PER_S)


class _Watch:
    """After a kidnapping, tracks the error of the robot's pose on its own map."""

    def __init__(self, mapper: Mapper, truth: Trajectory | None, down_ns: int | None) -> None:
        self._mapper, self._truth, self._down_ns = mapper, truth, down_ns
        self._off_m = list[float]()

    def look(self, sample: Sample, updates: Iterable[Update]) -> None:
        """Look at the map after a sample."""
        if self._truth is None or self._down_ns is None or sample.stamp_ns < self._down_ns:
            return
        self._off_m += [self._off_map_m(self._truth, self._down_ns) for update in updates if update.new_node is not None]

    def figures(self) -> Figures:
        """Error after the kidnapping; travel until the robot was in a known place, and until localised; None: never."""
        if self._truth is None or self._down_ns is None or not self._off_m:
            return {}
        stamps = _stamps(self._mapper)
        nodes, down = self._truth.at(stamps), int(np.searchsorted(stamps, self._down_ns))
        steps = np.diff(nodes[down:, :2], axis=0, prepend=self._truth.at([self._down_ns])[:, :2])
        way_m = np.hypot(steps[:, 0], steps[:, 1]).cumsum()
        found_m = way_m[int(np.max(np.flatnonzero(np.array(self._off_m) >= _FOUND_M), initial=-1)) + 1 :]
        known_m = way_m[_been_before(nodes, down)]
        return {
            "kidnapped_m": self._off_m[0],
            "known_m": float(known_m[0]) if len(known_m) else None,
            "found_m": float(found_m[0]) if len(found_m) else None,
        }

    def _off_map_m(self, truth: Trajectory, down_ns: int) -> float:
        """Error of the newest node, relative to the earlier node that is nearest to it in the ground truth."""
        stamps = _stamps(self._mapper)
        nodes, poses = truth.at(stamps), self._mapper.poses()
        before = nodes[: np.searchsorted(stamps, down_ns)]
        old = int(np.argmin(np.hypot(before[:, 0] - nodes[-1, 0], before[:, 1] - nodes[-1, 1])))
        apart = between(poses[old], poses[-1]) - between(nodes[old], nodes[-1])
        return float(np.hypot(apart[0], apart[1]))


def _been_before(nodes: Array, down: int) -> NDArray[np.bool_]:
    """Which nodes from a given one on, by true poses (N, 3), are near an earlier one with a similar heading."""
    apart = between(nodes[down:, None], nodes[None, :down])
    near = (np.hypot(apart[..., 0], apart[..., 1]) < _KNOWN_M) & (np.abs(apart[..., 2]) < _KNOWN_RAD)
    return np.asarray(near.any(axis=1))


def _of_session(mapper: Mapper, verdict: Verdict) -> Figures:
    """The verdict on the map, and the offset between the clocks of its sensors."""
    offset = mapper.calibration.clock.offset
    return {"verdict": float(verdict.grade), "clock_offset_s": offset.offset_s if offset.known else None}


def _figures(
    mapper: Mapper, track: Track, truth: Trajectory | None, relations: Relations | None, of_primary: Figures
) -> Mapping[str, Figures]:
    """Figures of odometry and of every back-end, with those that are `of_primary`; None if not finite."""
    found: dict[str, dict[str, float | None]] = {}
    estimates = {name: trajectory_of(track, mapper.poses(name)) for name in mapper.backends.solutions if name != ODOMETRY}
    for name, estimate in ({ODOMETRY: track.odometry} | estimates).items():
        figures: dict[str, float | None] = dict(_of_trajectory(grounded(estimate, mapper.map), truth, relations))
        if name != ODOMETRY:
            figures |= _of_loops(mapper, mapper.backends.solutions[name], truth)
        if name == mapper.backends.primary:
            figures |= of_primary
        found[name] = {key: value if value is not None and math.isfinite(value) else None for key, value in figures.items()}
    return found


def _poses(mapper: Mapper) -> dict[str, Array]:
    """Poses (N, 3) of the nodes by odometry and by every back-end, each in its own frame."""
    by_odometry = np.array([node.pose_odom for node in mapper.map.nodes])
    return {ODOMETRY: by_odometry} | {name: mapper.poses(name) for name in mapper.backends.solutions if name != ODOMETRY}


def _lost(mapper: Mapper) -> dict[str, tuple[str, str]]:
    """Status of every back-end that ended the drive without a map of its own, and why in one line."""
    reports = [one.report for one in mapper.backends.solutions.values()]
    found = {one.backend: (str(one.status), one.message) for one in reports if not one.status.has_map}
    failed = str(SolveStatus.FAILED)
    return found | {name: (failed, " ".join(why.split())) for name, why in mapper.backends.failures.items()}


def _of_trajectory(estimate: Trajectory, truth: Trajectory | None, relations: Relations | None) -> Iterator[tuple[str, float]]:
    if truth is not None:
        yield "ate_m", absolute_error(estimate, truth).rmse_m
    if relations is not None:
        errors = relation_errors(estimate, relations)
        yield "relation_m", errors.all.trans_mean_m
        yield "relation_deg", errors.all.rot_mean_deg
        yield "relation_loop_m", errors.loops.trans_mean_m


def _of_loops(mapper: Mapper, solution: Solution, truth: Trajectory | None) -> dict[str, float]:
    graph, report = mapper.map.pose_graph(), solution.report
    rejected = frozenset(report.rejected_edge_ids)
    figures = {
        "nodes": float(graph.n_nodes),
        "loops": float(np.count_nonzero(graph.is_loop)),
        "loops_rejected": float(len(rejected)),
    }
    if truth is None:
        return figures
    closures = closure_errors(mapper.map, truth, rejected, LIMITS)
    figures |= {"loop_precision": closures.precision, "loop_recall": closures.recall}
    figures |= {"false_kept": float(_false_kept(mapper, solution, truth)), "wrong_loops": 0.0}
    edges = edge_errors(mapper.map, truth, report.weights)
    if (of_loops := edges.get(EdgeKind.LOOP)) is not None:
        figures |= {
            "wrong_loops": float(of_loops.wrong),
            "loop_median_m": of_loops.trans_median_m,
            "loop_p95_m": of_loops.trans_p95_m,
            "loop_median_deg": of_loops.rot_median_deg,
            "loop_p95_deg": of_loops.rot_p95_deg,
            "loop_chi2_ratio": of_loops.chi2_ratio,
        }
    if (of_registrations := edges.get(EdgeKind.REGISTRATION)) is not None:
        figures["registration_chi2_ratio"] = of_registrations.chi2_ratio
    return figures


def _false_kept(mapper: Mapper, solution: Solution, truth: Trajectory) -> int:
    """Number of loops far from the ground truth that keep a weight above one half."""
    known, weights = known_at(truth, _stamps(mapper)), solution.report.weights
    kept = [
        edge
        for number, edge in enumerate(mapper.map.edges)
        if edge.kind is EdgeKind.LOOP
        and edge.status is Status.ACCEPTED
        and edge.relative is not None
        and known[edge.source]
        and known[edge.target]
        and weights.get(number, 1.0) > KEPT
    ]
    error, _ = normalised_errors(kept, truth.at(_stamps(mapper)))
    return int(np.count_nonzero((np.hypot(error[:, 0], error[:, 1]) > WRONG_M) | (np.degrees(np.abs(error[:, 2])) > WRONG_DEG)))


def _timings(cpu_s: float, duration_s: float, views: int) -> dict[str, float]:
    timings = {"cpu_s": cpu_s}
    if duration_s > 0.0:
        timings["cpu_s_per_min"] = 60.0 * cpu_s / duration_s
    if views:
        timings["cpu_ms_per_view"] = 1e3 * cpu_s / views
    return timings


def _track(mapper: Mapper, updates: Iterable[Update]) -> Track:
    """One row per distinct stamp, as in a session; rows before the first node are relative to that node."""
    rows: dict[int, tuple[int, Array, Array]] = {}
    first = mapper.map.node(0).pose_odom
    newest = -1
    for update in updates:
        if update.stamp_ns > newest:
            newest = update.stamp_ns
            delta = update.delta_node_robot if update.at_node >= 0 else between(first, update.pose_odom_robot)
            rows[newest] = max(update.at_node, 0), delta, update.pose_odom_robot
    nodes, deltas, poses_odom = zip(*rows.values(), strict=True)
    stamps_ns = np.array(list(rows), dtype=np.int64)
    return Track(stamps_ns, np.array(nodes, dtype=np.int64), np.array(deltas), np.array(poses_odom), mapper.anchors)


def _stamps(mapper: Mapper) -> NDArray[np.int64]:
    return np.array([node.stamp_ns for node in mapper.map.nodes], dtype=np.int64)


def truth_at(truth: Trajectory, stamps_ns: NDArray[np.int64]) -> Array:
    """True poses (N, 3) at stamps (N,) ns, m and rad; NaN where the ground truth has no pose."""
    poses = truth.at(stamps_ns)
    poses[~known_at(truth, stamps_ns)] = np.nan
    return poses


def _there(path: str) -> Path:
    """A path that must exist: a worker without the file reports that, and the study tries another one."""
    if not Path(path).exists():
        raise FileNotFoundError(f"{path}: not on this machine; a recording must lie at the same path on every worker")
    return Path(path)
