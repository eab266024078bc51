"""The page: samples in, a map out, without any file."""

from __future__ import annotations

import numpy as np
import pytest

from hybridmap.config import Config
from hybridmap.errors import BackendError, StreamError
from hybridmap.evaluate import absolute_error
from hybridmap.geometry import between, compose
from hybridmap.graph.edges import EdgeKind, Status
from hybridmap.graph.io import graph_hash
from hybridmap.mapper import Mapper
from hybridmap.neural.path_integrator import PathIntegrator
from hybridmap.streams.base import Sample, SelfMotion
from hybridmap.streams.laser import LaserScan
from hybridmap.trajectory import Trajectory
from hybridmap.verification.shadow import overwrite
from tests.narrowing import known
from tests.streams_for_tests import RoomDrive


def drive(mapper: Mapper, stream: RoomDrive) -> list:
    updates = [update for sample in stream for update in mapper.add(sample)]
    return updates + mapper.finish()


@pytest.fixture(scope="module")
def mapped():
    stream = RoomDrive()
    mapper = Mapper(Config.load("laser"), stream.rig)
    return mapper, drive(mapper, stream), stream


def test_the_map_is_better_than_odometry(mapped):
    mapper, _updates, stream = mapped
    stamps = np.array([node.stamp_ns for node in mapper.map.nodes])
    odometry = absolute_error(Trajectory(stamps, mapper.map.initial), stream.groundtruth)
    optimised = absolute_error(Trajectory(stamps, mapper.poses()), stream.groundtruth)
    assert odometry.rmse_m > 0.1
    assert optimised.rmse_m < 0.25 * odometry.rmse_m


def test_consecutive_nodes_are_always_joined(mapped):
    mapper, _, _ = mapped
    graph = mapper.map.pose_graph()
    chained = set(zip(graph.sources[~graph.is_loop].tolist(), graph.targets[~graph.is_loop].tolist(), strict=True))
    assert all((i - 1, i) in chained or (i, i - 1) in chained for i in range(1, len(mapper.map)))


def test_every_node_says_why_and_every_edge_too(mapped):
    mapper, updates, _ = mapped
    made = [update for update in updates if update.new_node is not None]
    assert [update.new_node for update in made] == list(range(len(mapper.map)))
    assert all(update.reason for update in made)
    assert all(edge.reason for edge in mapper.map.edges)


def test_the_correction_brings_odometry_onto_the_map(mapped):
    mapper, _updates, stream = mapped
    last = [sample for sample in stream if isinstance(sample, SelfMotion)][-1]
    assert np.allclose(between(compose(mapper.pose_map_odom, last.pose_odom_robot), mapper.pose_map_robot), 0, atol=1e-6)


def test_fed_by_hand_in_seconds_gives_the_same_map(mapped):
    whole, _, stream = mapped
    mapper = Mapper(Config.load("laser"), stream.rig)
    for sample in stream:
        if isinstance(sample, LaserScan):
            mapper.add_scan(sample.stamp_ns / 1e9, sample.ranges_m)
        else:
            mapper.add_odometry(sample.stamp_ns / 1e9, sample.pose_odom_robot)
    mapper.finish()
    assert graph_hash(mapper.map) == graph_hash(whole.map)


def test_the_pose_follows_the_activity():
    """No number integrates position beside the network: with other activity the mapper believes to be elsewhere."""
    mapper = Mapper(Config.load("laser", {"vision.sensor": "none", "neural.rectifier": "softplus"}))
    for i in range(20):
        mapper.add_odometry(0.1 * i, [0.05 * i, 0.0, 0.0])
    before = mapper.integrator.pose
    assert isinstance(mapper.integrator, PathIntegrator)
    overwrite(mapper.integrator, "both", np.array([0.1, 0.05]))
    moved = known(mapper.add_odometry(2.0, [0.95, 0.0, 0.0]))
    assert np.allclose(moved.pose_odom_robot[:2] - before[:2], [0.1, 0.05], atol=1e-4)


def test_velocities_make_a_map_of_dead_reckoning():
    mapper = Mapper(Config.load("laser", {"vision.sensor": "none"}))
    for i in range(200):
        mapper.add_velocity(0.05 * i, 0.5, 0.2)
    mapper.finish()
    assert len(mapper.map) > 5
    assert np.hypot(*mapper.pose_map_robot[:2]) == pytest.approx(2 * 2.5 * np.sin(0.5 * 0.2 * 9.95), abs=0.01)


