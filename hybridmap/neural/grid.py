"""Grid modules: attractor sheets on a hexagonal torus, moved by the band cells."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass
from typing import Literal

import numpy as np
from numpy.typing import DTypeLike, NDArray

from hybridmap.errors import ConfigError
from hybridmap.geometry import Array
from hybridmap.neural.rings import Metric

FOURIER_MODES = 4
"""K, the Fourier modes along each axis of a sheet that its recurrent weights carry; beyond them all gains are below 1e-3."""
KERNEL_GAIN_FIRST, KERNEL_GAIN_ZERO = 1.4, -1.0
"""Fourier gains of the recurrent weights at the first hexagonal mode and at mode zero: one hexagonal bump grows and settles,
uniform activity dies away (`docs/paper.md`, Kernel)."""
KERNEL_WIDTHS = (1.5, 0.3)
"""Widths of the excitatory and the inhibitory Gaussian's spectrum, in squared wave numbers of the first mode: every other
mode then has a gain below 1."""
SOFTPLUS_SHARPNESS = 2.0
"""beta of softplus, log(1 + exp(beta x)) / beta: soft enough that no bump is pinned, sharp enough that silent cells are."""

Rectifier = Callable[[NDArray[np.floating], NDArray[np.floating]], NDArray[np.floating]]
"""From the drive and zeros of its shape, which `maximum` takes several times faster than the number, to the rates."""


def relu(drive: NDArray[np.floating], zeros: NDArray[np.floating]) -> NDArray[np.floating]:
    """Return the paper's f, max(drive, 0), written into `drive`; `zeros` are zeros of its shape."""
    np.maximum(drive, zeros, out=drive)
    return drive


def softplus(sharpness: float = SOFTPLUS_SHARPNESS) -> Rectifier:
    """Return the rectifier f(x) = log(1 + exp(beta x)) / beta of this sharpness beta: smooth, and therefore free of pinning."""

    def f(drive: NDArray[np.floating], zeros: NDArray[np.floating]) -> NDArray[np.floating]:
        rest = np.abs(drive)
        rest *= -sharpness
        np.exp(rest, out=rest)
        rest += 1.0
        np.log(rest, out=rest)
        rest *= 1.0 / sharpness
        rest += np.maximum(drive, zeros)
        return np.asarray(rest)

    return f


def kernel_spectrum(
    squared_wave_number: NDArray[np.int64],
    gain_first: float = KERNEL_GAIN_FIRST,
    gain_zero: float = KERNEL_GAIN_ZERO,
    widths: tuple[float, float] = KERNEL_WIDTHS,
    kernel: Literal["two-amplitudes", "printed"] = "two-amplitudes",
) -> NDArray[np.float64]:
    """Return the Fourier gains of w0(x) = a exp(-gamma |x|^2) - c exp(-beta |x|^2) at the given |k|^2.

    The spectrum of exp(-gamma |x|^2) is exp(-|k|^2 / (4 gamma)) / gamma up to a constant, so widths (4 gamma, 4 beta). As
    printed (paper eq. 6) a = c: no local excitation, and once `gain_first` is met, `gain_zero` cannot be chosen and is far
    below -1. With two amplitudes the gains at the first mode and at zero are met exactly.

    Args:
        squared_wave_number: |k|^2 of each mode, of any shape; the result has the same.
        gain_first: gain at |k|^2 = 1.
        gain_zero: gain at |k|^2 = 0; the printed kernel ignores it.
        widths: (4 gamma, 4 beta), of the excitation and of the inhibition.
        kernel: two amplitudes, or one as printed.
    """
    wide, narrow = widths
    if kernel == "printed":
        printed = np.exp(-squared_wave_number / wide) / wide - np.exp(-squared_wave_number / narrow) / narrow
        return np.asarray(gain_first * printed / (np.exp(-1.0 / wide) / wide - np.exp(-1.0 / narrow) / narrow))
    system = np.array([[np.exp(-1.0 / wide), -np.exp(-1.0 / narrow)], [1.0, -1.0]])
    excitation, inhibition = np.linalg.solve(system, np.array([gain_first, gain_zero]))
    return np.asarray(excitation * np.exp(-squared_wave_number / wide) - inhibition * np.exp(-squared_wave_number / narrow))


