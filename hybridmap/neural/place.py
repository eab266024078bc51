"""Place cells: competitive Hebbian learning from grid cells, with recruitment."""

from __future__ import annotations

import logging
import math

import numpy as np
from numpy.typing import NDArray

from hybridmap.config.mapping import PlaceConfig

GRID_INPUTS_SIDE = 4
"""Grid cells along a side of each sheet that project to place cells; it divides every sheet's side."""
RECRUIT_THRESHOLD = 0.3
"""A cell is recruited where no other responds above this share of its peak: fields overlap a little, none is left out."""
INHIBITION = 0.6
"""C_inh_p, as a share of a field's peak drive: fields are some 7 cm wide, and 97 % and more have one peak."""
MAX_CELLS = 32768
"""No more place cells than this are recruited: with their weights some 16 MB, and as many learning steps."""

log = logging.getLogger(__name__)


class PlaceCells:
    """Place cells that learn single fields from the grid sheets (paper eqs. 8-9).

    The printed rule bounds no weight and leaves most cells with several fields. Here weights are non-negative with rows of
    unit length, and where no cell responds above the threshold a new one is recruited in one step: its weights are the grid
    cells' present rates above their mean (C_inh_g). Coarse modules weigh more (by the root of their spacing), which widens a
    field without letting side peaks through. Everything is deterministic.
    """

    def __init__(self, config: PlaceConfig, sheet_side: int, spacings_m: NDArray[np.float64]) -> None:
        self.config = config
        self._stride = sheet_side // GRID_INPUTS_SIDE
        self._module_weight = np.sqrt(spacings_m / spacings_m.max()).astype(np.float32)[:, None]
        inputs = GRID_INPUTS_SIDE**2
        self._less_mean = np.eye(inputs, dtype=np.float32) - np.float32(1.0 / inputs)
        self._weights = np.zeros((256, len(spacings_m) * GRID_INPUTS_SIDE**2), dtype=np.float32)
        self._recruited = 0

    @property
    def weights(self) -> NDArray[np.float32]:
        """Weights of the recruited cells, (cells, inputs), rows of unit length."""
        return self._weights[: self._recruited]

    def rates(self, sheets: NDArray[np.floating]) -> NDArray[np.float32]:
        """Return p = A f[W (s - C_inh_g) - C_inh_p] of every recruited cell, (cells,), 1 at the peak of a field."""
        return self.respond(self.inputs(sheets))

    def learn(self, sheets: NDArray[np.floating]) -> NDArray[np.float32]:
        """One learning step: recruit where nothing responds, else move the responding cells' weights (eq. 8).

        Returns:
            The rates (cells,) of all cells here, of a recruited one as it will be.
        """
        drive = self.inputs(sheets)
        rates = self.respond(drive)
        if rates.size == 0 or float(rates.max()) < RECRUIT_THRESHOLD:
            self._recruit(drive)
            return self.respond(drive)
        for cell in rates.nonzero()[0].tolist():
            weights = self._weights[cell]
            weights += np.float32(self.config.learning_rate * float(rates[cell])) * drive  # neither is negative
            weights *= np.float32(1.0 / math.sqrt(float(weights.dot(weights))))
        return rates

    def respond(self, drive: NDArray[np.float32]) -> NDArray[np.float32]:
        """Return the rates (cells,) or (cells, P) to inputs (inputs,) or (inputs, P), as `inputs` gives them."""
        inhibition = np.float32(INHIBITION)
        above = self.weights.dot(drive)
        above -= inhibition
        np.maximum(above, np.float32(0.0), out=above)
        above *= np.float32(1.0) / (np.float32(1.0) - inhibition)
        return np.asarray(above)

    def _recruit(self, drive: NDArray[np.float32]) -> None:
        if self._recruited == MAX_CELLS:
            return
        if self._recruited == len(self._weights):
            self._weights = np.concatenate([self._weights, np.zeros_like(self._weights)])
        self._weights[self._recruited] = drive
        self._recruited += 1
        if self._recruited == MAX_CELLS:
            log.warning("all %d place cells are recruited; new places get no cell of their own", self._recruited)

    def inputs(self, sheets: NDArray[np.floating]) -> NDArray[np.float32]:
        """Rates above the module's mean of the grid cells that project to place cells, (inputs,), of unit length."""
        sampled = sheets[:, :: self._stride, :: self._stride].reshape(len(sheets), -1).astype(np.float32)
        above = sampled.dot(self._less_mean)
        np.maximum(above, np.float32(0.0), out=above)
        above *= self._module_weight
        above *= np.float32(1.0 / math.sqrt(float(np.vdot(above, above))))
        return np.asarray(above.reshape(-1))


class PlaceProjection:
    """Hebbian weights from the place cells onto the place attractor: a cell learns where the bump is when it fires."""

    def __init__(self, attractor_cells: int) -> None:
        self._weights = np.zeros((256, attractor_cells), dtype=np.float32)
        self._fired = np.zeros(256, dtype=np.float32)

    def learn(self, rates: NDArray[np.float32], bump: NDArray[np.floating]) -> None:
        """Move each cell's weights to the mean of the bumps (N * N,) it fired with, weighted by its rates (cells,)."""
        while len(rates) > len(self._weights):
            self._weights = np.concatenate([self._weights, np.zeros_like(self._weights)])
            self._fired = np.concatenate([self._fired, np.zeros_like(self._fired)])
        active = np.flatnonzero(rates)
        self._fired[active] += rates[active]
        step = (rates[active] / self._fired[active])[:, None]
        self._weights[active] += step * (bump.astype(np.float32) - self._weights[active])

    def onto(self, rates: NDArray[np.float32]) -> NDArray[np.float32]:
        """Return the input (N * N,) of place cells with rates (cells,), or (N * N, P) of rates (cells, P)."""
        return np.asarray(self._weights[: len(rates)].T @ rates)
