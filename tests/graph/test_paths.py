"""Covariance along the shortest path: equal to chaining the edges one by one."""

import time

import numpy as np
import pytest

from hybridmap.backends.registry import create
from hybridmap.errors import GraphError
from hybridmap.geometry import RelativePose, between, compose, compose_relative, inverse, invert_relative
from hybridmap.graph.edges import EdgeKind
from hybridmap.graph.paths import chain_of, covariances_from
from hybridmap.graph.pose_graph import PoseGraph


def graph_of(pairs, rng, nodes):
    root = rng.normal(size=(len(pairs), 3, 3))
    covariance = 1e-2 * (root @ root.transpose(0, 2, 1) + np.eye(3))
    return PoseGraph(
        initial=np.zeros((nodes, 3)),
        sources=np.array([p[0] for p in pairs]),
        targets=np.array([p[1] for p in pairs]),
        deltas=rng.normal(size=(len(pairs), 3)),
        information=np.linalg.inv(covariance),
        kinds=np.full(len(pairs), EdgeKind.ODOMETRY, dtype=np.int8),
        edge_ids=np.arange(len(pairs)),
    )


def edge(graph, number, turned=False):
    relative = RelativePose(graph.deltas[number], np.linalg.inv(graph.information[number]))
    return invert_relative(relative) if turned else relative


def test_a_chain_is_the_chain_of_its_edges_in_both_directions():
    graph = graph_of([(0, 1), (2, 1), (2, 3), (3, 4)], np.random.default_rng(0), 5)
    found = covariances_from(graph)(1)
    there = compose_relative(compose_relative(edge(graph, 1, turned=True), edge(graph, 2)), edge(graph, 3))
    assert np.allclose(found[4], there.covariance)
    assert np.allclose(found[0], edge(graph, 0, turned=True).covariance)
    assert np.array_equal(found[1], np.zeros((3, 3)))


def test_the_surer_of_two_ways_counts():
    graph = graph_of([(0, 1), (1, 2), (2, 3), (0, 3)], np.random.default_rng(1), 4)
    information = graph.information.copy()
    information[3] *= 1e4
    sure = PoseGraph(graph.initial, graph.sources, graph.targets, graph.deltas, information, graph.kinds, graph.edge_ids)
    assert np.allclose(covariances_from(sure)(0)[3], edge(sure, 3).covariance)
    assert np.allclose(covariances_from(sure)(3)[0], edge(sure, 3, turned=True).covariance)


def test_edges_of_the_same_two_nodes_hold_each_other():
    """One loose along x, one without a heading, one of them given the other way round: together they hold all three."""
    delta = np.array([0.5, 0.1, 0.3])
    loose, blind = np.diag([1.0, 1e-4, 1e-4]), np.diag([1e-3, 1e-3, 1e-1])
    turned = invert_relative(RelativePose(delta, blind))
    graph = PoseGraph(
        initial=np.zeros((2, 3)),
        sources=np.array([0, 1]),
        targets=np.array([1, 0]),
        deltas=np.array([delta, turned.delta]),
        information=np.linalg.inv(np.array([loose, turned.covariance])),
        kinds=np.full(2, EdgeKind.ODOMETRY, dtype=np.int8),
        edge_ids=np.arange(2),
    )
    both = np.linalg.inv(np.linalg.inv(loose) + np.linalg.inv(blind)).astype(np.float64)
    assert np.allclose(covariances_from(graph)(0)[1], both)
    assert np.allclose(covariances_from(graph)(1)[0], invert_relative(RelativePose(delta, both)).covariance)


def test_every_covariance_is_one_on_a_large_graph_and_growth_is_that_of_the_path():
    rng = np.random.default_rng(2)
    n = 3000
    pairs = [(i - 1, i) for i in range(1, n)] + [(int(i), int(j)) for i, j in rng.integers(0, n, (1500, 2)) if i != j]
    graph = graph_of(pairs, rng, n)
    covariances_from(graph)(0)
    started = time.process_time()
    found = covariances_from(graph)(1234)
    assert time.process_time() - started < 0.2
    assert np.linalg.eigvalsh(np.delete(found, 1234, axis=0)).min() > 0
    assert np.allclose(found, found.transpose(0, 2, 1))


def test_a_node_out_of_reach_is_infinitely_uncertain():
    graph = graph_of([(0, 1), (2, 3)], np.random.default_rng(0), 4)
    found = covariances_from(graph)(0)
    assert np.all(np.isinf(np.diagonal(found[2:], axis1=1, axis2=2)))
    assert np.isfinite(found[:2]).all()


def test_every_node_is_asked_of_one_graph_and_once():
    graph = graph_of([(0, 1), (1, 2), (2, 3), (0, 3)], np.random.default_rng(1), 4)
    from_node = covariances_from(graph)
    for node in range(4):
        assert np.array_equal(from_node(node), covariances_from(graph)(node))
        assert from_node(node) is from_node(node)


def test_an_unknown_node_is_refused():
    with pytest.raises(GraphError, match="node 9"):
        covariances_from(graph_of([(0, 1)], np.random.default_rng(0), 2))(9)


def test_the_way_between_two_nodes_of_a_chain_is_that_along_its_edges():
    graph = graph_of([(0, 1), (2, 1), (2, 3), (3, 4), (2, 3)], np.random.default_rng(0), 5)
    graph.deltas[4] = graph.deltas[2]
    chain = chain_of(graph)
    first, second = np.array([0, 1, 2, 3]), np.array([4, 3, 4, 0])
    ways = chain.ways(first, second)
    for delta, covariance, source, target in zip(ways.delta, ways.covariance, first, second, strict=True):
        assert np.allclose(covariance, covariances_from(graph)(source)[target])
        assert np.allclose(compose(chain.poses[source], delta), chain.poses[target])
    assert np.allclose(compose(chain.poses[3], graph.deltas[3]), chain.poses[4])


def test_the_motion_of_several_edges_is_where_least_squares_has_it():
    graph = graph_of([(0, 1), (1, 0), (0, 1), (1, 2)], np.random.default_rng(3), 3)
    back = inverse(graph.deltas[1])
    graph.deltas[0] = compose(back, np.array([0.002, -0.001, 0.0005]))
    graph.deltas[2] = compose(back, np.array([-0.001, 0.003, -0.0008]))
    best = create("gtsam-lm").solve(graph)
    chain = chain_of(graph)
    assert between(best.poses[0], best.poses[1:]) == pytest.approx(between(chain.poses[0], chain.poses[1:]), abs=1e-5)


def test_nothing_is_known_of_a_way_across_a_break():
    graph = graph_of([(0, 1), (1, 2), (1, 3), (3, 4)], np.random.default_rng(0), 5)
    chain = chain_of(graph)
    assert chain.breaks.tolist() == [3]
    known = np.isfinite(chain.ways(np.array([0, 2, 3, 4]), np.array([2, 3, 4, 1])).covariance).all(axis=(1, 2))
    assert known.tolist() == [True, False, True, False]
