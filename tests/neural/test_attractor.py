import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from hybridmap.neural.place import PlaceAttractor

moves = st.floats(-3.0, 3.0)


def attractor():
    return PlaceAttractor(side=32, cell_m=0.16, width_cells=1.4)


@given(x=moves, y=moves)
def test_the_bump_moves_by_the_displacement_and_wraps(x, y):
    sheet = attractor()
    sheet.step(np.array([x, y]))
    assert sheet.unwrapped_m(np.array([x, y])) == pytest.approx([x, y], abs=1e-6)
    assert (sheet.position_m() >= 0).all()
    assert (sheet.position_m() <= sheet.extent_m).all()


def test_slow_motion_is_not_lost():
    sheet = attractor()
    for _ in range(2000):
        sheet.step(np.array([1e-5, -2e-5]))
    assert sheet.unwrapped_m(np.zeros(2)) == pytest.approx([0.02, -0.04], abs=1e-4)


def test_the_larger_of_two_bumps_wins_and_only_by_competition():
    sheet = attractor()
    bump = sheet.activity.copy()
    sheet.activity = 0.55 * np.roll(bump, 5, axis=0) + 0.45 * np.roll(bump, 18, axis=0)
    sheet.settle(10)
    assert sheet.activity.sum() == pytest.approx(1.0)
    assert sheet.activity == pytest.approx(np.roll(bump, 5, axis=0), abs=1e-4)


def test_the_bump_keeps_its_shape():
    sheet = attractor()
    peak = sheet.activity.max()
    for _ in range(320):
        sheet.step(np.array([0.05, 0.02]))
    assert sheet.activity.max() == pytest.approx(peak, rel=0.05)


@settings(max_examples=30)
@given(x=st.floats(-20, 20), y=st.floats(-20, 20), angle=st.floats(0, 6.3))
def test_the_code_tells_places_apart_and_the_same_place_together(x, y, angle):
    def code(position):
        sheet = attractor()
        sheet.step(position)
        return sheet.code(position)

    here = np.array([x, y])
    away = np.array([np.cos(angle), np.sin(angle)])
    assert np.linalg.norm(code(here)) == pytest.approx(1.0, abs=1e-6)
    assert 1.0 - code(here) @ code(here + 0.05 * away) < 0.1
    assert 1.0 - code(here) @ code(here + 0.5 * away) > 0.5
    assert 1.0 - code(here) @ code(here + np.array([5.12, 0.0])) > 0.5
    assert np.array_equal(code(here), code(here))
