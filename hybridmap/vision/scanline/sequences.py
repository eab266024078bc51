"""Views compared along a stretch of the way: G of equation 13, averaged over consecutive nodes (as in SeqSLAM)."""

from __future__ import annotations

from collections import deque

import numpy as np
from numpy.typing import NDArray

from hybridmap.config.vision import MatchingConfig
from hybridmap.geometry import Array
from hybridmap.vision.profile import Profile
from hybridmap.vision.templates import ProfileStore, band_weights

Indices = NDArray[np.int64]


class Sequences:
    """Scores every stretch of nodes that was driven against the stretch that ends at the newest node.

    The score of an older node j is the mean over the last L nodes i - k of the least G between node i - k and the nodes
    j - k - 1 to j - k + 1. It is infinite where one of the two stretches is shorter than L. Views without any contrast, such as
    scans without a return, are all alike and match none.

    Attributes:
        length: L, number of nodes of a stretch.
        scores: (N,) of all nodes against the newest; infinite for the newest itself.
        single: (N,) G of the views alone.
        shifts: (N,) best shift of each view against the newest, columns, with a fraction; positive when things lie at higher
            columns in the newest.
    """

    def __init__(self, settings: MatchingConfig, max_shift: int) -> None:
        """Start without nodes."""
        self.length = settings.sequence
        self._mu = (settings.mu_r, settings.mu_d)
        self._store = ProfileStore(max_shift)
        self._rows: deque[Array] = deque(maxlen=max(self.length - 1, 1))
        self._blank: list[bool] = []
        self.scores = self.single = self.shifts = np.zeros(0)

    def add(self, profile: Profile) -> None:
        """Add the view of the next node, and compare it with all others."""
        number = self._store.add(profile)
        weights = band_weights(len(profile), *self._mu)
        differences = self._store.differences(profile)
        self.single = differences.min(axis=2) @ weights
        self._blank.append(not np.ptp(profile, axis=1).any())
        self.single[number if not self._blank[number] else slice(None)] = np.inf
        self.single[np.array(self._blank)] = np.inf
        self.shifts = _best_shifts(np.einsum("nbs,b->ns", differences, weights), self._store.shifts)
        total = self.single.copy()
        for back, row in enumerate(reversed(self._rows), 1):
            if back == self.length:
                break
            total[back:] += row[: len(total) - back]
            total[:back] = np.inf
        complete = number + 1 >= self.length
        self.scores = total / self.length if complete else np.full(len(total), np.inf)
        beside = np.concatenate([[np.inf], self.single, [np.inf]])
        self._rows.append(np.minimum(np.minimum(beside[:-2], beside[1:-1]), beside[2:]))

    def offset_nodes(self, node: int) -> float:
        """Where the best score near a node lies, in nodes from it, by a parabola; 0 where the score is no minimum."""
        low, here, high = (float(s) for s in self.scores[node - 1 : node + 2]) if 0 < node < len(self.scores) - 1 else (0,) * 3
        bend = low - 2.0 * here + high
        return 0.5 * (low - high) / bend if np.isfinite(bend) and bend > 1e-9 and here <= min(low, high) else 0.0


def _best_shifts(totals: Array, shifts: Indices) -> Array:
    """(n,) shift of least total (n, S), refined by a parabola."""
    rows = np.arange(len(totals))
    best = np.argmin(totals, axis=1)
    inner = np.clip(best, 1, len(shifts) - 2)
    low, here, high = totals[rows, inner - 1], totals[rows, inner], totals[rows, inner + 1]
    bend = low - 2.0 * here + high
    fraction = np.where((inner == best) & (bend > 1e-12), 0.5 * (low - high) / np.maximum(bend, 1e-12), 0.0)
    return np.asarray(shifts[best] + fraction)
