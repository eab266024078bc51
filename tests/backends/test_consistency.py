"""Loops that agree in pairs through the chain, and back-ends that get no others."""

from dataclasses import replace

import numpy as np
import pytest
from scipy.stats import chi2 as chi2_law

from hybridmap import backends
from hybridmap.backends.base import Solution, SolveReport, SolveStatus
from hybridmap.backends.judging import prefilter
from hybridmap.backends.judging.clusters import loops_of
from hybridmap.backends.judging.prefilter import Consistent, consistent_loops
from hybridmap.config.backends import BackendsConfig, ConsistencyConfig
from hybridmap.geometry import adjoint, align, inverse, transform_points
from hybridmap.graph.agreement import ring
from hybridmap.graph.paths import chain_of
from hybridmap.graph.pose_graph import prefix
from hybridmap.store.records import report_from_json, report_to_json
from hybridmap.study.false_loops import inject
from tests.backends.graphs_for_tests import laps

FILTERED = BackendsConfig(consistency=ConsistencyConfig(enabled=True))


def ate(poses, reference):
    moved = transform_points(align(reference, poses), poses[:, :2])
    return float(np.sqrt(np.mean(np.sum((moved - reference[:, :2]) ** 2, axis=1))))


def turned(graph, edges):
    """The same measurements, told from the other end."""
    sources, targets, deltas, information = (
        array.copy() for array in (graph.sources, graph.targets, graph.deltas, graph.information)
    )
    sources[edges], targets[edges], deltas[edges] = graph.targets[edges], graph.sources[edges], inverse(graph.deltas[edges])
    back = adjoint(deltas[edges])
    information[edges] = back.transpose(0, 2, 1) @ information[edges] @ back
    return replace(graph, sources=sources, targets=targets, deltas=deltas, information=information)


@pytest.fixture(scope="module")
def drive():
    graph, truth = laps(np.random.default_rng(0), nodes=200, per_lap=40)
    return graph, truth


def test_true_loops_are_as_far_apart_as_the_stated_noise_has_it():
    apart = []
    for seed in range(20):
        graph, _ = laps(np.random.default_rng(seed), nodes=120, per_lap=40, every=7)
        loops = loops_of(graph, np.flatnonzero(graph.is_loop))
        first = np.arange(len(loops.older) - 1)
        apart.append(ring(loops[first], loops[first + 1], chain_of(graph).ways).distance)
    law = chi2_law(df=3)
    found = np.quantile(np.concatenate(apart), [0.25, 0.5, 0.9])
    assert found == pytest.approx(law.ppf([0.25, 0.5, 0.9]), rel=0.25)


def test_it_does_not_matter_from_which_end_loops_are_told(drive):
    graph = inject(drive[0], 0.3, "random", np.random.default_rng(1))
    told = consistent_loops(turned(graph, np.flatnonzero(graph.is_loop)[::2]))
    assert np.array_equal(told.loops, consistent_loops(graph).loops)


@pytest.mark.parametrize("mode", ["random", "aliased"])
@pytest.mark.parametrize("share", [0.2, 0.5])
def test_hardly_a_false_loop_passes_and_most_true_ones_do(drive, mode, share):
    graph, _ = drive
    false = inject(graph, share, mode, np.random.default_rng(1))
    passed = false.edge_ids[consistent_loops(false).loops]
    assert np.count_nonzero(passed > graph.edge_ids[-1]) <= 0.02 * (false.n_edges - graph.n_edges)
    assert np.count_nonzero(passed <= graph.edge_ids[-1]) >= 0.9 * graph.is_loop.sum()


def test_noise_that_is_overstated_lets_no_more_false_loops_through(drive):
    graph, _ = drive
    false = inject(graph, 0.3, "random", np.random.default_rng(1))
    honest, humble = (consistent_loops(g) for g in (false, replace(false, information=false.information / 50.0)))
    assert humble.variance == pytest.approx(honest.variance / 50.0, rel=0.3)
    assert np.count_nonzero(false.edge_ids[humble.loops] > graph.edge_ids[-1]) <= 0.05 * (false.n_edges - graph.n_edges)


def test_each_loop_needs_a_neighbour(drive, monkeypatch):
    graph, _ = drive
    alone = np.flatnonzero(graph.is_loop)[::25]  # far from each other
    sparse = graph.with_edges(np.sort(np.concatenate([np.flatnonzero(~graph.is_loop), alone])))
    assert len(consistent_loops(sparse).loops) == 0
    monkeypatch.setattr(prefilter, "NEIGHBOURS", 0)
    assert len(consistent_loops(sparse).loops) == len(alone)


