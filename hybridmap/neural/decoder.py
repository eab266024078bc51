"""From the phases of all grid modules together to one position."""

from __future__ import annotations

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
    """Least squares on the phases of all bands of all modules, with the wraps resolved near a prior position.

    One module repeats after its spacing; the phases of all modules together repeat only far beyond the largest. The prior
    says which repetition is meant. It enters nowhere else: anywhere inside its basin the answer is the same.
    """

    _AGREEMENT_CYCLES = 0.06

    def __init__(self, wave_vectors: NDArray[np.float64], box_m: float) -> None:
        """Take wave vectors (M, 3, 2), cycles per metre, and the half side of the scanned box, m."""
        self._waves = wave_vectors.reshape(-1, 2)
        self._solve = np.linalg.pinv(self._waves)
        shortest = 1.0 / float(np.linalg.norm(self._waves, axis=1).max())
        ticks = np.arange(-np.ceil(box_m / (shortest / 6.0)), np.ceil(box_m / (shortest / 6.0)) + 1) * (shortest / 6.0)
        self._ticks = ticks

    def decode(self, phases_cycles: NDArray[np.float64], priors_m: list[Array]) -> Decoded:
        """Decode phases (M, 3), cycles.

        Args:
            phases_cycles: (M, 3) phases of the sheets' first modes.
            priors_m: positions (2,); the first from which the modules agree is taken. Where none is close enough, the box
                around the last one is scanned for the position on which all modules agree best.
        """
        phases = phases_cycles.reshape(-1)
        for prior in priors_m:
            found = self._refine(phases, prior)
            if found.misfit_cycles < self._AGREEMENT_CYCLES:
                return found
        return self._refine(phases, self._scan(phases, priors_m[-1]))

    def _refine(self, phases: NDArray[np.float64], start_m: Array) -> Decoded:
        position = start_m
        for _ in range(2):
            residual = phases - self._waves @ position
            residual -= np.round(residual)
            position = position + self._solve @ residual
        residual = phases - self._waves @ position
        residual -= np.round(residual)
        return Decoded(position, float(np.sqrt(residual @ residual / residual.size)))

    def _scan(self, phases: NDArray[np.float64], centre_m: Array) -> Array:
        along_x = np.exp(2j * np.pi * np.outer(self._ticks, self._waves[:, 0]))
        along_y = np.exp(2j * np.pi * np.outer(self._ticks, self._waves[:, 1]))
        target = np.exp(-2j * np.pi * (phases - self._waves @ centre_m))
        score = ((along_x * target) @ along_y.T).real
        ix, iy = np.unravel_index(int(np.argmax(score)), score.shape)
        return np.asarray(centre_m + np.array([self._ticks[ix], self._ticks[iy]]))
