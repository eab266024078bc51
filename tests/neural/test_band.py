import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from hybridmap.neural.rings import BandRings

SPACINGS = np.geomspace(0.12, 0.52, 4)
ORIENTATIONS = np.radians([5.0, 17.0, -8.0, 40.0])


def rings(width=0.1, dtype=np.float64):
    return BandRings(SPACINGS, ORIENTATIONS, cells=32, width=width, dtype=dtype)


def cycles_apart(a, b):
    return np.abs((a - b + 0.5) % 1.0 - 0.5)


def test_a_ring_fires_the_printed_stripe():
    ring, position = rings(), np.array([0.07, -0.31])
    ring.step(position)
    period = ring.periods_m[2, 1]
    angle = ORIENTATIONS[2] + np.radians(60.0)
    d = np.array([np.cos(angle), np.sin(angle)]) @ position
    alpha = np.arange(32) / 32 * period
    s = (d - alpha) % period
    assert ring.activity[2, 1] == pytest.approx(np.exp(-((s - period / 2) ** 2) / (2 * (0.1 * period) ** 2)), abs=1e-6)


def test_periods_are_those_of_the_hexagonal_lattice():
    assert rings().periods_m == pytest.approx(np.repeat(SPACINGS[:, None] * np.sqrt(3) / 2, 3, axis=1))


@given(x=st.floats(-3, 3), y=st.floats(-3, 3))
def test_the_60_degree_ring_is_the_sum_of_the_other_two(x, y):
    ring = rings()
    ring.step(np.array([x, y]))
    phases = ring.phases()
    assert cycles_apart(phases[:, 1], phases[:, 0] + phases[:, 2]) == pytest.approx(np.zeros(4), abs=1e-6)


def test_many_small_steps_make_the_exact_phase():
    ring, rng = rings(), np.random.default_rng(0)
    steps = rng.normal(0.001, 0.01, (3000, 2))
    for step in steps:
        ring.step(step)
    exact = ring.wave_vectors @ steps.sum(axis=0)
    assert cycles_apart(ring.phases(), exact).max() < 1e-6


def test_the_state_is_the_activity_and_nothing_else():
    ring, other = rings(), rings()
    ring.step(np.array([0.4, 0.2]))
    other.activity = ring.activity.copy()
    assert np.array_equal(other.phases(), ring.phases())
    other.step(np.array([0.01, 0.0]))
    ring.step(np.array([0.01, 0.0]))
    assert np.array_equal(other.activity, ring.activity)


def test_the_stripe_is_an_attractor():
    ring, noise = rings(), np.random.default_rng(1).uniform(0.0, 0.3, (4, 3, 32))
    shape = ring.activity.copy()
    ring.activity = ring.activity + noise
    before = ring.phases()
    ring.step(np.zeros(2))
    assert ring.phases() == pytest.approx(before, abs=1e-6)
    assert ring.activity.max() == pytest.approx(shape.max(), abs=0.02)
    assert ring.activity.min() < 1e-3
