"""A carry that nobody noticed while driving is found on the final map, by evidence alone."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from hybridmap.config import Config
from hybridmap.geometry import RelativePose, align, between, compose, inverse
from hybridmap.graph.edges import EdgeKind, Lack, Search, Status
from hybridmap.graph.gaps import kidnappings
from hybridmap.mapper import Mapper
from hybridmap.simulation import SimulatedStream
from tests.narrowing import known
from tests.streams_for_tests import RoomDrive


def drive(named, world, carried_m, seed=1):
    settings = {"simulation.world": world, "simulation.carried_m": carried_m, "backends.names": ["gtsam-gnc"]}
    if named == "laser":
        settings["simulation.sensors"] = "laser"
    config = Config.load(named, settings)
    stream = SimulatedStream(config.simulation, seed)
    mapper = Mapper(config, stream.rig)
    for sample in stream:
        mapper.add(sample)
    mapper.finish()
    return stream, mapper


def error_m(stream, mapper):
    truth = stream.groundtruth.at(np.array([node.stamp_ns for node in mapper.map.nodes]))
    poses = mapper.poses()
    return float(np.sqrt(np.mean(np.sum((compose(align(truth, poses), poses) - truth)[:, :2] ** 2, axis=1))))


def put_down(stream, mapper):
    """The first node after the robot was carried."""
    stamps = np.array([node.stamp_ns for node in mapper.map.nodes])
    return int(np.searchsorted(stamps, stream.groundtruth.stamps_ns[known(stream.carry).last]))


@pytest.mark.parametrize(
    ("named", "carried_m"),
    [("laser", 0.75), ("laser", 1.0), ("laser", 2.0), pytest.param("rgbd", 1.0, marks=pytest.mark.slow)],
)
def test_a_short_carry_is_found_and_the_map_is_right(named, carried_m):
    stream, mapper = drive(named, "lab", carried_m)
    down = put_down(stream, mapper)
    assert [(one.before, one.after) for one in kidnappings(mapper.map)] == [(down - 1, down)]
    assert error_m(stream, mapper) < 0.02
    motion = (EdgeKind.REGISTRATION, EdgeKind.ODOMETRY)  # where no registration of the step was accepted, the wheels' edge
    crossing = [e for e in mapper.map.edges if e.source < down <= e.target and e.kind in motion]
    broken = [edge for edge in crossing if edge.lack is Lack.KIDNAPPED]
    assert broken
    assert all(edge.status is Status.RETRACTED for edge in broken)
    assert any(not check.passed for edge in broken for check in edge.broken_by)


@pytest.mark.parametrize("named", ["laser", pytest.param("rgbd", marks=pytest.mark.slow)])
def test_a_carry_to_a_place_that_looks_alike_is_found_by_the_place_that_fits_better(named):
    stream, mapper = drive(named, "lab", 20.0)  # the other end of the room, which looks the same turned round
    down = put_down(stream, mapper)
    assert [(one.before, one.after) for one in kidnappings(mapper.map)] == [(down - 1, down)]
    assert error_m(stream, mapper) < 0.02


@pytest.mark.parametrize(
    ("named", "world", "carried_m", "seed"),
    [
        pytest.param("laser", "lab", 1.5, 6, id="the loops across it are measured by scans of both sides"),
        pytest.param("rgbd", "office", 1.5, 3, marks=pytest.mark.slow, id="other places show more signs of a carry"),
        pytest.param("rgbd", "office", 2.0, 2, marks=pytest.mark.slow, id="false loops cost the trial a hundred true ones"),
    ],
)
def test_a_carry_is_found_against_the_odds(named, world, carried_m, seed):
    stream, mapper = drive(named, world, carried_m, seed)
    assert [one.after for one in kidnappings(mapper.map)] == [put_down(stream, mapper)]
    assert error_m(stream, mapper) < 0.04


def test_loops_outside_the_gate_tell_of_a_carry_of_some_metres():
    stream, mapper = drive("laser", "lab", 3.0)
    down = put_down(stream, mapper)
    assert [one.after for one in kidnappings(mapper.map)] == [down]
    assert error_m(stream, mapper) < 0.02
    across = [e for e in mapper.map.edges if e.kind is EdgeKind.LOOP and e.target < down <= e.source]
    accepted = [edge for edge in across if edge.status is Status.ACCEPTED]
    assert sum(edge.search is Search.AGAIN for edge in accepted) >= 6
    for edge in accepted:
        if edge.search is not Search.AGAIN:  # the gate is 3.2 m wide: a loop may just lie in it
            assert {check.figure: check.limit for check in edge.checks}["off_m"] > 3.0


@pytest.mark.slow
def test_few_rejected_loops_count_together_with_those_that_the_front_end_refused():
    stream, mapper = drive("laser", "lab", 1.5, seed=5)
    assert [one.after for one in kidnappings(mapper.map)] == [put_down(stream, mapper)]
    assert error_m(stream, mapper) < 0.02


@pytest.mark.slow
@pytest.mark.parametrize("seed", [1, 3])  # the loops bend the chain; they are rejected
def test_where_no_step_is_odd_single_scans_tell_the_node(seed):
    stream, mapper = drive("laser", "office", 1.0, seed)
    down = put_down(stream, mapper)
    assert [one.after for one in kidnappings(mapper.map)] == [down]
    [broken_by] = {e.broken_by for e in mapper.map.edges if e.source == down - 1 and e.target == down and e.broken_by}
    assert [check.figure for check in broken_by] == ["fit_elsewhere"]
    assert error_m(stream, mapper) < 0.03


@pytest.mark.slow
def test_a_carry_that_a_registration_measures_needs_no_break():
    stream, mapper = drive("rgbd", "lab", 0.3)
    assert kidnappings(mapper.map) == ()
    assert any(edge.contradicts_odometry for edge in mapper.map.edges)
    assert error_m(stream, mapper) < 0.02


def test_a_drive_without_a_carry_is_left_alone():
    stream, mapper = drive("laser", "lab", None)
    assert kidnappings(mapper.map) == ()
    assert error_m(stream, mapper) < 0.02


def mapped(stream):
    mapper = Mapper(Config.load("laser", {"backends.names": ["gtsam-gnc"]}), stream.rig)
    for sample in stream:
        mapper.add(sample)
    mapper.finish()
    return mapper


def test_false_loops_that_agree_move_nothing_where_the_chain_shows_no_break(monkeypatch):
    mapper = mapped(RoomDrive(laps=0.9))
    poses, last = mapper.poses(), len(mapper.map) - 1
    model = next(e for e in mapper.map.edges if e.kind is EdgeKind.REGISTRATION)
    motion = np.array([0.8, -0.5, 0.2])
    false = []
    for count, newer in enumerate(range(last - 7, last + 1)):
        relative = between(poses[count], compose(motion, poses[newer]))
        loop = replace(
            model,
            source=newer,
            target=count,
            kind=EdgeKind.LOOP,
            relative=RelativePose(inverse(relative), np.diag([1e-4, 1e-4, 1e-5])),
            checks=(),
            key=900 + count,
            since_node=-1,
        )
        false.append(loop)
    entered = mapper.book.enter(false)
    monkeypatch.setattr(mapper.vision, "verify", lambda outliers, belief: [])  # else it would measure them rightly
    mapper.finish()
    assert kidnappings(mapper.map) == ()
    assert len(set(entered) & set(mapper.backends.solutions["gtsam-gnc"].report.rejected_edge_ids)) >= 6
    np.testing.assert_allclose(mapper.poses(), poses, atol=0.01)
