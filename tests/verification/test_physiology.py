import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from hybridmap.verification.physiology import autocorrelogram, field_counts, gridness, ideal_map, stripe_of


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
