"""Place cells recruited from the grid cells, and the place attractor."""

from __future__ import annotations

import logging
import math
from typing import NamedTuple

import numpy as np
from numpy.typing import DTypeLike, NDArray

from hybridmap.config.mapping import PlaceConfig
from hybridmap.geometry import Array

GRID_INPUTS_SIDE = 4
"""Grid cells along a side of each sheet that project to place cells; it divides every sheet's side."""
RECRUIT_THRESHOLD = 0.3
"""A cell is recruited where no other responds above this share of its peak: fields overlap a little, none is left out."""
INHIBITION = 0.6
"""C_inh_p, as a share of a field's peak drive: fields are some 7 cm wide, and 97 % and more have one peak."""
BLOCK_M = 0.5
"""Cells are looked up by blocks of this side, m: those of the block of a position and of the eight around it can fire there."""
MAX_CELLS = 32768
"""No more place cells than this are recruited: with their weights some 16 MB, with those onto the attractor 134 MB more."""

log = logging.getLogger(__name__)


class Firing(NamedTuple):
    """What some place cells do; all others are silent.

    Attributes:
        cells: (k,) int64 numbers of the cells, ascending.
        rates: (k,) float32, 1 at the peak of a field.
    """

    cells: NDArray[np.int64]
    rates: NDArray[np.float32]


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
        self._in_block: dict[tuple[int, int], list[int]] = {}

    @property
    def weights(self) -> NDArray[np.float32]:
        """Weights of the recruited cells, (cells, inputs), rows of unit length."""
        return self._weights[: self._recruited]

    def rates(self, sheets: NDArray[np.floating]) -> NDArray[np.float32]:
        """Return p = A f[W (s - C_inh_g) - C_inh_p] of every recruited cell, (cells,), for sheets (M, N, N); 1 at a peak."""
        return self.respond(self.inputs(sheets))

    def learn(self, sheets: NDArray[np.floating], near_m: Array | None = None) -> Firing:
        """One learning step: recruit where nothing responds, else move the responding cells' weights (eq. 8).

        Args:
            sheets: (M, N, N) rates of the grid cells.
            near_m: (2,) about where the robot is, m: only cells recruited around there are asked (`around`), as the field of
                any other lies elsewhere: a step costs what lies near. None: all are asked. Side peaks of the others, weaker
                than what recruits, are left out.

        Returns:
            What the cells that were asked do at this position; for a newly recruited cell, its rate after recruiting.
        """
        drive = self.inputs(sheets)
        firing = self._local(drive, near_m)
        if firing.rates.size == 0 or float(firing.rates.max()) < RECRUIT_THRESHOLD:
            if self._recruit(drive) and near_m is not None:
                self._in_block.setdefault(_block(near_m), []).append(self._recruited - 1)
            return self._local(drive, near_m)
        active = firing.rates.nonzero()
        for cell, rate in zip(firing.cells[active].tolist(), firing.rates[active].tolist(), strict=True):
            weights = self._weights[cell]
            weights += np.float32(self.config.learning_rate * rate) * drive  # neither is negative
            weights *= np.float32(1.0 / math.sqrt(float(weights.dot(weights))))
        return firing

    def respond(self, drive: NDArray[np.float32]) -> NDArray[np.float32]:
        """Return the rates (cells,) of the cells to one input vector (inputs,), or (cells, P) to P of them, (inputs, P)."""
        return _above_inhibition(self.weights.dot(drive))

    def around(self, near_m: Array) -> list[int]:
        """Numbers of the cells that were recruited around a position (2,), m: those that are asked there."""
        x, y = _block(near_m)
        blocks = [(x + across, y + along) for across in (-1, 0, 1) for along in (-1, 0, 1)]
        return sorted(cell for block in blocks for cell in self._in_block.get(block, ()))

    def _local(self, drive: NDArray[np.float32], near_m: Array | None) -> Firing:
        """What the cells recruited around a position (2,), m, do; None: all cells."""
        if near_m is None:
            return Firing(np.arange(self._recruited), self.respond(drive))
        cells = np.array(self.around(near_m), dtype=np.int64)
        return Firing(cells, _above_inhibition(self._weights[cells].dot(drive)))

    def _recruit(self, drive: NDArray[np.float32]) -> bool:
        if self._recruited == MAX_CELLS:
            return False
        if self._recruited == len(self._weights):
            self._weights = np.concatenate([self._weights, np.zeros_like(self._weights)])
        self._weights[self._recruited] = drive
        self._recruited += 1
        if self._recruited == MAX_CELLS:
            log.warning("all %d place cells are recruited; new places get no cell of their own", self._recruited)
        return True

    def inputs(self, sheets: NDArray[np.floating]) -> NDArray[np.float32]:
        """Input (inputs,) of the place cells from sheets (M, N, N): sampled rates above their module's mean, of unit length."""
        sampled = sheets[:, :: self._stride, :: self._stride].reshape(len(sheets), -1).astype(np.float32)
        above = sampled.dot(self._less_mean)
        np.maximum(above, np.float32(0.0), out=above)
        above *= self._module_weight
        above *= np.float32(1.0 / math.sqrt(float(np.vdot(above, above))))
        return np.asarray(above.reshape(-1))


