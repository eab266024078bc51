"""The paper's rule, its stable relative and RatSLAM's: the laws each of them keeps."""

from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from hybridmap import backends
from hybridmap.backends.relaxation.linear import LinearRule, lambda_max, relax
from hybridmap.config.backends import BackendsConfig, RelaxationConfig
from hybridmap.geometry import align, transform_points, wrap_angle
from hybridmap.graph.io import read_graph
from hybridmap.graph.paths import chain
from hybridmap.study.false_loops import inject, with_drift
from hybridmap.study.model import DriftConfig
from tests.backends.graphs_for_tests import laps, star
from tests.narrowing import known


def configured(**settings_):
    return BackendsConfig(relaxation=RelaxationConfig(**settings_))


def ate(poses, reference):
    moved = transform_points(align(reference, poses), poses[:, :2])
    return np.sqrt(np.mean(np.sum((moved - reference[:, :2]) ** 2, axis=1)))


def printed_rule(graph, positions, theta):
    """Equation 16, node by node as it stands in the paper."""
    yaw = graph.initial[:, 2]
    moved = positions.copy()
    for i in range(graph.n_nodes):
        for e in range(graph.n_edges):
            s, t = graph.sources[e], graph.targets[e]
            c, sn = np.cos(yaw[s]), np.sin(yaw[s])
            step = np.array([[c, -sn], [sn, c]]) @ graph.deltas[e, :2]
            if s == i:
                moved[i] += theta * (positions[t] - positions[i] - step)
            if t == i:
                moved[i] += theta * (positions[s] - positions[i] + step)
    return moved


def test_a_sweep_of_the_paper_s_rule_is_equation_16():
    graph, _ = laps(np.random.default_rng(0), nodes=45)
    start = graph.initial[:, :2] + np.random.default_rng(1).normal(size=(45, 2))
    swept, _ = relax(LinearRule.of(graph), start, 0.1, 1, 0.0)
    assert np.allclose(known(swept), printed_rule(graph, start, 0.1), atol=1e-12)


@given(st.integers(0, 10_000), st.floats(0.05, 1.0))
@settings(max_examples=20, deadline=None)
def test_the_normalised_rule_never_raises_its_objective(seed, theta):
    rng = np.random.default_rng(seed)
    graph, _ = laps(rng, nodes=40, noise=10.0)
    rule = LinearRule.of(graph)
    positions = graph.initial[:, :2] + rng.normal(size=(40, 2))
    rate = theta / rule.degree[:, None]
    for _ in range(10):
        after = known(relax(rule, positions, rate, 1, 0.0)[0])
        assert rule.objective(after) <= rule.objective(positions) * (1 + 1e-12)
        positions = after


@pytest.mark.parametrize("make", [lambda: laps(np.random.default_rng(0), nodes=100)[0], lambda: star(50)])
def test_theta_max_is_where_the_paper_s_rule_turns_unstable(make):
    graph = make()
    theta_max = 2.0 / lambda_max(LinearRule.of(graph).laplacian)
    start = graph.initial + np.random.default_rng(0).normal(size=graph.initial.shape) * [1, 1, 0]
    statuses = {}
    for factor in (0.99, 1.01):
        config = configured(theta=factor * theta_max, solve_sweeps=4000)
        statuses[factor] = backends.create("relaxation-paper", config).solve(replace(graph, initial=start)).report
    assert statuses[0.99].status != "diverged"
    assert statuses[1.01].status == "diverged"
    assert f"{theta_max:.4g}" in statuses[1.01].message


def test_the_paper_s_theta_diverges_and_leaves_the_map_as_it_was():
    graph = star(50)
    for choice in ("run", "refuse"):
        solution = backends.create("relaxation-paper", configured(theta=0.5, on_unstable=choice)).solve(graph)
        assert solution.report.status == "diverged"
        assert np.array_equal(solution.poses, graph.initial)
    normalised = backends.create("relaxation-paper", configured(theta=0.5, on_unstable="normalise")).solve(graph)
    assert normalised.report.status != "diverged"
    assert "normalised" in normalised.report.message


@pytest.mark.parametrize(
    "name", ["relaxation-paper", "relaxation-normalised", "relaxation-ratslam", "relaxation-weighted", "relaxation-robust"]
)
@pytest.mark.parametrize("make", [lambda: star(50), lambda: laps(np.random.default_rng(0), noise=40.0)[0]])
def test_relaxation_never_gives_anything_but_finite_poses(name, make):
    graph = make()
    assert np.isfinite(backends.create(name, configured(theta=1.0, solve_sweeps=1000)).solve(graph).poses).all()
    for solution in backends.replay(backends.create(name, configured(theta=1.0)), graph):
        assert np.isfinite(solution.poses).all()


def test_ratslam_corrects_headings_where_world_frame_rules_cannot():
    graph, truth = laps(np.random.default_rng(2), nodes=120, noise=3.0)
    last = {n: list(backends.replay(backends.create(n), graph))[-1].poses for n in ("odometry", "relaxation-ratslam")}
    errors = {n: np.abs(wrap_angle(p[:, 2] - truth[:, 2])).mean() for n, p in last.items()}
    assert errors["relaxation-ratslam"] < 0.5 * errors["odometry"]


def test_a_decaying_theta_ends_nearer_to_the_optimum_than_the_limit_cycle():
    graph, _ = laps(np.random.default_rng(2), nodes=60, noise=3.0)
    constant = backends.create("relaxation-ratslam", configured(solve_sweeps=400)).solve(graph)
    decaying = backends.create("relaxation-ratslam", configured(solve_sweeps=400, theta_decay=0.96)).solve(graph)
    best = backends.create("gtsam-lm").solve(graph).report.chi2
    assert best < decaying.report.chi2 < 0.7 * constant.report.chi2