def combine_bands(cycles: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return the sheets' phases or shifts (M, 2), phi0 and phi120, from the bands' (M, 3), phi0, phi60 and phi120, cycles.

    Least squares under phi60 = phi0 + phi120: the misfit, wrapped, is shared equally. The result is not wrapped.
    """
    misfit = cycles[:, 1] - cycles[:, 0] - cycles[:, 2]
    misfit = (misfit - np.rint(misfit)) / 3.0
    return cycles[:, ::2] + misfit[:, None]


class GridModules:
    """M sheets of N x N grid cells on a twisted torus (paper eqs. 5-7).

    Cell (i, j) of a sheet prefers the phases (i/N, j/N) of the module's first and last band (0 and 120 degrees), so that the
    plain torus of indices carries the hexagonal metric, or for comparison the square one (bands at 0 and 90 degrees). With
    dt = tau the dynamics are s <- f[W(ds) s + I_BC]: the recurrent weights W, shifted by the band cells' advance ds, act on the
    low Fourier modes; I_BC is uniform excitation plus the stripes of the bands, which hold the sheet in register with the
    rings. A stationary bump moves by exactly ds.
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
        metric: Metric = "hexagonal",
    ) -> None:
        """Make the sheets and let them settle.

        Args:
            modules: M, number of sheets.
            side: N, cells along a side of a sheet.
            fourier_modes: K, modes along each axis on which the recurrent weights act.
            gains: (2K+1, K+1) Fourier gains of the recurrent weights, as `kernel_spectrum` gives them.
            rectifier: f.
            band_drive: gain of the bands' stripes; the uniform excitation is 1.
            dtype: floating-point type of the rates.
            metric: lattice on which the sheets fire.

        Raises:
            ConfigError: with these gains no stationary pattern forms; the message names the instability.
        """
        self.modes = LowModes(side, fourier_modes, modules, dtype)
        self._dtype = np.dtype(dtype)
        self._complex = np.result_type(self._dtype, np.complex64)
        self._rectifier = rectifier
        self._centre = fourier_modes
        self._gains = np.repeat(gains[:, None], modules, axis=1).astype(self._complex)
        self._stripes = self._stripe_weights(band_drive, side, metric)
        self._phasors = np.ones((modules, 4), dtype=self._complex)
        self._phasors_real, self._phasors_given = self._phasors.view(self._dtype), self._phasors[:, :3]
        self._drive = np.empty((modules, self._stripes.shape[1]), dtype=self._dtype)
        self._drive_modes = self._drive.view(self._complex).reshape(modules, 3, -1).swapaxes(0, 1)
        wave = 2.0 * np.pi * np.arange(side) / side
        seed = np.cos(wave[:, None]) + np.cos(wave)
        if metric == "hexagonal":
            seed = seed + np.cos(wave[:, None] + wave)
        self._stack: NDArray[np.floating] = np.repeat((1.0 + 0.3 * seed)[:, None], modules, axis=1).astype(dtype)
        self._silent = np.zeros_like(self._stack)
        self._settle(modules)

    @property
    def activity(self) -> NDArray[np.floating]:
        """Rates (M, N, N); the whole state, as a view: it may be written to, or replaced."""
        return self._stack.swapaxes(0, 1)

    @activity.setter
    def activity(self, rates: NDArray[np.floating]) -> None:
        """Rates (M, N, N): the whole state, as a view that may be written to or replaced."""
        self._stack = np.ascontiguousarray(rates.swapaxes(0, 1), dtype=self._dtype)

    def _settle(self, modules: int) -> None:
        """Let the pattern form, with every band at phase zero.

        Raises:
            ConfigError: it does not become stationary.
        """
        still, phasors = np.zeros((modules, 3)), np.ones((modules, 3), dtype=self._complex)
        last = [self._stack] * 3
        with np.errstate(over="ignore", invalid="ignore"):
            for _ in range(300):
                self.step(still, phasors)
                last = [*last[1:], self._stack]
            change, again = (float(np.abs(last[2] - before).max()) for before in (last[1], last[0]))
            peak = float(last[2].max())
        if change <= 1e-3 * peak < np.inf:
            return
        raise ConfigError(f"neural: the grid sheets do not settle: {self._what_happens(change, again, peak)}")

    def _what_happens(self, change: float, again: float, peak: float) -> str:
        """Name the instability from the changes over one and over two steps and the peak after settling."""
        zero, most = float(self._gains[self._centre, 0, 0].real), float(self._gains.real.max())
        if not peak < 1e6:
            found = f"the activity grows without bound (peak {peak:.3g} after 300 steps)"
        elif again <= 1e-3 * max(peak, change):
            found = f"all cells fire in every second step (period-two oscillation; change {change:.3g} a step)"
        else:
            found = f"no pattern becomes stationary (change {change:.3g} at a peak of {peak:.3g} after 300 steps)"
        return (
            f"{found}; the recurrent weights have Fourier gain {zero:.3g} at mode zero and {most:.3g} at most, where one step "
            "of dt = tau needs about -1 and 1.4: take neural.kernel: two-amplitudes"
        )

    def step(self, band_advance: NDArray[np.floating], band_phasors: NDArray[np.complexfloating]) -> None:
        """Advance by one time constant.

        Args:
            band_advance: (M, 3) how far each band ring moved in this step, cycles; the first and the last shift the sheet.
            band_phasors: (M, 3) unit phasors exp(2 pi i phi) of where the band rings are after it.
        """
        modes = self.modes.forward(self._stack)
        factors = self.modes.shift(band_advance[:, ::2])
        factors *= self._gains
        modes *= factors
        near = modes[self._centre - 1 : self._centre + 2]
        near += self._band_input(band_phasors)
        self._stack = self._rectifier(self.modes.inverse(modes), self._silent)

    def _band_input(self, phasors: NDArray[np.complexfloating]) -> NDArray[np.complexfloating]:
        """Modes p = -1..1 (3, M, K+1) of I_BC: the stripes of the bands and uniform excitation."""
        self._phasors_given[...] = phasors
        self._phasors_real.dot(self._stripes, out=self._drive)
        return self._drive_modes

    def _stripe_weights(self, band_drive: float, side: int, metric: Metric) -> NDArray[np.floating]:
        """Weights (8, 6 (K+1)) from the phasors of three bands and a one to modes p = -1..1, all as (real, imaginary)."""
        k, stripe = self._centre, 0.5 * band_drive * side**2
        weights = np.zeros((4, 2, 3, k + 1, 2))
        for band, mode, sign in ((0, (2, 0), -1.0), (0, (0, 0), 1.0), (1, (2, 1), -1.0), (2, (1, 1), -1.0)):
            if band == 1 and metric == "square":
                continue
            weights[band, 0][mode][0] = stripe
            weights[band, 1][mode][1] = sign * stripe
        weights[3, 0, 1, 0, 0] = side**2
        return weights.reshape(8, -1).astype(self._dtype)

    def band_phases(self) -> NDArray[np.float64]:
        """Return phi0, phi60, phi120 (M, 3): phases of the activity's modes (1,0), (1,1), (0,1), cycles in [-0.5, 0.5]."""
        modes, k = self.modes.forward(self._stack), self._centre
        first = modes[[k + 1, k + 1, k], :, [0, 1, 1]].T.astype(np.complex128)
        return np.asarray(-np.arctan2(first.imag, first.real) / (2.0 * np.pi))

    def phases(self) -> NDArray[np.float64]:
        """Return the sheets' decoded phases (M, 2), cycles in [0, 1), of the first and the last band."""
        return combine_bands(self.band_phases()) % 1.0


