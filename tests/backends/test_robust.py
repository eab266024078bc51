"""False loops: what survives them, and what does not."""

from dataclasses import replace
from functools import partial

import numpy as np
import pytest

from hybridmap import backends
from hybridmap.backends.base import SolveStatus
from hybridmap.backends.gtsam import gnc
from hybridmap.backends.gtsam.gnc import Truncated
from hybridmap.backends.objective import gate_of
from hybridmap.config.backends import BackendsConfig, GncConfig
from hybridmap.errors import BackendError, GraphError
from hybridmap.geometry import align, between, compose, transform_points
from hybridmap.graph.edges import EdgeKind
from hybridmap.graph.io import read_graph
from hybridmap.graph.pose_graph import PoseGraph, prefix
from hybridmap.study.false_loops import inject
from tests.backends.graphs_for_tests import laps


def ate(poses, reference):
    moved = transform_points(align(reference, poses), poses[:, :2])
    return float(np.sqrt(np.mean(np.sum((moved - reference[:, :2]) ** 2, axis=1))))


@pytest.fixture(scope="module")
def disturbed():
    graph, _ = laps(np.random.default_rng(0), nodes=150, per_lap=30)
    return graph, inject(graph, 0.2, "random", np.random.default_rng(1)), backends.create("gtsam-lm").solve(graph).poses


@pytest.mark.parametrize("name", ["gtsam-cauchy", "gtsam-gnc"])
@pytest.mark.parametrize("mode", ["random", "aliased"])
def test_a_fifth_of_false_loops_ruins_least_squares_but_not_robust_back_ends(disturbed, name, mode):
    graph, _, clean = disturbed
    false = inject(graph, 0.2, mode, np.random.default_rng(1))
    assert ate(backends.create("gtsam-lm").solve(false).poses, clean) > 0.3
    solution = backends.create(name).solve(false)
    assert ate(solution.poses, clean) < 0.05
    rejected = set(solution.report.rejected_edge_ids)
    injected = set(false.edge_ids[graph.n_edges :].tolist())
    assert len(injected - rejected) <= 1
    assert len(rejected - injected) <= {"gtsam-gnc": 0.05, "gtsam-cauchy": 0.15}[name] * graph.is_loop.sum()


@pytest.mark.parametrize("start", ["auto", "batch", "grow"])
def test_every_start_of_gnc_finds_the_false_loops_of_a_mild_drive(disturbed, start, monkeypatch):
    monkeypatch.setattr(gnc, "CHUNK_NODES", 40)
    _, false, clean = disturbed
    config = BackendsConfig(gnc=GncConfig(start=start))
    solution = backends.create("gtsam-gnc", config).solve(false)
    assert ate(solution.poses, clean) < 0.05
    assert set(solution.report.weights) == set(false.edge_ids[false.is_loop].tolist())
    assert set(solution.report.weights.values()) <= {0.0, 1.0}


def test_gnc_without_false_loops_is_least_squares(disturbed):
    graph, _, clean = disturbed
    solution = backends.create("gtsam-gnc").solve(graph)
    assert len(solution.report.rejected_edge_ids) <= 0.05 * graph.is_loop.sum()  # honest noise: one in a hundred is beyond 99 %
    assert ate(solution.poses, clean) < 0.02


def test_gnc_follows_with_a_kernel_and_ends_with_a_verdict(disturbed):
    _, false, clean = disturbed
    backend = backends.create("gtsam-gnc")
    *_, driven = backends.replay(backend, false)
    assert 0.0 < min(driven.report.weights.values()) < 0.1
    final = backend.finish(false)
    assert ate(final.poses, clean) < 0.05
    assert f"{len(final.report.rejected_edge_ids)} of {int(false.is_loop.sum())} loops rejected" in final.report.message


@pytest.mark.parametrize("wrong", [True, False])
def test_what_begins_at_the_map_of_the_drive_is_held_against_another_result(disturbed, monkeypatch, wrong):
    graph, _, clean = disturbed
    bent = clean + np.linspace(0.0, 3.0, len(clean))[:, None] * [1.0, 1.0, 0.1]
    lone = np.ones(int(graph.is_loop.sum()), dtype=bool)
    lone[[10, 60]] = False  # too far from each other to be a cluster
    bound = gate_of(BackendsConfig())
    starts = {
        "drive": Truncated(bent if wrong else clean, lone, 1, bound),
        "other": Truncated(clean if wrong else bent, lone, 1, bound),
    }
    backend = backends.create("gtsam-gnc")
    monkeypatch.setattr(gnc, "on_probation", lambda _graph, result, _config: result)
    monkeypatch.setattr(gnc, "attempts", lambda *_: {name: partial(starts.get, name) for name in starts})
    final = backend.finish(graph)
    assert np.array_equal(final.poses, clean)
    assert f"start: {'other' if wrong else 'drive'}" in final.report.message


