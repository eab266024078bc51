"""A conventional SLAM beside ours: registration of each scan to the map of the last metres, and no loop."""

from __future__ import annotations

import numpy as np
import pytest

from hybridmap.config import Config
from hybridmap.evaluate import absolute_error
from hybridmap.graph.edges import EdgeKind, Status
from hybridmap.mapper import Mapper
from hybridmap.simulation import SimulatedStream
from hybridmap.trajectory import Trajectory
from tests.streams_for_tests import RoomDrive


def mapped(config, stream):
    mapper = Mapper(config, stream.rig)
    for sample in stream:
        mapper.add(sample)
    mapper.finish()
    return mapper


@pytest.fixture(scope="module")
def room():
    return mapped(Config.load("scan-to-map"), RoomDrive(laps=3))


def test_three_laps_of_a_room_close_no_loop_where_the_laser_configuration_does(room):
    assert any(edge.kind is EdgeKind.LOOP for edge in mapped(Config.load("laser"), RoomDrive(laps=2)).map.edges)
    assert {edge.kind for edge in room.map.edges} <= {EdgeKind.ODOMETRY, EdgeKind.REGISTRATION}
    assert room.lost_since is None


def test_nearly_every_node_is_registered_and_the_map_is_better_than_the_wheels(room):
    registered = [edge for edge in room.map.edges if edge.kind is EdgeKind.REGISTRATION and edge.status is Status.ACCEPTED]
    assert len(registered) > 0.9 * (len(room.map) - 1)
    stamps = np.array([node.stamp_ns for node in room.map.nodes])
    wheels = np.array([node.pose_odom for node in room.map.nodes])
    truth = RoomDrive(laps=3).groundtruth
    by_map, by_wheels = (absolute_error(Trajectory(stamps, poses), truth).rmse_m for poses in (room.poses(), wheels))
    assert by_map < 0.25 * by_wheels


def test_a_camera_without_loops_registers_depth_alone():
    settings = {"simulation.world": "lab", "simulation.duration_s": 5.0, "vision.closing.by": "nothing"}
    config = Config.load("rgbd", settings)
    edges = mapped(config, SimulatedStream(config.simulation, 0)).map.edges
    assert {edge.kind for edge in edges} == {EdgeKind.ODOMETRY, EdgeKind.REGISTRATION}
