"""The compiled sweeps against a plain loop, and the laws of the per-link rule."""

import os
import subprocess
import sys
from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from numba import njit

from hybridmap import backends, compiled
from hybridmap.backends.base import Outcome, SolveStatus
from hybridmap.backends.relaxation import ratslam as sweeps
from hybridmap.backends.relaxation.ratslam import TOLERANCE_M, relax_links, swept
from hybridmap.config.backends import RelaxationConfig
from hybridmap.errors import GraphError
from hybridmap.geometry import compose, wrap_angle
from hybridmap.study.false_loops import inject
from tests.backends.graphs_for_tests import laps, star

ELSEWHERE = """
import sys, numba, numpy as np
from tests.backends.graphs_for_tests import laps
from hybridmap.backends.relaxation.ratslam import relax_links
from hybridmap.config.backends import RelaxationConfig
graph = laps(np.random.default_rng(0), noise=3.0)[0]
print(numba.config.DISABLE_JIT, relax_links(graph, graph.initial, 10, RelaxationConfig(), robust=True).poses.tobytes().hex())
"""


def one_by_one(graph, start, count, config, robust=False, tolerance_m=TOLERANCE_M):
    """The rule in plain Python: poses and how many sweeps it took until nothing moved."""
    poses = start.copy()
    order = sorted(range(graph.n_edges), key=lambda e: (graph.sources[e], graph.edge_ids[e]))
    for sweep in range(1, count + 1):
        before = poses.copy()
        scale = sweeps.ROBUST_START ** max(0, 1 - 2 * sweep / count) if robust else 1.0
        for e in order:
            s, t = graph.sources[e], graph.targets[e]
            error = poses[t] - compose(poses[s], graph.deltas[e])
            error[2] = wrap_angle(error[2])
            rate = config.theta * config.theta_decay ** (sweep - 1)
            if robust and graph.is_loop[e]:
                in_scales = error / (scale * np.array([0.3, 0.3, 0.1]))
                rate *= (1 + in_scales @ in_scales) ** -2
            poses[s] += rate * error
            poses[t] -= rate * error
        if scale == 1.0 and np.abs(poses - before).max() <= tolerance_m:
            break
    return poses, sweep


def apart(poses, others):
    """Largest difference of two arrays of poses, m or rad."""
    return max(np.abs((poses - others)[:, :2]).max(), np.abs(wrap_angle(poses[:, 2] - others[:, 2])).max())


def wound(nodes=60):
    """Laps whose headings wind round twice, so that loops are off by two thirds of a turn."""
    graph, _ = laps(np.random.default_rng(0), nodes=nodes)
    initial = graph.initial + np.linspace(0.0, 4.0 * np.pi, nodes)[:, None] * [0, 0, 1]
    return replace(graph, initial=initial)


GRAPHS = {
    "laps": lambda: laps(np.random.default_rng(0), nodes=80, noise=3.0)[0],
    "star": lambda: star(50),
    "wound": wound,
    "false": lambda: inject(laps(np.random.default_rng(1))[0], 0.3, "random", np.random.default_rng(0)),
}


@pytest.mark.parametrize("name", GRAPHS)
@pytest.mark.parametrize("robust", [False, True])
@pytest.mark.parametrize(("theta", "theta_decay"), [(0.5, 1.0), (1.0, 0.9), (0.2, 0.5)])
def test_sweeps_are_the_loop_over_links(name, robust, theta, theta_decay, monkeypatch):
    monkeypatch.setattr(sweeps, "ROBUST_START", 5.0)
    graph = GRAPHS[name]()
    config = RelaxationConfig(theta=theta, theta_decay=theta_decay)
    expected, swept = one_by_one(graph, graph.initial, 23, config, robust)
    found = relax_links(graph, graph.initial, 23, config, robust=robust)
    assert found.sweeps == swept
    assert apart(found.poses, expected) < 1e-9
    assert np.all(np.abs(found.poses[:, 2]) <= np.pi)


def test_links_are_visited_by_source_and_of_one_source_by_age():
    graph, _ = laps(np.random.default_rng(3), noise=3.0)
    turned = replace(graph, sources=graph.targets, targets=graph.sources)  # the chain last
    for each in (graph, turned):
        expected, _ = one_by_one(each, each.initial, 3, RelaxationConfig())
        assert apart(relax_links(each, each.initial, 3, RelaxationConfig()).poses, expected) < 1e-12
    shuffled = graph.with_edges(np.random.default_rng(0).permutation(graph.n_edges))
    by_age = shuffled.with_edges(np.argsort(shuffled.edge_ids))
    assert np.array_equal(
        relax_links(by_age, graph.initial, 3, RelaxationConfig()).poses,
        relax_links(graph, graph.initial, 3, RelaxationConfig()).poses,
    )


