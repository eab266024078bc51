"""ISAM2: what it may put off, what it reads, and that edges which were false leave nothing behind."""

from dataclasses import replace
from typing import Any

import numpy as np
import pytest

from hybridmap import backends
from hybridmap.backends.gtsam import incremental
from hybridmap.backends.gtsam.covariance import Covariances
from hybridmap.backends.gtsam.factors import NoiseModels, poses_of
from hybridmap.backends.gtsam.incremental import Smoother
from hybridmap.errors import BackendError
from hybridmap.geometry import between, log
from hybridmap.graph.io import read_graph
from hybridmap.graph.pose_graph import prefix
from hybridmap.study.false_loops import inject
from tests.backends.graphs_for_tests import laps


def modest(seed, nodes=90):
    """A graph whose edges are ten times as good as they say, as in the standard files."""
    graph, _ = laps(np.random.default_rng(seed), nodes=nodes, noise=0.1)
    return graph


def grown(backend, graph):
    return [backend.update(prefix(graph, nodes)) for nodes in range(1, graph.n_nodes + 1)]


@pytest.mark.parametrize("patience", [0.3, 1.0])
def test_closures_wait_only_while_no_pose_would_move_by_more_than_the_patience(patience, monkeypatch):
    monkeypatch.setattr(incremental, "RELINEARIZE_RAD", 1e-5)  # nearly always, so that only the waiting makes a difference
    monkeypatch.setattr(incremental, "RELINEARIZE_M", 1e-4)
    graph = modest(0)
    waited = 0
    monkeypatch.setattr(incremental, "PATIENCE", patience)
    lazy = grown(backends.create("gtsam-isam2"), graph)
    monkeypatch.setattr(incremental, "PATIENCE", 0.0)
    eager = grown(backends.create("gtsam-isam2"), graph)
    for nodes, mine, best in zip(range(1, 91), lazy, eager, strict=True):
        if "loop closures wait" not in mine.report.message:
            continue
        waited += 1
        covariances = Covariances(prefix(graph, nodes), best.poses)
        shifts = log(between(mine.poses, best.poses))
        ratios = [np.sqrt(s @ np.linalg.solve(covariances.marginal(n), s)) for n, s in enumerate(shifts) if n]
        assert max(ratios) <= 1.1 * patience  # of the first order, and in deviations after the closure, which are less
        assert best.report.chi2 - 1e-3 <= mine.report.chi2 <= best.report.chi2 + patience**2 + 1e-3
    assert waited > 20


def test_where_the_stated_noise_is_the_true_one_every_closure_is_worked_on_at_once():
    graph, _ = laps(np.random.default_rng(0), nodes=60)
    solutions = grown(backends.create("gtsam-isam2"), graph)
    assert all(solution.report.iterations > 0 for solution in solutions[20:])


def test_the_end_of_the_drive_leaves_nothing_waiting(monkeypatch):
    graph = modest(1)
    monkeypatch.setattr(incremental, "PATIENCE", 1e6)
    backend = backends.create("gtsam-isam2")
    driven = grown(backend, graph)[-1]
    best = backends.create("gtsam-lm").solve(graph)
    assert driven.report.chi2 > 1.05 * best.report.chi2
    end = backend.finish(graph)
    assert end.report.chi2 == pytest.approx(best.report.chi2, rel=1e-6)
    assert np.abs(between(best.poses, end.poses)).max() < 1e-4
    assert backend.update(graph).poses.tobytes() == end.poses.tobytes()


def test_poses_read_piece_by_piece_are_the_estimate_of_gtsam():
    graph, _ = laps(np.random.default_rng(3), nodes=120)
    following = Smoother(NoiseModels(), orthogonal=False)
    parts = [prefix(graph, nodes) for nodes in range(1, 121)]
    parts.append(graph.with_edges(graph.edge_ids != 70))
    for part in parts:
        following.follow(part, graph.initial, following.lacks(part))
        theirs = poses_of(following.isam.calculateEstimate())
        assert np.abs(log(between(theirs, following.poses()))).max() < 1e-9


@pytest.mark.parametrize("mode", ["random", "aliased"])
def test_a_map_ruined_by_false_edges_is_the_clean_one_again_once_they_are_out(mode):
    graph, _ = laps(np.random.default_rng(0), nodes=200, per_lap=100)
    false = inject(graph, 0.4, mode, np.random.default_rng(50))
    clean = backends.create("gtsam-lm").solve(graph)
    backend = backends.create("gtsam-isam2")
    ruined = grown(backend, false)[-1]
    assert np.abs(between(clean.poses, ruined.poses))[:, :2].max() > 1.0
    back = backend.update(graph)
    assert back.report.status == "converged"
    assert back.report.chi2 == pytest.approx(clean.report.chi2, rel=1e-3)
    assert np.abs(between(clean.poses, back.poses)).max() < 1e-2


