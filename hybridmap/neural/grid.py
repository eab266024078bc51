"""Grid modules: attractor sheets on a hexagonal torus, moved by the band cells."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
from numpy.typing import DTypeLike, NDArray

from hybridmap.errors import ConfigError
from hybridmap.neural.torus import LowModes

Rectifier = Callable[[NDArray[np.floating]], NDArray[np.floating]]


def relu(drive: NDArray[np.floating]) -> NDArray[np.floating]:
    """The paper's rectifying linear f."""
    return np.asarray(np.maximum(drive, np.zeros_like(drive)))


def softplus(sharpness: float) -> Rectifier:
    """Return f(x) = log(1 + exp(beta x)) / beta, smooth and therefore free of pinning."""

    def f(drive: NDArray[np.floating]) -> NDArray[np.floating]:
        rest = np.abs(drive)
        rest *= -sharpness
        np.exp(rest, out=rest)
        rest += 1.0
        np.log(rest, out=rest)
        rest *= 1.0 / sharpness
        rest += np.maximum(drive, np.zeros_like(drive))
        return np.asarray(rest)

    return f


def kernel_spectrum(
    squared_wave_number: NDArray[np.int64], gain_first: float, gain_zero: float, widths: tuple[float, float]
) -> NDArray[np.float64]:
    """Return the Fourier gains of w0(x) = a exp(-gamma |x|^2) - c exp(-beta |x|^2) at the given |k|^2.

    The paper's single amplitude (a = c) has no local excitation; the two amplitudes here are fixed by the gains at the
    first hexagonal mode and at zero, which they meet exactly.
    """
    wide, narrow = widths
    system = np.array([[np.exp(-1.0 / wide), -np.exp(-1.0 / narrow)], [1.0, -1.0]])
    excitation, inhibition = np.linalg.solve(system, np.array([gain_first, gain_zero]))
    return np.asarray(excitation * np.exp(-squared_wave_number / wide) - inhibition * np.exp(-squared_wave_number / narrow))


def combine_bands(cycles: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return the sheet's two phases or shifts (M, 2) from those of the three bands (M, 3), cycles.

    Least squares under phi60 = phi0 + phi120: the misfit, wrapped, is shared equally.
    """
    misfit = cycles[:, 1] - cycles[:, 0] - cycles[:, 2]
    misfit = (misfit - np.round(misfit)) / 3.0
    return cycles[:, ::2] + misfit[:, None]


class GridModules:
    """M sheets of N x N grid cells on a twisted torus (paper eqs. 5-7).

    Cell (i, j) of a sheet prefers the phases (i/N, j/N) of the module's 0 and 120 degree bands, so that the plain torus of
    indices carries the hexagonal metric. With dt = tau the dynamics are s <- f[W(ds) s + I_BC]: the recurrent weights W,
    shifted by the band cells' advance ds, act on the low Fourier modes; I_BC is uniform excitation plus the stripes of the
    three bands, which hold the sheet in register with the rings. A stationary bump moves by exactly ds.

    Attributes:
        activity: (M, N, N) rates; the whole state.
    """

    def __init__(
        self,
        modules: int,
        side: int,
        fourier_modes: int,
        gains: NDArray[np.float64],
        rectifier: Rectifier,
        band_drive: float,
        dtype: DTypeLike = np.float64,
    ) -> None:
        """Make the sheets and let them settle.

        Raises:
            ConfigError: with these gains no stationary pattern forms.
        """
        self.modes = LowModes(side, fourier_modes, dtype)
        self._gains = gains.astype(dtype)
        self._rectifier = rectifier
        self._centre = fourier_modes
        self._complex = np.result_type(self._gains.dtype, np.complex64)
        self._stripes = self._stripe_weights(band_drive, side)
        uniform = np.zeros((2 * fourier_modes + 1, fourier_modes + 1, 2), dtype=dtype)
        uniform[fourier_modes, 0, 0] = side**2
        self._uniform = uniform.reshape(-1)
        wave = 2.0 * np.pi * np.arange(side) / side
        seed = np.cos(wave[:, None]) + np.cos(wave) + np.cos(wave[:, None] + wave)
        self.activity: NDArray[np.floating] = np.repeat((1.0 + 0.3 * seed)[None], modules, axis=0).astype(dtype)
        self._settle(modules)

    def _settle(self, modules: int) -> None:
        """Let the pattern form, with every band at phase zero.

        Raises:
            ConfigError: it does not become stationary.
        """
        still, phasors = np.zeros((modules, 3)), np.ones((modules, 3), dtype=self._complex)
        with np.errstate(over="ignore", invalid="ignore"):
            for _ in range(300):
                before = self.activity
                self.step(still, phasors)
            change = float(np.abs(self.activity - before).max())
            peak = float(self.activity.max())
        if not change <= 1e-3 * peak < np.inf:
            raise ConfigError(
                f"neural: the grid sheets do not settle (change {change:.3g} at a peak of {peak:.3g} after 300 steps): "
                f"the largest gain of a mode is {float(self._gains.max()):.3g}; lower kernel_gain_first or kernel_widths"
            )

    def step(self, band_advance: NDArray[np.floating], band_phasors: NDArray[np.complexfloating]) -> None:
        """Advance by one time constant.

        Args:
            band_advance: (M, 3) how far each band ring moved in this step, cycles; two of the three fix the sheet's shift.
            band_phasors: (M, 3) unit phasors of where the band rings are after it.
        """
        modes = self.modes.forward(self.activity)
        modes *= self.modes.shift(band_advance[:, ::2])
        modes *= self._gains
        modes += self._band_input(band_phasors)
        self.activity = self._rectifier(self.modes.inverse(modes))

    def _band_input(self, phasors: NDArray[np.complexfloating]) -> NDArray[np.complexfloating]:
        """Modes (M, 2K+1, K+1) of I_BC: uniform excitation and the stripes of the three bands."""
        drive = np.ascontiguousarray(phasors, dtype=self._complex).view(self._gains.dtype) @ self._stripes
        drive += self._uniform
        return np.asarray(drive.view(self._complex)).reshape(-1, *self._gains.shape)

    def _stripe_weights(self, band_drive: float, side: int) -> NDArray[np.floating]:
        """Weights (6, 2 * modes) from the phasors of three bands to their stripes' modes, all as (real, imaginary)."""
        k, stripe = self._centre, 0.5 * band_drive * side**2
        weights = np.zeros((3, 2, 2 * k + 1, k + 1, 2))
        for band, mode, sign in ((0, (k + 1, 0), -1.0), (0, (k - 1, 0), 1.0), (1, (k + 1, 1), -1.0), (2, (k, 1), -1.0)):
            weights[band, 0][mode][0] = stripe
            weights[band, 1][mode][1] = sign * stripe
        return weights.reshape(6, -1).astype(self._gains.dtype)

    def band_phases(self) -> NDArray[np.float64]:
        """Return the phases (M, 3) of the first hexagonal modes of the activity, cycles in [-0.5, 0.5]."""
        modes, k = self.modes.forward(self.activity), self._centre
        first = np.stack([modes[:, k + 1, 0], modes[:, k + 1, 1], modes[:, k, 1]], axis=1)
        return np.asarray(-np.angle(first.astype(np.complex128)) / (2.0 * np.pi))

    def phases(self) -> NDArray[np.float64]:
        """Return the sheets' decoded phases (M, 2), cycles in [0, 1), of the 0 and 120 degree bands."""
        return combine_bands(self.band_phases()) % 1.0