DECODE_BOX_M = 1.0
"""Half side of the box around the prior in which all modules together resolve the wrap, m: about twice the coarsest spacing."""
AGREEMENT_CYCLES = 0.06
"""The modules agree on a position if the RMS misfit of their phases is below this."""


@dataclass(frozen=True, slots=True)
class Decoded:
    """A decoded position.

    Attributes:
        position_m: (2,) in the integrator's frame, m.
        misfit_cycles: RMS disagreement of the phases of all bands, cycles; 0.29 means no agreement at all.
    """

    position_m: Array
    misfit_cycles: float

    @property
    def agreed(self) -> bool:
        """Whether the modules agree (misfit below 0.06 cycles), so that the position can be trusted."""
        return self.misfit_cycles < AGREEMENT_CYCLES


class PhaseDecoder:
    """Least squares on the phases of all bands of all modules; the wraps are resolved from a start position.

    One module repeats after its spacing; the phases of all modules together repeat only far beyond the largest spacing. The
    start selects the repetition and has no other effect: the result is the same for every start in its basin.
    """

    def __init__(self, wave_vectors: NDArray[np.float64]) -> None:
        """Set up the decoder for bands with wave vectors (M, 3, 2), cycles per metre."""
        self._waves = wave_vectors.reshape(-1, 2)
        self._solve = np.linalg.pinv(self._waves)
        tick = 1.0 / (6.0 * float(np.linalg.norm(self._waves, axis=1).max()))
        half = int(np.ceil(DECODE_BOX_M / tick))
        self._ticks = np.arange(-half, half + 1) * tick

    def decode(self, phases_cycles: NDArray[np.float64], last_m: Array, starts_m: Callable[[], Array]) -> Decoded:
        """Decode phases (M, 3), cycles.

        Starts are tried in order until the modules agree: `last_m`; the first of `starts_m`; the position of best
        agreement in the box around that, and around `last_m`; all of `starts_m`. If the modules never agree, the best of
        the first box is returned, with `agreed` False.

        Args:
            phases_cycles: (M, 3) phases of the sheets' first modes, as `GridModules.band_phases` gives them.
            last_m: (2,) last decoded position, m.
            starts_m: returns further starts (S, 2), m, the likeliest first; called only if `last_m` fails.
        """
        phases = phases_cycles.reshape(-1)
        found = self._refine(phases, last_m)
        if found.agreed:
            return found
        starts = starts_m()
        found = self._refine(phases, starts[0])
        if found.agreed:
            return found
        near = self._refine(phases, self._scan(phases, starts[0]))
        if near.agreed:
            return near
        found = self._refine(phases, self._scan(phases, last_m))
        if found.agreed:
            return found
        far = min((self._refine(phases, start) for start in starts), key=lambda decoded: decoded.misfit_cycles)
        return far if far.agreed else near

    def _refine(self, phases: NDArray[np.float64], start_m: Array) -> Decoded:
        """Take whole cycles from a start (2,), solve for the position, and again until the whole cycles stay the same."""
        wraps = np.rint(phases - self._waves @ start_m)
        for _ in range(4):
            position = self._solve @ (phases - wraps)
            offset = phases - self._waves @ position
            before, wraps = wraps, np.rint(offset)
            if (before == wraps).all():
                break
        residual = offset - wraps
        return Decoded(position, math.sqrt(float(residual @ residual) / residual.size))

    def _scan(self, phases: NDArray[np.float64], centre_m: Array) -> Array:
        along_x = np.exp(2j * np.pi * np.outer(self._ticks, self._waves[:, 0]))
        along_y = np.exp(2j * np.pi * np.outer(self._ticks, self._waves[:, 1]))
        target = np.exp(-2j * np.pi * (phases - self._waves @ centre_m))
        score = ((along_x * target) @ along_y.T).real
        ix, iy = np.unravel_index(int(np.argmax(score)), score.shape)
        return np.asarray(centre_m + np.array([self._ticks[ix], self._ticks[iy]]))


