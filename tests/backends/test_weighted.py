"""Relaxation with covariances as weights: what each link's rate is, where it ends, and that nothing but the graph counts."""

import subprocess
import sys
from dataclasses import replace

import numpy as np
import pytest

from hybridmap import backends
from hybridmap.backends.relaxation.ratslam import relax_links
from hybridmap.backends.relaxation.weighted import shares
from hybridmap.config.backends import BackendsConfig, RelaxationConfig
from hybridmap.geometry import between, compose, exp, wrap_angle
from hybridmap.graph.edges import EdgeKind
from hybridmap.graph.paths import chain
from tests.backends.graphs_for_tests import laps
from tests.backends.test_relaxation import ate

NAME = "relaxation-weighted"


def lab(seed, nodes=200, per_lap=50):
    """Laps with odometry of 2 cm, 1 cm and 0.6 degrees, and loops of which some are four times as loose as the others."""
    rng = np.random.default_rng(seed)
    graph, truth = laps(rng, nodes=nodes, per_lap=per_lap, every=7, noise=0.0)
    loose = np.array([0.1, 0.2, np.radians(2.0)]) * rng.choice([1.0, 4.0], size=(graph.n_edges, 1))
    sigma = np.where(graph.is_loop[:, None], loose, [0.02, 0.01, np.radians(0.6)])
    deltas = compose(graph.deltas, exp(rng.normal(size=sigma.shape) * sigma))
    information = np.eye(3) * sigma[:, None, :] ** -2.0
    return chain(replace(graph, deltas=deltas, information=information)), truth


def with_sigma(graph, edge, sigma):
    """The graph with other standard deviations of one edge."""
    information = graph.information.copy()
    information[edge] = np.diag(np.asarray(sigma) ** -2.0)
    return replace(graph, information=information)


def test_a_share_is_the_usual_variance_of_motion_over_the_edge_s_own_and_never_above_one():
    graph, _ = lab(0)
    loop, step = int(np.flatnonzero(graph.is_loop)[0]), int(np.flatnonzero(~graph.is_loop)[0])
    graph = with_sigma(with_sigma(graph, loop, [0.1, 0.2, 0.05]), step, [1e-6, 1e-6, 1e-6])
    found = shares(graph)
    usual = 0.5 * (0.02**2 + 0.01**2)
    assert found[loop] == pytest.approx([usual / (0.5 * (0.1**2 + 0.2**2)), (np.radians(0.6) / 0.05) ** 2])
    assert np.all(found[~graph.is_loop] == pytest.approx(1.0))
    assert found.max() <= 1.0


def test_variances_are_those_of_the_covariance_whatever_way_the_edge_looks():
    graph, _ = laps(np.random.default_rng(0))
    mixing = np.random.default_rng(1).normal(size=(graph.n_edges, 3, 3))
    information = mixing @ mixing.transpose(0, 2, 1) + 0.1 * np.eye(3)
    covariance = np.linalg.inv(information)
    own = np.column_stack([0.5 * (covariance[:, 0, 0] + covariance[:, 1, 1]), covariance[:, 2, 2]])
    expected = np.minimum(1.0, np.median(own[~graph.is_loop], axis=0) / own)
    turn = np.array([[0.0, -1.0, 0.0], [1.0, 0.0, 0.0], [0.0, 0.0, 1.0]])
    for each in (information, turn @ information @ turn.T):
        assert shares(replace(graph, information=each)) == pytest.approx(expected)


def test_registrations_are_motion_too_and_where_none_is_known_all_edges_say_what_is_usual():
    graph, _ = lab(0)
    registered = replace(graph, kinds=np.where(graph.is_loop, graph.kinds, np.int8(EdgeKind.REGISTRATION)))
    assert np.array_equal(shares(registered), shares(graph))
    unknown = replace(graph, kinds=np.full(graph.n_edges, np.int8(EdgeKind.LOOP)))
    assert (shares(unknown) == 1.0).mean() >= 0.5  # the median edge and all that are surer
    assert np.isfinite(backends.create(NAME).solve(unknown).poses).all()


@pytest.mark.parametrize("sigma", [[1e-7, 1e-7, 1e-7], [3e4, 3e4, 3e4], [1e-7, 3e4, 3e4]])
def test_one_extreme_edge_neither_stops_nor_tears_the_others(sigma):
    graph, truth = lab(1)
    loop = int(np.flatnonzero(graph.is_loop)[3])
    graph.deltas[loop] = between(truth[graph.sources[loop]], truth[graph.targets[loop]])  # so that no claim is a lie
    usual = backends.create(NAME).solve(graph)
    solution = backends.create(NAME).solve(with_sigma(graph, loop, sigma))
    assert ate(solution.poses, truth) < 1.5 * ate(usual.poses, truth)


