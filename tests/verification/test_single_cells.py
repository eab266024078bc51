"""Spikes of single cells along a path, and what they show."""

import numpy as np
import pytest

from hybridmap.verification import path_rows, verify_along
from hybridmap.verification.physiology import stripe_of
from hybridmap.verification.recorded import RATE_HZ, arena_of, track_of
from hybridmap.verification.single_cells import BAND, HEADING, PEAK_HZ, SCORES, heading_tuning, poisson_spikes, scores_of
from tests.verification.paths_for_tests import FEW, recorded


def along(seed=1, concentration=5.0, **changes):
    return verify_along(recorded(**changes), seed, FEW, concentration, shuffles=5, workers=1)


@pytest.fixture(scope="module")
def result():
    return along()


@pytest.fixture(scope="module")
def rows(result):
    return {row.name.removeprefix("verify/"): row for row in path_rows(result)}


def test_poisson_spikes_come_at_the_rate_and_when_it_is_there():
    rng, started = np.random.default_rng(0), np.arange(200_000) / RATE_HZ + 7.0
    rates = np.where(np.arange(200_000) % 2 == 0, 20.0, 0.0)
    samples, times = poisson_spikes(rng, rates, started)
    assert len(samples) == pytest.approx(40_000, abs=5 * np.sqrt(40_000))
    assert (samples % 2 == 0).all()
    assert (np.diff(times) >= 0).all()
    assert (np.abs(times - started[samples] - 0.01) <= 0.01 + 1e-9).all()
    counts = np.bincount(samples)[::2]
    assert counts.var() == pytest.approx(counts.mean(), rel=0.05)


def test_every_kind_of_cell_shows_what_it_is(result, rows):
    assert {cell.kind for cell in result.cells} == set(SCORES)
    assert rows["grid_langston"].value > 1.0
    assert rows["grid_langston_above"].value == 100.0
    assert rows["band_langston"].value < 0.7
    assert rows["grid_information"].value > rows["grid_information_chance"].value
    assert rows["head_direction_vector_length"].value > 0.8


def test_path_integration_keeps_its_bars(rows):
    judged = {name: row for name, row in rows.items() if row.passed is not None}
    assert set(judged) == {"path_position", "path_phase", "path_heading"}
    assert all(row.passed for row in judged.values())


def test_a_wrong_gain_misses_a_bar():
    result = verify_along(recorded(), 1, FEW | {"gain": 1.02}, shuffles=1, workers=1)
    assert "verify/path_phase" in {row.name for row in path_rows(result) if row.passed is False}


def test_the_same_seed_gives_the_same_spikes_and_another_seed_others(result):
    again, other = along(), along(seed=2)
    assert all(np.array_equal(a, b) for a, b in zip(result.spike_times_s, again.spike_times_s, strict=True))
    for part in ("scores", "chance", "true_scores"):
        assert str([getattr(found, part) for found in again.results]) == str([getattr(found, part) for found in result.results])
    assert not np.array_equal(result.spike_times_s[0], other.spike_times_s[0])


def test_rates_are_those_of_real_cells(result):
    for kind, peak in PEAK_HZ.items():
        rates = np.array([result.rates_hz[number] for number, _, _ in result.of_kind(kind)])
        assert rates.shape[1] == len(result.track.stamps_s)
        assert rates.min() >= 0.0
        assert peak * 0.5 < rates.max() < peak * 1.1


def test_a_cell_that_fires_anywhere_scores_like_its_shuffles():
    arena = arena_of(track_of(recorded()), 0.12)
    fired = np.sort(np.random.default_rng(0).integers(0, len(arena.bins), 800))
    found = scores_of("grid", fired, np.full(len(arena.bins), 10.0), arena, np.random.SeedSequence(1), 40)
    assert found.scores["information"] < 1.3 * found.chance["information"]
    assert found.true_scores["information"] == pytest.approx(0.0, abs=1e-12)
    assert found.scores["langston"] < 0.8


def test_a_tuning_curve_is_over_the_time_at_each_heading():
    headings = np.concatenate([np.zeros(100), np.full(300, np.pi), np.full(50, -0.104)])
    tuning = heading_tuning(np.concatenate([np.full(100, 0.1), np.full(300, 0.1), np.zeros(50)]), headings)
    assert tuning[[0, 30, 59]] == pytest.approx([5.0, 5.0, 0.0])
    assert np.isnan(tuning).sum() == 57


def test_cells_are_tuned_to_what_their_table_says_in_the_frame_of_the_path():
    headings = np.linspace(1.0, 1.0 + 12.0 * np.pi, len(recorded().stamps_ns))
    result = verify_along(recorded(headings_rad=headings), 3, FEW, 5.0, shuffles=1, workers=1)
    for _, cell, found in result.of_kind(HEADING):
        vector = np.exp(2j * np.pi * np.arange(60) / 60) @ found.tuning
        assert np.angle(vector * np.exp(-1j * cell.preferred_rad)) == pytest.approx(0.0, abs=0.1)
    for _, cell, found in result.of_kind(BAND):
        stripes = stripe_of(np.nan_to_num(found.rates), result.arena.pitch_m)
        off = np.degrees(stripes.orientation_rad - cell.preferred_rad)
        assert (off + 90.0) % 180.0 - 90.0 == pytest.approx(0.0, abs=4.0)
        assert stripes.period_m == pytest.approx(cell.spacing_m, rel=0.03)


def test_with_the_papers_cosine_the_mean_vector_is_a_half():
    headings = np.linspace(-3.0 * np.pi, 5.0 * np.pi, len(recorded().stamps_ns))
    result = verify_along(recorded(headings_rad=headings), 3, FEW, shuffles=1, workers=1)
    found = [scores.true_scores["vector_length"] for _, _, scores in result.of_kind(HEADING)]
    assert found == pytest.approx([0.5] * 8, abs=0.01)
    widths = [np.degrees(scores.width_rad) for _, _, scores in result.of_kind(HEADING)]
    assert np.median(widths) == pytest.approx(180.0, abs=25.0)
    sharp = verify_along(recorded(headings_rad=headings), 3, FEW, 5.0, shuffles=1, workers=1)
    assert [s.true_scores["vector_length"] for _, _, s in sharp.of_kind(HEADING)] == pytest.approx([0.893] * 8, abs=0.01)
    assert sharp.errors.heading_rad.max() < 1e-9