@pytest.mark.parametrize("robust", [False, True])
def test_the_tolerance_ends_a_run(robust, monkeypatch):
    monkeypatch.setattr(sweeps, "TOLERANCE_M", 1e-3)
    graph, _ = laps(np.random.default_rng(0), noise=3.0)
    config = RelaxationConfig(theta_decay=0.9)
    expected, swept = one_by_one(graph, graph.initial, 100, config, robust, tolerance_m=1e-3)
    found = relax_links(graph, graph.initial, 100, config, robust=robust)
    assert found.settled
    assert found.sweeps == swept < 100
    assert apart(found.poses, expected) < 1e-9
    if robust:
        assert found.sweeps == 50  # the scales have to come down first
    else:
        assert not relax_links(graph, graph.initial, swept - 1, config).settled


@pytest.mark.parametrize("robust", [False, True])
def test_a_consistent_graph_stays_where_it_is(robust):
    graph, truth = laps(np.random.default_rng(0), noise=0.0)
    found = relax_links(graph, truth, 50, RelaxationConfig(), robust=robust)
    assert (found.sweeps, found.settled) == (25 if robust else 1, True)
    assert apart(found.poses, truth) < 1e-9


@given(st.integers(0, 10_000), st.floats(0.05, 1.0), st.booleans())
@settings(max_examples=20, deadline=None)
def test_no_sweep_leads_away_from_poses_that_fit_every_link(seed, theta, headings):
    rng = np.random.default_rng(seed)
    graph, truth = laps(rng, nodes=40, noise=0.0)
    start = truth + rng.normal(size=truth.shape) * (np.array([0, 0, 0.3]) if headings else np.array([2, 2, 0]))
    poses, which = start, slice(2, 3) if headings else slice(0, 2)
    for _ in range(10):
        after = relax_links(graph, poses, 1, RelaxationConfig(theta=theta)).poses
        off, now = poses - truth, after - truth
        off[:, 2], now[:, 2] = wrap_angle(off[:, 2]), wrap_angle(now[:, 2])
        assert np.linalg.norm(now[:, which]) <= np.linalg.norm(off[:, which]) * (1 + 1e-12)
        poses = after


@given(st.floats(0.05, 1.0), st.integers(0, 10_000))
@settings(max_examples=20, deadline=None)
def test_the_error_of_links_that_share_no_node_shrinks_by_one_minus_two_theta(theta, seed):
    graph, _ = laps(np.random.default_rng(seed), nodes=30, noise=5.0)
    alone = graph.with_edges(np.flatnonzero((graph.targets - graph.sources == 1) & (graph.sources % 2 == 0)))
    start = graph.initial + np.random.default_rng(seed).normal(size=(30, 3)) * [1, 1, 0.3]
    steps = compose(start[alone.sources], alone.deltas) - start[alone.sources]
    after = relax_links(alone, start, 1, RelaxationConfig(theta=theta)).poses

    def errors(poses):
        off = poses[alone.targets] - poses[alone.sources] - steps
        return np.column_stack([off[:, :2], wrap_angle(off[:, 2])])

    shrunk = errors(after) - (1 - 2 * theta) * errors(start)
    assert np.abs(np.column_stack([shrunk[:, :2], wrap_angle(shrunk[:, 2])])).max() < 1e-9


@given(st.integers(0, 10_000), st.floats(0.05, 1.0), st.booleans())
@settings(max_examples=20, deadline=None)
def test_no_graph_makes_the_rule_grow_beyond_all_bounds(seed, theta, robust):
    rng = np.random.default_rng(seed)
    graph, _ = laps(rng, nodes=40)
    ends = np.concatenate([graph.sources[None], graph.targets[None]])
    ends[:, graph.is_loop] = [rng.integers(1, 40, graph.is_loop.sum()), np.zeros(graph.is_loop.sum(), dtype=np.int64)]
    deltas = np.where(graph.is_loop[:, None], rng.uniform(-100, 100, graph.deltas.shape), graph.deltas)
    nonsense = replace(graph, sources=ends[0], targets=ends[1], deltas=deltas)  # a hub of contradicting loops
    poses = relax_links(nonsense, graph.initial, 500, RelaxationConfig(theta=theta), robust=robust).poses
    assert np.abs(poses - poses[0]).max() < 1e6  # growth without bound reaches 1e300 in so many sweeps


