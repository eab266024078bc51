"""The bound of chi2 is below the chi2 of every map, and next to that of the best one."""

import time
from dataclasses import replace

import numpy as np
import pytest
from bound_bench import random_graph, trial
from hypothesis import given, settings
from hypothesis import strategies as st

from hybridmap import backends
from hybridmap.backends.judging.dual import critical_point, isotropised, lower_bound, stacked
from hybridmap.backends.judging.minorant import chi2_bound, minorant
from hybridmap.backends.objective import chi2
from hybridmap.geometry import compose
from hybridmap.graph.io import read_graph
from tests.backends.graphs_for_tests import laps

SEEDS = st.integers(0, 2**32 - 1)


@given(SEEDS, st.floats(1e-3, 1.0), st.floats(0.01, 3.0))
@settings(max_examples=200, deadline=None)
def test_the_minorant_is_nowhere_above_chi2(seed, noise, size):
    rng = np.random.default_rng(seed)
    graph = random_graph(rng, noise)
    form = minorant(graph, graph.initial + size * rng.normal(size=graph.initial.shape))
    for spread in (0.0, 0.01, 0.3, 3.0):
        poses = graph.initial + spread * rng.normal(size=graph.initial.shape)
        cost = chi2(graph, poses)
        assert form(stacked(poses)) <= cost + 1e-9 * (cost + abs(form.constant))


@given(SEEDS)
@settings(max_examples=50, deadline=None)
def test_the_minorant_touches_chi2_up_to_the_square_of_the_heading_errors(seed):
    rng = np.random.default_rng(seed)
    graph = random_graph(rng, 1e-3)
    poses = graph.initial + 1e-3 * rng.normal(size=graph.initial.shape)
    largest = np.abs(poses[graph.targets, 2] - poses[graph.sources, 2] - graph.deltas[:, 2])
    largest = np.abs((largest + np.pi) % (2.0 * np.pi) - np.pi).max()
    cost = chi2(graph, poses)
    assert cost * (1.0 - largest**2 / 2.0) - 1e-9 * cost <= minorant(graph, poses)(stacked(poses)) <= cost * (1.0 + 1e-9)


def test_no_map_of_random_graphs_has_less_chi2_than_the_bound():
    trials = [trial(np.random.default_rng(seed), starts=1) for seed in range(200)]
    assert not [one for one in trials if one.violated]
    gaps = np.array([1.0 - one.bound / one.least for one in trials])
    noise = np.array([one.noise for one in trials])
    assert np.median(gaps[noise < 0.01]) < 1e-4  # a bound of zero would be no violation
    assert np.percentile(gaps, 95) < 0.2


def test_the_bound_of_measurements_that_can_all_be_met_is_zero():
    for seed in range(20):
        graph = random_graph(np.random.default_rng(seed), 1e-2)
        turned, cos, sin = graph.initial[graph.sources, 2], np.cos, np.sin
        apart = graph.initial[graph.targets] - graph.initial[graph.sources]
        x = cos(turned) * apart[:, 0] + sin(turned) * apart[:, 1]
        y = cos(turned) * apart[:, 1] - sin(turned) * apart[:, 0]
        exact = replace(graph, deltas=np.stack([x, y, apart[:, 2]], axis=1))
        for poses in (graph.initial, graph.initial + 0.1 * np.random.default_rng(seed).normal(size=graph.initial.shape)):
            assert chi2_bound(exact, poses) <= 1e-12


def test_the_bound_does_not_depend_on_the_frame():
    graph, _ = laps(np.random.default_rng(1), noise=2.0)
    poses = backends.create("gtsam-lm").solve(graph).poses
    bound = chi2_bound(graph, poses)
    assert chi2_bound(graph, compose([300.0, -200.0, 1.0], poses)) == pytest.approx(bound, rel=1e-7)
    assert 1.0 - bound / chi2(graph, poses) < 1e-3


def test_information_that_holds_one_direction_a_million_times_better_costs_no_gap():
    graph, _ = laps(np.random.default_rng(1))
    needle = np.array([[1e6, 30.0, 2e3], [30.0, 1.0, 3.0], [2e3, 3.0, 1e2]])
    needled = replace(graph, information=np.repeat(needle[None], graph.n_edges, axis=0))
    poses = backends.create("gtsam-lm").solve(needled).poses
    assert 1e-9 < 1.0 - chi2_bound(needled, poses) / chi2(needled, poses) < 1e-2


def dense_bound(form, x):
    """Sum of the multipliers at x, and n times the smallest eigenvalue after elimination of the positions, by dense algebra."""
    n = len(x) // 2
    multipliers = (x[n:].conj() * (form.matrix @ x)[n:]).real
    dual = form.matrix.toarray() - np.diag(np.concatenate([np.zeros(n), multipliers]))
    schur = dual[n:, n:] - dual[n:, 1:n] @ np.linalg.solve(dual[1:n, 1:n], dual[1:n, n:])
    return multipliers.sum(), n * min(np.linalg.eigvalsh(schur)[0], 0.0)


@pytest.mark.parametrize("off", [0.0, 0.3, 0.5, 1.0])
def test_the_bound_of_a_form_is_that_of_the_smallest_eigenvalue(off):
    graph = random_graph(np.random.default_rng(3), 0.5, least=8)
    form = isotropised(graph)
    x, _ = critical_point(form, stacked(graph.initial))
    x[graph.n_nodes :] *= np.exp(1j * off * np.random.default_rng(1).normal(size=graph.n_nodes))
    multipliers, negative = dense_bound(form, x)
    bound, rounding = lower_bound(form, x), 1e-7 * form(x)
    assert bound <= multipliers + negative
    assert max(bound, 0.0) >= multipliers + 3.1 * negative - rounding  # one of chi2 below zero is not looked for
    assert (off > 0.0) == (negative < -rounding)


def test_a_graph_in_two_pieces_has_no_bound():
    graph = random_graph(np.random.default_rng(3), 0.1, least=8)
    cut = graph.with_edges((graph.sources < 4) == (graph.targets < 4))
    assert chi2_bound(cut, cut.initial) == 0.0


@pytest.mark.data
@pytest.mark.parametrize(
    ("file", "gap"),
    [
        ("intel.g2o", 1e-5),
        ("CSAIL.g2o", 1e-5),
        ("input_M3500_g2o.g2o", 1e-4),
        ("FR079_P_toro.graph", 1e-5),
        ("input_INTEL_g2o.g2o", 1e-3),
        pytest.param("city10000.g2o", 1e-4, marks=pytest.mark.slow),
    ],
)
def test_the_standard_graphs_have_a_bound_close_to_their_chi2(data_dir, file, gap):
    graph = read_graph(data_dir / "posegraphs" / file)
    poses = backends.create("gtsam-lm").solve(graph).poses
    started = time.process_time()
    bound = chi2_bound(graph, poses)
    assert time.process_time() - started < 10.0
    assert 0.0 < 1.0 - bound / chi2(graph, poses) < gap