def test_equal_weights_give_ratslam_s_sweeps_to_the_bit():
    graph, _ = lab(2)
    equal = replace(graph, information=np.broadcast_to(np.eye(3), graph.information.shape).copy())
    config = BackendsConfig(relaxation=RelaxationConfig(sweeps_per_node=3))
    ours, ratslam = (
        list(backends.replay(backends.create(name, config), equal))[-1].poses for name in (NAME, "relaxation-ratslam")
    )
    assert np.array_equal(ours, ratslam)


@pytest.mark.parametrize("seed", range(6))
def test_the_map_is_nearer_to_the_weighted_optimum_than_that_of_equal_weights(seed):
    graph, truth = lab(seed)
    best = backends.create("gtsam-lm").solve(graph).poses
    off = {name: ate(backends.create(name).solve(graph).poses, best) for name in (NAME, "relaxation-ratslam")}
    assert off[NAME] < off["relaxation-ratslam"]
    assert ate(backends.create(NAME).solve(graph).poses, truth) < ate(graph.initial, truth)


def test_headings_end_at_their_own_weighted_mean():
    graph, _ = lab(3, nodes=60, per_lap=20)
    heading = graph.information[:, 2, 2]
    incidence = np.zeros((graph.n_edges, graph.n_nodes))
    rows = np.arange(graph.n_edges)
    incidence[rows, graph.targets], incidence[rows, graph.sources] = 1.0, -1.0
    winding = graph.initial[graph.targets, 2] - graph.initial[graph.sources, 2]
    measured = winding + wrap_angle(graph.deltas[:, 2] - winding)
    root = np.sqrt(heading)[:, None]
    best = np.linalg.lstsq(
        root * incidence[:, 1:], root[:, 0] * (measured - incidence[:, 0] * graph.initial[0, 2]), rcond=None
    )[0]
    settings = RelaxationConfig(solve_sweeps=30_000)
    found = backends.create(NAME, BackendsConfig(relaxation=settings)).solve(graph)
    assert np.abs(wrap_angle(found.poses[1:, 2] - best)).max() < 1e-3
    constant = relax_links(graph, graph.initial, 30_000, settings, shares=shares(graph)).poses
    constant = wrap_angle(constant[1:, 2] - constant[0, 2] + graph.initial[0, 2] - best)
    assert np.abs(constant).max() > 3e-3  # a constant rate ends in a cycle beside it


def test_a_drive_ends_with_a_whole_solution_from_its_map():
    graph, _ = lab(4)
    backend = backends.create(NAME)
    *_, driven = backends.replay(backend, graph)
    final = backend.finish(graph)
    best = backends.create("gtsam-lm").solve(graph).poses
    assert driven.report.iterations <= 20
    assert final.report.iterations > 1000
    assert ate(final.poses, best) < ate(driven.poses, best) < ate(graph.initial, best)
    again = backends.create(NAME)
    list(backends.replay(again, graph))
    assert np.array_equal(again.finish(graph).poses, final.poses)


def test_sweeps_are_never_more_than_asked_for_and_the_report_says_how_they_went():
    graph, _ = lab(0)
    for sweeps in (1, 2, 3, 100):
        config = BackendsConfig(relaxation=RelaxationConfig(solve_sweeps=sweeps))
        report = backends.create(NAME, config).solve(graph).report
        assert (report.iterations, report.status) == (sweeps, "max-iterations")
    consistent, _ = laps(np.random.default_rng(0), noise=0.0)
    report = backends.create(NAME).solve(consistent).report
    assert report.status == "converged"
    assert "falling rate" in report.message


def test_the_map_does_not_depend_on_the_order_of_nodes_and_edges():
    graph, _ = lab(5)
    rng = np.random.default_rng(0)
    number = np.concatenate([[0], 1 + rng.permutation(graph.n_nodes - 1)])
    initial = np.empty_like(graph.initial)
    initial[number] = graph.initial
    renamed = replace(graph, initial=initial, sources=number[graph.sources], targets=number[graph.targets])
    here, there = (backends.create(NAME).solve(each) for each in (graph, renamed))
    assert np.array_equal(here.poses, there.poses[number])


def test_another_process_gives_the_same_bytes():
    graph, _ = lab(0)
    code = (
        "from tests.backends.test_weighted import *; graph, _ = lab(0);"
        "print(backends.create(NAME).solve(graph).poses.tobytes().hex())"
    )
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert done.stdout.strip() == backends.create(NAME).solve(graph).poses.tobytes().hex()