def test_robust_relaxation_survives_what_plain_relaxation_does_not():
    graph, truth = laps(np.random.default_rng(2), nodes=120, per_lap=30)
    false = inject(graph, 0.2, "random", np.random.default_rng(0))
    injected = set(false.edge_ids[graph.n_edges :].tolist())
    config = configured(solve_sweeps=1000)
    plain = backends.create("relaxation-ratslam", config).solve(false)
    robust = backends.create("relaxation-robust", config).solve(false)
    off = {"plain": plain.poses, "robust": robust.poses}
    off = {name: np.hypot(*(poses - truth)[:, :2].T).mean() for name, poses in off.items()}
    assert off["robust"] < 0.25 < off["plain"]
    assert injected <= set(robust.report.rejected_edge_ids)
    assert len(robust.report.rejected_edge_ids) <= len(injected) + 2
    assert set(robust.report.weights) == set(false.edge_ids[false.is_loop].tolist())
    backend = backends.create("relaxation-robust", config)
    for solution in backends.replay(backend, false):
        assert np.isfinite(solution.poses).all()
    assert injected <= set(backend.finish(false).report.rejected_edge_ids)


def test_robust_relaxation_costs_nothing_where_there_is_no_false_loop():
    graph, _ = laps(np.random.default_rng(2), nodes=120, per_lap=30)
    config = configured(solve_sweeps=1000)
    plain = backends.create("relaxation-ratslam", config).solve(graph)
    robust = backends.create("relaxation-robust", config).solve(graph)
    assert robust.report.rejected_edge_ids == ()
    assert np.abs(robust.poses - plain.poses)[:, :2].max() < 0.02


@pytest.mark.data
@pytest.mark.parametrize("share", [0.0, 0.05, 0.1])
def test_robust_relaxation_on_intel(data_dir, share):
    graph = read_graph(data_dir / "posegraphs" / "intel.g2o")
    clean = backends.create("gtsam-lm").solve(graph).poses
    false = inject(graph, share, "aliased", np.random.default_rng(0))
    solution = backends.create("relaxation-robust").solve(false)
    assert ate(solution.poses, clean) < 0.10
    assert set(solution.report.rejected_edge_ids) == set(false.edge_ids[graph.n_edges :].tolist())


@pytest.mark.slow
@pytest.mark.data
@pytest.mark.parametrize(("name", "share"), [("intel.g2o", 0.15), ("manhattanOlson3500.g2o", 0.05)])
def test_a_map_that_is_relaxed_as_it_grows_keeps_a_small_share_of_odometry_s_error(data_dir, name, share):
    graph = chain(read_graph(data_dir / "posegraphs" / name))
    best = backends.create("gtsam-lm").solve(graph).poses
    *_, grown = backends.replay(backends.create("relaxation-ratslam"), graph)
    assert ate(grown.poses, best) < share * ate(graph.initial, best)


@pytest.mark.data
def test_the_paper_s_theta_diverges_on_intel_and_is_no_map(data_dir):
    graph = read_graph(data_dir / "posegraphs" / "intel.g2o")
    solution = backends.create("relaxation-paper", configured(theta=0.5)).solve(graph)
    assert solution.report.status == "diverged"
    assert np.array_equal(solution.poses, graph.initial)


def test_the_hybrid_relaxes_while_driving_and_optimises_at_the_end():
    graph, _ = laps(np.random.default_rng(2), nodes=60, noise=3.0)
    hybrid, plain = backends.create("relaxation-gtsam-lm"), backends.create("relaxation-ratslam")
    *_, driven = backends.replay(hybrid, graph)
    *_, relaxed = backends.replay(plain, graph)
    assert np.array_equal(driven.poses, relaxed.poses)
    best = backends.create("gtsam-lm").solve(graph).report.chi2
    assert driven.report.chi2 > 1.05 * best
    for final in (hybrid.finish(graph), hybrid.solve(graph)):
        assert final.report.chi2 <= best * (1 + 1e-6)
        assert final.report.status == "converged"


@pytest.mark.data
def test_relaxing_first_ends_no_worse_than_either_start_on_a_real_experience_map(data_dir):
    graph = read_graph(data_dir / "ratslam_maps" / "paper_irat_complete.g2o")
    hybrid = backends.create("relaxation-gtsam-lm").solve(graph).report
    for start in (graph, chain(graph)):
        from_start = backends.create("gtsam-dogleg").solve(start).report.chi2
        assert hybrid.chi2 <= from_start * (1 + 1e-7)
    assert hybrid.chi2 <= backends.create("gtsam-lm").solve(graph).report.chi2 * (1 + 1e-7)
    assert hybrid.chi2 == pytest.approx(143.149, abs=1e-3)


@pytest.mark.parametrize("bias", [1.0, 3.0])
def test_the_robust_rule_keeps_true_loops_after_a_bad_drift(bias):
    graph, truth = laps(np.random.default_rng(5), nodes=400, per_lap=100, every=15)
    drifted = chain(with_drift(graph, DriftConfig(heading_bias_deg_per_m=bias), 0))
    solution = backends.create("relaxation-robust").solve(drifted)
    assert solution.report.rejected_edge_ids == ()
    assert ate(solution.poses, truth) < 0.3 * ate(drifted.initial, truth)


def test_the_robust_rule_still_rejects_a_lone_false_loop():
    graph, truth = laps(np.random.default_rng(5), nodes=400, per_lap=100, every=15)
    false = inject(graph, 0.05, "random", np.random.default_rng(2))
    solution = backends.create("relaxation-robust").solve(false)
    injected = set(false.edge_ids.tolist()) - set(graph.edge_ids.tolist())
    assert injected <= set(solution.report.rejected_edge_ids)
    assert ate(solution.poses, truth) < 0.5
