import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from hybridmap.config.mapping import NeuralConfig
from hybridmap.errors import ConfigError
from hybridmap.geometry import wrap_angle
from hybridmap.neural import PathIntegrator
from hybridmap.neural.rings import HeadDirectionRing, cells_needed

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


@given(phi=angles, concentration=st.floats(0.1, 500.0))
def test_a_von_mises_ring_gives_the_heading_exactly_with_as_many_cells_as_it_needs(phi, concentration):
    ring = HeadDirectionRing(cells_needed(concentration), concentration=concentration)
    ring.turn(phi)
    assert ring.activity == pytest.approx(2.0 * np.exp(concentration * (np.cos(ring.preferred_rad - phi) - 1.0)), abs=1e-9)
    assert wrap_angle(ring.heading_rad - phi) == pytest.approx(0.0, abs=1e-12)
    assert ring.rates_at(phi) == pytest.approx(ring.activity, abs=1e-9)


def test_a_von_mises_ring_stays_exact_over_24000_turns():
    ring, turns = HeadDirectionRing(360, concentration=5.0), np.random.default_rng(3).normal(0.002, 0.02, 24000)
    for turn in turns:
        ring.turn(turn)
    assert abs(wrap_angle(ring.heading_rad - turns.sum())) <= 1e-9


@pytest.mark.parametrize(
    ("cells", "concentration"), [(23, 5.0), (360, 2000.0), (360, -1.0), (360, float("nan")), (360, float("inf"))]
)
def test_a_tuning_that_so_many_cells_cannot_have_is_refused(cells, concentration):
    with pytest.raises(ConfigError, match="concentration"):
        HeadDirectionRing(cells, concentration=concentration)


def test_the_pose_is_the_same_with_either_tuning():
    cosine, sharp = (PathIntegrator(NeuralConfig(), heading_concentration=k) for k in (0.0, 5.0))
    start = sharp.snapshot()
    for step in np.random.default_rng(1).normal((0.02, 0.0, 0.05), 0.01, (100, 3)):
        cosine.step(step, 0.03)
        sharp.step(step, 0.03)
    assert sharp.pose == pytest.approx(cosine.pose, abs=1e-9)
    assert np.ptp(sharp.head_direction.activity) > 1.9
    sharp.restore(start, delta_snapshot_robot=(0.1, 0.0, 1.0))
    assert sharp.pose == pytest.approx([0.1, 0.0, 1.0], abs=1e-3)
