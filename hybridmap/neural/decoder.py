"""From the phases of all grid modules together to one position."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from hybridmap.geometry import Array

DECODE_BOX_M = 1.0
"""Half side of the box around the prior in which all modules together resolve the wrap, m: about twice the coarsest spacing."""
_AGREEMENT_CYCLES = 0.06


@dataclass(frozen=True, slots=True)
class Decoded:
    """A position that the modules agree on.

    Attributes:
        position_m: (2,) in the integrator's frame, m.
        misfit_cycles: RMS of what the phases of all bands still disagree by, cycles; 0.29 means no agreement at all.
    """

    position_m: Array
    misfit_cycles: float

    @property
    def agreed(self) -> bool:
        """Whether the modules agree, i.e. the position can be trusted."""
        return self.misfit_cycles < _AGREEMENT_CYCLES


class PhaseDecoder:
    """Least squares on the phases of all bands of all modules, with the wraps resolved from where to start.

    One module repeats after its spacing; the phases of all modules together repeat only far beyond the largest. A start says
    which repetition is meant, and enters nowhere else: anywhere inside its basin the answer is the same.
    """

    def __init__(self, wave_vectors: NDArray[np.float64], box_m: float = DECODE_BOX_M) -> None:
        """Take wave vectors (M, 3, 2), cycles per metre, and the half side of the scanned box, m."""
        self._waves = wave_vectors.reshape(-1, 2)
        self._solve = np.linalg.pinv(self._waves)
        tick = 1.0 / (6.0 * float(np.linalg.norm(self._waves, axis=1).max()))
        half = int(np.ceil(box_m / tick))
        self._ticks = np.arange(-half, half + 1) * tick

    def decode(self, phases_cycles: NDArray[np.float64], last_m: Array, starts_m: Callable[[], Array]) -> Decoded:
        """Decode phases (M, 3), cycles.

        Tried in this order, until the modules agree: from `last_m`; from the first of `starts_m`; the position on which the
        modules agree best in the box around that; from all of `starts_m`. Where nothing agrees, the best of the box is given.

        Args:
            phases_cycles: (M, 3) phases of the sheets' first modes.
            last_m: (2,) where the robot was decoded last.
            starts_m: gives further starts (S, 2), the likeliest first; called only where `last_m` fails.
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
        far = min((self._refine(phases, start) for start in starts), key=lambda decoded: decoded.misfit_cycles)
        return far if far.agreed else near

    def _refine(self, phases: NDArray[np.float64], start_m: Array) -> Decoded:
        """Take whole cycles from a start (2,), solve for the position, and again until the whole cycles stay the same."""
        wraps = np.round(phases - self._waves @ start_m)
        for _ in range(4):
            position = self._solve @ (phases - wraps)
            offset = phases - self._waves @ position
            before, wraps = wraps, np.round(offset)
            if np.array_equal(before, wraps):
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
