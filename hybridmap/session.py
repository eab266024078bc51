"""A session: stream -> mapper -> map file, with progress, and the figures at its end."""

from __future__ import annotations

import logging
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np

from hybridmap.backends import objective
from hybridmap.backends.base import ODOMETRY, SolveReport
from hybridmap.calibration.clock import ClockOffset
from hybridmap.calibration.sessions import CLOCK_OFFSET, GAIN_CHANGES
from hybridmap.config import Config
from hybridmap.edge_book import Update
from hybridmap.errors import StreamError, counted
from hybridmap.geometry import Array, between, compose
from hybridmap.graph.edges import Edge, EdgeKind, Proposer, Status
from hybridmap.graph.gaps import kidnappings, unobserved
from hybridmap.graph.io import graph_hash
from hybridmap.mapper import Mapper
from hybridmap.metrics import Metric, figure
from hybridmap.store import MapStore
from hybridmap.store.session_folder import SessionFolder
from hybridmap.store.track import trajectory_of
from hybridmap.streams.base import Observation, Stream, StreamReport
from hybridmap.trajectory import NS_PER_S
from hybridmap.verdict import Facts, reasons_of, said_of

log = logging.getLogger(__name__)

CORRECTED_ODOMETRY = "odometry, gains corrected"
"""Title of odometry where gains that were found while driving are in it: it is better than what the wheels said."""
LOOK_M = 40.0
"""Path length after which a first look ends, m: most drives have told the offset of their clocks by then."""

Progress = Callable[[int, int | None], None]


@dataclass(frozen=True, slots=True)
class Session:
    """A finished session.

    Attributes:
        folder: the session folder.
        head: all keys of `metrics.json` but the list of metrics.
        metrics: the metrics.
    """

    folder: SessionFolder
    head: dict[str, Any]
    metrics: list[Metric]


def run(stream: Stream, config: Config, out: Path, *, overwrite: bool = False, progress: Progress | None = None) -> Session:
    """Map a stream into a session folder.

    The map file is written as the run proceeds: a run that is killed leaves a readable map up to its last node. On any
    error what this run wrote is removed, and an overwritten session is restored. Ctrl-C keeps what was written, unless it
    overwrites a session.

    Args:
        stream: the samples.
        config: every setting; saved resolved.
        out: the session folder itself.
        overwrite: replace a session that exists.
        progress: called with (observations done, observations expected; None if unknown).

    Raises:
        StreamError: the stream is damaged or unordered, or has no odometry and views to map.
        OutputError: the folder cannot be used, or another run is writing there.
        ConfigError, BackendError: the configuration names a sensor or back-end that does not exist.
    """
    mapper = Mapper(config, stream.rig)
    folder = SessionFolder(out)
    with folder.writing(overwrite=overwrite):
        folder.write_config(config.to_yaml())
        if stream.groundtruth is not None:
            folder.write_groundtruth(stream.groundtruth)  # before the drive, so that a killed run can be evaluated
        with MapStore.create(folder.path, config.to_yaml(), stream.rig, stream.name) as store:
            recorder = _Recorder(mapper, store)
            _drive(stream, mapper, recorder, progress)
            return _conclude(stream, mapper, recorder, folder)


def first_look(stream: Stream, config: Config) -> ClockOffset:
    """Estimate how late the views of a stream are stamped, from its first `LOOK_M` metres at most, without writing a map.

    The offset may stay unknown: see `ClockOffset.state`. It comes on top of `sensors.odometry_delay_s`, if that is set.

    Raises:
        StreamError: the stream is damaged or unordered.
        ConfigError: the configuration names a sensor that the stream does not have.
    """
    mapper = Mapper(config, stream.rig, [ODOMETRY])
    clock = mapper.calibration.clock
    for sample in stream:
        mapper.add(sample)
        if clock.offset.known or (len(mapper.map) and mapper.map.nodes[-1].travel_m > LOOK_M):
            break
    if not clock.offset.known and len(mapper.map):
        clock.finish(mapper.map)
    return replace(clock.offset, used_s=0.0)


def _drive(stream: Stream, mapper: Mapper, recorder: _Recorder, progress: Progress | None) -> None:
    observations = 0
    for sample in stream:
        for update in mapper.add(sample):
            recorder.record(update)
        if isinstance(sample, Observation):
            observations += 1
            if progress is not None:
                progress(observations, stream.expected_observations)
    for name, (gone, stated) in stream.report.lost.items():
        of = counted(stated, "message")
        log.warning("%s: %s: %d of %s damaged or missing, left out", stream.name, name, gone, of)
    for update in mapper.finish():
        recorder.record(update)
    recorder.rewrite_odometry()
    if not len(mapper.map):
        counts = ", ".join(f"{count} {name}" for name, count in stream.report.counts.items()) or "no sample"
        raise StreamError(f"{stream.name}: gave nothing to map (found {counts}); expected odometry and views at the same time")


