"""Views compared along a stretch of the way, against the definition."""

from __future__ import annotations

import numpy as np
import pytest

from hybridmap.config.vision import MatchingConfig
from hybridmap.vision.scanline.sequences import Sequences
from hybridmap.vision.templates import band_weights, combine, shifted_differences

WIDTH, BANDS, MAX_SHIFT = 24, 4, 4


def fed(profiles, length):
    sequences = Sequences(MatchingConfig(sequence=length), MAX_SHIFT)
    for profile in profiles:
        sequences.add(profile)
    return sequences


def places(count, seed=0):
    return np.random.default_rng(seed).normal(size=(count, BANDS, WIDTH)).astype(np.float32)


def by_definition(profiles, length):
    """Mean over the last views of the least G to the three nodes around the partner."""
    newest, weights, shifts = len(profiles) - 1, band_weights(BANDS, 0.7, 0.3), np.arange(-MAX_SHIFT, MAX_SHIFT + 1)

    def g(i, j):
        table = shifted_differences(profiles[i].astype(float), profiles[j][:, None].astype(float), shifts)
        return float(combine(table, shifts, "plain", weights)[0][0])

    scores = np.full(len(profiles), np.inf)
    for older in range(length - 1, newest):
        terms = [g(newest, older)]
        for back in range(1, length):
            partners = [j for j in range(older - back - 1, older - back + 2) if 0 <= j < newest - back]
            terms.append(min((g(newest - back, j) for j in partners), default=np.inf))
        scores[older] = np.mean(terms)
    return scores


@pytest.mark.parametrize("length", [1, 2, 4])
def test_scores_are_those_of_the_definition(length):
    profiles = places(9)
    profiles[6:] += 0.5 * profiles[1:4]
    found = fed(profiles, length).scores
    assert found == pytest.approx(by_definition(profiles, length), abs=1e-5)


def test_a_stretch_driven_again_scores_best_where_it_was_driven_first():
    first = places(20)
    again = first[5:15] + 0.3 * places(10, seed=1)
    sequences = fed([*first, *again], 4)
    assert int(np.argmin(sequences.scores)) == 14


def test_one_view_that_is_hidden_does_not_hide_the_stretch():
    first = places(20)
    again = first[5:15].copy()
    again[-1] = places(1, seed=2)[0]
    sequences = fed([*first, *again], 6)
    assert abs(int(np.argmin(sequences.scores)) - 14) <= 1
    assert abs(int(np.argmin(sequences.single)) - 14) > 1


def test_nothing_matches_before_a_stretch_is_complete():
    assert np.isinf(fed(places(5), 8).scores).all()
    assert np.isinf(fed(places(1), 1).scores).all()
    scores = fed(places(12), 8).scores
    assert np.isinf(scores[:7]).all()
    assert np.isfinite(scores[7:11]).all()
    assert np.isinf(scores[11])


def test_views_without_contrast_match_none():
    profiles = places(20)
    profiles[4:9] = 0.0
    profiles[14:] = 0.0
    sequences = fed(profiles, 3)
    assert np.isinf(sequences.scores).all()
    sequences.add(profiles[2])
    assert np.isinf(sequences.single[4:9]).all()
    assert np.isfinite(sequences.single[:4]).all()


def test_the_shift_has_a_fraction_and_is_positive_where_things_lie_at_higher_columns_in_the_newest():
    fine = np.interp(
        np.arange(0, 80, 0.25), np.arange(80), np.convolve(np.random.default_rng(3).normal(size=80), np.ones(5), "same")
    )
    older, newest = (np.tile(fine[start : start + 4 * WIDTH : 4], (BANDS, 1)) for start in (60, 50))
    assert fed([older, newest], 1).shifts[0] == pytest.approx(2.5, abs=0.3)


def test_the_best_node_has_a_fraction_between_its_neighbours_and_none_at_the_ends():
    ways = np.linspace(0.0, 12.0, 25)
    knots = np.random.default_rng(4).normal(size=(BANDS, WIDTH, 14))

    def view(at):
        low = int(at)
        return ((1 - at + low) * knots[..., low] + (at - low) * knots[..., low + 1]).astype(np.float32)

    sequences = fed([*map(view, ways), *map(view, ways[5:12] + 0.15)], 4)
    best = int(np.argmin(sequences.scores))
    assert best == 11
    assert 0.05 < sequences.offset_nodes(best) < 0.5
    assert sequences.offset_nodes(0) == 0.0
    assert sequences.offset_nodes(len(sequences.scores) - 1) == 0.0
    assert sequences.offset_nodes(best - 1) == 0.0