def test_odometry_is_never_rejected(disturbed):
    _, false, _ = disturbed
    for name in ("gtsam-cauchy", "gtsam-dcs", "gtsam-huber", "gtsam-gnc"):
        report = backends.create(name).solve(false).report
        assert set(report.rejected_edge_ids) <= set(false.edge_ids[false.is_loop].tolist()), name
        assert all(0.0 <= weight <= 1.0 for weight in report.weights.values()), name


@pytest.mark.parametrize("mode", ["random", "aliased"])
def test_injection_gives_the_share_asked_for_and_only_that(mode):
    graph, _ = laps(np.random.default_rng(0), nodes=150, per_lap=30)
    false = inject(graph, 0.4, mode, np.random.default_rng(1))
    added = false.n_edges - graph.n_edges
    assert added / false.is_loop.sum() == pytest.approx(0.4, abs=0.01)
    assert np.array_equal(false.deltas[: graph.n_edges], graph.deltas)
    assert np.all(np.diff(false.edge_ids) > 0)
    false.validate()
    again = inject(graph, 0.4, mode, np.random.default_rng(1))
    assert np.array_equal(again.sources, false.sources)
    with pytest.raises(GraphError, match="share"):
        inject(graph, 1.0, mode, np.random.default_rng(1))


@pytest.mark.data
@pytest.mark.slow
@pytest.mark.parametrize("mode", ["random", "aliased"])
@pytest.mark.parametrize("share", [0.1, 0.4])
def test_gnc_on_intel_with_false_loops(data_dir, share, mode):
    graph = read_graph(data_dir / "posegraphs" / "intel.g2o")
    clean = backends.create("gtsam-lm").solve(graph).poses
    for seed in range(3):
        false = inject(graph, share, mode, np.random.default_rng(seed))
        report = (solution := backends.create("gtsam-gnc").solve(false)).report
        assert ate(solution.poses, clean) < 0.05
        rejected = np.array(report.rejected_edge_ids)
        assert np.sum(rejected <= graph.edge_ids[-1]) <= 0.005 * graph.is_loop.sum()


@pytest.mark.data
@pytest.mark.slow
def test_a_drive_that_false_loops_have_ruined_ends_well(data_dir):
    graph = read_graph(data_dir / "posegraphs" / "intel.g2o")
    clean = backends.create("gtsam-lm").solve(graph).poses
    false = inject(graph, 0.1, "random", np.random.default_rng(0))
    backend = backends.create("gtsam-gnc")
    *_, driven = backends.replay(backend, false)
    assert ate(driven.poses, clean) > 5.0
    assert ate(backend.finish(false).poses, clean) < 0.05


def test_a_back_end_that_trusts_no_loop_still_trusts_registrations():
    graph, truth = laps(np.random.default_rng(0), nodes=90, per_lap=30)
    bent = graph.initial.copy()
    bent[:, 2] += np.linspace(0.0, 3.0, len(bent))  # wheels that lie
    bent[:, :2] += np.linspace(0.0, 5.0, len(bent))[:, None]
    lied_to = replace(graph, initial=bent)
    for name in ("gtsam-cauchy", "gtsam-huber", "gtsam-gnc"):
        assert ate(backends.create(name).solve(lied_to).poses, truth) < 0.1, name


def in_two_pieces():
    """Laps whose chain has a gap in the middle; two lone loops join the pieces, one loop is false."""
    laps_of_20, _ = laps(np.random.default_rng(3), nodes=60, per_lap=20)
    joins = laps_of_20.is_loop & np.isin(laps_of_20.sources, (32, 48))
    false = laps_of_20.is_loop & (laps_of_20.sources == 56)
    gap = (laps_of_20.sources == 29) & (laps_of_20.targets == 30)
    deltas = laps_of_20.deltas.copy()
    deltas[false] += [4.0, -3.0, 1.0]
    graph = replace(laps_of_20, deltas=deltas)
    return graph.with_edges(joins | false | (graph.is_motion & ~gap)), int(graph.edge_ids[false][0])


def test_probation_never_takes_a_map_apart():
    graph, false = in_two_pieces()
    kept = graph.edge_ids[graph.is_loop] != false
    config = BackendsConfig()
    found = gnc.on_probation(graph, Truncated(graph.initial, kept, 1, gate_of(config)), config)
    assert np.array_equal(found.kept, kept)
    assert backends.create("gtsam-gnc").solve(graph).report.hanging_nodes == 0


def raising(*_, **__):
    raise BackendError("covariance: the graph is singular")