class _Recorder:
    """Writes what each update did into the map file, one transaction a node."""

    def __init__(self, mapper: Mapper, store: MapStore) -> None:
        self.store = store
        self.largest_correction_m = 0.0
        self._mapper = mapper
        self._before_first_node: list[Update] = []
        self._gain_changes = 0
        self._put_back = 0
        self._last_stamp_ns = -1
        self._poses = np.zeros((0, 3))

    def record(self, update: Update) -> None:
        """Take in one update."""
        if update.new_node is not None:
            self._write_node(update.new_node)
            self._write_put_back()
            self._write_gain_changes()
        for number in update.edges:
            self.store.put_edge(number, self._mapper.map.edge(number))
        if update.at_node < 0:
            self._before_first_node.append(update)
            return
        if update.new_node is not None or update.edges:
            self._note_correction(update)
        for early in self._before_first_node:
            self._write_track(early, 0, between(self._mapper.map.node(0).pose_odom, early.pose_odom_robot))
        self._before_first_node.clear()
        self._write_track(update, update.at_node, update.delta_node_robot)
        if update.new_node is not None:
            self.store.commit()

    def rewrite_odometry(self) -> None:
        """At the end of the drive, write its odometry anew if it was measured again, by its clock or its gains."""
        calibration, experiences = self._mapper.calibration, self._mapper.map
        self.store.put_info(CLOCK_OFFSET, calibration.clock.offset.used_s)
        again = calibration.remeasured
        if again is None:
            return
        track = self.store.track()
        if again.gains is not None:
            self.store.put_info(GAIN_CHANGES, [[int(track.stamps_ns[0]), *again.gains.to_array().tolist()]])
        poses, nodes = again.poses_at(track.stamps_ns, track.poses_odom), np.array([n.pose_odom for n in experiences.nodes])
        moved = replace(track, deltas=between(nodes[track.nodes], poses), poses_odom=poses)
        self.store.replace_odometry(moved, experiences)

    def _write_node(self, number: int) -> None:
        mapper = self._mapper
        keyframe = mapper.vision.keyframe(number) if mapper.vision is not None else {}
        initial = mapper.map.initial[number]
        self.store.add_node(number, mapper.map.node(number), initial, keyframe, mapper.cells.activity_at(number))

    def _write_put_back(self) -> None:
        """Write the cells' state again at nodes that were made while the robot was lost, once it is found."""
        cells = self._mapper.cells
        for number in cells.put_back_nodes[self._put_back :]:
            self.store.put_snapshot(number, cells.activity_at(number))
        self._put_back = len(cells.put_back_nodes)

    def _write_gain_changes(self) -> None:
        changes = self._mapper.calibration.changes
        if len(changes) > self._gain_changes:
            self._gain_changes = len(changes)
            self.store.put_info(GAIN_CHANGES, [change.row for change in changes])

    def _write_track(self, update: Update, node: int, delta: Array) -> None:
        if update.stamp_ns <= self._last_stamp_ns:
            return
        self._last_stamp_ns = update.stamp_ns
        self.store.add_track(update.stamp_ns, node, delta, update.pose_odom_robot)
        for backend in self._mapper.backends.names:
            pose = update.poses_map_robot.get(backend, update.pose_odom_robot)
            self.store.add_online(backend, update.stamp_ns, pose)

    def _note_correction(self, update: Update) -> None:
        """Keep the map just before and after the largest shift of a node on it."""
        poses = self._mapper.poses()
        known = len(self._poses)
        if known and update.edges:
            seen = self._mapper.map.initial
            extended = compose(self._poses[-1], between(seen[known - 1], seen[known:])) if len(poses) > known else seen[:0]
            before = np.concatenate([self._poses, extended])
            shift_m = float(np.hypot(*(poses[:, :2] - before[:, :2]).T).max())
            if shift_m > self.largest_correction_m:
                self.largest_correction_m = shift_m
                self.store.put_info(
                    "largest_correction",
                    {
                        "stamp_ns": update.stamp_ns,
                        "node": len(poses) - 1,
                        "shift_m": shift_m,
                        "before": before.tolist(),
                        "after": poses.tolist(),
                    },
                )
        self._poses = poses


def _conclude(stream: Stream, mapper: Mapper, recorder: _Recorder, folder: SessionFolder) -> Session:
    store = recorder.store
    store.put_anchors(mapper.anchors)
    track = store.track()
    folder.write_trajectory(ODOMETRY, track.odometry)
    for name in mapper.backends.names:
        solution = mapper.backends.solutions.get(name)
        if solution is not None:
            store.put_solution(name, solution.poses, solution.report)
            if name != ODOMETRY:
                folder.write_trajectory(name, trajectory_of(track, solution.poses))
            folder.write_trajectory(f"{name}_online", store.online(name))
    free, offset = unobserved(mapper.map, mapper.poses()), mapper.calibration.clock.offset
    head = {
        **said_of(reasons_of(facts_of(mapper, stream.report))),
        "graph_hash": graph_hash(mapper.map),
        "primary_backend": mapper.backends.primary,
        "backends": list(mapper.backends.names),
        "titles": {ODOMETRY: CORRECTED_ODOMETRY} if mapper.calibration.changes else {},
        "source": stream.name,
        "failed_backends": dict(mapper.backends.failures),
        "stream": dict(stream.report.counts),
        "lost": {name: list(counts) for name, counts in stream.report.lost.items()},
        "remarks": [
            *stream.report.remarks,
            *stream.report.skips,
            *map(str, mapper.calibration.changes),
            *([str(offset)] if offset.used_s else []),
            *map(str, kidnappings(mapper.map)),
        ],
    }
    metrics = _figures(mapper, recorder, float(track.stamps_ns[-1] - track.stamps_ns[0]) / NS_PER_S)
    if free is not None:
        metrics.append(figure("unobserved", free.sliding_m + free.blind_m, free=free))
    folder.write_metrics(head, metrics)
    for key in ("graph_hash", "primary_backend"):
        store.put_info(key, head[key])
    return Session(folder, head, metrics)