def _block(position_m: Array) -> tuple[int, int]:
    x, y = np.floor(position_m / BLOCK_M).astype(int).tolist()
    return x, y


def _above_inhibition(drive: NDArray[np.float32]) -> NDArray[np.float32]:
    inhibition = np.float32(INHIBITION)
    drive -= inhibition
    np.maximum(drive, np.float32(0.0), out=drive)
    drive *= np.float32(1.0) / (np.float32(1.0) - inhibition)
    return np.asarray(drive)


class PlaceProjection:
    """Hebbian weights from the place cells onto the place attractor: a cell learns where the bump is when it fires.

    Rates are those of the cells of the given numbers (k,), ascending; None: of all cells, from the first on.
    """

    def __init__(self, attractor_cells: int) -> None:
        self._weights = np.zeros((256, attractor_cells), dtype=np.float32)
        self._fired = np.zeros(256, dtype=np.float32)

    def learn(self, rates: NDArray[np.float32], bump: NDArray[np.floating], cells: NDArray[np.int64] | None = None) -> None:
        """Move each cell's weights to the mean of the bumps (N * N,) it fired with, weighted by its rates (k,)."""
        active = np.flatnonzero(rates)
        rows = self._rows(active, cells)
        self._fired[rows] += rates[active]
        step = (rates[active] / self._fired[rows])[:, None]
        self._weights[rows] += step * (bump.astype(np.float32) - self._weights[rows])

    def onto(self, rates: NDArray[np.float32], cells: NDArray[np.int64] | None = None) -> NDArray[np.float32]:
        """Return the input (N * N,) that place cells of rates (k,) give the attractor; (N * N, P) for P sets (k, P)."""
        active = np.flatnonzero(rates.reshape(len(rates), -1).any(axis=1))
        rows = self._rows(active, cells)
        return np.asarray(self._weights[rows].T @ rates[active])

    def _rows(self, active: NDArray[np.int64], cells: NDArray[np.int64] | None) -> NDArray[np.int64]:
        """Numbers of the cells that fire; there are weights for each of them."""
        rows = active if cells is None else cells[active]
        while len(rows) and int(rows[-1]) >= len(self._weights):
            self._weights = np.concatenate([self._weights, np.zeros_like(self._weights)])
            self._fired = np.concatenate([self._fired, np.zeros_like(self._fired)])
        return rows


ATTRACTOR_WIDTH_CELLS = 1.4
"""Standard deviation of the attractor's bump, cells: wide enough to move smoothly from cell to cell."""