def test_a_failure_inside_an_update_is_made_good_from_the_poses_before_it(monkeypatch):
    graph, _ = laps(np.random.default_rng(1), nodes=60)
    backend = backends.create("gtsam-isam2")
    grown(backend, prefix(graph, 40))
    follow, calls = Smoother.follow, []

    def fails_once(self, *given):
        follow(self, *given)
        calls.append(self)
        if len(calls) == 1:
            raise RuntimeError("Indeterminate linear system")

    monkeypatch.setattr(Smoother, "follow", fails_once)
    solution = backend.update(graph)
    assert len(calls) == 2
    assert calls[1] is not calls[0]
    assert solution.report.chi2 == pytest.approx(backends.create("gtsam-lm").solve(graph).report.chi2, rel=1e-3)


def test_a_failure_that_stays_leaves_the_state_before_it_bit_for_bit(monkeypatch):
    graph, _ = laps(np.random.default_rng(1), nodes=60)
    backend = backends.create("gtsam-isam2")
    part = prefix(graph, 40)
    kept = grown(backend, part)[-1]
    far: dict[str, Any] = {"sources": [39], "targets": [5], "deltas": [[0.3, 0.2, 0.1]], "edge_ids": [999]}
    far |= {"information": graph.information[:1], "kinds": [np.int8(2)]}
    longer: dict[str, Any] = {name: np.concatenate([getattr(part, name), rows]) for name, rows in far.items()}
    with_loop = replace(part, **longer)
    follow = Smoother.follow

    def fails(self, *given):
        follow(self, *given)
        raise RuntimeError("Indeterminate linear system")

    with monkeypatch.context() as broken:
        broken.setattr(Smoother, "follow", fails)
        for attempt in (backend.update, backend.finish):
            with pytest.raises(BackendError, match="gave up: Indeterminate"):
                attempt(with_loop)
    again = backend.update(part)
    assert again.poses.tobytes() == kept.poses.tobytes()
    assert again.report.chi2 == kept.report.chi2
    best = backends.create("gtsam-lm").solve(with_loop).report.chi2
    assert backend.update(with_loop).report.chi2 == pytest.approx(best, rel=1e-3)  # the loop counts once


def test_a_chi2_that_rose_in_an_update_is_not_called_converged(monkeypatch):
    graph, _ = laps(np.random.default_rng(1), nodes=60)
    backend = backends.create("gtsam-isam2")
    grown(backend, prefix(graph, 59))
    poses = Smoother.poses
    monkeypatch.setattr(Smoother, "poses", lambda self: poses(self) + np.linspace(0.0, 1.0, 60)[:, None])
    report = backend.update(graph).report
    assert report.status == "stalled"
    assert "chi2 rose" in report.message
    assert report.chi2 > report.chi2_initial


def test_an_ill_conditioned_graph_is_solved_on_orthogonal_factors():
    graph, _ = laps(np.random.default_rng(0))
    information = graph.information.copy()
    information[::3] = np.diag([1e14, 1e-2, 1e3])
    hard = replace(graph, information=information)
    best = backends.create("gtsam-lm").solve(hard).report
    report = backends.create("gtsam-isam2").solve(hard).report
    assert best.status == "converged"
    assert report.chi2 <= 1.01 * best.chi2 or report.status != "converged"


@pytest.mark.data
@pytest.mark.slow
@pytest.mark.parametrize("share", [0.01, 0.05])
def test_isam2_returns_to_the_clean_optimum_when_false_edges_are_taken_out(data_dir, share):
    graph = read_graph(data_dir / "posegraphs" / "intel.g2o")
    false = inject(graph, share, "random", np.random.default_rng(0))
    clean = backends.create("gtsam-lm").solve(graph)
    backend = backends.create("gtsam-isam2")
    ruined = grown(backend, false)[-1]
    assert ruined.report.chi2 > 10.0 * clean.report.chi2
    back = backend.update(graph)
    assert back.report.chi2 <= 1.001 * clean.report.chi2
    assert np.abs(between(clean.poses, back.poses)).max() < 1e-2


@pytest.mark.data
@pytest.mark.slow
def test_a_replay_of_manhattan_by_isam2_ends_at_the_batch_optimum(data_dir):
    graph = read_graph(data_dir / "posegraphs" / "manhattanOlson3500.g2o")
    backend, best = backends.create("gtsam-isam2"), backends.create("gtsam-lm").solve(graph).report.chi2
    *_, last = backends.replay(backend, graph)
    assert last.report.chi2 <= 1.001 * best
    assert backend.finish(graph).report.chi2 <= best * (1.0 + 1e-6)
