"""The ring test and the largest consistent set: laws, simulated noise and brute force."""

from itertools import combinations

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.stats import chi2 as chi2_law

from hybridmap.geometry import RelativePose, between, compose, exp, invert_relative
from hybridmap.graph.agreement import Loops, Ring, agreement, chi2_quantile, largest_consistent_set, ring

FIRST, SECOND = np.array([0]), np.array([1])


def covariances(rng, count, size):
    root = rng.normal(size=(count, 3, 3))
    return size**2 * (root @ root.transpose(0, 2, 1) + 0.3 * np.eye(3))


def noisy(rng, truth, covariance):
    """Poses (..., 3) measured with noise of that covariance (3, 3)."""
    return compose(truth, exp(rng.normal(size=truth.shape) @ np.linalg.cholesky(covariance).T))


class World:
    """Two places, two loops between them, and ways along both, with noise."""

    def __init__(self, seed, size=0.03, count=1):
        """`count` draws of the same ring."""
        rng = np.random.default_rng(seed)
        self.truth = rng.uniform([-8, -8, -3], [8, 8, 3], (4, 3))  # older ends 0, 1; newer ends 2, 3
        parts = covariances(rng, 4, size)
        exact = [between(self.truth[a], self.truth[b]) for a, b in ((0, 2), (1, 3), (0, 1), (2, 3))]
        drawn = [noisy(rng, np.tile(delta, (count, 1)), c) for delta, c in zip(exact, parts, strict=True)]
        first, second, self.old, self.new = (
            RelativePose(delta, np.tile(c, (count, 1, 1))) for delta, c in zip(drawn, parts, strict=True)
        )
        ends = np.repeat(np.arange(4)[:, None], count, axis=1)
        self.first, self.second = Loops(ends[0], ends[2], first), Loops(ends[1], ends[3], second)

    def ways(self, a, b):
        chosen = self.new if a[0] >= 2 else self.old
        return chosen if b[0] > a[0] else invert_relative(chosen)


@given(st.integers(0, 2**32 - 1))
def test_a_ring_of_exact_measurements_closes(seed):
    world = World(seed, size=1e-12)
    assert ring(world.first, world.second, world.ways).error == pytest.approx(np.zeros((1, 3)), abs=1e-9)


@given(st.integers(0, 2**32 - 1))
def test_it_does_not_matter_which_loop_is_the_first(seed):
    world = World(seed, size=1e-4)
    there = ring(world.first, world.second, world.ways).distance
    assert ring(world.second, world.first, world.ways).distance == pytest.approx(there, rel=1e-2)


@given(st.integers(0, 2**32 - 1))
def test_it_does_not_matter_from_which_end_a_loop_is_told(seed):
    world = World(seed)
    back = invert_relative(world.first.relative)
    told = Loops.of(world.first.newer, world.first.older, back)
    assert told.older == world.first.older
    assert ring(told, world.second, world.ways).distance == pytest.approx(ring(world.first, world.second, world.ways).distance)


@given(st.integers(0, 2**32 - 1))
def test_moving_the_whole_map_changes_nothing(seed):
    rng = np.random.default_rng(seed)
    poses, moved = rng.uniform(-5, 5, (2, 4, 3))
    moved = compose(moved[0], poses)
    loops = Loops(np.array([0, 1]), np.array([2, 3]), RelativePose(rng.uniform(-5, 5, (2, 3)), covariances(rng, 2, 0.1)))

    def distance(poses):
        def ways(a, b):
            return RelativePose(between(poses[a], poses[b]), np.tile(np.eye(3) * 1e-3, (len(a), 1, 1)))

        return ring(loops[FIRST], loops[SECOND], ways).distance

    assert distance(moved) == pytest.approx(distance(poses), rel=1e-6)


@pytest.mark.parametrize("seed", range(5))
def test_error_and_distance_follow_the_stated_noise(seed):
    found = World(seed, size=3e-3, count=20_000)
    closed = ring(found.first, found.second, found.ways)
    assert np.cov(closed.error.T) == pytest.approx(closed.covariance[0], rel=0.1, abs=0.05 * closed.covariance[0].max())
    law = chi2_law(df=3)
    assert closed.distance.mean() == pytest.approx(3.0, abs=0.1)
    assert np.quantile(closed.distance, [0.5, 0.95]) == pytest.approx(law.ppf([0.5, 0.95]), rel=0.05)


