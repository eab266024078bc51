import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from hybridmap.geometry import wrap_angle
from hybridmap.neural.rings import HeadDirectionRing

angles = st.floats(-3.0, 3.0)


@given(first=angles, second=angles)
def test_turns_add_and_wrap(first, second):
    ring = HeadDirectionRing(360)
    ring.turn(first)
    ring.turn(second)
    assert wrap_angle(ring.heading_rad - first - second) == pytest.approx(0.0, abs=1e-12)


@given(phi=angles, cells=st.integers(8, 400))
def test_the_rates_are_the_cosine_tuning_of_the_paper(phi, cells):
    ring = HeadDirectionRing(cells)
    ring.turn(phi)
    assert ring.activity == pytest.approx(1.0 + np.cos(ring.preferred_rad - phi), abs=1e-12)
    assert ring.activity.min() >= 0.0 - 1e-12


@pytest.mark.parametrize(("dtype", "bar_rad"), [(np.float64, 1e-9), (np.float32, 1e-3)])
def test_24000_turns_stay_exact(dtype, bar_rad):
    ring, turns = HeadDirectionRing(360, dtype), np.random.default_rng(3).normal(0.002, 0.02, 24000)
    for turn in turns:
        ring.turn(turn)
    assert abs(wrap_angle(ring.heading_rad - turns.sum())) <= bar_rad
    assert np.hypot(*ring.direction()) == pytest.approx(1.0)
    assert ring.activity.dtype == dtype


def test_the_heading_is_read_from_the_activity():
    ring = HeadDirectionRing(360)
    ring.activity = np.roll(ring.activity, 90)
    assert ring.heading_rad == pytest.approx(np.pi / 2)


def test_turn_rate_modulates_the_rates_but_not_the_heading():
    ring = HeadDirectionRing(360)
    still, turning = ring.rates(0.0), ring.rates(-2.0)
    assert turning == pytest.approx(1.2 * still)
    assert ring.heading_rad == pytest.approx(0.0)
