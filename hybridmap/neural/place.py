"""Place cells: competitive Hebbian learning from grid cells, with recruitment."""

from __future__ import annotations

import logging

import numpy as np
from numpy.typing import NDArray

from hybridmap.config.neural import PlaceConfig

log = logging.getLogger(__name__)


class PlaceCells:
    """P place cells that learn single fields from the grid sheets (paper eqs. 8-9).

    The printed rule bounds no weight and leaves most cells with several fields. Here weights are non-negative with rows of
    unit length, and where no field responds above the threshold a new one is recruited in one step: its weights are the
    grid cells' present rates above their mean (C_inh_g). Fields are handed to cells in turn; once every cell has one, cells get a second, far
    away from the first, as in real large environments. Everything is deterministic.
    """

    def __init__(self, config: PlaceConfig, sheet_side: int, modules: int) -> None:
        self.config = config
        self.size = config.attractor_side**2
        self._stride = sheet_side // config.grid_inputs_side
        self._inputs = modules * config.grid_inputs_side**2
        self._weights = np.zeros((256, self._inputs), dtype=np.float32)
        self.fields = 0

    @property
    def weights(self) -> NDArray[np.float32]:
        """Weights of the recruited fields, (fields, inputs), rows of unit length; field n belongs to cell n mod P."""
        return self._weights[: self.fields]

    def field_rates(self, sheets: NDArray[np.floating]) -> NDArray[np.float32]:
        """Return p = A f[W (s - C_inh_g) - C_inh_p] of every field, (fields,), 1 at a field's peak."""
        return self._respond(self._drive(sheets))

    def code(self, sheets: NDArray[np.floating]) -> NDArray[np.float32]:
        """Return the place code (P,): rates after competition, of unit length (all zero before the first field)."""
        rates = self.field_rates(sheets) ** np.float32(self.config.competition)
        padded = np.zeros(-(-max(self.fields, 1) // self.size) * self.size, dtype=np.float32)
        padded[: self.fields] = rates
        code = padded.reshape(-1, self.size).max(axis=0)
        norm = np.float32(np.linalg.norm(code))
        return code / norm if norm > 0 else code

    def learn(self, sheets: NDArray[np.floating]) -> None:
        """One learning step: recruit where nothing responds, else move the responding fields' weights (eq. 8)."""
        drive = self._drive(sheets)
        rates = self._respond(drive)
        if rates.size == 0 or float(rates.max()) < self.config.recruit_threshold:
            self._recruit(drive)
            return
        active = np.flatnonzero(rates)
        grown = self._weights[active] + np.float32(self.config.learning_rate) * rates[active, None] * drive
        np.maximum(grown, 0.0, out=grown)
        self._weights[active] = grown / np.linalg.norm(grown, axis=1, keepdims=True)

    def _respond(self, drive: NDArray[np.float32]) -> NDArray[np.float32]:
        inhibition = np.float32(self.config.inhibition)
        return np.maximum(self.weights @ drive - inhibition, 0.0) / (np.float32(1.0) - inhibition)

    def _recruit(self, drive: NDArray[np.float32]) -> None:
        if self.fields == self.config.max_fields:
            return
        if self.fields == len(self._weights):
            self._weights = np.concatenate([self._weights, np.zeros_like(self._weights)])
        self._weights[self.fields] = drive
        self.fields += 1
        if self.fields == self.config.max_fields:
            log.warning("all %d place fields are in use; new places get no field of their own", self.fields)

    def _drive(self, sheets: NDArray[np.floating]) -> NDArray[np.float32]:
        """Rates above the mean of the grid cells that project to place cells, (inputs,), of unit length."""
        sampled = sheets[:, :: self._stride, :: self._stride].reshape(len(sheets), -1).astype(np.float32)
        above = np.maximum(sampled - sampled.mean(axis=1, keepdims=True), 0.0).reshape(-1)
        return above / np.float32(np.linalg.norm(above))
