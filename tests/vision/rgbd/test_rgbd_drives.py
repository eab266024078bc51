"""Whole simulated drives: what closures find, how wrong edges are and whether they know it, what a bare corridor admits."""

import numpy as np
import pytest

from hybridmap.config import Config
from hybridmap.evaluate.edge_errors import ClosureLimits, closure_errors, edge_errors
from hybridmap.geometry import align, transform_points
from hybridmap.graph.edges import EdgeKind
from hybridmap.graph.gaps import unobserved
from hybridmap.mapper import Mapper
from hybridmap.streams.open import open_stream
from tests.narrowing import known


def mapped(world):
    config = Config.load(world, {"seed": 1, "backends.names": ["gtsam-gnc"]})
    stream = open_stream(world, config)
    mapper = Mapper(config, stream.rig)
    for sample in stream:
        mapper.add(sample)
    mapper.finish()
    return mapper, stream.groundtruth


def ate_m(poses, truth):
    return float(np.sqrt(np.mean(np.sum((transform_points(align(truth, poses), poses[:, :2]) - truth[:, :2]) ** 2, axis=1))))


@pytest.mark.slow
def test_the_lab_is_found_again_and_its_edges_know_their_errors():
    mapper, truth = mapped("lab")
    weights = mapper.backends.solutions["gtsam-gnc"].report.weights
    assert closure_errors(mapper.map, truth, limits=ClosureLimits(right_m=0.5, right_deg=10.0)).recall >= 0.85
    errors = edge_errors(mapper.map, truth, weights)
    assert errors[EdgeKind.LOOP].wrong == 0
    assert errors[EdgeKind.LOOP].trans_p95_m < 0.08
    assert errors[EdgeKind.LOOP].rot_p95_deg < 1.5
    for kind in (EdgeKind.LOOP, EdgeKind.REGISTRATION):
        assert 0.5 <= errors[kind].chi2_ratio <= 2.0
    at_nodes = truth.at([node.stamp_ns for node in mapper.map.nodes])
    assert ate_m(mapper.poses(), at_nodes) < 0.02


@pytest.mark.slow
@pytest.mark.parametrize(("world", "closes"), [("corridor", False), ("corridor-landmarks", True)])
def test_a_corridor_closes_with_landmarks_and_without_them_admits_what_it_cannot_see(world, closes):
    mapper, truth = mapped(world)
    at_nodes = truth.at([node.stamp_ns for node in mapper.map.nodes])
    raw = np.array([node.pose_odom for node in mapper.map.nodes])
    assert ate_m(mapper.poses(), at_nodes) < (0.05 if closes else ate_m(raw, at_nodes))
    loops = edge_errors(mapper.map, truth).get(EdgeKind.LOOP)
    assert (loops is not None and loops.count > 50) == closes
    assert loops is None or loops.wrong == 0
    free = known(unobserved(mapper.map, mapper.poses()))
    assert (free.sliding_m + free.blind_m > 0.1 * free.travel_m) == (not closes)
    if not closes:
        assert free.sliding_m > 0.5 * free.travel_m
        assert abs(np.degrees(free.direction_rad)) < 5.0  # the corridor's own direction