def test_a_way_of_which_nothing_is_known_supports_nothing():
    unknown = Ring(np.zeros((2, 3)), np.array([np.eye(3), np.full((3, 3), np.inf)]))
    assert unknown.distance.tolist() == [0.0, np.inf]


def test_loops_that_ask_for_the_same_agree_and_one_elsewhere_does_not():
    poses = np.column_stack([np.arange(20.0), np.zeros(20), np.zeros(20)])
    older, newer = np.arange(5), np.arange(12, 17)
    seen = compose([0.0, 2.0, 0.1], between(poses[12], poses[newer]))
    delta = between(poses[older], seen)
    delta[3] = compose(delta[3], [0.5, 0.0, 0.0])
    loops = Loops.of(newer, older, invert_relative(RelativePose(delta, np.tile(np.eye(3) * 1e-4, (5, 1, 1)))))

    def ways(a, b):
        return RelativePose(between(poses[a], poses[b]), np.abs(a - b)[:, None, None] * np.eye(3) * 1e-6)

    agree = agreement(loops, ways, chi2_quantile(0.99))
    expected = np.ones((5, 5), dtype=bool)
    expected[3], expected[:, 3], expected[3, 3] = False, False, True
    assert np.array_equal(agree, expected)
    assert largest_consistent_set(agree).tolist() == [True, True, True, False, True]


def graph_of_pairs(rng, count, density):
    agree = np.triu(rng.random((count, count)) < density, 1)
    return agree | agree.T | np.eye(count, dtype=bool)


@settings(max_examples=60, deadline=None)
@given(st.integers(1, 40), st.integers(0, 2**32 - 1), st.floats(0.0, 1.0))
def test_all_of_a_set_agree_and_nothing_can_be_added_to_it(count, seed, density):
    rng = np.random.default_rng(seed)
    agree, weights = graph_of_pairs(rng, count, density), rng.uniform(0.1, 1.0, count)
    for members in (largest_consistent_set(agree), largest_consistent_set(agree, weights, first=count - 1)):
        assert agree[np.ix_(members, members)].all()
        assert not agree[np.ix_(~members, members)].all(axis=1).any()
    assert members[count - 1]


def test_the_set_is_mostly_the_one_of_brute_force_and_never_far_from_it():
    shares = []
    for seed in range(100):
        rng = np.random.default_rng(seed)
        agree, weights = graph_of_pairs(rng, 9, rng.uniform(0.2, 0.9)), rng.uniform(0.1, 1.0, 9)
        best = max(
            sum(weights[list(chosen)])
            for size in range(1, 10)
            for chosen in combinations(range(9), size)
            if agree[np.ix_(chosen, chosen)].all()
        )
        shares.append(weights[largest_consistent_set(agree, weights)].sum() / best)
    assert max(shares) == pytest.approx(1.0)
    assert np.count_nonzero(np.isclose(shares, 1.0)) > 70
    assert min(shares) > 0.6


def test_a_planted_set_is_found():
    rng = np.random.default_rng(0)
    agree = graph_of_pairs(rng, 60, 0.4)
    planted = np.arange(60) % 2 == 0
    agree |= np.outer(planted, planted)
    assert np.array_equal(largest_consistent_set(agree), planted)


def test_weights_choose_among_sets_of_one_size():
    agree = np.kron(np.eye(2, dtype=bool), np.ones((3, 3), dtype=bool))
    assert largest_consistent_set(agree, np.array([1.0, 1.0, 1.0, 1.0, 1.0, 1.1])).tolist() == [False] * 3 + [True] * 3


@pytest.mark.parametrize("probability", [0.5, 0.95, 0.99, 0.999])
def test_the_quantile_is_that_of_scipy(probability):
    assert chi2_quantile(probability) == pytest.approx(chi2_law.ppf(probability, df=3), rel=1e-12)