class LowModes:
    """Transforms between a stack of M sheets (N, M, N), N being `side`, and their modes (2K+1, M, K+1), K being `modes`.

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
        """Return the stack of sheets (N, M, N) that have these modes (2K+1, M, K+1) and no others: a new array."""
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
        """Return |k|^2 of every mode (p, q), (2K+1, K+1).

        Hexagonal: axes 120 degrees apart, first shell (1,0), (0,1), (1,1). Square: orthogonal axes, first shell (1,0), (0,1).
        """
        p, q = self.first[:, None], self.second
        return np.asarray(p * p + q * q - (p * q if metric == "hexagonal" else 0))


def shift_sheets(sheets: NDArray[np.floating], shift_cycles: NDArray[np.float64]) -> NDArray[np.floating]:
    """Return sheets (M, N, N) moved by any shifts (M, 2), cycles, exactly in all their modes (Fourier interpolation)."""
    side = sheets.shape[-1]
    first, second = np.fft.fftfreq(side, 1.0 / side), np.arange(side // 2 + 1)
    turn = np.exp(-2j * np.pi * shift_cycles[:, 0, None] * first)[:, :, None]
    turn = turn * np.exp(-2j * np.pi * shift_cycles[:, 1, None] * second)[:, None, :]
    return np.asarray(np.fft.irfft2(np.fft.rfft2(sheets) * turn, s=(side, side)), dtype=sheets.dtype)
