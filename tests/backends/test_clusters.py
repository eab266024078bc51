"""Rejected loops that agree with each other, lone loops on probation, and how sure a map is."""

from dataclasses import replace

import numpy as np
import pytest

from hybridmap import backends
from hybridmap.backends.gtsam.covariance import Covariances
from hybridmap.backends.gtsam.gnc import Truncated, on_probation
from hybridmap.backends.judging.clusters import rejected_clusters
from hybridmap.backends.objective import gate_of
from hybridmap.config.backends import BackendsConfig
from hybridmap.errors import BackendError
from hybridmap.graph.edges import EdgeKind
from hybridmap.study.false_loops import Kind, inject
from tests.backends.graphs_for_tests import laps
from tests.narrowing import known

CONFIG = BackendsConfig()


def test_true_loops_that_a_wrong_map_rejects_are_one_cluster():
    graph, truth = laps(np.random.default_rng(0), nodes=60, per_lap=30)
    bent = truth.copy()
    bent[30:, :2] += [5.0, 3.0]  # the second lap lies elsewhere: every loop contradicts the map in the same way
    loops = tuple(graph.edge_ids[graph.is_loop].tolist())
    clusters = rejected_clusters(graph, bent, loops, gate_of(CONFIG))
    assert [sorted(cluster) for cluster in clusters] == [sorted(loops)]


def test_random_false_loops_are_no_cluster_and_aliased_ones_are():
    graph, truth = laps(np.random.default_rng(0), nodes=200, per_lap=40)
    modes: tuple[tuple[Kind, int], ...] = (("random", 0), ("aliased", 100))
    for mode, most in modes:
        false = inject(graph, 0.2, mode, np.random.default_rng(1))
        injected = tuple(false.edge_ids[graph.n_edges :].tolist())
        clusters = rejected_clusters(false, truth, injected, gate_of(CONFIG))
        assert sum(map(len, clusters)) <= most
        assert bool(clusters) == (mode == "aliased")
        assert {edge for cluster in clusters for edge in cluster} <= set(injected)
    assert rejected_clusters(graph, truth, (), 1.0) == ()


def with_lone_loop(graph, delta):
    """One loop between places that no other loop joins."""
    return replace(
        graph,
        sources=np.append(graph.sources, 58),
        targets=np.append(graph.targets, 3),
        deltas=np.concatenate([graph.deltas, [delta]]),
        information=np.concatenate([graph.information, graph.information[:1]]),
        kinds=np.append(graph.kinds, np.int8(EdgeKind.LOOP)),
        edge_ids=np.append(graph.edge_ids, graph.edge_ids[-1] + 1),
    )


@pytest.mark.parametrize("false", [True, False])
def test_a_lone_loop_stays_only_where_the_map_without_it_expects_it(false):
    graph, truth = laps(np.random.default_rng(0), nodes=60, per_lap=30)
    from hybridmap.geometry import between

    delta = between(truth[58], truth[3]) + ([0.6, 0.4, 0.2] if false else [0.0, 0.0, 0.0])
    lone = with_lone_loop(graph, delta)
    everything = np.ones(int(lone.is_loop.sum()), dtype=bool)
    judged = on_probation(lone, Truncated(graph.initial, everything, 0, gate_of(CONFIG)), CONFIG)
    assert judged.kept[:-1].all()
    assert bool(judged.kept[-1]) is not false


def test_covariances_are_those_of_the_dense_inverse_and_grow_along_the_chain():
    graph, truth = laps(np.random.default_rng(0), nodes=30, per_lap=20)
    covariances = Covariances(graph, truth)
    assert np.allclose(covariances.marginal(0), 0.0)
    single = graph.with_edges(np.arange(1))
    first = Covariances(replace(single, initial=truth[:2]), truth[:2]).marginal(1)
    assert np.allclose(first, np.linalg.inv(graph.information[0]))
    chain_only = Covariances(graph.with_edges(~graph.is_loop), truth)
    ends = np.array([0]), np.array([29])
    assert np.trace(chain_only.relative(*ends)[0]) > 2.0 * np.trace(covariances.relative(*ends)[0])
    assert np.allclose(covariances.relative(np.array([0]), np.array([17]))[0], covariances.marginal(17))
    assert np.linalg.eigvalsh(covariances.marginal(29)).min() > 0.0
    with pytest.raises(BackendError, match="no node 30"):
        covariances.marginal(30)


def test_the_report_says_what_was_rejected_together_and_how_strained_odometry_is():
    graph, _ = laps(np.random.default_rng(0), nodes=150, per_lap=30)
    false = inject(graph, 0.2, "aliased", np.random.default_rng(1))
    report = backends.create("gtsam-gnc").solve(false).report
    assert {edge for cluster in report.rejected_clusters for edge in cluster} <= set(report.rejected_edge_ids)
    assert len(report.rejected_clusters) >= 1
    assert 0.5 < known(report.unit_variance) < 1.5
    assert 0.0 < known(report.chi2_odometry) < report.chi2
    together = sum(map(len, report.rejected_clusters))
    assert report.doubt.startswith(f"{together} of {len(report.rejected_edge_ids)} rejected loops agree with each other, in ")
    assert report.summary == f"{report.message}; {report.doubt}"
    ruined = backends.create("gtsam-lm").solve(false).report
    assert known(ruined.chi2_odometry) > 10.0 * known(report.chi2_odometry)
    assert known(ruined.unit_variance) > 10.0 * known(report.unit_variance)
    assert ruined.doubt == ""
    assert ruined.summary == ruined.message
