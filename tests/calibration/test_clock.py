"""The offset between views and odometry: found where the drive tells it, refused where it does not, and used."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, replace

import numpy as np
import pytest

from hybridmap.calibration import clock
from hybridmap.calibration.clock import ClockOffset, ClockState, Headings, Turns, offset_of
from hybridmap.calibration.sessions import read_drive
from hybridmap.config import Config
from hybridmap.geometry import compose
from hybridmap.graph.edges import EdgeKind, Status
from hybridmap.graph.io import graph_hash
from hybridmap.mapper import Mapper
from hybridmap.session import first_look, run
from hybridmap.streams.base import Sample, SelfMotion
from hybridmap.streams.laser import LaserScan
from hybridmap.streams.order import merge
from hybridmap.trajectory import NS_PER_S
from tests.calibration.drives import Drive, along, circle, drive
from tests.narrowing import known
from tests.streams_for_tests import BEARINGS, RoomDrive, scan

NODE_STEPS = 7


def told_by(one: Drive, late_s: float, every: int = 1, *, wide: bool = False) -> ClockOffset:
    """The offset of a drive with a view at every seventh step, whose views are stamped late by a time."""
    rng = np.random.default_rng(5)
    stamps_s = (one.motion.stamps_ns - one.motion.stamps_ns[0]) / NS_PER_S
    yaw, way = np.concatenate([[0.0], np.cumsum(one.motion.steps[:, 2])]), one.motion.travel_m
    headings = Headings(stamps_s[::every], yaw[::every], way[::every])
    seen = one.truth[::NODE_STEPS, 2] + rng.normal(0.0, 1e-3, len(one.truth[::NODE_STEPS]))
    at_s = stamps_s[::NODE_STEPS] + late_s
    turns = Turns(at_s[:-1], at_s[1:], np.diff(seen), np.full(len(at_s) - 1, 2e-3))
    return offset_of(headings, turns, wide=wide)


@pytest.mark.parametrize("late_s", [-0.2, -0.05, 0.0, 0.13, 0.3])
def test_a_drive_that_turns_tells_the_offset_whatever_the_gains_of_its_wheels(late_s):
    found = told_by(drive(np.random.default_rng(1)), late_s)
    assert found.state is ClockState.KNOWN
    assert found.offset_s == pytest.approx(late_s, abs=0.015)
    assert abs(found.offset_s - late_s) < 2.0 * found.sigma_s < 0.06
    assert found.matters == (abs(late_s) > 0.02)


def test_wheels_that_drop_out_do_not_spoil_it():
    found = told_by(drive(np.random.default_rng(2), drop_outs=6), 0.1)
    assert found.known
    assert found.offset_s == pytest.approx(0.1, abs=0.015)


@pytest.mark.parametrize("shape", ["circle", "straight"])
def test_a_drive_without_changes_of_its_turn_rate_tells_nothing(shape):
    rng = np.random.default_rng(3)
    one = circle(rng) if shape == "circle" else along(rng, [(0.05, 0.0, 0.0)] * 1500)
    assert told_by(one, 0.1, wide=True) == ClockOffset(ClockState.OPEN)


def test_sparse_odometry_tells_nothing():
    assert told_by(drive(np.random.default_rng(1)), 0.1, every=6) == ClockOffset(ClockState.SPARSE)


def test_a_large_offset_may_be_less_certain_than_a_small_one(monkeypatch):
    monkeypatch.setattr(clock, "SIGMA_MAX_S", 0.0)
    late = told_by(drive(np.random.default_rng(1)), 0.15)
    assert late.known
    assert late.offset_s == pytest.approx(0.15, abs=0.015)
    assert told_by(drive(np.random.default_rng(1)), 0.0).state is ClockState.OPEN


def test_an_offset_hardly_better_than_another_is_not_known(monkeypatch):
    one = drive(np.random.default_rng(1))
    assert told_by(one, 0.15).state is ClockState.KNOWN
    monkeypatch.setattr(clock, "RIVAL_MIN", 1e9)  # nats: no drive tells so much
    assert told_by(one, 0.15).state is ClockState.OPEN
    assert told_by(one, 3.0, wide=True).state is ClockState.OPEN


def test_another_time_base_is_told_from_a_delay():
    found = told_by(drive(np.random.default_rng(1)), 3.0, wide=True)
    assert found.state is ClockState.TIME_BASE
    assert found.offset_s == pytest.approx(3.0, abs=0.1)
    assert not found.matters
    assert told_by(drive(np.random.default_rng(1)), 3.0).state is ClockState.OPEN


@dataclass
class LateRoom(RoomDrive):
    """Laps along a rectangle in the room, with turns on the spot; odometry is stamped earlier than scans by `late_s`."""

    late_s: float = 0.0

    def _true_poses(self) -> np.ndarray:
        poses = [np.array([-1.5, -1.0, 0.0])]
        for length_m in [2.4, 2.4] * round(2 * self.laps):
            steps = [(0.06, 0.0, 0.0)] * round(length_m / 0.06) + [(0.0, 0.0, np.pi / 20)] * 10
            for step in steps:
                poses.append(compose(poses[-1], np.array(step)))
        return np.array(poses)

    def __iter__(self) -> Iterator[Sample]:
        rng, poses = np.random.default_rng(1), self._true_poses()
        noise = (
            rng.normal(0.0, [0.001, 0.0, 0.002], (len(poses), 3))
            * np.any(np.diff(poses, axis=0, append=poses[-1:]), axis=1)[:, None]
        )
        wheels = poses + np.cumsum(noise, axis=0)
        early_ns = round(self.late_s * NS_PER_S)
        motions = [SelfMotion(NS_PER_S + i * NS_PER_S // 10 - early_ns, pose) for i, pose in enumerate(wheels)]
        laser = np.array([0.1, 0.0, 0.0])
        scans = [
            LaserScan(
                NS_PER_S + i * NS_PER_S // 10,
                scan(compose(poses[i], laser)) + rng.normal(0, 0.01, len(BEARINGS)).astype(np.float32),
            )
            for i in range(0, len(poses), 2)
        ]
        samples: Iterator[Sample] = merge(motions, scans)
        yield from samples


def mapped(late_s: float, **settings: object) -> Mapper:
    tree = {"nodes.distance_m": 0.3, "backends.names": ["gtsam-lm"], **settings}
    one = LateRoom(laps=3.0, late_s=late_s)
    mapper = Mapper(Config.load("laser", tree), one.rig)
    for sample in one:
        mapper.add(sample)
    mapper.finish()
    return mapper


def odometry_errors(mapper: Mapper, first: int = 0, last: int = 10**9) -> tuple[float, int]:
    """Largest heading error of the odometry edges against the registrations, rad, and how many edges were dropped.

    Only edges into the nodes from `first` to `last` count.
    """
    edges = [edge for edge in mapper.map.edges if first <= edge.target <= last]
    own = {edge.target: edge for edge in edges if edge.kind is EdgeKind.ODOMETRY}
    seen = [edge for edge in edges if edge.kind is EdgeKind.REGISTRATION and edge.status is Status.ACCEPTED]
    off = [abs(known(edge.relative).delta[2] - known(own[edge.target].relative).delta[2]) for edge in seen]
    return max(off), sum(edge.status is not Status.ACCEPTED for edge in own.values())


@pytest.mark.parametrize("late_s", [0.2, -0.2])
def test_the_mapper_finds_the_offset_and_corrects_the_whole_drive(late_s):
    mapper = mapped(late_s)
    offset = mapper.calibration.clock.offset
    assert offset.known
    assert offset.offset_s == pytest.approx(late_s, abs=0.015)
    assert offset.used_s == offset.offset_s
    assert odometry_errors(mapper) < (0.06, 1)
    given = mapped(late_s, **{"sensors.odometry_delay_s": 0.0})
    assert given.calibration.clock.offset.used_s == 0.0
    assert given.calibration.clock.offset.left_s == pytest.approx(late_s, abs=0.015)
    assert odometry_errors(given)[0] > 0.15


@pytest.mark.parametrize("late_s", [0.2, -0.2])
def test_once_the_offset_is_known_odometry_is_corrected_while_driving(late_s):
    one = LateRoom(laps=3.0, late_s=late_s)
    mapper = Mapper(Config.load("laser", {"nodes.distance_m": 0.3, "backends.names": ["gtsam-lm"]}), one.rig)
    known_at = None
    for sample in one:
        mapper.add(sample)
        if known_at is None and mapper.calibration.clock.offset.known:
            known_at = len(mapper.map) - 1
    assert known_at is not None
    assert known_at < len(mapper.map) - 10  # among the nodes after it are turns on the spot
    assert odometry_errors(mapper, last=known_at)[0] > 0.15
    assert odometry_errors(mapper, first=known_at + 1) < (0.06, 1)


def test_a_delay_that_the_user_gives_is_taken_and_only_the_rest_is_estimated():
    offset = mapped(0.2, **{"sensors.odometry_delay_s": 0.15}).calibration.clock.offset
    assert offset.used_s == 0.0
    assert offset.offset_s == pytest.approx(0.05, abs=0.015)


def test_clocks_that_agree_change_nothing():
    assert mapped(0.0).calibration.clock.offset.used_s == 0.0
    assert graph_hash(mapped(0.0).map) == graph_hash(mapped(0.0, **{"sensors.odometry_delay_s": 0.0}).map)


def test_the_session_holds_the_odometry_on_the_clock_of_the_views(tmp_path):
    one = LateRoom(laps=3.0, late_s=0.2)
    config = Config.load("laser", {"nodes.distance_m": 0.3, "backends.names": ["gtsam-lm"]})
    session = run(one, config, tmp_path / "s")
    figures = {metric.name: metric.value for metric in session.metrics}
    assert figures["clock_offset"] == figures["clock_offset_used"] == pytest.approx(0.2, abs=0.015)
    assert 0.0 < figures["clock_offset_sigma"] < 0.03
    found = read_drive(tmp_path / "s")
    assert found.delay_s == figures["clock_offset_used"]
    yaw = np.interp(found.stamps_ns, found.motion.stamps_ns, np.concatenate([[0.0], np.cumsum(found.motion.steps[:, 2])]))
    true = np.interp(found.stamps_ns, one.groundtruth.stamps_ns + NS_PER_S, np.unwrap(one.groundtruth.poses[:, 2]))
    assert np.abs(np.diff(yaw) - np.diff(true)).max() < 0.06
    again = run(replace(one), config, tmp_path / "t")
    assert again.head["graph_hash"] == session.head["graph_hash"]


def test_a_first_look_finds_the_offset_without_a_map():
    config = Config.load("laser", {"nodes.distance_m": 0.3})
    found = first_look(LateRoom(laps=3.0, late_s=0.15), config)
    assert (found.state, found.used_s) == (ClockState.KNOWN, 0.0)
    assert found.offset_s == pytest.approx(0.15, abs=0.015)
    assert first_look(LateRoom(laps=0.5, late_s=0.15), config).state is ClockState.OPEN
