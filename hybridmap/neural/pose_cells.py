"""RatSLAM's pose cells: a continuous attractor network over place and heading, moved by self-motion and held by views.

The network is that of Milford and Wyeth (2004, 2008), written anew from its description, with the constants that Ball et al.
published with OpenRatSLAM (2013). An iteration is: input of the view, local excitation, local and global inhibition,
normalisation, and path integration. The cells wrap in all three directions, so that one cell stands for many places.

The cells' grid holds a packet back: it lags by 3 % where it moves 0.1 m an iteration, by 8 % at 0.05 m. Views make up for it.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike, NDArray

from hybridmap.geometry import Array

Indices = NDArray[np.int64]

SIDE, HEADINGS = 30, 36
"""Cells along x' and y', and along theta'."""
CELL_M, CELL_RAD = 0.25, 2.0 * math.pi / HEADINGS
"""Size of a cell, m and rad: a packet is some cells wide, and a place is told to about a metre before the network repeats."""
EXCITATION_CELLS, EXCITATION_VARIANCE = 7, 1.0
INHIBITION_CELLS, INHIBITION_VARIANCE = 5, 2.0
"""Width of the cube of cells that a cell excites or inhibits, and the variance of the weights' Gaussian, cells and cells^2."""
GLOBAL_INHIBITION = 2e-5
"""Activity that every cell loses in an iteration; all activity sums to 1. Of two packets the weaker one dies by it."""
INJECTED = 0.1
"""Activity that a view adds at the cell where it was first seen, if it was not seen lately."""
SEEN, RESTORED, SATURATION = 1.0, 0.05, 30.0
"""A view loses `SEEN` of its freshness each time that it is seen again, and every view regains `RESTORED` in every iteration,
until only `SEEN` is lost. It adds a share of 1 - exp(1.2 * freshness lost) / `SATURATION` of the above, which is 89 % when it
is fresh, 63 % right after that, and nothing the third time in a row."""
YOUNG_VIEWS = 10
"""The newest views add nothing: they were learnt at the packet as it is."""
AVERAGED_CELLS = 3
"""Cells on either side of the most active one whose mean is the decoded place."""
_SIZE = np.array([SIDE, SIDE, HEADINGS], dtype=np.float64)
_SETTLING = 10


@dataclass(slots=True)
class _Association:
    """Where the packet was when a view was first seen, (3,) cells, and how much of its freshness the view has lost."""

    place: Array
    lost: float = SEEN


