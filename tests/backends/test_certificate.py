"""The certificate proves what is optimal, and never what is not."""

import time
from dataclasses import replace

import numpy as np
import pytest

from hybridmap import backends
from hybridmap.backends.comparison import compare, metrics_of
from hybridmap.backends.gtsam.batch import run
from hybridmap.backends.gtsam.factors import NoiseModels, factor_graph
from hybridmap.backends.judging.certificate import Certificate, certify
from hybridmap.backends.judging.dual import isotropised, prove, stacked
from hybridmap.backends.objective import chi2
from hybridmap.geometry import compose
from hybridmap.graph.io import read_graph
from hybridmap.study.false_loops import inject
from tests.backends.graphs_for_tests import laps


def test_the_quadratic_form_is_the_sum_over_edges():
    graph, _ = laps(np.random.default_rng(0), noise=3.0)
    total = 0.0
    for s, t, (dx, dy, turn), information in zip(graph.sources, graph.targets, graph.deltas, graph.information, strict=True):
        predicted = compose(graph.initial[s], [dx, dy, turn])
        off = graph.initial[t] - predicted
        tau = 2.0 / np.trace(np.linalg.inv(information[:2, :2]))
        total += 2.0 * information[2, 2] * (2.0 - 2.0 * np.cos(off[2])) + tau * (off[0] ** 2 + off[1] ** 2)
    assert isotropised(graph)(stacked(graph.initial)) == pytest.approx(total, rel=1e-9)


def test_least_squares_on_a_mild_graph_is_certified_from_any_frame():
    graph, _ = laps(np.random.default_rng(1), noise=2.0)
    poses = backends.create("gtsam-lm").solve(graph).poses
    first = certify(graph, poses)
    assert first.certified
    assert first.gap < 1e-8
    assert first.objective <= first.objective_given
    moved = certify(graph, compose([3.0, -2.0, 1.0], poses))
    assert moved.objective == pytest.approx(first.objective, rel=1e-9)


def test_a_local_optimum_is_not_certified():
    graph, _ = laps(np.random.default_rng(1), nodes=40, per_lap=20, noise=0.1)
    wound = graph.initial.copy()
    wound[:, 2] += np.linspace(0.0, 4.0 * np.pi, 40)  # a whole turn too many a lap
    solution = backends.create("gtsam-gn").solve(graph)
    assert certify(graph, solution.poses).certified
    best = certify(graph, solution.poses).objective
    for start in (wound, np.random.default_rng(3).normal(size=wound.shape) * 3.0):
        assert not certify(graph, start).certified
        trapped = run("lm", factor_graph(graph, NoiseModels()), start, 100).poses
        proof = certify(graph, trapped)
        assert not proof.certified or proof.objective <= best * (1.0 + 1e-6)


def test_a_map_in_a_wrong_optimum_is_told_how_much_better_another_may_be():
    graph, _ = laps(np.random.default_rng(1), nodes=40, per_lap=20, noise=2.0)
    best = chi2(graph, backends.create("gtsam-lm").solve(graph).poses)
    start = np.random.default_rng(3).normal(size=(40, 3)) * 3.0
    trapped = run("lm", factor_graph(graph, NoiseModels()), start, 100).poses
    worse = chi2(graph, trapped)
    assert worse > 10.0 * best
    proof = certify(graph, trapped)
    assert proof.chi2 == worse
    assert (1.0 - 1e-3) * best < proof.chi2_bound <= best
    assert proof.chi2_gap == pytest.approx(1.0 - best / worse, rel=1e-3)
    assert f"this one has {worse:.7g}" in proof.chi2_message


def test_the_gap_of_chi2_is_of_the_edges_kept():
    graph, _ = laps(np.random.default_rng(0), nodes=90, per_lap=30)
    false = inject(graph, 0.2, "random", np.random.default_rng(1))
    solution = backends.create("gtsam-gnc").solve(false)
    rejected = solution.report.rejected_edge_ids
    proof = certify(false, solution.poses, rejected)
    assert proof.chi2 == chi2(false.with_edges(~np.isin(false.edge_ids, rejected)), solution.poses)
    assert proof.chi2_gap < 1e-3
    assert certify(false, solution.poses).chi2_gap > 0.1


@pytest.mark.parametrize(("gap", "word"), [(2.4e-6, "<= 2.4e-06"), (0.44, "<= 44 %"), (1.0, "not proved"), (-1e-12, "<= 0")])
def test_a_gap_of_chi2_in_words(gap, word):
    assert Certificate(np.inf, "", chi2=2.0, chi2_bound=2.0 * (1.0 - gap)).chi2_word == word


@pytest.mark.parametrize(
    ("gap", "word"), [(2.401e-6, "<= 2.5e-06"), (0.12301, "<= 12.4 %"), (0.00991, "<= 0.01"), (0.99999, "<= 100 %")]
)
def test_what_is_printed_of_a_proof_claims_no_more_than_is_proved(gap, word):
    proof = Certificate(np.inf, "", chi2=2.0, chi2_bound=2.0 * (1.0 - gap))
    assert proof.chi2_word == word
    stated = float(proof.chi2_message.partition("less than ")[2].split()[0])
    assert proof.chi2_bound * (1.0 - 1e-6) <= stated <= proof.chi2_bound
    assert Certificate(1.2e-11, "").word == "gap <= 2e-11"


