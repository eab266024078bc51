"""Wheels that fail now and then: kernels on edges of motion, and what they leave in the report."""

from dataclasses import replace
from typing import Any

import gtsam
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from hybridmap import backends
from hybridmap.backends import objective
from hybridmap.backends.objective import WEAK, hanging_nodes, motion_weights, squared_norms, truncated_cost, weak_edges
from hybridmap.config.backends import BackendsConfig, RobustConfig
from hybridmap.errors import GraphError
from hybridmap.geometry import align, transform_points
from hybridmap.graph.edges import EdgeKind
from hybridmap.store.records import report_from_json, report_to_json
from hybridmap.study.false_loops import drop_out, inject
from tests.backends.graphs_for_tests import laps
from tests.narrowing import known

KERNELS: dict[str, Any] = {
    "huber": gtsam.noiseModel.mEstimator.Huber,
    "cauchy": gtsam.noiseModel.mEstimator.Cauchy,
    "geman-mcclure": gtsam.noiseModel.mEstimator.GemanMcClure,
}

CAUCHY = BackendsConfig(robust=RobustConfig(odometry="cauchy"))


def ate(poses, reference):
    moved = transform_points(align(reference, poses), poses[:, :2])
    return float(np.sqrt(np.mean(np.sum((moved - reference[:, :2]) ** 2, axis=1))))


@pytest.fixture(scope="module")
def failing():
    """A drive on which the wheels fail at four places, and which edges those are."""
    graph, truth = laps(np.random.default_rng(0), nodes=200, per_lap=40)
    dropped = drop_out(graph, 0.02, np.random.default_rng(2))
    return dropped, truth, set(graph.edge_ids[(dropped.deltas != graph.deltas).any(axis=1)].tolist())


@pytest.mark.parametrize("name", KERNELS)
@given(off_m=st.floats(0.0, 1.0), scale=st.floats(0.1, 10.0))
def test_weights_and_costs_are_those_of_gtsams_kernels(name, off_m, scale):
    graph, _ = laps(np.random.default_rng(0), nodes=3, per_lap=20)
    poses = graph.initial.copy()
    poses[2, 0] += off_m
    squared = squared_norms(graph, poses)
    kernel, config = KERNELS[name].Create(scale), RobustConfig(odometry=name)
    whitened = np.sqrt(squared).tolist()
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(objective, "ODOMETRY_SCALE", scale)
        assert motion_weights(graph, squared, config) == pytest.approx([kernel.weight(r) for r in whitened])
        assert truncated_cost(graph, poses, 1.0, config) == pytest.approx(2.0 * sum(map(kernel.loss, whitened)), abs=1e-12)


@pytest.mark.parametrize(("name", "share"), [("gtsam-cauchy", 0.5), ("gtsam-gnc", 0.5), ("gtsam-isam2", 0.75)])
def test_a_kernel_on_odometry_takes_drop_outs_out_and_names_them(failing, name, share):
    dropped, truth, hit = failing
    without, found = backends.create(name).solve(dropped), backends.create(name, CAUCHY).solve(dropped)
    assert ate(found.poses, truth) < share * ate(without.poses, truth)
    assert ate(found.poses, truth) < 0.1
    report = found.report
    assert len(hit & set(report.weak_edges)) >= 3
    assert set(report.weak_edges) <= set(dropped.edge_ids[dropped.is_motion].tolist())
    assert max(report.weak_edges.values()) < WEAK
    assert report.hanging_nodes == 0
    assert known(report.unit_variance) < 0.75 * known(without.report.unit_variance)
    assert without.report.weak_edges == {}
    assert report_from_json(report_to_json(report)) == report


def test_false_loops_beside_drop_outs_do_not_tear_the_chain(failing):
    dropped, truth, _ = failing
    false = inject(dropped, 0.2, "random", np.random.default_rng(3))
    solution = backends.create("gtsam-gnc", CAUCHY).solve(false)
    assert ate(solution.poses, truth) < 0.2
    assert set(false.edge_ids[dropped.n_edges :].tolist()) <= set(solution.report.rejected_edge_ids)


def test_least_squares_and_relaxation_take_no_notice_of_the_kernel(failing):
    dropped, _, _ = failing
    for name in ("gtsam-lm", "relaxation-ratslam", "odometry"):
        plain, other = (backends.create(name, config).solve(dropped) for config in (None, CAUCHY))
        assert np.array_equal(plain.poses, other.poses), name
        assert other.report.weak_edges == {}


def test_nodes_that_hang_on_weak_edges_alone_are_counted():
    graph, _ = laps(np.random.default_rng(0), nodes=60, per_lap=20)
    into = {int(t): int(e) for t, e, k in zip(graph.targets, graph.edge_ids, graph.kinds, strict=True) if k == 0}
    loops_from = tuple(graph.edge_ids[graph.is_loop & (np.maximum(graph.sources, graph.targets) >= 55)].tolist())
    assert hanging_nodes(graph, (into[55],)) == 0  # its loops hold them
    assert hanging_nodes(graph, (into[55], *loops_from)) == 5
    assert hanging_nodes(graph, ()) == 0


def test_a_registration_counts_as_motion_and_a_manual_edge_does_not():
    graph, _ = laps(np.random.default_rng(0), nodes=4, per_lap=20)
    kinds = np.array([EdgeKind.ODOMETRY, EdgeKind.REGISTRATION, EdgeKind.MANUAL], dtype=np.int8)
    found = weak_edges(replace(graph, kinds=kinds), np.full(3, 99.0), RobustConfig(odometry="cauchy"))
    assert found == pytest.approx({0: 0.01, 1: 0.01})


def test_drop_outs_hit_the_share_asked_for_and_only_odometry():
    graph, _ = laps(np.random.default_rng(0), nodes=101, per_lap=30)
    dropped = drop_out(graph, 0.1, np.random.default_rng(1))
    hit = (dropped.deltas != graph.deltas).any(axis=1)
    assert hit.sum() == 10
    assert not (hit & graph.is_loop).any()
    off = dropped.deltas[hit] - graph.deltas[hit]
    assert np.hypot(off[:, 0], off[:, 1]) == pytest.approx(0.5)
    assert np.abs(off[:, 2]) == pytest.approx(np.deg2rad(20.0))
    assert np.array_equal(dropped.information, graph.information)
    again = drop_out(graph, 0.1, np.random.default_rng(1))
    assert np.array_equal(again.deltas, dropped.deltas)
    with pytest.raises(GraphError, match="share"):
        drop_out(graph, 1.5, np.random.default_rng(1))


@pytest.mark.parametrize("seed", [0, 4])
def test_where_no_wheel_fails_false_loops_do_not_tear_the_chain_either(seed):
    graph, truth = laps(np.random.default_rng(seed), nodes=240, per_lap=60)
    false = inject(graph, 0.1, "random", np.random.default_rng(seed))
    solution = backends.create("gtsam-gnc", CAUCHY).solve(false)
    assert ate(solution.poses, truth) < 0.15
    assert set(false.edge_ids[graph.n_edges :].tolist()) <= set(solution.report.rejected_edge_ids)
