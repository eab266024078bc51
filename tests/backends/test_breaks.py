"""Loops that a solver rejects are freed where the chain is loosened at the right node."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from hybridmap.backends.judging.breaks import drove, freed, leads_across, loosened, moves, shift, wanted_motion
from hybridmap.backends.objective import gate_of
from hybridmap.backends.registry import create
from hybridmap.config.backends import BackendsConfig
from hybridmap.geometry import RelativePose, align, between, compose
from hybridmap.graph.agreement import Loops
from hybridmap.graph.edges import EdgeKind
from hybridmap.graph.paths import Chain, chain
from tests.backends.graphs_for_tests import laps

CARRIED, AT = np.array([1.0, 0.3, 0.1]), 35
GATE = gate_of(BackendsConfig())


@pytest.fixture
def plain():
    return laps(np.random.default_rng(7))


@pytest.fixture
def carried(plain):
    """The same drive, but the robot was carried before node AT, which its odometry does not know."""
    graph, truth = plain
    felt = compose(truth[AT - 1], between(compose(truth[AT - 1], CARRIED), truth[AT]))
    [edge] = np.flatnonzero((graph.targets == AT) & (graph.kinds == EdgeKind.ODOMETRY))
    deltas = graph.deltas.copy()
    deltas[edge] = between(truth[AT - 1], felt)
    return chain(replace(graph, deltas=deltas)), truth


@pytest.fixture
def solved(carried):
    return create("gtsam-gnc", BackendsConfig()).solve(carried[0])


def freed_at(graph, solution, place, clear=None):
    clear = np.ones(graph.n_edges, dtype=bool) if clear is None else clear
    edges = np.flatnonzero(np.isin(graph.edge_ids, solution.report.rejected_edge_ids) & leads_across(graph, place))
    motion = wanted_motion(graph, solution.poses, edges, place)
    again = create("gtsam-gnc", BackendsConfig()).solve(loosened(graph, solution.poses, place, motion))
    return freed(graph, solution.poses, again.poses, place, GATE, clear), again.poses


def test_loosening_the_chain_where_it_broke_frees_the_loops(carried, solved):
    graph, truth = carried
    found, poses = freed_at(graph, solved, AT)
    assert found.pays
    assert len(found.loops) >= 15
    assert found.lost == 0
    ends = compose(align(truth, poses), poses)
    assert np.hypot(*(ends - truth)[:, :2].T).max() < 0.2
    assert freed_at(graph, solved, AT + 10)[0].gain < found.gain


def test_loosening_a_sound_chain_does_not_pay(plain):
    graph, _ = plain
    solution = create("gtsam-gnc", BackendsConfig()).solve(graph)
    again = create("gtsam-gnc", BackendsConfig()).solve(loosened(graph, solution.poses, AT, np.zeros(3)))
    assert not freed(graph, solution.poses, again.poses, AT, GATE, np.ones(graph.n_edges, dtype=bool)).pays


def test_loosening_a_chain_that_loops_bend_straightens_it(carried, plain):
    for graph, straightens in ((carried[0], True), (plain[0], False)):
        poses = create("gtsam-lm", BackendsConfig()).solve(graph).poses
        again = create("gtsam-lm", BackendsConfig()).solve(loosened(graph, poses, AT, np.zeros(3))).poses
        found = freed(graph, poses, again, AT, np.inf, np.ones(graph.n_edges, dtype=bool))
        assert not found.pays
        found = freed(graph, poses, again, AT, GATE, np.ones(graph.n_edges, dtype=bool))
        assert found.straightens is straightens


def test_a_loosened_graph_keeps_all_but_the_motion_across(plain):
    graph, _ = plain
    loose = loosened(graph, graph.initial, AT, np.array([1.0, 0.0, 0.0]))
    assert loose.n_edges == graph.n_edges
    assert loose.edge_ids[-1] == graph.edge_ids[-1] + 1
    loose.validate()
    np.testing.assert_allclose(loose.initial[AT:, 0], graph.initial[AT:, 0] + 1.0)
    np.testing.assert_allclose(loose.initial[:AT], graph.initial[:AT])


def test_a_motion_within_the_noise_moves_nothing():
    poses = np.array([[1.0, 0.0, 0.0], [3.0, 2.0, 0.5]])
    assert not moves(np.array([0.05, 0.0, 0.0]), poses, 1)
    assert moves(np.array([0.3, 0.0, 0.0]), poses, 1)
    assert shift(np.array([0.3, 0.4, 0.0]), poses, 1) == pytest.approx((0.5, 0.0))


@pytest.mark.parametrize("sigma_m", [0.03, 3.0])
@pytest.mark.parametrize(("carried_m", "expected"), [(0.0, True), (0.5, True), (1.5, False), (3.0, False)])
def test_a_robot_drove_where_its_wheels_agree_with_loops_and_not_where_they_lack_the_carry(carried_m, sigma_m, expected):
    """On a bent map loops want node 10 put down 3 m farther on; in truth the robot was carried there by less, or not at all."""
    way = np.column_stack([0.5 * np.arange(21.0), np.zeros(21), np.zeros(21)])
    there = way + np.where(np.arange(21) < 10, 0.0, carried_m)[:, None] * np.array([1.0, 0.0, 0.0])
    grown = np.arange(21.0)[:, None, None] * np.diag([sigma_m**2, sigma_m**2, 1e-8])
    wheels, sure = Chain(way, grown, np.zeros(0, dtype=np.int64)), np.diag([0.01, 0.01, 0.01]) ** 2
    loops = Loops.measured([(a, b, RelativePose(between(there[a], there[b]), sure)) for a, b in [(0, 18), (1, 19), (2, 20)]])
    assert drove(wheels, loops, 10, np.array([0.5 + 3.0, 0.0, 0.0])) is expected


def test_nothing_tells_whether_a_robot_drove_where_its_wheels_are_not_known():
    wheels = Chain(np.zeros((10, 3)), np.zeros((10, 3, 3)), np.array([5]))
    loops = Loops.measured([(1, 8, RelativePose(np.zeros(3), np.eye(3)))])
    assert not drove(wheels, loops, 5, np.array([3.0, 0.0, 0.0]))