@given(st.integers(0, 10_000), st.tuples(st.floats(-50, 50), st.floats(-50, 50), st.floats(-3.1, 3.1)), st.booleans())
@settings(max_examples=20, deadline=None)
def test_a_moved_map_relaxes_to_the_moved_result(seed, motion, robust):
    graph, _ = laps(np.random.default_rng(seed), nodes=40, noise=3.0)
    here = relax_links(graph, graph.initial, 30, RelaxationConfig(), robust=robust).poses
    there = relax_links(graph, compose(motion, graph.initial), 30, RelaxationConfig(), robust=robust).poses
    assert apart(there, compose(motion, here)) < 1e-8


def test_a_loop_s_weight_falls_with_its_error_and_an_odometry_edge_has_none(monkeypatch):
    monkeypatch.setattr(sweeps, "ROBUST_START", 1.0)
    graph, _ = laps(np.random.default_rng(0), nodes=22, noise=0.0)
    config = RelaxationConfig(theta=0.5)
    loop = graph.with_edges(graph.is_loop)
    loop = loop.with_edges(np.array([0]))
    off = graph.initial.copy()
    off[loop.targets[0], :2] += [0.3, 0.0]  # r^2 = 1: a quarter
    moved = relax_links(loop, off, 1, config, robust=True).poses - off
    assert np.allclose(moved[loop.sources[0]], [0.125 * 0.3, 0, 0], atol=1e-12)
    assert np.allclose(moved[loop.targets[0]], [-0.125 * 0.3, 0, 0], atol=1e-12)
    chain = graph.with_edges(~graph.is_loop)
    plain = relax_links(chain, off, 5, config).poses
    assert np.array_equal(relax_links(chain, off, 5, config, robust=True).poses, plain)


def test_a_run_beyond_all_bounds_ends_at_once_and_is_no_map():
    graph, _ = laps(np.random.default_rng(0))
    deltas = graph.deltas.copy()
    deltas[:, 0] = 1.7e308
    absurd = replace(graph, deltas=deltas)
    found = relax_links(absurd, graph.initial, 100, RelaxationConfig())
    assert (found.sweeps, found.settled) == (1, False)
    assert not np.isfinite(found.poses).all()

    def rule(graph, start, sweeps):
        return Outcome(relax_links(graph, start, sweeps, RelaxationConfig()).poses, SolveStatus.CONVERGED, "relaxed", sweeps)

    outcome = swept(rule, 100)(absurd, graph.initial)
    assert outcome.status == "diverged"
    assert np.array_equal(outcome.poses, graph.initial)
    for name in ("relaxation-ratslam", "relaxation-weighted", "relaxation-robust"):
        with pytest.raises(GraphError, match=r"edge 0 .*beyond 1e\+09"):
            backends.create(name).solve(absurd)


def test_the_input_is_left_alone_whatever_its_layout():
    graph, _ = laps(np.random.default_rng(0))
    start = np.asfortranarray(graph.initial)
    kept, fortran = start.copy(), replace(graph, deltas=np.asfortranarray(graph.deltas))
    for array in (start, fortran.sources, fortran.targets, fortran.deltas):
        array.setflags(write=False)
    found = relax_links(fortran, start, 5, RelaxationConfig()).poses
    assert np.array_equal(start, kept)
    assert np.array_equal(found, relax_links(graph, kept, 5, RelaxationConfig()).poses)


@pytest.mark.parametrize("without", ["", "1"])
def test_another_process_gives_the_same_with_and_without_compiled_code(without):
    graph, _ = laps(np.random.default_rng(0), noise=3.0)
    here = relax_links(graph, graph.initial, 10, RelaxationConfig(), robust=True).poses
    env = os.environ | {"NUMBA_DISABLE_JIT": without or "0", "PYTHONPATH": os.pathsep.join(sys.path)}
    done = subprocess.run([sys.executable, "-c", ELSEWHERE], capture_output=True, text=True, check=True, env=env)
    disabled, poses = done.stdout.split()
    assert disabled == (without or "0")
    there = np.frombuffer(bytes.fromhex(poses)).reshape(-1, 3)
    assert apart(there, here) < 1e-12
    assert without or np.array_equal(there, here)


def test_compiled_code_that_cannot_be_kept_is_compiled_all_the_same(monkeypatch):
    asked = []

    def unwritable(signature, cache=False):
        asked.append(cache)
        if cache:
            raise RuntimeError("cannot cache function 'doubled': no locator available for file")
        return njit(signature)

    monkeypatch.setattr(compiled, "njit", unwritable)
    doubled = compiled.compiled("float64(float64)")(lambda number: 2.0 * number)
    assert asked == [True, False]
    assert doubled(1.5) == 3.0