class PlaceAttractor:
    """Sheet of N x N place-attractor cells (paper eq. 10).

    A step moves the activity by whole cells (floor) and by the residual, spreads it with Gaussian weights of the bump's own
    width, and lets the cells compete: rates are squared and normalised (Deneve, Latham and Pouget 1999). A Gaussian of that
    width is the fixed point, the largest of several bumps wins, and since all of it is smooth the bump does not stick to cells.

    Attributes:
        activity: (N, N) rates of sum one, first index x, second y; the whole state.
    """

    def __init__(
        self, side: int, cell_m: float, width_cells: float = ATTRACTOR_WIDTH_CELLS, dtype: DTypeLike = np.float64
    ) -> None:
        self.cell_m = cell_m
        self._side = side
        wave = 2.0 * np.pi * np.arange(side // 2) / side
        angle = np.outer(wave, np.arange(side))
        gain = np.exp(-0.5 * (width_cells * wave) ** 2) * np.where(wave == 0, 1.0, 2.0) / side
        quarter = np.full(len(wave), -0.5 * np.pi)  # the cosine of an angle less a quarter is its sine
        self._wave = np.stack([np.tile(wave, 2), np.concatenate([0.0 * wave, quarter])]).astype(dtype)
        self._residuals = np.ones((2, 2), dtype=dtype)
        kernel = np.concatenate([gain[:, None] * np.cos(angle), gain[:, None] * np.sin(angle)])
        self._kernel = np.ascontiguousarray(np.tile(kernel, 3)).astype(dtype)
        self._lines = np.empty((2, 3 * side), dtype=dtype)
        self._along_x, self._along_y = (_circulants(line, side) for line in self._lines)
        self._silent = np.zeros((side, side), dtype=dtype)
        self._phasors = np.exp(1j * angle[1])
        self._remappings: dict[tuple[int, int], NDArray[np.int64]] = {}
        offset = (np.arange(side) + side // 2) % side - side // 2
        line = np.exp(-0.5 * (offset / width_cells) ** 2)
        self.activity: NDArray[np.floating] = (np.outer(line, line) / line.sum() ** 2).astype(dtype)

    @property
    def extent_m(self) -> float:
        """Distance after which the sheet repeats, m."""
        return self._side * self.cell_m

    def step(self, displacement_m: NDArray[np.float64]) -> None:
        """Move the bump by a displacement (2,) in the world, m, and let the cells compete once."""
        x, y = displacement_m.tolist()
        whole_x, self._residuals[0, 0] = split_shift(x / self.cell_m)
        whole_y, self._residuals[1, 0] = split_shift(y / self.cell_m)
        phase = self._residuals.dot(self._wave)
        np.cos(phase, out=phase)
        phase.dot(self._kernel, out=self._lines)
        side = self._side
        row, column = -whole_x % side, -whole_y % side
        along_x, along_y = self._along_x[row : row + side], self._along_y[column : column + side]
        spread = along_x.dot(self.activity).dot(along_y.T)
        np.maximum(spread, self._silent, out=spread)
        total = float(np.vdot(spread, spread))
        spread *= spread
        spread *= 1.0 / total
        self.activity = spread

    def receive(self, place_input: NDArray[np.floating], share: float) -> None:
        """Replace a `share` (0..1) of the activity by the place cells' input (N * N,), scaled to it; zeros change nothing."""
        total = float(place_input.sum())
        if total > 0.0:
            given = (place_input * (share / total)).reshape(self.activity.shape).astype(self.activity.dtype)
            self.activity = (1.0 - share) * self.activity + given

    def settle(self, iterations: int = 10) -> None:
        """Let the cells compete so many times without self-motion; the largest bump is left."""
        for _ in range(iterations):
            self.step(np.zeros(2))

    def position_m(self) -> Array:
        """Return the bump's position (2,) by population vector, m in [0, extent)."""
        return self.position_of(self.activity)

    def position_of(self, activity: NDArray[np.floating]) -> Array:
        """Return the position (2,) that an activity (N, N) stands for, m in [0, extent)."""
        z = np.array([self._phasors @ activity.sum(axis=1), self._phasors @ activity.sum(axis=0)])
        return np.asarray(np.angle(z) / (2.0 * np.pi) % 1.0 * self.extent_m)

    def unwrapped_m(self, near_m: Array) -> Array:
        """Return the bump's position (2,), m, in that repetition of the sheet that is nearest to `near_m` (2,)."""
        offset = self.position_m() - near_m
        return near_m + offset - self.extent_m * np.round(offset / self.extent_m)

    def code(self, near_m: Array) -> NDArray[np.float32]:
        """Return the rates (N * N,) of unit length, with cells drawn anew (remapped) in each repetition of the sheet.

        Around the origin the code is the sheet itself. A place one wrap away is carried by other cells, as real place cells
        remap; `near_m` (2,) says which repetition the bump is in.
        """
        code = np.zeros(self._side**2)
        columns = self._repetitions(float(near_m[1]))
        for tx, rows in self._repetitions(float(near_m[0])):
            for ty, cols in columns:
                code[self._remapping(tx, ty)[rows, cols]] += self.activity[rows, cols]
        return np.asarray(code / math.sqrt(float(code @ code)), dtype=np.float32)

    def _repetitions(self, near_m: float) -> list[tuple[int, slice]]:
        """The repetitions of the sheet that the cells nearest to a coordinate along an axis are in, each with its cells."""
        half = self._side // 2
        first = math.ceil(near_m / self.cell_m) - half
        tile, cell = divmod(first, self._side)
        return [(tile, slice(cell, None)), (tile + 1, slice(None, cell))][: 2 if cell else 1]

    def _remapping(self, tx: int, ty: int) -> NDArray[np.int64]:
        """Which cell stands for each cell (N, N) of the sheet in its repetition (tx, ty); the same in every run."""
        if (tx, ty) not in self._remappings:
            size = self._side**2
            seed = [abs(tx), abs(ty), int(tx < 0), int(ty < 0)]
            drawn = np.arange(size) if tx == ty == 0 else np.random.default_rng(seed).permutation(size)
            self._remappings[tx, ty] = drawn.reshape(self._side, self._side)
        return self._remappings[tx, ty]


def _circulants(line: NDArray[np.floating], side: int) -> NDArray[np.floating]:
    """View (2 N, N) of a line laid end to end three times (3 N,): rows w to w + N are its circulant, moved by -w cells."""
    stride = line.strides[0]
    return np.lib.stride_tricks.as_strided(line[side:], shape=(2 * side, side), strides=(stride, -stride))


def split_shift(shift_cells: float) -> tuple[int, float]:
    """Split a shift into whole cells by floor and the residual in [0, 1) (paper eq. 10): -0.3 gives -1 and 0.7."""
    whole = math.floor(shift_cells)
    return whole, shift_cells - whole