def test_a_proved_gap_is_never_below_the_true_one():
    graph, _ = laps(np.random.default_rng(1), nodes=60, noise=6.0)
    best = prove(graph, backends.create("gtsam-lm").solve(graph).poses).objective
    rng = np.random.default_rng(5)
    for size in (0.01, 0.3, 1.0, 3.0):
        proof = prove(graph, graph.initial + size * rng.normal(size=graph.initial.shape))
        assert (proof.objective - best) / proof.objective <= proof.gap + 1e-9


@pytest.mark.parametrize("off", [0.1, 3.0])
def test_poses_in_the_basin_of_the_optimum_are_not_the_optimum(off):
    graph, _ = laps(np.random.default_rng(1), noise=2.0)
    solution = backends.create("gtsam-lm").solve(graph)
    moved = solution.poses + off * np.random.default_rng(2).normal(size=(graph.n_nodes, 3)) * [0.03, 0.02, 0.01]
    moved[0] = solution.poses[0]
    assert prove(graph, moved).gap <= 1e-6
    proof = certify(graph, moved)
    assert np.isinf(proof.gap)
    assert proof.word == "not certified"
    assert f"not at an optimum; the one near it has chi2 {solution.report.chi2:.4g}" in proof.message


def test_an_optimum_of_chi2_far_above_that_of_the_isotropised_objective_is_not_certified():
    graph, _ = laps(np.random.default_rng(1))
    needle = np.diag([1e6, 1.0, 1e2])  # made isotropic, all of it is as loose as y
    needled = replace(graph, information=np.repeat(needle[None], graph.n_edges, axis=0))
    poses = backends.create("gtsam-lm").solve(needled).poses
    proof = certify(needled, poses)
    assert "isotropised objective" in proof.message
    assert np.isinf(proof.gap)


def test_a_map_that_meets_every_measurement_is_optimal():
    graph, _ = laps(np.random.default_rng(1), noise=2.0)
    exact = graph.with_edges(~graph.is_loop)
    proof = certify(exact, exact.initial)
    assert (proof.certified, proof.gap, proof.chi2_gap) == (True, 0.0, 0.0)
    assert "chi2 is zero" in proof.message
    assert "chi2 is zero" in proof.chi2_message


def test_edges_that_a_back_end_rejected_do_not_count():
    graph, _ = laps(np.random.default_rng(0), nodes=90, per_lap=30)
    false = inject(graph, 0.2, "random", np.random.default_rng(1))
    solution = backends.create("gtsam-gnc").solve(false)
    kept = certify(false, solution.poses, solution.report.rejected_edge_ids)
    assert kept.certified
    assert kept.objective < 0.01 * prove(false, solution.poses).objective_given


def test_poses_that_are_none_are_not_certified():
    graph, _ = laps(np.random.default_rng(0), nodes=20)
    proof = certify(graph, np.full((20, 3), np.nan))
    assert not proof.certified
    assert proof.word == "not certified"
    assert (proof.chi2_gap, proof.chi2_word) == (1.0, "not proved")


def test_a_comparison_carries_the_proof():
    graph, _ = laps(np.random.default_rng(0), nodes=40)
    rows = compare(graph, ["gtsam-lm", "odometry"], certified=True)
    assert rows[0].certificate is not None
    gaps = {m.name: m.value for m in metrics_of(rows) if m.name.startswith("certificate_gap")}
    assert gaps == {"certificate_gap/gtsam-lm": rows[0].certificate.gap}
    figures = {m.name: m.value for m in metrics_of(rows)}
    assert figures["chi2_gap/gtsam-lm"] == rows[0].certificate.chi2_gap < 1e-3
    assert figures["chi2_bound/gtsam-lm"] == rows[0].certificate.chi2_bound <= figures["chi2/gtsam-lm"]
    assert figures["chi2_gap/odometry"] == pytest.approx(
        1.0 - figures["chi2_bound/gtsam-lm"] / figures["chi2/odometry"], rel=1e-6
    )
    assert compare(graph, ["gtsam-lm"])[0].certificate is None


@pytest.mark.data
@pytest.mark.parametrize(
    ("file", "objective"),
    [
        ("intel.g2o", 52.3482),
        ("CSAIL.g2o", 31.7037),
        ("FR079_P_toro.graph", 28.5858),
        ("input_INTEL_g2o.g2o", 393.6525),
        ("manhattanOlson3500.g2o", 204.943),
        pytest.param("city10000.g2o", 638.625, marks=pytest.mark.slow),
    ],
)
def test_the_standard_graphs_are_certified_at_their_known_objective(data_dir, file, objective):
    graph = read_graph(data_dir / "posegraphs" / file)
    poses = backends.create("gtsam-lm").solve(graph).poses
    started = time.process_time()
    proof = prove(graph, poses)
    assert time.process_time() - started < 2.0
    assert certify(graph, poses).gap == proof.gap <= 1e-6
    assert proof.objective == pytest.approx(objective, rel=1e-5)


@pytest.mark.data
@pytest.mark.parametrize(
    ("file", "name"), [("CSAIL.g2o", "relaxation-ratslam"), ("intel.g2o", "odometry"), ("intel.g2o", "relaxation-paper")]
)
def test_what_is_far_from_the_optimum_of_a_standard_graph_is_not_certified(data_dir, file, name):
    graph = read_graph(data_dir / "posegraphs" / file)
    proof = certify(graph, backends.create(name).solve(graph).poses)
    assert np.isinf(proof.gap)
    assert "times less" in proof.message
