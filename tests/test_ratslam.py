"""RatSLAM as a system on a drive through the laboratory: loops by view cells, nodes that hang on matched ones."""

from __future__ import annotations

import numpy as np
import pytest

from hybridmap.config import Config
from hybridmap.errors import ConfigError
from hybridmap.evaluate import absolute_error
from hybridmap.geometry import between
from hybridmap.graph.edges import EdgeKind, Method, Status
from hybridmap.mapper import Mapper
from hybridmap.metrics import StageClock
from hybridmap.ratslam.front_end import create
from hybridmap.simulation import SimulatedStream
from hybridmap.streams.base import Rig
from hybridmap.trajectory import Trajectory
from tests.streams_for_tests import RoomDrive

LAB = {
    "simulation.world": "lab",
    "simulation.duration_s": 60.0,
    "simulation.camera.width_px": 160,
    "simulation.camera.height_px": 120,
}


def drive(stream, changes, samples=None):
    mapper = Mapper(Config.load("ratslam", changes), stream.rig)
    for sample in samples or stream:
        mapper.add(sample)
    mapper.finish()
    return mapper


@pytest.fixture(scope="module")
def stream():
    return SimulatedStream(Config.load("ratslam", LAB).simulation, 0)


@pytest.fixture(scope="module")
def samples(stream):
    return list(stream)


@pytest.fixture(scope="module")
def lab(stream, samples):
    return drive(stream, LAB, samples)


def loops(mapper):
    return [edge for edge in mapper.map.edges if edge.kind is EdgeKind.LOOP and edge.status is Status.ACCEPTED]


def test_the_second_lap_is_recognised_and_every_match_is_right(lab, stream):
    truth = stream.groundtruth.at(np.array([node.stamp_ns for node in lab.map.nodes]))
    assert len(loops(lab)) > 30
    for edge in loops(lab):
        gap = between(between(truth[edge.source], truth[edge.target]), edge.relative.delta)
        assert np.hypot(*gap[:2]) < 0.5
        assert abs(gap[2]) < np.radians(10.0)


def test_the_map_has_less_than_half_the_error_of_the_wheels(lab, stream):
    stamps = np.array([node.stamp_ns for node in lab.map.nodes])
    wheels = np.array([node.pose_odom for node in lab.map.nodes])
    by_map, by_wheels = (absolute_error(Trajectory(stamps, p), stream.groundtruth).rmse_m for p in (lab.poses(), wheels))
    assert by_wheels > 0.2
    assert by_map < 0.5 * by_wheels


def test_the_node_after_a_match_hangs_on_the_matched_one(lab):
    into = {edge.target: edge.source for edge in lab.map.edges if edge.kind is EdgeKind.ODOMETRY}
    matched = {edge.source: edge.target for edge in loops(lab)}
    after = [node + 1 for node in matched if node + 1 in into]
    assert len(after) > 30
    assert all(into[node] == matched[node - 1] for node in after)


def test_edges_are_of_the_wheels_and_of_profiles_alone(lab):
    assert {edge.method for edge in lab.map.edges} == {Method.ODOMETRY, Method.PROFILE}
    assert all(edge.relative.delta[:2] == pytest.approx([0.0, 0.0]) for edge in loops(lab))


def test_a_looser_threshold_makes_fewer_nodes(lab, stream, samples):
    assert len(drive(stream, LAB | {"vision.matching.c_t": 0.3}, samples).map) < 0.7 * len(lab.map)


def test_a_laser_closes_the_laps_of_a_room():
    room = RoomDrive(laps=2)
    mapper = drive(room, {"vision.sensor": "laser", "vision.matching.c_t": 0.1})
    assert len(loops(mapper)) > 10


def test_a_source_without_such_a_sensor_is_refused():
    with pytest.raises(ConfigError, match=r"vision\.closing\.by is ratslam: expected a laser or an RGB-D camera"):
        create(Config.load("ratslam").vision, Rig(), 0, StageClock())
