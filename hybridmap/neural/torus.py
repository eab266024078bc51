"""The low Fourier modes of a periodic sheet, and the metric on them."""

from __future__ import annotations

from typing import Literal

import numpy as np
from numpy.typing import DTypeLike, NDArray

Metric = Literal["hexagonal", "square"]


class LowModes:
    """Transforms between a stack of sheets (N, M, N) and their modes (2K+1, M, K+1).

    The stack has a sheet's first axis first, then the module, then the sheet's second axis: so each transform of all modules is
    two small matrix products. Modes are p = -K..K on the first axis, q = 0..K on the last; the half plane suffices because
    sheets are real. Both transforms work in buffers of their own and return arrays that the next call overwrites.
    """

    def __init__(self, side: int, modes: int, dtype: DTypeLike = np.float64) -> None:
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
        self._complex = complex_type
        self._angles = np.zeros((2, len(self.first) + len(self.second)), dtype=dtype)
        self._angles[0, : len(self.first)] = -2.0 * np.pi * self.first
        self._angles[1, len(self.first) :] = -2.0 * np.pi * self.second
        self._buffers: dict[int, tuple[NDArray[np.complexfloating], ...]] = {}

    def forward(self, stack: NDArray[np.floating]) -> NDArray[np.complexfloating]:
        """Return the modes of a contiguous stack of sheets (N, M, N)."""
        half, modes, _ = self._buffers_of(stack.shape[1])
        real = half.view(self._rows.dtype).reshape(-1, self._columns.shape[1])
        np.dot(stack.reshape(-1, self.side), self._columns, out=real)
        np.dot(self._left, half, out=modes)
        return modes.reshape(len(self.first), -1, len(self.second))

    def inverse(self, modes: NDArray[np.complexfloating]) -> NDArray[np.floating]:
        """Return the stack of sheets (N, M, N) that have these modes, contiguous, and no others."""
        half = self._buffers_of(modes.shape[1])[2]
        np.dot(self._right, modes.reshape(len(self.first), -1), out=half)
        real = half.view(self._rows.dtype).reshape(-1, self._columns.shape[1])
        return np.asarray(np.dot(real, self._rows)).reshape(self.side, -1, self.side)

    def _buffers_of(self, modules: int) -> tuple[NDArray[np.complexfloating], ...]:
        """Work space: half-transformed sheets, modes, half-transformed modes."""
        if modules not in self._buffers:
            width = modules * len(self.second)
            rows = (self.side, len(self.first), self.side)
            self._buffers[modules] = tuple(np.empty((count, width), dtype=self._complex) for count in rows)
        return self._buffers[modules]

    def shift(self, shift_cycles: NDArray[np.floating]) -> NDArray[np.complexfloating]:
        """Return the factors (2K+1, M, K+1) that move sheets by shifts (M, 2), cycles of the sheet."""
        angle = shift_cycles.astype(self._angles.dtype) @ self._angles
        factors = np.empty(angle.shape, dtype=self._complex)
        np.cos(angle, out=factors.real)
        np.sin(angle, out=factors.imag)
        split = len(self.first)
        return np.asarray(factors[:, :split].T[:, :, None] * factors[:, split:])

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


def split_shift(shift_cells: NDArray[np.float64]) -> tuple[NDArray[np.int64], NDArray[np.float64]]:
    """Split shifts into whole cells by floor and residuals in [0, 1) (paper eq. 10): -0.3 gives -1 and 0.7."""
    whole = np.floor(shift_cells)
    return whole.astype(np.int64), np.asarray(shift_cells - whole)
