import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from hybridmap.neural.grid import GridModules, LowModes, combine_bands, kernel_spectrum, relu, shift_sheets, softplus

SQUARED = LowModes(32, 4).squared_wave_number()
GAINS = kernel_spectrum(SQUARED, 1.4, -1.0, (1.5, 0.3))


def grid(rectifier=relu, band_drive=0.1, dtype=np.float64):
    return GridModules(2, 32, 4, GAINS, rectifier, band_drive, dtype)


def turn(cycles):
    return np.exp(2j * np.pi * np.asarray(cycles))


def advance(du, dv):
    return np.tile([du, du + dv, dv], (2, 1))


def cycles_apart(a, b):
    return np.abs((np.asarray(a) - b + 0.5) % 1.0 - 0.5)


def test_the_kernel_has_exactly_the_gains_asked_for():
    assert pytest.approx(1.4, abs=1e-12) == GAINS[SQUARED == 1]
    assert pytest.approx(-1.0, abs=1e-12) == GAINS[SQUARED == 0]
    assert GAINS[SQUARED > 1].max() < 1.0


def test_the_kernel_in_space_excites_near_and_inhibits_in_sum():
    kernel = LowModes(32, 4).inverse(GAINS[:, None].astype(complex))[:, 0]
    assert kernel[0, 0] == kernel.max() > 0.0
    assert kernel.sum() == pytest.approx(-1.0)


@pytest.mark.parametrize("rectifier", [relu, softplus(2.0)])
def test_one_hexagonal_bump_stands_still(rectifier):
    sheets = grid(rectifier)
    before = sheets.activity.copy()
    for _ in range(50):
        sheets.step(np.zeros((2, 3)), turn(np.zeros((2, 3))))
    assert sheets.activity == pytest.approx(before, abs=1e-9)
    assert before[0].argmax() == 0
    assert before[0] == pytest.approx(before[0].T)
    assert before[0].max() > 3 * before[0].mean()


@settings(max_examples=20, deadline=None)
@given(i=st.integers(0, 31), j=st.integers(0, 31), du=st.floats(-0.2, 0.2), dv=st.floats(-0.2, 0.2))
def test_a_step_commutes_with_shifts(i, j, du, dv):
    one, other = grid(softplus(2.0)), grid(softplus(2.0))
    other.activity = np.roll(one.activity, (i, j), axis=(1, 2))
    phase = np.tile([du, du + dv, dv], (2, 1))
    offset = np.array([i, i + j, j]) / 32
    one.step(advance(du, dv), turn(phase))
    other.step(advance(du, dv), turn(phase + offset))
    assert other.activity == pytest.approx(np.roll(one.activity, (i, j), axis=(1, 2)), abs=1e-9)


@pytest.mark.parametrize("band_drive", [0.0, 0.1])
@pytest.mark.parametrize("cells", [0.5, 2.0, 8.0])
def test_the_bump_moves_by_what_the_bands_say(cells, band_drive):
    sheets, total = grid(band_drive=band_drive), np.zeros(2)
    step = np.array([cells, -0.37 * cells]) / 32
    for _ in range(100):
        total += step
        sheets.step(advance(*step), turn(np.tile([total[0], total.sum(), total[1]], (2, 1))))
    assert cycles_apart(sheets.phases(), total).max() < 2e-4


def test_bands_drive_the_sheets_into_register():
    sheets, target = grid(), np.array([0.11, 0.05])
    phasors = turn(np.tile([target[0], target.sum(), target[1]], (2, 1)))
    for _ in range(300):
        sheets.step(np.zeros((2, 3)), phasors)
    assert cycles_apart(sheets.phases(), target).max() < 5e-4


def test_without_bands_relu_pins_slow_motion_and_softplus_does_not():
    errors = {}
    for name, rectifier in (("relu", relu), ("softplus", softplus(2.0))):
        sheets, step = grid(rectifier, band_drive=0.0), 1e-4 / 32
        for _ in range(500):
            sheets.step(advance(step, 0.0), turn(np.zeros((2, 3))))
        errors[name] = abs(sheets.phases()[0, 0] - 500 * step) / (500 * step)
    assert errors["relu"] > 0.2
    assert errors["softplus"] < 1e-4


def test_phases_are_read_from_the_activity():
    sheets = grid()
    sheets.activity = shift_sheets(sheets.activity, np.array([[0.3, 0.6], [0.9, 0.1]]))
    assert cycles_apart(sheets.phases(), [[0.3, 0.6], [0.9, 0.1]]).max() < 1e-12


@given(u=st.floats(-0.49, 0.49), v=st.floats(-0.49, 0.49))
def test_three_bands_combine_to_two_phases_whatever_the_wraps(u, v):
    bands = np.array([[u, (u + v + 0.5) % 1.0 - 0.5, v]])
    assert cycles_apart(combine_bands(bands), [u, v]).max() < 1e-9
