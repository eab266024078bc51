"""The low Fourier modes of a periodic sheet, and the metric on them."""

from __future__ import annotations

import math
from typing import Literal

import numpy as np
from numpy.typing import DTypeLike, NDArray

Metric = Literal["hexagonal", "square"]


class LowModes:
    """Transforms between a stack of sheets (N, M, N) and their modes (2K+1, M, K+1).

    The stack has a sheet's first axis first, then the module, then the sheet's second axis: so each transform of all modules is
    two small matrix products. Modes are p = -K..K on the first axis, q = 0..K on the last; the half plane suffices because
    sheets are real. Modes and factors are returned in buffers that the next call overwrites.
    """

    def __init__(self, side: int, modes: int, modules: int = 1, dtype: DTypeLike = np.float64) -> None:
        self.side = side
        self.first: NDArray[np.int64] = np.arange(-modes, modes + 1)
        self.second: NDArray[np.int64] = np.arange(modes + 1)
        angle_p = 2.0 * np.pi * np.outer(self.first, np.arange(side)) / side
        angle_q = 2.0 * np.pi * np.outer(np.arange(side), self.second) / side
        complex_type = np.result_type(np.dtype(dtype), np.complex64)
        self._columns = np.stack([np.cos(angle_q), -np.sin(angle_q)], axis=-1).reshape(side, -1).astype(dtype)
        twice = np.where(self.second == 0, 1.0, 2.0)
        rows = np.stack([twice * np.cos(angle_q), -twice * np.sin(angle_q)], axis=-1).reshape(side, -1).T / side**2
        self._rows = np.ascontiguousarray(rows).astype(dtype)
        self._left = np.exp(-1j * angle_p).astype(complex_type)
        self._right = np.ascontiguousarray(np.exp(1j * angle_p).T).astype(complex_type)
        shape = (len(self.first), modules, len(self.second))
        self._half, self._back = (np.empty((side, modules * shape[2]), dtype=complex_type) for _ in range(2))
        self._half_real, self._back_real = (a.view(dtype).reshape(-1, 2 * shape[2]) for a in (self._half, self._back))
        self._modes = np.empty(shape, dtype=complex_type)
        self._modes_flat = self._modes.reshape(shape[0], -1)
        self._angles = self._angles_of_shifts(shape).astype(dtype)
        self._shifts = np.ones(2 * modules + 1, dtype=dtype)
        self._shift_pairs = self._shifts[:-1].reshape(modules, 2)
        self._cosines = np.empty(self._angles.shape[1], dtype=dtype)
        self._factors = self._cosines.view(complex_type).reshape(shape)

    def forward(self, stack: NDArray[np.floating]) -> NDArray[np.complexfloating]:
        """Return the modes of a contiguous stack of sheets (N, M, N)."""
        stack.reshape(-1, self.side).dot(self._columns, out=self._half_real)
        self._left.dot(self._half, out=self._modes_flat)
        return self._modes

    def inverse(self, modes: NDArray[np.complexfloating]) -> NDArray[np.floating]:
        """Return the stack of sheets (N, M, N) that have these modes and no others: a new array."""
        self._right.dot(modes.reshape(self._modes_flat.shape), out=self._back)
        return np.asarray(self._back_real.dot(self._rows)).reshape(self.side, -1, self.side)

    def shift(self, shift_cycles: NDArray[np.floating]) -> NDArray[np.complexfloating]:
        """Return the factors (2K+1, M, K+1) that move sheets by shifts (M, 2), cycles of the sheet."""
        self._shift_pairs[...] = shift_cycles
        self._shifts.dot(self._angles, out=self._cosines)
        np.cos(self._cosines, out=self._cosines)
        return self._factors

    def _angles_of_shifts(self, shape: tuple[int, int, int]) -> NDArray[np.float64]:
        """Matrix from the shifts of all modules and a one to angles: their cosines are the factors, as (real, imaginary)."""
        modules = shape[1]
        angles = np.zeros((modules, 2, *shape, 2))
        for module in range(modules):
            angles[module, 0, :, module] = -2.0 * np.pi * self.first[:, None, None]
            angles[module, 1, :, module] = -2.0 * np.pi * self.second[:, None]
        quarter = np.broadcast_to([0.0, -0.5 * np.pi], (*shape, 2))
        return np.concatenate([angles.reshape(2 * modules, -1), quarter.reshape(1, -1)])

    def squared_wave_number(self, metric: Metric = "hexagonal") -> NDArray[np.int64]:
        """Return |k|^2 (2K+1, K+1).

        Hexagonal: axes 120 degrees apart, first shell (1,0), (0,1), (1,1). Square: orthogonal axes, first shell (1,0), (0,1).
        """
        p, q = self.first[:, None], self.second
        return np.asarray(p * p + q * q - (p * q if metric == "hexagonal" else 0))


def shift_sheets(sheets: NDArray[np.floating], shift_cycles: NDArray[np.float64]) -> NDArray[np.floating]:
    """Move sheets (M, N, N) by any shifts (M, 2), cycles, exactly in all their modes (Fourier interpolation)."""
    side = sheets.shape[-1]
    first, second = np.fft.fftfreq(side, 1.0 / side), np.arange(side // 2 + 1)
    turn = np.exp(-2j * np.pi * shift_cycles[:, 0, None] * first)[:, :, None]
    turn = turn * np.exp(-2j * np.pi * shift_cycles[:, 1, None] * second)[:, None, :]
    return np.asarray(np.fft.irfft2(np.fft.rfft2(sheets) * turn, s=(side, side)), dtype=sheets.dtype)


def split_shift(shift_cells: float) -> tuple[int, float]:
    """Split a shift into whole cells by floor and the residual in [0, 1) (paper eq. 10): -0.3 gives -1 and 0.7."""
    whole = math.floor(shift_cells)
    return whole, shift_cells - whole
