"""From the phases of all grid modules together to one position."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from hybridmap.geometry import Array


@dataclass(frozen=True, slots=True)
class Decoded:
    """A position that the modules agree on.

    Attributes:
        position_m: (2,) in the integrator's frame, m.
        misfit_cycles: RMS of what the phases of all bands still disagree by, cycles; 0.29 means no agreement at all.
    """

    position_m: Array
    misfit_cycles: float


class PhaseDecoder:
    """Least squares on the phases of all bands of all modules, with the wraps resolved from where to start.

    One module repeats after its spacing; the phases of all modules together repeat only far beyond the largest. A start says
    which repetition is meant, and enters nowhere else: anywhere inside its basin the answer is the same.
    """

    _AGREEMENT_CYCLES = 0.06

    def __init__(self, wave_vectors: NDArray[np.float64], box_m: float) -> None:
        """Take wave vectors (M, 3, 2), cycles per metre, and the half side of the scanned box, m."""
        self._waves = wave_vectors.reshape(-1, 2)
        self._solve = np.linalg.pinv(self._waves).T
        tick = 1.0 / (6.0 * float(np.linalg.norm(self._waves, axis=1).max()))
        half = int(np.ceil(box_m / tick))
        self._ticks = np.arange(-half, half + 1) * tick

    def decode(self, phases_cycles: NDArray[np.float64], starts_m: Array, far_m: Callable[[], Array]) -> Decoded:
        """Decode phases (M, 3), cycles.

        Args:
            phases_cycles: (M, 3) phases of the sheets' first modes.
            starts_m: (S, 2) likely positions; the first from which the modules come to agree gives the answer. Where none
                does, the box around the last one is scanned for the position on which the modules agree best.
            far_m: gives further starts (F, 2), tried only where the box holds no agreement either.
        """
        phases = phases_cycles.reshape(-1)
        for start in starts_m:
            found = self._refine(phases, start[None])
            if found.misfit_cycles < self._AGREEMENT_CYCLES:
                return found
        near = self._refine(phases, self._scan(phases, starts_m[-1])[None])
        if near.misfit_cycles < self._AGREEMENT_CYCLES:
            return near
        far = self._refine(phases, far_m())
        return far if far.misfit_cycles < self._AGREEMENT_CYCLES else near

    def _refine(self, phases: NDArray[np.float64], starts_m: Array) -> Decoded:
        """Gauss-Newton from each start (S, 2), twice; the best agreement wins."""
        position = starts_m
        for _ in range(2):
            position = position + self._residual(phases, position) @ self._solve
        misfit = np.sqrt(np.mean(self._residual(phases, position) ** 2, axis=1))
        best = int(np.argmin(misfit))
        return Decoded(position[best], float(misfit[best]))

    def _residual(self, phases: NDArray[np.float64], position_m: Array) -> NDArray[np.float64]:
        residual = phases - position_m @ self._waves.T
        return np.asarray(residual - np.round(residual))

    def _scan(self, phases: NDArray[np.float64], centre_m: Array) -> Array:
        along_x = np.exp(2j * np.pi * np.outer(self._ticks, self._waves[:, 0]))
        along_y = np.exp(2j * np.pi * np.outer(self._ticks, self._waves[:, 1]))
        target = np.exp(-2j * np.pi * (phases - self._waves @ centre_m))
        score = ((along_x * target) @ along_y.T).real
        ix, iy = np.unravel_index(int(np.argmax(score)), score.shape)
        return np.asarray(centre_m + np.array([self._ticks[ix], self._ticks[iy]]))
