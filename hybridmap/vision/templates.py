"""Stored profiles, their comparison over shifts (eq. 12) and the combined score G (eq. 13) in its several readings."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

import numpy as np
from numpy.typing import NDArray

from hybridmap.vision.profile import Profile

Mode = Literal["literal", "ratio", "signed", "plain", "four-band"]
GBar = Literal["templates", "shifts"]
Floats = NDArray[np.float64]
Indices = NDArray[np.int64]

MODERATE_THRESHOLD: dict[Mode, float] = {"literal": 1.0, "ratio": 0.4, "signed": -0.38, "plain": 0.28, "four-band": 0.33}
"""c_t of each mode where candidates are not verified and the configuration names none (z-normalised profiles)."""


@dataclass(frozen=True, slots=True)
class Match:
    """Scores of one query against n stored profiles.

    Attributes:
        indices: (n,) numbers of the stored profiles.
        score: (n,) G; smaller is a better match in every mode but `literal`, which is inverted as printed.
        shift: (n,) best shift c_m, columns; positive when things lie farther right in the query.
    """

    indices: Indices
    score: Floats
    shift: Indices


class ProfileStore:
    """Profiles by number, with their differences to a query over all shifts. Grows by doubling."""

    def __init__(self, max_shift: int) -> None:
        self._shifts = np.arange(-max_shift, max_shift + 1)
        self._profiles = np.zeros((0, 0, 0))
        self._count = 0

    def __len__(self) -> int:
        return self._count

    @property
    def shifts(self) -> Indices:
        """(S,) the shifts tried, ascending."""
        return self._shifts

    def add(self, profile: Profile) -> int:
        """Store a (bands, width) profile and return its number."""
        bands, width = profile.shape
        if self._count == self._profiles.shape[1]:
            grown = np.zeros((bands, max(64, 2 * self._count), width))
            grown[:, : self._count] = self._profiles if self._count else 0.0
            self._profiles = grown
        self._profiles[:, self._count] = profile
        self._count += 1
        return self._count - 1

    def profile(self, number: int) -> Profile:
        """One stored profile, (bands, width) float32."""
        return self._profiles[:, number].astype(np.float32)

    def differences(self, query: Profile, indices: Indices | None = None) -> Floats:
        """g(c) of eq. 12 for each band: mean absolute difference over the overlap of query and stored profile.

        Args:
            query: (bands, width), Ij of the equation; the stored profiles are Ik.
            indices: which stored profiles; all by default.

        Returns:
            (n, bands, S) for the shifts of `shifts`.
        """
        stored = self._profiles[:, : self._count] if indices is None else self._profiles[:, indices]
        return shifted_differences(np.asarray(query, dtype=np.float64), stored, self._shifts)


def shifted_differences(query: Floats, stored: Floats, shifts: Indices) -> Floats:
    """g(c, Ij, Ik) = 1/(b - |c|) sum_{i=1..b-|c|} | Ij[i + max(c,0)] - Ik[i - min(c,0)] |  (eq. 12).

    All shifts go through one L1 distance: the shifted query is padded with zeros, and what the padding adds (the sum of
    |Ik| outside the overlap) is taken off again.

    Args:
        query: (bands, width), Ij.
        stored: (bands, n, width), Ik.
        shifts: (S,) columns, |c| < width.

    Returns:
        (n, bands, S).
    """
    from scipy.spatial.distance import cdist

    bands, width = query.shape
    n = stored.shape[1]
    source = np.arange(width)[None, :] + shifts[:, None]
    inside = (source >= 0) & (source < width)
    clipped = source.clip(0, width - 1)
    magnitude = np.abs(stored)
    out = np.empty((n, bands, len(shifts)))
    for band in range(bands):
        padded = np.where(inside, query[band][clipped], 0.0)
        total = cdist(stored[band], padded, "cityblock")
        out[:, band] = total - magnitude[band] @ (~inside).T
    return np.asarray(np.maximum(out, 0.0) / (width - np.abs(shifts)))


def band_weights(bands: int, mu_r: float, mu_d: float) -> Floats:
    """Weight of each band (mu_R over the intensity bands, mu_D over the depth bands); one lone band has all the weight."""
    if bands == 1:
        return np.ones(1)
    half = bands // 2
    return np.concatenate([np.full(half, mu_r / half), np.full(half, mu_d / half)])


def combine(
    g: Floats, shifts: Indices, mode: Mode, weights: Floats, g_bar: GBar = "templates", g_bar_of: Floats | None = None
) -> tuple[Floats, Indices]:
    """Score G and best shift of n pairs (eq. 13).

    `literal`: sum mu |g_min - g_bar|, as printed (inverted: a true match lies far from the mean); `ratio`: sum mu g_min/g_bar;
    `signed`: sum mu (g_min - g_bar); `plain` and `four-band`: sum mu g_min. In all of them each band has its own best shift.

    Args:
        g: (n, bands, S) differences.
        shifts: (S,) the shifts.
        mode: the reading of G.
        weights: (bands,) summing to 1.
        g_bar: `templates`: mean of g_min over the stored templates; `shifts`: mean of g over the shifts of the pair.
        g_bar_of: (m, bands, S) differences to all stored templates, if `g` holds only some of them.

    Returns:
        G (n,), and the shift (n,) at which the weighted sum of the bands' g(c) is smallest.
    """
    g_min = g.min(axis=2)
    if g_bar == "shifts":
        mean = g.mean(axis=2)
    else:
        mean = (g if g_bar_of is None else g_bar_of).min(axis=2).mean(axis=0, keepdims=True)
    if mode == "literal":
        terms = np.abs(g_min - mean)
    elif mode == "ratio":
        terms = g_min / np.maximum(mean, 1e-9)
    elif mode == "signed":
        terms = g_min - mean
    else:
        terms = g_min
    best = np.argmin(np.einsum("nbs,b->ns", g, weights), axis=1)
    return terms @ weights, shifts[best].astype(np.int64)


class Matcher:
    """A store of profiles with one way of scoring."""

    def __init__(self, mode: Mode, mu_r: float, mu_d: float, max_shift: int, g_bar: GBar = "templates") -> None:
        self.store = ProfileStore(max_shift)
        self._mode: Mode = mode
        self._mu = (mu_r, mu_d)
        self._g_bar: GBar = g_bar

    def add(self, profile: Profile) -> int:
        """Store a profile and return its number."""
        return self.store.add(profile)

    def score(self, query: Profile, indices: Indices) -> Match:
        """Score a query against some of the stored profiles; g_bar is over all of them where the mode has one."""
        weights = band_weights(len(query), *self._mu)
        needs_all = self._g_bar == "templates" and self._mode in ("literal", "ratio", "signed")
        every = self.store.differences(query) if needs_all else None
        g = self.store.differences(query, indices) if every is None else every[indices]
        score, shift = combine(g, self.store.shifts, self._mode, weights, self._g_bar, every)
        return Match(np.asarray(indices, dtype=np.int64), score, shift)


@dataclass(frozen=True, slots=True)
class Recognition:
    """Which template a frame shows.

    Attributes:
        template: its number.
        founded: the frame founded it.
        difference: mean absolute difference to the best template that was there before; inf for the first one.
    """

    template: int
    founded: bool
    difference: float


class ViewTemplates:
    """View templates V: one is founded when the view has been new in several consecutive frames."""

    def __init__(self, threshold: float, stable_frames: int, max_shift: int, mu_r: float, mu_d: float) -> None:
        self._matcher = Matcher("plain", mu_r, mu_d, max_shift)
        self._threshold = threshold
        self._stable_frames = stable_frames
        self._new_for = 0

    def __len__(self) -> int:
        return len(self._matcher.store)

    def recognise(self, profile: Profile) -> Recognition:
        """Find the template of a profile, or found one; until a new view is stable it goes by the nearest template."""
        count = len(self)
        if count == 0:
            return Recognition(self._matcher.add(profile), True, float("inf"))
        match = self._matcher.score(profile, np.arange(count))
        best = int(np.argmin(match.score))
        difference = float(match.score[best])
        self._new_for = self._new_for + 1 if difference > self._threshold else 0
        if self._new_for < self._stable_frames:
            return Recognition(best, False, difference)
        self._new_for = 0
        return Recognition(self._matcher.add(profile), True, difference)
