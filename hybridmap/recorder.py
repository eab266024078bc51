"""Writes what a mapper does into the map file, one transaction a node."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from hybridmap.calibration.sessions import CLOCK_OFFSET, GAIN_CHANGES
from hybridmap.edge_book import Update
from hybridmap.geometry import Array, between, compose
from hybridmap.mapper import Mapper
from hybridmap.store import MapStore
from hybridmap.vision.base import MeetingFrontEnd


class Recorder:
    """Writes what each update did into the map file, one transaction a node."""

    def __init__(self, mapper: Mapper, store: MapStore) -> None:
        """Start with an empty map file."""
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
        if update.new_node is not None or update.followed:
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
        made = np.searchsorted(experiences.stamps_ns, track.stamps_ns, side="right").clip(1) - 1
        followed = (track.nodes != made)[:, None]  # seen from an older node: by registration, not by the odometry since then
        deltas = np.where(followed, track.deltas, between(nodes[track.nodes], poses))
        moved = replace(track, deltas=deltas, poses_odom=poses)
        self.store.replace_odometry(moved, experiences)

    def _write_node(self, number: int) -> None:
        mapper = self._mapper
        keyframe = mapper.vision.keyframe(number) if mapper.vision is not None else {}
        state = mapper.vision.state(number) if isinstance(mapper.vision, MeetingFrontEnd) else {}
        initial = mapper.map.initial[number]
        self.store.add_node(number, mapper.map.node(number), initial, keyframe, mapper.cells.activity_at(number), state)

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