def facts_of(mapper: Mapper, report: StreamReport) -> Facts:
    """What the verdict on a drive is made from: the mapper after `finish`, and the report of its stream."""
    primary = mapper.backends.primary
    return Facts.of_drive(
        mapper.map,
        mapper.backends.solutions.get(primary),
        primary,
        failure=mapper.backends.failures.get(primary, ""),
        lost_since=mapper.lost_since,
        clock=mapper.calibration.clock.offset,
        lost=report.lost,
    )


def _weak(name: str, report: SolveReport) -> list[Metric]:
    """Figures of the edges of motion that a back-end's kernel down-weights."""
    if not report.weak_edges:
        return []
    return [
        figure(f"weak_edges/{name}", len(report.weak_edges)),
        figure(f"hanging_nodes/{name}", report.hanging_nodes),
    ]


def _clock_figures(offset: ClockOffset) -> list[Metric]:
    return [
        figure("clock_offset", offset.offset_s, said=offset),
        figure("clock_offset_sigma", offset.sigma_s),
        figure("clock_offset_used", offset.used_s),
    ]


def _proposed_by(loops: Sequence[Edge]) -> list[Metric]:
    """How many accepted loops each proposer found first."""
    accepted = [loop.proposed_by for loop in loops if loop.status is Status.ACCEPTED]
    return [figure(f"loops_proposed_by/{who}", accepted.count(who), what=who.words) for who in Proposer]


def _measured_again(mapper: Mapper) -> list[Metric]:
    tried, edges = mapper.book.tried_again, mapper.map.edges
    solution = mapper.backends.solutions.get(mapper.backends.primary)
    without = set(solution.report.rejected_edge_ids) if solution is not None else set()
    kept = [number for number in tried if edges[number].status is Status.ACCEPTED and number not in without]
    return [
        figure("loops_tried_again", len(tried)),
        figure("loops_readmitted", len(kept)),
    ]


def _learnt_noise(mapper: Mapper) -> list[Metric]:
    learnt = mapper.book.motion.wheels.learnt
    if learnt is None:
        return []
    heading = figure("wheels_heading_noise", learnt.heading_deg)
    return [heading, figure("wheels_translation_noise", learnt.translation_m)]


def _figures(mapper: Mapper, recorder: _Recorder, duration_s: float) -> list[Metric]:
    edges = mapper.map.edges
    loops = [edge for edge in edges if edge.kind is EdgeKind.LOOP]
    dropped = [edge for edge in edges if edge.kind is EdgeKind.ODOMETRY and edge.status is not Status.ACCEPTED]
    count = {status: float(sum(edge.status is status for edge in loops)) for status in Status}
    rows = [
        figure("nodes", len(mapper.map)),
        figure("loops_accepted", count[Status.ACCEPTED]),
        figure("loops_pending", count[Status.PENDING]),
        figure("loops_rejected", count[Status.REJECTED]),
        figure("loops_retracted", count[Status.RETRACTED]),
        *_proposed_by(loops),
        *_measured_again(mapper),
        figure("odometry_dropped", len(dropped)),
        *_learnt_noise(mapper),
        *_clock_figures(mapper.calibration.clock.offset),
        figure("largest_correction", recorder.largest_correction_m),
        figure("travel", mapper.map.node(len(mapper.map) - 1).travel_m),
        figure("duration", duration_s),
    ]
    graph = mapper.map.pose_graph()
    chain = objective.chi2(graph, graph.initial)
    rows += [figure(f"chi2_initial/{ODOMETRY}", chain), figure(f"chi2/{ODOMETRY}", chain)]
    for name, solution in mapper.backends.solutions.items():
        if name == ODOMETRY:
            continue
        report = solution.report
        rows += [
            figure(f"chi2_initial/{name}", chain),
            figure(f"chi2/{name}", objective.chi2(graph, solution.poses)),
            figure(f"loops_rejected/{name}", len(report.rejected_edge_ids)),
            *_weak(name, report),
        ]
    rows += [figure(f"cpu_s/{stage}", cpu_s, what="the stage") for stage, cpu_s in mapper.clock.cpu_s.items()]
    total = sum(mapper.clock.cpu_s.values())
    rows.append(figure("cpu_s/mapping", total, what="all stages"))
    if duration_s > 0:
        rows.append(figure("cpu_s_per_min", 60.0 * total / duration_s))
    return rows
