import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from hypothesis.extra import numpy as hnp

from hybridmap.neural.grid import LowModes, shift_sheets
from hybridmap.neural.place import split_shift


def stack_of(sheets):
    return np.ascontiguousarray(sheets.swapaxes(0, 1))


def smooth_sheets(seed: int) -> np.ndarray:
    """A stack (N, M, N)."""
    modes = LowModes(32, 4, 3)
    return modes.inverse(modes.forward(np.random.default_rng(seed).normal(size=(32, 3, 32))))


def test_transforms_are_those_of_numpy():
    sheets = np.random.default_rng(0).normal(size=(3, 32, 32))
    full = np.fft.fft2(sheets)
    modes = LowModes(32, 4, 3).forward(stack_of(sheets))
    assert modes.swapaxes(0, 1) == pytest.approx(full[:, np.arange(-4, 5)][:, :, np.arange(5)])


def test_inverse_undoes_forward_on_low_modes():
    sheets = smooth_sheets(1)
    modes = LowModes(32, 4, 3)
    assert modes.inverse(modes.forward(sheets)) == pytest.approx(sheets, abs=1e-12)


@settings(max_examples=20, deadline=None)
@given(whole=hnp.arrays(np.int64, (3, 2), elements=st.integers(-40, 40)), seed=st.integers(0, 9))
def test_a_shift_by_whole_cells_is_a_roll(whole, seed):
    stack, modes = smooth_sheets(seed), LowModes(32, 4, 3)
    sheets = stack.swapaxes(0, 1)
    expected = np.stack([np.roll(s, w, axis=(0, 1)) for s, w in zip(sheets, whole, strict=True)])
    factors = modes.shift(whole / 32)
    assert modes.inverse(modes.forward(stack) * factors) == pytest.approx(stack_of(expected), abs=1e-10)
    assert shift_sheets(sheets, whole / 32) == pytest.approx(expected, abs=1e-10)


def test_the_first_shell_has_six_modes():
    squared = LowModes(32, 4).squared_wave_number()
    half = {(int(p), int(q)) for p, q in np.argwhere(squared == 1) - [4, 0]}
    assert half == {(1, 0), (-1, 0), (0, 1), (1, 1)}


@given(st.floats(-1e6, 1e6))
def test_floor_and_residual(shift):
    whole, residual = split_shift(shift)
    assert 0.0 <= residual <= 1.0
    assert whole + residual == pytest.approx(shift)


def test_floor_of_a_negative_shift():
    assert split_shift(-0.3) == pytest.approx((-1, 0.7))
    assert split_shift(0.3) == pytest.approx((0, 0.3))
    assert split_shift(-2.0) == (-2, 0.0)
