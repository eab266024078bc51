"""The exact search over 8-bit profiles against brute force, and what the matcher makes of it."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from hybridmap.vision import search
from hybridmap.vision.search import Blocks, ProfileIndex
from hybridmap.vision.templates import Matcher, band_weights

WIDTH = 24


def profiles(rng, n, bands):
    rows = np.apply_along_axis(lambda row: np.convolve(row, np.ones(5) / 5, "same"), -1, rng.normal(size=(n, bands, WIDTH)))
    return ((rows - rows.mean(-1, keepdims=True)) / rows.std(-1, keepdims=True)).astype(np.float32)


def by_brute_force(index, query, stored, max_shift):
    """(n,) least mean difference of the bytes over all shifts common to the bands, and the shift where it is."""
    bands = len(index.quantised(query)) // WIDTH
    ours = index.quantised(query).reshape(WIDTH, bands).astype(int)
    theirs = np.stack([index.quantised(p).reshape(WIDTH, bands) for p in stored]).astype(int)
    shifts = np.arange(-max_shift, max_shift + 1)
    cost = []
    for c in shifts:
        gap = np.abs(ours[max(c, 0) : WIDTH + min(c, 0)] - theirs[:, max(-c, 0) : WIDTH - max(c, 0)])
        cost.append(gap.sum(axis=(1, 2)) / (WIDTH - abs(c)))
    return np.min(cost, axis=0), shifts[np.argmin(cost, axis=0)]


@settings(max_examples=40, deadline=None)
@given(seed=st.integers(0, 10**6), n=st.integers(1, 90), count=st.integers(1, 9), bands=st.sampled_from([1, 2, 8]))
def test_the_search_finds_what_brute_force_finds(seed, n, count, bands):
    rng = np.random.default_rng(seed)
    stored, query = profiles(rng, n, bands), profiles(rng, 1, bands)[0]
    index = ProfileIndex(band_weights(bands, 0.7, 0.3), WIDTH, 6)
    for profile in stored:
        index.add(profile)
    cost, shift = by_brute_force(index, query, stored, 6)
    expected = np.argsort(cost, kind="stable")[:count]
    found = index.nearest(query, count)
    assert found.numbers.tolist() == expected.tolist()
    assert found.shift.tolist() == shift[expected].tolist()
    among = np.flatnonzero(rng.random(n) < 0.5)
    expected = among[np.argsort(cost[among], kind="stable")[:count]]
    assert index.nearest(query, count, among).numbers.tolist() == expected.tolist()


@settings(max_examples=20, deadline=None)
@given(seed=st.integers(0, 10**6), turn=st.integers(0, WIDTH - 1))
def test_a_full_circle_is_known_again_from_any_side(seed, turn):
    rng = np.random.default_rng(seed)
    stored = profiles(rng, 40, 1)
    matcher = Matcher("plain", 0.5, 0.5, max_shift=2, circular=True)
    for profile in stored:
        matcher.add(profile)
    query = np.roll(stored[17], turn, axis=1)
    best = matcher.best(query, 1)
    assert best.indices.tolist() == [17]
    assert best.score[0] == pytest.approx(0.0, abs=1e-6)
    assert (best.shift[0] - turn) % WIDTH == 0
    noisy = (query + rng.normal(scale=0.2, size=query.shape)).astype(np.float32)
    every = matcher.score(noisy, np.arange(40))
    by_hand = min(np.abs(np.roll(noisy, -c, axis=1) - stored[30]).mean() for c in range(WIDTH))
    assert every.score[30] == pytest.approx(by_hand, abs=1e-6)
    assert matcher.best(noisy, 1).score[0] == every.score.min()


def test_the_distance_is_the_weighted_mean_difference_of_the_profiles():
    rng = np.random.default_rng(1)
    stored, query = profiles(rng, 50, 8), profiles(rng, 1, 8)[0]
    weights = band_weights(8, 0.7, 0.3)
    index = ProfileIndex(weights, WIDTH, 0)
    for profile in stored:
        index.add(profile)
    found = index.nearest(query, 50)
    exact = np.einsum("nbw,b->n", np.abs(stored - query), weights) / WIDTH
    assert found.distance == pytest.approx(exact[found.numbers], abs=0.01)


def test_a_search_over_several_blocks_is_the_same(monkeypatch):
    rng = np.random.default_rng(2)
    stored, queries = profiles(rng, 100, 2), profiles(rng, 5, 2)
    answers = []
    for block in (4096, 16):
        monkeypatch.setattr(search, "BLOCK", block)
        index = ProfileIndex(band_weights(2, 0.5, 0.5), WIDTH, 5)
        for profile in stored:
            index.add(profile)
        answers.append([index.nearest(query, 7).numbers.tolist() for query in queries])
        among = np.arange(3, 99, 7)
        answers[-1].append(index.nearest(queries[0], 4, among).numbers.tolist())
    assert answers[0] == answers[1]


def test_rows_stay_where_they_are_as_more_come(monkeypatch):
    monkeypatch.setattr(search, "BLOCK", 8)
    rows = Blocks(3, np.uint8)
    rows.append(np.array([1, 2, 3], np.uint8))
    first = rows.filled()[0].ctypes.data
    for value in range(40):
        rows.append(np.full(3, value, np.uint8))
    assert rows.filled()[0].ctypes.data == first
    assert [len(block) for block in rows.filled()] == [8, 8, 8, 8, 8, 1]
    assert rows.take(np.array([40, 0, 9]))[:, 0].tolist() == [39, 1, 8]


def test_a_band_without_weight_does_not_count():
    rng = np.random.default_rng(3)
    stored = profiles(rng, 30, 2)
    index = ProfileIndex(band_weights(2, 1.0, 0.0), WIDTH, 3)
    for profile in stored:
        index.add(profile)
    query = np.stack([stored[4, 0], stored[9, 1]])
    assert index.nearest(query, 1).numbers.tolist() == [4]


@pytest.mark.parametrize("mode", ["literal", "ratio", "signed", "plain", "four-band"])
def test_the_matchers_best_are_those_of_its_scores(mode):
    rng = np.random.default_rng(4)
    stored = profiles(rng, 300, 2)
    matcher = Matcher(mode, 0.7, 0.3, max_shift=5)
    for profile in stored:
        matcher.add(profile)
    for near in range(0, 300, 37):
        query = (stored[near] + rng.normal(scale=0.3, size=(2, WIDTH))).astype(np.float32)
        every = matcher.score(query, np.arange(300))
        best = matcher.best(query, 3)
        exact = 1 if mode in ("plain", "four-band") else 3  # the search has one shift for all bands, G one for each
        assert best.score[:exact].tolist() == sorted(every.score)[:exact]
        among = np.arange(near % 5, 300, 5)
        assert near in among
        assert matcher.best(query, 1, among).score[0] == every.score[among].min()


def test_nothing_is_found_in_an_empty_store_or_among_nothing():
    matcher = Matcher("plain", 0.5, 0.5, max_shift=2)
    query = profiles(np.random.default_rng(5), 1, 2)[0]
    assert len(matcher.best(query, 5).indices) == 0
    matcher.add(query)
    assert len(matcher.best(query, 5, np.zeros(0, np.int64)).indices) == 0


def test_a_sequence_tells_apart_places_that_look_alike():
    """Place 50..59 is seen again; a look-alike of its last view lies elsewhere, and is the better match by itself."""
    rng = np.random.default_rng(6)
    stored = profiles(rng, 80, 2)
    again = (stored[50:60] + rng.normal(scale=0.15, size=(10, 2, WIDTH))).astype(np.float32)
    stored[20] = again[-1]
    found = {}
    for sequence in (1, 5):
        matcher = Matcher("four-band", 0.7, 0.3, max_shift=2, sequence=sequence)
        for profile in (*stored, *again):
            matcher.add(profile)
        found[sequence] = int(matcher.best(again[-1], 1, np.arange(80), ending_at=89).indices[0])
    assert found == {1: 20, 5: 59}
