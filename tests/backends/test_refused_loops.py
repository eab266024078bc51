"""What refused and rejected loops do to a map: whether it expects them, how far they would move it, and how far they pull."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from hybridmap import backends
from hybridmap.backends.gtsam.covariance import Covariances
from hybridmap.backends.judging.rivals import admitted
from hybridmap.backends.judging.strain import optimum, rejected_pull
from hybridmap.geometry import apart_m, compose
from hybridmap.graph.pose_graph import prefix
from hybridmap.study.false_loops import inject
from hybridmap.study.model import SyntheticConfig
from hybridmap.study.sources import laps

CONFIG = SyntheticConfig(nodes=120, per_lap=40)


@pytest.fixture(scope="module")
def lap_graph():
    graph = laps(CONFIG, 0).graph
    assert graph is not None
    return graph


def solved(graph, backend):
    solution = backends.create(backend).solve(graph)
    kept = ~np.isin(graph.edge_ids, np.array(solution.report.rejected_edge_ids, dtype=np.int64))
    return solution, kept


def test_the_error_that_covariances_predict_is_that_of_many_drives():
    squared, predicted = [], []
    for seed in range(12):
        drive = laps(CONFIG, seed)
        assert drive.graph is not None
        assert drive.reference is not None
        poses = backends.create("gtsam-lm").solve(drive.graph).poses
        squared.append(apart_m(drive.reference, poses) ** 2)
        predicted.append(Covariances(drive.graph, poses).position_error())
    assert np.sqrt(np.mean(squared)) == pytest.approx(np.mean(predicted), rel=0.2)


def test_a_graph_of_two_nodes_has_no_error_left_after_alignment(lap_graph):
    two = prefix(lap_graph, 2)
    assert Covariances(two, two.initial).position_error() == 0.0


def test_the_distance_of_two_maps_does_not_count_how_they_lie(lap_graph):
    poses = lap_graph.initial
    assert apart_m(poses, compose(np.array([3.0, -2.0, 1.0]), poses)) == pytest.approx(0.0, abs=1e-9)
    assert apart_m(poses, poses * np.array([1.1, 1.0, 1.0])) > 0.1


@pytest.mark.parametrize(("off_m", "expects"), [(0.0, True), (1.0, False)])
def test_true_loops_that_were_left_out_are_expected_and_displaced_ones_are_not(lap_graph, off_m, expects):
    loops = np.flatnonzero(lap_graph.is_loop)[20:40]
    deltas = lap_graph.deltas.copy()
    deltas[loops] = compose(deltas[loops], np.array([0.0, off_m, 0.0]))
    graph, in_map = replace(lap_graph, deltas=deltas), np.ones(lap_graph.n_edges, dtype=bool)
    in_map[loops] = False
    poses = backends.create("gtsam-lm").solve(graph.with_edges(in_map)).poses
    found = admitted(graph, poses, in_map, graph.edge_ids[loops].tolist())
    assert (found.expected > 0.8) is expects
    assert (found.shift_m < found.error_m) is expects


def test_loops_that_a_kernel_rejects_pull_its_map_and_those_of_weight_zero_do_not(lap_graph):
    false = inject(lap_graph, 0.1, "random", np.random.default_rng(3))
    solution, kept = solved(false, "gtsam-huber")
    pull = rejected_pull(false, solution.poses, kept, solution.report.weights)
    assert pull is not None
    assert pull.shift_m == pytest.approx(apart_m(solution.poses, optimum(false.with_edges(kept), solution.poses)), rel=0.2)
    assert pull.shift_m > 0.1
    solution, kept = solved(false, "gtsam-gnc")
    assert solution.report.rejected_edge_ids
    assert rejected_pull(false, solution.poses, kept, solution.report.weights) is None


def test_a_solver_that_ended_early_is_no_pull(lap_graph):
    false = inject(lap_graph, 0.1, "random", np.random.default_rng(3))
    solution, kept = solved(false, "gtsam-cauchy")
    early = solution.poses * np.array([1.02, 1.0, 1.0])
    pull, same = (rejected_pull(false, poses, kept, solution.report.weights) for poses in (early, solution.poses))
    assert pull is not None
    assert same is not None
    assert pull.shift_m == pytest.approx(same.shift_m, abs=1e-3)
    assert pull.shift_m < apart_m(early, solution.poses)
