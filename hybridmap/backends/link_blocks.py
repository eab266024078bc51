"""Many sweeps over links at one theta, a block of them at a time.

Correcting headings is linear, and so are positions once the heading of each link's source at the time of its visit is
known. With few levels of links a whole sweep is therefore one sparse matrix, and what is not linear (the rotations, the
wrapping of errors) is done for a block of sweeps at once. The result is that of `Links.sweep` to rounding; an error that
would wrap in the middle of a sweep is wrapped at its start.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy.sparse import coo_array, csr_array, eye_array, tril

from hybridmap.backends.links import Complex, Links, Planar
from hybridmap.geometry import Array

_BLOCK = 16  # sweeps a block
_SMALL_RAD = 0.1  # up to here a rotation is a short series
_NEGLIGIBLE = 1e-18
_HUB = 64  # mean number of links that a link meets at its ends, from which matrices are too full
_TURN = 2.0 * np.pi


@dataclass(frozen=True, slots=True)
class Relaxed:
    """Where a run of sweeps ended.

    Attributes:
        poses: after them.
        sweeps: how many were done.
        settled: whether the last one moved nothing by more than the tolerance.
    """

    poses: Planar
    sweeps: int
    settled: bool


def affordable(links: Links, n_nodes: int) -> bool:
    """Whether the matrices of a graph are sparse; those of large hubs are not."""
    degree = np.bincount(np.concatenate([links.sources, links.targets]), minlength=n_nodes)
    return float(np.sum(degree**2)) <= _HUB * len(links.order)


class BlockSweeps:
    """One graph's links at one theta."""

    def __init__(self, links: Links, n_nodes: int, theta: float) -> None:
        self._links = links
        e = len(links.order)
        signs = np.concatenate([np.ones(e), -np.ones(e)])
        ends = np.concatenate([links.sources, links.targets])
        # A link's unit correction moves its source by +1 and its target by -1.
        moves = coo_array((signs, (ends, np.tile(np.arange(e), 2))), shape=(n_nodes, e)).tocsr()
        corrections = theta * _inverse(csr_array(tril(moves.T @ moves, k=-1) * theta))
        self._earlier = csr_array(tril(csr_array(moves[links.sources]), k=-1) @ corrections)
        self._pull = csr_array(moves @ corrections)
        self._map = csr_array(eye_array(n_nodes) - self._pull @ moves.T)
        self._complex_map = self._map.astype(np.complex128)

    def run(self, poses: Planar, most: int, tolerance: float) -> Relaxed:
        """Sweep until nothing moves by more than `tolerance` (m or rad), at most so often."""
        done, block = 0, _BLOCK
        while done < most:
            asked = min(block, most - done)
            yaw, headings = self._turn(poses.yaw, asked)
            block = min(2 * block, _BLOCK) if len(headings) == asked else max(block // 2, 1)
            position = self._shift(poses.position, headings)
            moved = np.maximum(_largest_steps(position.view(np.float64)), _largest_steps(yaw))
            still = np.flatnonzero(moved <= tolerance)
            if len(still):
                last = int(still[0]) + 1
                return Relaxed(Planar(position[last], yaw[last]), done + last, settled=True)
            poses = Planar(position[-1], yaw[-1])
            done += len(headings)
            if not np.isfinite(moved).all():
                break
        return Relaxed(poses, done, settled=False)

    def _turn(self, yaw: Array, sweeps: int) -> tuple[Array, Array]:
        """Headings (K + 1, N) before and after each of up to so many sweeps, and of each link's source at its visit (K, E).

        The errors' windings are those at the first sweep; where one changes the block ends.
        """
        links = self._links
        error = yaw[links.targets] - yaw[links.sources] - links.turns
        turns = links.turns + _TURN * np.rint(error / _TURN)
        pull = self._pull @ turns
        states = np.empty((sweeps + 1, len(yaw)))
        states[0] = yaw
        for sweep in range(sweeps):
            yaw = self._map @ yaw
            yaw -= pull
            states[sweep + 1] = yaw
        at_source = states[:-1].take(links.sources, axis=1)
        errors = states[:-1].take(links.targets, axis=1)
        errors -= at_source
        errors -= turns
        wound = np.flatnonzero(np.maximum(errors.max(axis=1), -errors.min(axis=1)) > 1.0000001 * np.pi)
        good = max(int(wound[0]), 1) if len(wound) else sweeps
        at_source += (self._earlier @ np.ascontiguousarray(errors.T)).T
        return states[: good + 1], at_source[:good]

    def _shift(self, position: Complex, headings: Array) -> Complex:
        """Positions (K + 1, N) before and after each sweep."""
        sweeps = len(headings)
        pull = (self._pull @ np.ascontiguousarray(_rotated(self._links.steps, headings).T)).T
        pulls = pull[:sweeps] + 1j * pull[sweeps:]
        states = np.empty((sweeps + 1, len(position)), dtype=np.complex128)
        states[0] = position
        for sweep in range(sweeps):
            position = np.asarray(self._complex_map @ position)
            position -= pulls[sweep]
            states[sweep + 1] = position
        return states


def _inverse(strictly_lower: csr_array) -> csr_array:
    """(I + L)^-1 as I - L + L^2 - ...; L is nilpotent, and its powers fade."""
    power = total = csr_array(eye_array(strictly_lower.shape[0]))
    while True:
        power = csr_array(-(strictly_lower @ power))
        power.data[np.abs(power.data) < _NEGLIGIBLE] = 0.0
        power.eliminate_zeros()
        if power.nnz == 0:
            return csr_array(total)
        total = total + power


def _rotated(steps: Complex, headings: Array) -> Array:
    """Steps (E,) turned by headings (K, E): all x, then all y, (2 K, E).

    Within a block headings change little: then the rotation since its first sweep is summed from its series.
    """
    sweeps = len(headings)
    by = headings - headings[0]
    largest = float(max(by.max(initial=0.0), -by.min(initial=0.0)))
    start = steps * np.exp(1j * headings[0])
    cos, sin = _series(by, largest) if largest <= _SMALL_RAD else (np.cos(by), np.sin(by))
    x, y = start.real.copy(), start.imag.copy()
    out = np.empty((2 * sweeps, len(steps)))
    np.subtract(x * cos, y * sin, out=out[:sweeps])
    np.add(y * cos, x * sin, out=out[sweeps:])
    return out


def _series(angle: Array, largest: float) -> tuple[Array, Array]:
    """Cosine and sine of small angles, by as many terms as the largest of them needs."""
    terms, size = 1, 0.5 * largest**2
    while size > 1e-17 and terms < 8:
        terms += 1
        size *= largest**2 / ((2 * terms) * (2 * terms - 1))
    square = angle * angle
    cos, sin = np.ones_like(angle), np.ones_like(angle)
    for k in range(terms, 0, -1):
        cos *= square
        cos *= -1.0 / ((2 * k) * (2 * k - 1))
        cos += 1.0
        sin *= square
        sin *= -1.0 / ((2 * k) * (2 * k + 1))
        sin += 1.0
    return cos, np.asarray(sin * angle)


def _largest_steps(states: Array) -> Array:
    """Largest change (K,) of a coordinate in each of K sweeps, from states (K + 1, M)."""
    change = states[1:] - states[:-1]
    return np.asarray(np.maximum(change.max(axis=1), -change.min(axis=1)))