def test_odometry_gate_owes_nothing_to_a_back_end():
    hashes = set()
    for primary in ("gtsam-lm", "relaxation-ratslam"):
        overrides = {"edges.gate": "odometry", "backends.names": [primary]}
        stream = RoomDrive(laps=1.6)
        mapper = Mapper(Config.load("laser", overrides), stream.rig)
        drive(mapper, stream)
        hashes.add(graph_hash(mapper.map))
    assert len(hashes) == 1


def test_rehanging_mode_hangs_the_next_node_on_the_matched_one():
    stream = RoomDrive(laps=4)
    mapper = Mapper(Config.load("laser", {"edges.hanging": "ratslam"}), stream.rig)
    drive(mapper, stream)
    edges = [edge for edge in mapper.map.edges if edge.kind is EdgeKind.ODOMETRY and edge.status is Status.ACCEPTED]
    assert any(edge.target != edge.source + 1 for edge in edges)


def test_reanchoring_brings_old_place_codes_back_and_leaves_odometry_alone():
    """The wheels drift; at a closure the cells take up the matched node's activity, and `odom` goes on as it was."""
    likeness, poses = {}, {}
    for weight in (0.0, 1.0):
        stream = RoomDrive(laps=4)
        mapper = Mapper(Config.load("laser", {"neural.reanchor_weight": weight}), stream.rig)
        drive(mapper, stream)
        nodes = mapper.map.nodes
        codes = np.array([node.place_code for node in nodes])
        on_map, lap = mapper.poses()[:, :2], len(nodes) // 4
        late = np.arange(3 * lap, len(nodes))
        first = [int(np.argmin(np.linalg.norm(on_map[: lap + 2] - on_map[node], axis=1))) for node in late]
        likeness[weight] = float(np.median(np.sum(codes[late] * codes[first], axis=1)))
        poses[weight] = np.array([node.pose_odom for node in nodes])
    assert likeness[1.0] > likeness[0.0] + 0.4
    assert poses[1.0] == pytest.approx(poses[0.0], abs=5e-3)


def test_a_closure_that_recalibrates_makes_no_node_by_its_jump():
    """The drive moves by 0.12 m a scan, too little for a node of its own."""
    stream = RoomDrive(laps=4)
    settings = {"neural.reanchor_weight": 1.0, "nodes.rule": "passage", "nodes.place_threshold": 0.267}
    mapper = Mapper(Config.load("laser", settings), stream.rig)
    drive(mapper, stream)
    poses = np.array([node.pose_odom for node in mapper.map.nodes])
    steps = between(poses[:-1], poses[1:])
    straight = np.abs(steps[:, 2]) < np.radians(15.0)
    assert np.hypot(*steps[straight, :2].T).min() > 0.2


def test_the_place_cells_matter_where_nodes_are_made_by_place():
    hashes = set()
    for share in (0.0, 0.2):
        stream = RoomDrive(laps=2.2)
        settings = {"nodes.rule": "passage", "nodes.place_threshold": 0.267, "neural.place.attractor_input": share}
        mapper = Mapper(Config.load("laser", settings), stream.rig)
        drive(mapper, stream)
        hashes.add(graph_hash(mapper.map))
    assert len(hashes) == 2


def test_nan_odometry_is_refused_with_its_stamp():
    stream = RoomDrive(laps=1, nan_at=7)
    mapper = Mapper(Config.load("laser"), stream.rig)
    with pytest.raises(StreamError, match=r"0\.700000000.*NaN"):
        drive(mapper, stream)


def test_samples_that_come_too_late_are_left_out_and_counted():
    stream = RoomDrive()
    mapper = Mapper(Config.load("laser"), stream.rig)
    scan = next(sample for sample in stream if isinstance(sample, LaserScan))
    later: list[Sample] = [SelfMotion(scan.stamp_ns + step, np.zeros(3)) for step in (1, 2)]
    assert [len(mapper.add(sample)) for sample in (*later, scan)] == [1, 1, 0]
    assert mapper.left_out == {"observations behind odometry": 1}


def test_poses_by_a_back_end_that_is_not_in_use_are_refused(mapped):
    mapper, _, _ = mapped
    with pytest.raises(BackendError, match=r"'gtsam-gn': is not in use; expected one of gtsam-gnc"):
        mapper.poses("gtsam-gn")
