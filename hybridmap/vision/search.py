"""Nearest stored profiles by an exact search: weighted L1 distance of 8-bit profiles over shifts.

One shift against every stored profile is one `cv2.batchDistance`: profiles lie column by column, so that the columns two
views have in common at a shift are one run of bytes in every row. The few nearest of each shift hold the nearest of all.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from hybridmap.vision.profile import Profile

Indices = NDArray[np.int64]
Bytes = NDArray[np.uint8]

BLOCK = 4096
"""Rows of a block; a full block is followed by another one, without copies."""
HALF_RANGE = 4.0
"""Values beyond +- this are clipped in bands of the largest weight, in one of weight w beyond w_max/w times that. The unit is
the standard deviation of a z-normalised profile, the mean of a mean-normalised one."""


@dataclass(frozen=True, slots=True)
class Nearest:
    """Stored profiles, the nearest first; at equal distance the older first.

    Attributes:
        numbers: (k,) numbers of the profiles.
        distance: (k,) weighted mean absolute difference over the overlap, at the shift where it is least.
        shift: (k,) shift of least distance, columns; positive when things lie farther right in the query.
    """

    numbers: Indices
    distance: NDArray[np.float64]
    shift: Indices


def full_circle(width: int) -> Indices:
    """(width,) every shift of a profile that goes full circle, ascending, beginning with minus half a turn."""
    return np.arange(width) - width // 2


class Blocks:
    """An array that grows by rows; memory is taken in blocks and never moved.

    Args:
        row_length: number of values in a row.
        dtype: type of the values.
    """

    def __init__(self, row_length: int, dtype: type[np.generic]) -> None:
        self._row_length = row_length
        self._dtype = dtype
        self._blocks: list[NDArray[np.generic]] = []
        self._count = 0

    def __len__(self) -> int:
        return self._count

    def append(self, row: NDArray[np.generic]) -> None:
        """Append a copy of a row (row_length,)."""
        block, at = divmod(self._count, BLOCK)
        if block == len(self._blocks):
            self._blocks.append(np.empty((BLOCK, self._row_length), dtype=self._dtype))
        self._blocks[block][at] = row
        self._count += 1

    def filled(self) -> list[NDArray[np.generic]]:
        """All rows so far in order, as views (n, row_length), n <= BLOCK, of the memory: to be read only."""
        full, rest = divmod(self._count, BLOCK)
        return self._blocks[:full] + ([self._blocks[full][:rest]] if rest else [])

    def take(self, numbers: Indices) -> NDArray[np.generic]:
        """A copy of the rows of the given numbers (n,) in their order, (n, row_length)."""
        if len(self._blocks) == 1:
            return self._blocks[0][numbers]
        out = np.empty((len(numbers), self._row_length), dtype=self._dtype)
        block, at = np.divmod(numbers, BLOCK)
        for b in np.unique(block):
            here = block == b
            out[here] = self._blocks[b][at[here]]
        return out


class ProfileIndex:
    """Stores profiles as 8-bit numbers and searches for the nearest ones.

    The weights of the bands are part of the quantisation: a band of half the weight gets half as many steps a unit, so that
    plain sums of absolute differences are weighted ones. A band of weight 0 is not stored.

    Args:
        weights: (bands,) weights of the bands, summing to 1.
        width: columns of a profile.
        max_shift: largest shift tried, columns.
        circular: the profiles go full circle: every shift is tried, and columns wrap around.
    """

    def __init__(self, weights: NDArray[np.float64], width: int, max_shift: int, circular: bool = False) -> None:
        self._bands = np.flatnonzero(weights > 0)
        self._width = width
        self._steps = 127.0 / HALF_RANGE * (weights[self._bands] / weights.max())
        self._unit = float(weights.max()) * HALF_RANGE / 127.0
        self._rows = Blocks(width * len(self._bands), np.uint8)
        self._circular = circular
        self._shifts = full_circle(width) if circular else np.arange(-max_shift, max_shift + 1)

    def __len__(self) -> int:
        return len(self._rows)

    def add(self, profile: Profile) -> int:
        """Store a (bands, width) profile and return its number, counted from 0."""
        self._rows.append(self.quantised(profile))
        return len(self._rows) - 1

    def quantised(self, profile: Profile) -> Bytes:
        """Bytes (width * n,) of a profile (bands, width), column by column, for the n bands of positive weight.

        The weight w of a band is in them: 127/4 w/w_max steps a unit about 128, so values are clipped at +-4 w_max/w.
        """
        steps = np.asarray(profile)[self._bands].T * self._steps
        return np.asarray(np.clip(np.rint(steps) + 128.0, 1.0, 255.0).astype(np.uint8).ravel())

    def nearest(self, query: Profile, count: int, among: Indices | None = None) -> Nearest:
        """Find the nearest stored profiles, each at its best shift (common to all bands); exact for 8-bit profiles.

        A profile among the `count` nearest of all is among the `count` nearest at its own best shift; so it is enough to find
        the `count` nearest of each shift.

        Args:
            query: (bands, width).
            count: number of profiles to return at most.
            among: numbers of the stored profiles to be compared, ascending; all by default.
        """
        if among is None:
            blocks, firsts = self._rows.filled(), range(0, len(self._rows), BLOCK)
        else:
            blocks, firsts = ([self._rows.take(among)] if len(among) else []), range(1)
        sought = self.quantised(query)[None]
        found = [self._in_block(sought, block, first, count) for block, first in zip(blocks, firsts, strict=False)]
        if not found:
            nothing = np.zeros(0, dtype=np.int64)
            return Nearest(nothing, np.zeros(0), nothing)
        numbers, distance, shift = (np.concatenate(parts) for parts in zip(*found, strict=True))
        order = np.lexsort((numbers, distance))
        _, first_of = np.unique(numbers[order], return_index=True)
        best = order[np.sort(first_of)[:count]]
        chosen = numbers[best] if among is None else among[numbers[best]]
        return Nearest(chosen, distance[best] * self._unit, shift[best])

    def _in_block(
        self, sought: Bytes, block: NDArray[np.generic], first: int, count: int
    ) -> tuple[Indices, NDArray[np.float64], Indices]:
        """Numbers, mean absolute differences in steps, and shifts of the nearest of each shift."""
        import cv2

        most, bands, length = min(count, len(block)), len(self._bands), sought.shape[1]
        if self._circular:
            windows = np.lib.stride_tricks.sliding_window_view(np.concatenate([sought[0], sought[0]]), length)
            turned = windows[bands * self._shifts % length]
            sums, rows = cv2.batchDistance(turned, block, cv2.CV_32S, None, None, cv2.NORM_L1, most)
            return rows.ravel().astype(np.int64) + first, sums.ravel() / self._width, np.repeat(self._shifts, most)
        sums, rows = np.empty((2, len(self._shifts), 1, most), dtype=np.int32)
        for at, c in enumerate(self._shifts.tolist()):
            skip, overlap = bands * abs(c), length - bands * abs(c)
            if c >= 0:
                ours, theirs = sought[:, skip:], block[:, :overlap]
            else:
                ours, theirs = sought[:, :overlap], block[:, skip:]
            cv2.batchDistance(ours, theirs, cv2.CV_32S, sums[at], rows[at], cv2.NORM_L1, most)
        distance = sums.reshape(-1, most) / (self._width - np.abs(self._shifts))[:, None]
        return rows.ravel().astype(np.int64) + first, distance.ravel(), np.repeat(self._shifts, most)