class PoseCells:
    """The network and its associations with views.

    The cost of an iteration grows with the number of active cells, and with that of the views that have not regained their
    freshness: in the mean over a drive at most 1 / `RESTORED` of them, however many views there are.

    Attributes:
        activity: (HEADINGS, SIDE, SIDE) by theta', x' and y', not negative, of sum 1.
    """

    def __init__(self) -> None:
        """Begin with one packet in the middle."""
        self.activity: Array = np.zeros((HEADINGS, SIDE, SIDE))
        self.activity[HEADINGS // 2, SIDE // 2, SIDE // 2] = 1.0
        self._views: list[_Association] = []
        self._tired: dict[int, _Association] = {}
        for _ in range(_SETTLING):
            self._settle()

    def __len__(self) -> int:
        """Number of views that were seen."""
        return len(self._views)

    def step(self, view: int, delta_robot: ArrayLike, turned_rad: float = 0.0) -> Array:
        """Do one iteration, and return where the packet is, as `place`.

        Args:
            view: number of the view that is seen; the next unused number makes a new one, learnt at the packet after the step.
            delta_robot: (3,) motion since the last iteration, m and rad, in the frame of the robot before it.
            turned_rad: heading of the robot now seen from where the view was first seen, rad.
        """
        if view < len(self._views):
            self._inject(view, turned_rad)
        self._settle()
        self._integrate(*np.asarray(delta_robot, dtype=np.float64).tolist())
        for number, tired in list(self._tired.items()):
            tired.lost = max(tired.lost - RESTORED, SEEN)
            if tired.lost == SEEN:
                del self._tired[number]
        if view < len(self._views):
            self._views[view].lost += SEEN
            self._tired[view] = self._views[view]
        else:
            self._views.append(_Association(self.place))
        return self.place

    @property
    def place(self) -> Array:
        """(3,) x', y' and theta' of the strongest packet, cells: the mean of the activity around the most active cell."""
        peak = np.array(np.unravel_index(int(np.argmax(self.activity)), self.activity.shape))
        offsets = np.arange(-AVERAGED_CELLS, AVERAGED_CELLS + 1)
        block = self.activity[np.ix_(*((peak[:, None] + offsets) % np.array(self.activity.shape)[:, None]))]
        means = [float(block.sum(axis=others) @ offsets) / float(block.sum()) for others in _OTHER_AXES]
        theta, x, y = (peak + means).tolist()
        return np.array([x, y, theta]) % _SIZE

    def _inject(self, view: int, turned_rad: float) -> None:
        known = self._views[view]
        share = 1.0 - math.exp(1.2 * known.lost) / SATURATION
        if share > 0.0 and view < len(self._views) - YOUNG_VIEWS:
            x, y, theta = np.rint(known.place + np.array([0.0, 0.0, turned_rad / CELL_RAD])).astype(np.int64).tolist()
            self.activity[theta % HEADINGS, x % SIDE, y % SIDE] += INJECTED * share

    def _settle(self) -> None:
        """Excite, inhibit and normalise: among the active cells, and those that they excite."""
        active = _active(self.activity)
        reached = [np.flatnonzero(weights[:, cells].any(axis=1)) for weights, cells in zip(_EXCITATION, active, strict=True)]
        excited = _spread(self.activity[np.ix_(*active)], _EXCITATION, active, reached)
        inhibited = excited - _spread(excited, _INHIBITION, reached, reached)
        left = np.maximum(np.maximum(inhibited, 0.0) - GLOBAL_INHIBITION, 0.0)
        self.activity = np.zeros_like(self.activity)
        self.activity[np.ix_(*reached)] = left / left.sum()

    def _integrate(self, forward_m: float, left_m: float, turn_rad: float) -> None:
        """Shift each layer of heading along its own direction, and then all layers by the turn; fractions are interpolated."""
        theta, x, y = _active(self.activity)
        cos, sin = np.cos(theta * CELL_RAD), np.sin(theta * CELL_RAD)
        shifts = np.stack([cos * forward_m - sin * left_m, sin * forward_m + cos * left_m]) / CELL_M
        whole = np.floor(shifts).astype(np.int64)
        fraction = shifts - whole
        block, moved = self.activity[np.ix_(theta, x, y)], np.zeros_like(self.activity)
        for right in (0, 1):
            for up in (0, 1):
                weight = np.abs(1 - right - fraction[0]) * np.abs(1 - up - fraction[1])
                to_x, to_y = (x + whole[0, :, None] + right) % SIDE, (y + whole[1, :, None] + up) % SIDE
                moved[theta[:, None, None], to_x[:, :, None], to_y[:, None, :]] += weight[:, None, None] * block
        turn = turn_rad / CELL_RAD
        layers = math.floor(turn)
        part = turn - layers
        self.activity = (1.0 - part) * np.roll(moved, layers, axis=0) + part * np.roll(moved, layers + 1, axis=0)


def apart_cells(places: ArrayLike, place: ArrayLike) -> Array:
    """Distance of places (..., 3) from one (3,), cells, a cell of theta' counting as one of x': the network wraps."""
    difference = np.abs(np.asarray(places, dtype=np.float64) - np.asarray(place, dtype=np.float64)) % _SIZE
    return np.asarray(np.linalg.norm(np.minimum(difference, _SIZE - difference), axis=-1))


def _active(activity: Array) -> list[Indices]:
    """Indices along each axis in whose range all active cells lie."""
    return [np.flatnonzero(activity.any(axis=others)) for others in _OTHER_AXES]


def _spread(block: Array, weights: Sequence[Array], sources: Sequence[Indices], targets: Sequence[Indices]) -> Array:
    """Sum of a block of activity at `targets`, weighted by a kernel that is a product over the axes."""
    theta, x, y = (w[np.ix_(to, of)] for w, to, of in zip(weights, targets, sources, strict=True))
    turned = (theta @ block.reshape(len(block), -1)).reshape(len(theta), *block.shape[1:])
    return np.asarray(x @ turned @ y.T)


def _weights(cells: int, variance: float) -> tuple[Array, Array, Array]:
    """Weights (n, n) along each axis: a Gaussian, cut off and of sum 1, that wraps."""
    offsets = np.arange(cells) - cells // 2
    line = np.exp(-(offsets**2) / (2.0 * variance))
    line /= line.sum()
    rings = {}
    for size in (HEADINGS, SIDE):
        ring = np.zeros(size)
        ring[offsets % size] = line
        rings[size] = np.stack([np.roll(ring, shift) for shift in range(size)])
    return rings[HEADINGS], rings[SIDE], rings[SIDE]


_OTHER_AXES = ((1, 2), (0, 2), (0, 1))
_EXCITATION = _weights(EXCITATION_CELLS, EXCITATION_VARIANCE)
_INHIBITION = _weights(INHIBITION_CELLS, INHIBITION_VARIANCE)
