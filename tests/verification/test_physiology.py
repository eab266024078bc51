import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from hybridmap.verification.physiology import (
    autocorrelogram,
    field_counts,
    grid_scores,
    gridness,
    ideal_map,
    spatial_information,
    stripe_of,
    tuning_width,
    vector_length,
)


@settings(max_examples=15, deadline=None)
@given(spacing=st.floats(9.0, 40.0), angle=st.floats(0.0, 1.0))
def test_an_ideal_hexagonal_map_scores_high_and_a_square_one_far_below_zero(spacing, angle):
    assert 1.3 < gridness(ideal_map(128, spacing, angle)) < 1.45
    assert gridness(ideal_map(128, spacing, angle, "square")) < -1.0


def test_noise_and_stripes_are_no_grid():
    rng = np.random.default_rng(0)
    noisy = gridness(rng.uniform(size=(64, 64)))
    assert np.isnan(noisy) or noisy < 0.5
    stripes = np.tile(np.cos(np.arange(64) / 2.0), (64, 1))
    striped = gridness(stripes)
    assert np.isnan(striped) or striped < 0.5


def test_noise_on_a_grid_map_costs_little():
    rates = ideal_map(96, 16.0, 0.2)
    noisy = rates + np.random.default_rng(1).normal(0.0, 0.2, rates.shape)
    assert gridness(noisy) > 1.2


def test_the_autocorrelogram_is_pearsons_coefficient_at_each_lag():
    rates = np.random.default_rng(2).uniform(size=(9, 12))
    found = autocorrelogram(rates)
    assert found.shape == (17, 23)
    assert found[8, 11] == pytest.approx(1.0)
    assert found == pytest.approx(found[::-1, ::-1])
    dx, dy = 2, -3
    here, there = rates[dx:, :dy], rates[:-dx, -dy:]
    assert found[8 + dx, 11 + dy] == pytest.approx(np.corrcoef(here.ravel(), there.ravel())[0, 1])
    assert found[0, 0] == 0.0  # one common bin


@settings(max_examples=15, deadline=None)
@given(angle=st.floats(0.0, np.pi), period=st.floats(6.0, 30.0), phase=st.floats(0.0, 6.0))
def test_a_stripe_is_measured_between_the_bins(angle, period, phase):
    x, y = np.meshgrid(np.arange(96), np.arange(96), indexing="ij")
    wave = np.cos(2.0 * np.pi * (np.cos(angle) * x + np.sin(angle) * y) / period + phase)
    stripe = stripe_of(np.exp(3.0 * wave), 0.02)
    assert stripe.period_m == pytest.approx(0.02 * period, rel=5e-3)
    turned = np.degrees(stripe.orientation_rad - angle)
    assert (turned + 90.0) % 180.0 - 90.0 == pytest.approx(0.0, abs=0.3)


def test_fields_are_counted():
    maps = np.zeros((5, 20, 20))
    maps[1, 3:7, 3:7] = 1.0
    maps[2, 3:7, 3:7], maps[2, 12:15, 12:15] = 1.0, 0.5
    maps[3, 3:7, 3:7], maps[3, 12:15, 12:15], maps[3, 0, 19] = 1.0, 0.15, 0.9  # too weak; too small
    maps[4] = 0.5
    maps[4, 5, 5] = 1.0  # everywhere is no field
    assert field_counts(maps).tolist() == [0, 1, 2, 1, 0]


@settings(max_examples=10, deadline=None)
@given(spacing=st.floats(9.0, 40.0), angle=st.floats(0.0, 1.0))
def test_langstons_score_tells_hexagons_from_squares_and_stripes(spacing, angle):
    assert 1.3 < grid_scores(ideal_map(128, spacing, angle)).langston < 1.5
    assert grid_scores(ideal_map(128, spacing, angle, "square")).langston < 0.2


def test_bins_without_a_visit_are_left_out_of_the_scores():
    rates = ideal_map(90, 20.0, 0.3)
    whole = grid_scores(rates)
    holed = rates.copy()
    holed[np.hypot(*np.mgrid[-45:45, -45:45]) > 46.0] = np.nan  # a round arena
    holed[np.random.default_rng(0).uniform(size=rates.shape) < 0.2] = np.nan
    assert grid_scores(holed) == pytest.approx(whole, abs=0.05)
    dx, dy = 2, 3
    here, there = holed[dx:, dy:].ravel(), holed[:-dx, :-dy].ravel()
    both = np.isfinite(here) & np.isfinite(there)
    assert autocorrelogram(holed)[89 + dx, 89 + dy] == pytest.approx(np.corrcoef(here[both], there[both])[0, 1])


def test_a_map_without_any_peak_has_no_score():
    assert np.isnan(grid_scores(np.ones((20, 20)))).all()


def test_information_of_a_cell_that_fires_in_a_share_of_the_arena_is_the_logarithm_of_that_share():
    rates, dwell = np.zeros((8, 8)), np.full((8, 8), 0.5)
    rates[:2, :4] = 7.0
    assert spatial_information(rates, dwell) == pytest.approx(3.0)
    assert spatial_information(np.full((8, 8), 7.0), dwell) == pytest.approx(0.0)
    assert np.isnan(spatial_information(np.zeros((8, 8)), dwell))
    dwell[:2, :4], dwell[4, 4], rates[4, 4] = 3.5, 0.0, np.nan  # half of the time is in the field
    dwell[dwell == 0.5] = 28.0 / 55
    assert spatial_information(rates, dwell) == pytest.approx(1.0)


@settings(max_examples=20, deadline=None)
@given(phase=st.floats(0.0, 6.0), concentration=st.floats(0.7, 60.0))
def test_the_tuning_of_von_mises_has_the_width_and_vector_that_it_should(phase, concentration):
    from scipy.special import ive

    angles = 2.0 * np.pi * np.arange(360) / 360
    curve = np.exp(concentration * (np.cos(angles - phase) - 1.0))
    assert vector_length(3.0 * curve) == pytest.approx(ive(1, concentration) / ive(0, concentration))
    half = 0.5 * (1.0 + np.exp(-2.0 * concentration))
    assert tuning_width(3.0 * curve) == pytest.approx(2.0 * np.arccos(1.0 + np.log(half) / concentration), abs=2e-3)
    cosine = 1.0 + np.cos(angles - phase)
    assert vector_length(cosine) == pytest.approx(0.5)
    assert tuning_width(cosine) == pytest.approx(np.pi, abs=1e-3)


def test_a_cell_that_fires_alike_in_all_directions_has_no_width():
    assert np.isnan(tuning_width(np.ones(60)))
    assert vector_length(np.ones(60)) == pytest.approx(0.0, abs=1e-12)
    assert np.isnan(vector_length(np.zeros(60)))
