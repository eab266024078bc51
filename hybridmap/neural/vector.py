"""The grid code as a vector: the displacement between two places, from the grid phases that were stored at them."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike, NDArray

from hybridmap.config.mapping import NeuralConfig
from hybridmap.errors import ConfigError
from hybridmap.geometry import Array
from hybridmap.neural.grid import AGREEMENT_CYCLES
from hybridmap.neural.path_integrator import band_rings

REACH_M = 20.0
"""Displacements up to this length are looked for, m: some 17 ms each, as there are 5,500 repetitions of the coarsest module."""
_ROUNDS = 4


@dataclass(frozen=True, slots=True)
class GridVector:
    """A displacement that was read from two grid codes.

    Attributes:
        displacement_m: (2,) from the first place to the second, in the axes of the frame in which the cells started, m.
        misfit_cycles: RMS disagreement of the phases of all bands with it, cycles; with eight modules no other displacement
            within 20 m has less than 0.1 by chance.
    """

    displacement_m: Array
    misfit_cycles: float

    @property
    def agreed(self) -> bool:
        """Whether the modules agree (misfit below 0.06 cycles), so that the displacement can be trusted."""
        return self.misfit_cycles < AGREEMENT_CYCLES


class GridVectors:
    """Reads displacements from grid phases (vector navigation by grid cells; Bush et al. 2015).

    Each module tells the displacement but for its repetitions. Those of the coarsest are tried, all of them at once: whole
    cycles of the other modules are taken from each and the phases of all bands are solved for one displacement. The one with
    the smallest misfit is it. No pose enters: what is read is the displacement between the poses that the cells showed, with
    their drift since the first of the two, unless closures re-anchored them.
    """

    def __init__(self, config: NeuralConfig) -> None:
        """Set up for the cells of a map's configuration."""
        waves = band_rings(config).wave_vectors
        self._shape = (len(waves), 2)
        self._waves = waves.reshape(-1, 2)
        self._solve = np.linalg.pinv(self._waves)
        self._metres_a_cycle = np.linalg.inv(waves[-1, [0, 2]])

    def between(self, phases_from: ArrayLike, phases_to: ArrayLike, reach_m: float = REACH_M) -> GridVector:
        """Return the displacement between two places; its cost grows with the square of the reach.

        Args:
            phases_from, phases_to: (M, 2) grid phases at the two places, cycles, as `MapStore.grid_phases` gives them.
            reach_m: longest displacement that is looked for, m. A longer one gives a large misfit.

        Raises:
            ConfigError: the phases are not finite or not those of as many modules as the configuration has, or the reach is
                not positive.
        """
        if not 0.0 < reach_m < math.inf:
            raise ConfigError(f"grid code: expected a positive reach, found {reach_m} m")
        first, last = (self._checked(phases).T for phases in (phases_from, phases_to))
        moved = last - first
        moved -= np.rint(moved)
        phases = np.stack([moved[0], moved[0] + moved[1], moved[1]], axis=1).reshape(-1)
        found = self._repetitions(moved[:, -1], reach_m)
        for _ in range(_ROUNDS):
            found = found + self._residuals(phases, found) @ self._solve.T
        misfits = np.sqrt((self._residuals(phases, found) ** 2).mean(axis=1))
        best = int(np.argmin(misfits))
        return GridVector(found[best].copy(), float(misfits[best]))

    def _checked(self, phases: ArrayLike) -> Array:
        cycles = np.asarray(phases, dtype=np.float64)
        if cycles.shape != self._shape or not np.isfinite(cycles).all():
            raise ConfigError(f"grid code: expected finite phases {self._shape}, one row a module, found {cycles.shape}")
        return cycles

    def _repetitions(self, cycles: Array, reach_m: float) -> Array:
        """All displacements (K, 2), m, up to the reach that the coarsest module's phases (2,) allow."""
        most = math.ceil(reach_m * float(np.linalg.norm(self._waves[-3:], axis=1).max())) + 1
        whole = np.arange(-most, most + 1)
        lattice = np.stack(np.meshgrid(whole, whole, indexing="ij"), axis=-1).reshape(-1, 2)
        places = (lattice + cycles) @ self._metres_a_cycle.T
        beyond_m = 0.5 * float(np.linalg.norm(self._metres_a_cycle, axis=0).max())  # what noisy phases may be off by
        return np.asarray(places[np.hypot(*places.T) <= reach_m + beyond_m])

    def _residuals(self, phases: Array, places: Array) -> NDArray[np.float64]:
        """What the phases (3 M,) of all bands differ by, in cycles, from those of displacements (K, 2), m: (K, 3 M)."""
        offset = phases - places @ self._waves.T
        return np.asarray(offset - np.rint(offset))