def test_a_judge_that_cannot_go_on_leaves_the_loops_and_says_so(monkeypatch, disturbed):
    _, false, clean = disturbed
    monkeypatch.setattr(gnc, "on_probation", raising)
    solution = backends.create("gtsam-gnc").solve(false)
    assert solution.report.status is SolveStatus.FELL_BACK
    assert solution.report.status.has_map
    assert ate(solution.poses, clean) < 0.1


def test_least_squares_takes_over_where_no_attempt_comes_to_an_end(monkeypatch, disturbed):
    graph, _, clean = disturbed
    for name in ("trusting", "graduate", "grow"):
        monkeypatch.setattr(gnc, name, raising)
    solution = backends.create("gtsam-gnc").solve(graph)
    assert solution.report.status is SolveStatus.FELL_BACK
    assert solution.report.rejected_edge_ids == ()
    assert np.allclose(solution.poses, clean, atol=1e-3)


@pytest.mark.data
def test_a_map_bent_until_all_loops_fit_is_not_taken_for_a_good_one(data_dir):
    graph = prefix(read_graph(data_dir / "posegraphs" / "intel.g2o"), 500)
    clean = backends.create("gtsam-lm").solve(graph).poses
    false = inject(graph, 0.1, "random", np.random.default_rng(0))
    assert ate(backends.create("gtsam-gnc").solve(false).poses, clean) < 0.05


@pytest.mark.parametrize(
    ("file", "count", "seed"),
    [
        *(("intel.g2o", 1, seed) for seed in range(3)),
        *(("input_INTEL_g2o.g2o", 1, seed) for seed in range(3)),
        ("intel.g2o", 8, 1),
        ("intel.g2o", 20, 2),
    ],
)
def test_a_few_false_loops_do_not_move_the_map(data_dir, file, count, seed):
    graph = read_graph(data_dir / "posegraphs" / file)
    loops = int(graph.is_loop.sum())
    false = inject(graph, count / (loops + count), "random", np.random.default_rng(seed))
    solution = backends.create("gtsam-gnc").solve(false)
    assert set(false.edge_ids[-count:].tolist()) <= set(solution.report.rejected_edge_ids)
    assert ate(solution.poses, backends.create("gtsam-lm").solve(graph).poses) < 0.05


def test_the_lone_loop_that_closes_a_ring_is_kept_against_dead_reckoning():
    """Of 400 loops 399 span two steps and tell nothing of the ring. Noise is overstated, and the odometry turns too much."""
    rng, size = np.random.default_rng(0), 400
    true = chain_poses([np.array([0.3, 0.0, 2 * np.pi / size])] * size)
    steps = [(i, i + 1, [0.0, 0.0, 0.001]) for i in range(size)] + [(i, i + 2, [0.0, 0.0, 0.0]) for i in range(size - 1)]
    sources, targets = np.array([*((i, j) for i, j, _ in steps), (size, 0)]).T
    deltas = between(true[sources], true[targets])
    deltas[:-1] += [bias + rng.normal(0.0, 0.001, 3) for _, _, bias in steps]
    kinds = np.array([EdgeKind.ODOMETRY] * size + [EdgeKind.LOOP] * size, dtype=np.int8)
    graph = PoseGraph(
        initial=chain_poses(deltas[:size]),
        sources=sources,
        targets=targets,
        deltas=deltas,
        information=np.tile(np.diag([100.0, 100.0, 400.0]), (2 * size, 1, 1)),
        kinds=kinds,
        edge_ids=np.arange(2 * size),
    )
    solution = backends.create("gtsam-gnc").solve(graph)
    assert solution.report.rejected_edge_ids == ()
    assert ate(solution.poses, true) < 0.05


def chain_poses(deltas):
    poses = [np.zeros(3)]
    for delta in deltas:
        poses.append(compose(poses[-1], delta))
    return np.array(poses)


def test_a_lone_loop_that_bends_a_map_of_overstated_noise_is_left_out():
    laps_of_20, _ = laps(np.random.default_rng(3), nodes=60, per_lap=20)
    graph = replace(laps_of_20, information=laps_of_20.information * 1e-3)  # noise stated 30 times too large: all fits
    clean = backends.create("gtsam-lm").solve(graph).poses
    false = inject(graph, 1.0 / (int(graph.is_loop.sum()) + 1), "random", np.random.default_rng(2))
    assert ate(backends.create("gtsam-lm").solve(false).poses, clean) > 0.05
    solution = backends.create("gtsam-gnc").solve(false)
    assert solution.report.rejected_edge_ids == (int(false.edge_ids[-1]),)
    assert ate(solution.poses, clean) < 0.02
    assert backends.create("gtsam-gnc").solve(graph).report.rejected_edge_ids == ()
