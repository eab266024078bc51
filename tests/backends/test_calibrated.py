"""The odometry's calibration as a variable of the graph: what drops true loops elsewhere is solved here."""

from dataclasses import replace

import numpy as np
import pytest

from hybridmap import backends
from hybridmap.geometry import between
from hybridmap.graph.edges import EdgeKind
from hybridmap.graph.io import read_graph
from hybridmap.graph.paths import chain
from hybridmap.study.false_loops import inject
from tests.backends.graphs_for_tests import laps
from tests.backends.test_robust import ate
from tests.narrowing import known

BIAS = 0.12


def bend(graph, bias_rad_m):
    """The graph with a heading bias on every odometry edge; its poses are the bent chain."""
    deltas, odometry = graph.deltas.copy(), graph.kinds == EdgeKind.ODOMETRY
    deltas[odometry, 2] += bias_rad_m * np.hypot(deltas[odometry, 0], deltas[odometry, 1])
    return chain(replace(graph, deltas=deltas))


@pytest.fixture(scope="module")
def bent():
    graph, truth = laps(np.random.default_rng(0), nodes=150, per_lap=30, every=3)
    return bend(graph, BIAS), truth


def test_a_bent_chain_is_straightened_and_no_true_loop_lost(bent):
    graph, truth = bent
    solution = backends.create("gtsam-calibrated").solve(graph)
    assert ate(solution.poses, truth) < 0.08
    assert len(solution.report.rejected_edge_ids) <= 2
    dropped = backends.create("gtsam-gnc").solve(graph)
    assert ate(dropped.poses, truth) > 1.0
    assert len(dropped.report.rejected_edge_ids) > 20
    assert "heading bias -" in solution.report.message
    assert 0.5 < known(solution.report.unit_variance) < 1.6
    assert known(solution.report.chi2_odometry) < solution.report.chi2


def test_it_tells_bias_from_false_loops():
    graph, truth = laps(np.random.default_rng(0), nodes=150, per_lap=30, every=3)
    graph = bend(graph, 0.05)
    false = inject(graph, 0.2, "random", np.random.default_rng(2))
    solution = backends.create("gtsam-calibrated").solve(false)
    assert ate(solution.poses, truth) < 0.15
    assert set(false.edge_ids[graph.n_edges :].tolist()) <= set(solution.report.rejected_edge_ids)


def test_without_bias_it_is_gnc():
    graph, _ = laps(np.random.default_rng(0), nodes=150, per_lap=30)
    calibrated, plain = (backends.create(name).solve(graph) for name in ("gtsam-calibrated", "gtsam-gnc"))
    assert np.abs(between(plain.poses, calibrated.poses))[:, :2].max() < 0.05


@pytest.mark.data
@pytest.mark.slow
@pytest.mark.parametrize(("file", "bias"), [("intel.g2o", 0.06), ("manhattanOlson3500.g2o", 0.06)])
def test_drifted_standard_graphs_are_solved_with_every_loop_kept(data_dir, file, bias):
    graph = read_graph(data_dir / "posegraphs" / file)
    clean = backends.create("gtsam-lm").solve(graph).poses
    drifted = bend(graph, bias)
    assert ate(drifted.initial, clean) > 10.0
    solution = backends.create("gtsam-calibrated").solve(drifted)
    assert ate(solution.poses, clean) < 0.5
    assert len(solution.report.rejected_edge_ids) <= 0.01 * graph.is_loop.sum()
