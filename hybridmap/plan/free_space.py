"""Where the middle of the robot can be, as far as the map knows, and between which points it can drive straight."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from functools import cache, cached_property
from typing import Self

import numpy as np
from numpy.typing import NDArray
from scipy.sparse import csr_array
from scipy.sparse.csgraph import dijkstra

from hybridmap.export.costs import clearance_m, fits
from hybridmap.export.keyframes import OccupancyGrid
from hybridmap.geometry import Array

Mask = NDArray[np.bool_]


@dataclass(frozen=True)
class FreeSpace:
    """Known free space, shrunk by the robot's radius. What is unknown blocks as what is occupied does.

    Attributes:
        room: (H, W) cells in which the middle of the robot can be; row 0 has the smallest y.
        origin_m: (2,) position in `map` of the lower left corner of cell (0, 0).
        resolution_m: side of a cell.
        radius_m: radius of the robot.
    """

    room: Mask
    origin_m: Array
    resolution_m: float
    radius_m: float

    @classmethod
    def of(cls, grid: OccupancyGrid, radius_m: float) -> Self:
        """The free space of a grid for a robot of this radius."""
        room = fits(clearance_m(~grid.free, grid.resolution_m), grid.resolution_m, radius_m) & grid.free
        return cls(room, grid.origin_m, grid.resolution_m, radius_m)

    def without(self, point: Array, radius_m: float) -> FreeSpace:
        """The free space that is left when a disc round a point (2,) in `map`, m, is blocked."""
        off = self.middles(np.arange(self.room.size)) - point
        near = (np.hypot(off[:, 0], off[:, 1]) < radius_m + self.radius_m).reshape(self.room.shape)
        return FreeSpace(self.room & ~near, self.origin_m, self.resolution_m, self.radius_m)

    def middles(self, cells: NDArray[np.int64]) -> Array:
        """Middles (K, 2) in `map`, m, of cells given as row * W + column."""
        row, column = np.divmod(cells, self.room.shape[1])
        return np.asarray(self.origin_m + self.resolution_m * (np.stack([column, row], axis=1) + 0.5))

    def cell(self, point: Array) -> int | None:
        """The cell, as row * W + column, of a point (2,) in `map`, m, if the robot can be there, else None."""
        column, row = (int(i) for i in np.floor((point - self.origin_m) / self.resolution_m))
        height, width = self.room.shape
        inside = 0 <= row < height and 0 <= column < width
        return row * width + column if inside and self.room[row, column] else None

    def nearest_m(self, point: Array) -> float:
        """Distance of a point (2,) in `map` from the nearest cell in which the robot can be, m; infinite if there is none."""
        off = self.middles(np.flatnonzero(self.room)) - point
        return float(np.hypot(off[:, 0], off[:, 1]).min(initial=np.inf))

    def sees(self, starts: Array, ends: Array) -> Mask:
        """(K,) whether the robot can drive straight from each start (K, 2) to each end (K, 2) in `map`, m.

        The cost grows with the lengths over the side of a cell.
        """
        a = np.ascontiguousarray((starts - self.origin_m) / self.resolution_m)
        b = np.ascontiguousarray((ends - self.origin_m) / self.resolution_m)
        out = np.empty(len(a), dtype=np.bool_)
        _straight()(np.ascontiguousarray(self.room), a, b, out)
        return out

    @cached_property
    def steps(self) -> csr_array:
        """Lengths of the steps between neighbouring cells (of 8) in which the robot can be, m, as a matrix over all cells."""
        number = np.arange(self.room.size).reshape(self.room.shape)
        pairs, lengths = [], []
        for row, column in ((0, 1), (1, 0), (1, 1), (1, -1)):
            height, width = self.room.shape
            here = np.s_[: height - row, max(0, -column) : width - max(0, column)]
            there = np.s_[row:, max(0, column) : width + min(0, column)]
            both = self.room[here] & self.room[there]
            pairs.append(np.stack([number[here][both], number[there][both]]))
            lengths.append(np.full(int(both.sum()), np.hypot(row, column) * self.resolution_m))
        first, second = np.concatenate(pairs, axis=1)
        return csr_array((np.concatenate(lengths), (first, second)), shape=(self.room.size, self.room.size))

    @cached_property
    def coarse(self) -> FreeSpace:
        """The same with cells of twice the side, in which the robot can be if it can be in all four: quick to search."""
        height, width = self.room.shape
        whole = np.pad(self.room, ((0, height % 2), (0, width % 2)))
        room = whole[::2, ::2] & whole[1::2, ::2] & whole[::2, 1::2] & whole[1::2, 1::2]
        return FreeSpace(room, self.origin_m, 2.0 * self.resolution_m, self.radius_m)

    def ways_to(self, points: Array) -> Approach:
        """The shortest ways over cells from everywhere to the nearest of some points (K, 2) in `map`, m.

        The cost grows with the number of cells; ask once for all points.
        """
        found = [(cell, k) for k, point in enumerate(points) if (cell := self.cell(point)) is not None]
        ends = dict(reversed(found))  # of two in one cell the first
        if not ends:
            return Approach(self, ends, np.full(self.room.size, -1))
        _, before, _ = dijkstra(
            self.steps, directed=False, indices=np.array(list(ends)), min_only=True, return_predecessors=True
        )
        return Approach(self, ends, before)


@dataclass(frozen=True)
class Approach:
    """Ways over cells to the nearest of some points.

    Attributes:
        space: the free space.
        ends: cell -> number of the point in it.
        onward: (H * W,) the next cell on the way from each; negative at the end of a way and where there is none.
    """

    space: FreeSpace
    ends: dict[int, int]
    onward: NDArray[np.int32]

    def way(self, point: Array) -> tuple[int, Array] | None:
        """From a point (2,) in `map`: the number of the point that is reached, and the way (K, 2) there; None if none is."""
        cell = self.space.cell(point)
        if cell is None or (cell not in self.ends and self.onward[cell] < 0):
            return None
        cells = [cell]
        while cells[-1] not in self.ends:
            cells.append(int(self.onward[cells[-1]]))
        return self.ends[cells[-1]], np.vstack([point, self.space.middles(np.array(cells[1:], dtype=np.int64))])


@cache
def _straight() -> Callable[..., None]:
    """The compiled loop; compiled on first use."""
    from hybridmap.compiled import compiled

    points = "float64[:, ::1]"
    return compiled(f"void(boolean[:, ::1], {points}, {points}, boolean[::1])")(_walk_straight)


def _walk_straight(room: Mask, starts: Array, ends: Array, out: Mask) -> None:
    """Whether every cell under the line from each start to each end (K, 2), in cells, has room; four samples a cell."""
    height, width = room.shape
    for k in range(len(out)):
        dx, dy = ends[k, 0] - starts[k, 0], ends[k, 1] - starts[k, 1]
        count = int(4.0 * max(abs(dx), abs(dy))) + 1
        out[k] = True
        for i in range(count + 1):
            column, row = int(np.floor(starts[k, 0] + dx * i / count)), int(np.floor(starts[k, 1] + dy * i / count))
            if not (0 <= row < height and 0 <= column < width and room[row, column]):
                out[k] = False
                break
