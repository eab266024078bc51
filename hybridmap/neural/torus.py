"""The low Fourier modes of a periodic sheet, and the hexagonal metric on them."""

from __future__ import annotations

import numpy as np
from numpy.typing import DTypeLike, NDArray


class LowModes:
    """Transforms between sheets (M, N, N) and their modes (M, 2K+1, K+1): p = -K..K on the first axis, q = 0..K on the second.

    Two small matrix products each way; the half plane q >= 0 suffices because sheets are real.
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
        pairs = np.stack(np.meshgrid(self.first, self.second, indexing="ij")).reshape(2, -1)
        self._angles = (-2.0 * np.pi * pairs).astype(dtype)

    def forward(self, sheets: NDArray[np.floating]) -> NDArray[np.complexfloating]:
        """Return the modes of sheets (M, N, N)."""
        half = (sheets.reshape(-1, self.side) @ self._columns).view(self._complex)
        return np.asarray(np.matmul(self._left, half.reshape(-1, self.side, len(self.second))))

    def inverse(self, modes: NDArray[np.complexfloating]) -> NDArray[np.floating]:
        """Return the sheets (M, N, N) that have these modes and no others."""
        half = self._right @ modes
        return np.asarray(half.reshape(-1, len(self.second)).view(self._rows.dtype) @ self._rows).reshape(
            -1, self.side, self.side
        )

    def shift(self, shift_cycles: NDArray[np.floating]) -> NDArray[np.complexfloating]:
        """Return the factors (M, 2K+1, K+1) that move sheets by shifts (M, 2), cycles of the sheet."""
        angle = shift_cycles.astype(self._angles.dtype) @ self._angles
        factors = np.empty(angle.shape, dtype=self._complex)
        np.cos(angle, out=factors.real)
        np.sin(angle, out=factors.imag)
        return factors.reshape(-1, len(self.first), len(self.second))

    def squared_wave_number(self) -> NDArray[np.int64]:
        """Return |k|^2 (2K+1, K+1) in the hexagonal metric: axes 120 degrees apart, first shell (1,0), (0,1), (1,1)."""
        p, q = self.first[:, None], self.second
        return np.asarray(p * p + q * q - p * q)


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