@pytest.mark.parametrize("name", ["gtsam-lm", "relaxation-ratslam", "gtsam-isam2", "gtsam-gnc"])
def test_with_the_filter_any_back_end_survives_false_loops(drive, name):
    graph, _ = drive
    clean = backends.create("gtsam-lm").solve(graph).poses
    false = inject(graph, 0.2, "random", np.random.default_rng(1))
    injected = false.edge_ids[graph.n_edges :]
    solution = backends.create(name, FILTERED).solve(false)
    report = solution.report
    assert ate(solution.poses, clean) < 0.1
    assert set(report.inconsistent_edge_ids) <= set(report.rejected_edge_ids)
    assert np.isin(injected, report.rejected_edge_ids).all()
    assert len(report.rejected_edge_ids) - len(injected) <= 0.05 * graph.is_loop.sum()  # the others were taken in again
    assert set(report.weights) == set(false.edge_ids[false.is_loop].tolist())
    assert {report.weights[edge] for edge in report.inconsistent_edge_ids} == {0.0}
    assert f"{len(report.inconsistent_edge_ids)} of {int(false.is_loop.sum())} loops left out" in report.message
    assert report.chi2_initial == backends.create("odometry").solve(false).report.chi2
    assert report_from_json(report_to_json(report)) == report


def test_without_it_least_squares_does_not(drive):
    graph, truth = drive
    false = inject(graph, 0.2, "random", np.random.default_rng(1))
    assert ate(backends.create("gtsam-lm").solve(false).poses, truth) > 1.0


def test_a_lone_true_loop_is_taken_in_from_the_solution(drive):
    graph, _ = drive
    alone = np.flatnonzero(graph.is_loop)[-1:]
    sparse = graph.with_edges(np.sort(np.concatenate([np.flatnonzero(~graph.is_loop), alone])))
    report = backends.create("gtsam-lm", FILTERED).solve(sparse).report
    assert report.inconsistent_edge_ids == ()
    assert "1 added again" in report.message


@pytest.mark.parametrize("name", ["gtsam-isam2", "gtsam-gnc"])
def test_while_driving_all_loops_count_and_at_the_end_the_filter_judges(drive, name):
    graph = prefix(drive[0], 120)
    clean = backends.create("gtsam-lm").solve(graph).poses
    false = inject(graph, 0.1, "random", np.random.default_rng(1))
    backend = backends.create(name, FILTERED)
    *_, driven = backends.replay(backend, false)
    assert driven.report.inconsistent_edge_ids == ()
    final = backend.finish(false)
    assert ate(final.poses, clean) < 0.1
    assert np.isin(false.edge_ids[graph.n_edges :], final.report.rejected_edge_ids).all()


class Judge:
    """A robust back-end that finds the map only if it gets every loop."""

    name = "judge"

    def __init__(self, n_edges, right, wrong, *, weighs):
        self._n_edges, self._right, self._wrong, self._weighs = n_edges, right, wrong, weighs

    def solve(self, graph):
        poses = self._right if graph.n_edges == self._n_edges else self._wrong
        weights = dict.fromkeys(graph.edge_ids[graph.is_loop].tolist(), 1.0) if self._weighs else {}
        return Solution(poses, SolveReport("judge", SolveStatus.CONVERGED, "judged", 1, 2.0, 1.0, 0.0, weights=weights))

    update = finish = solve


@pytest.mark.parametrize("weighs", [True, False])
def test_a_back_end_that_weighs_loops_gets_all_where_those_left_out_agree(drive, monkeypatch, weighs):
    graph, truth = drive
    bent = truth + np.linspace(0.0, 5.0, len(truth))[:, None] * [1.0, 1.0, 0.1]
    monkeypatch.setattr(prefilter, "consistent_loops", lambda *_: Consistent(np.flatnonzero(graph.is_loop)[:5], 1.0))
    backend = prefilter.ConsistentBackend(Judge(graph.n_edges, truth, bent, weighs=weighs), FILTERED)
    solution = backend.solve(graph)
    assert np.array_equal(solution.poses, truth) == weighs
    assert solution.report.message.startswith("pre-filter not used, because all loops together fit better") == weighs
    assert bool(solution.report.inconsistent_edge_ids) != weighs


def test_a_broken_chain_is_solved_with_all_loops_and_says_so(drive):
    graph, _ = drive
    gone = (graph.sources == 99) & (graph.targets == 100)
    broken = graph.with_edges(~gone)
    report = backends.create("gtsam-lm", FILTERED).solve(broken).report
    assert "nodes 99 and 100" in report.message
    assert report.rejected_edge_ids == ()
