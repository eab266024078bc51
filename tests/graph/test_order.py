"""The order of the drive: found whatever the numbers of the nodes, and the same for every numbering."""

from dataclasses import replace

import numpy as np
import pytest

from hybridmap import backends
from hybridmap.geometry import between, compose, log
from hybridmap.graph.edges import EdgeKind
from hybridmap.graph.io import read_graph
from hybridmap.graph.order import in_driving_order
from tests.backends.graphs_for_tests import laps

EDGE = "EDGE_SE2 {} {} 1 0 0.1 9 0 0 9 0 9\n"
ROBUST = ("gtsam-isam2", "gtsam-gnc", "gtsam-calibrated", "gtsam-cauchy", "gtsam-dcs")


def shuffled(graph, seed):
    """The same graph with its nodes in a random order, and that order."""
    number = np.random.default_rng(seed).permutation(graph.n_nodes)
    initial = np.empty_like(graph.initial)
    initial[number] = graph.initial
    return replace(graph, initial=initial, sources=number[graph.sources], targets=number[graph.targets]), number


def unknown(graph):
    """The same graph with no edge known to be odometry."""
    return replace(graph, kinds=np.full(graph.n_edges, EdgeKind.LOOP, dtype=np.int8))


def test_a_graph_in_driving_order_is_not_touched():
    graph, _ = laps(np.random.default_rng(0))
    arranged = in_driving_order(graph)
    assert arranged.graph is graph
    assert arranged.nodes is None


@pytest.mark.parametrize("seed", range(5))
@pytest.mark.parametrize("forget", [False, True])
def test_the_drive_is_found_again_from_any_numbers_of_its_nodes(seed, forget):
    graph, _ = laps(np.random.default_rng(0))
    other, _ = shuffled(unknown(graph) if forget else graph, seed)
    arranged = in_driving_order(other)
    for name in ("sources", "targets", "kinds", "edge_ids", "initial"):
        assert np.array_equal(getattr(arranged.graph, name), getattr(graph, name)), name
    assert np.array_equal(arranged.given(arranged.graph.initial), other.initial)


@pytest.mark.parametrize("name", ROBUST)
def test_a_back_end_gives_the_same_map_for_every_order_of_nodes(name):
    graph, _ = laps(np.random.default_rng(1))
    expected = backends.create(name).solve(graph)
    for seed in range(3):
        other, number = shuffled(graph, seed)
        found = backends.create(name).solve(other)
        assert found.report.chi2 == pytest.approx(expected.report.chi2, rel=1e-6)
        assert np.array_equal(found.poses[0], other.initial[0])
        moved = compose(expected.poses[0], between(found.poses[number[0]], found.poses[number]))
        assert np.abs(log(between(moved, expected.poses))).max() < 1e-4


def test_edges_that_the_initial_poses_were_composed_of_are_odometry_whatever_the_order_of_lines():
    graph, _ = laps(np.random.default_rng(2))
    mixed = np.random.default_rng(3).permutation(graph.n_edges)
    other, _ = shuffled(unknown(graph), 4)
    lines = replace(other.with_edges(mixed), edge_ids=np.arange(graph.n_edges))
    found = in_driving_order(lines).graph
    assert found.kinds.tolist() == graph.kinds[mixed].tolist()


def test_a_file_with_a_gap_in_its_chain_is_a_walk_over_its_edges(tmp_path):
    path = tmp_path / "gap.g2o"
    path.write_text("".join(EDGE.format(*ends) for ends in ((4, 5), (5, 6), (70, 71), (5, 70), (6, 71))))
    graph = read_graph(path)
    assert graph.n_nodes == 5
    assert graph.kinds.tolist().count(EdgeKind.ODOMETRY) == graph.n_nodes - 1
    for name in backends.names():
        assert np.isfinite(backends.create(name).solve(graph).poses).all()


def test_edges_between_consecutive_numbers_are_odometry_where_they_join_all():
    graph, _ = laps(np.random.default_rng(0))
    found = in_driving_order(unknown(graph))
    assert found.nodes is None
    assert found.graph.kinds.tolist() == graph.kinds.tolist()


def test_a_graph_in_parts_is_left_for_the_check_to_name(tmp_path):
    graph, _ = laps(np.random.default_rng(0))
    parts = unknown(graph.with_edges((graph.sources != 30) & (graph.targets != 30)))
    assert in_driving_order(parts).graph is parts
