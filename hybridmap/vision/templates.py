"""Stored profiles, their comparison over shifts (eq. 12), and the score G (eq. 13) in several variants."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from functools import lru_cache
from typing import Literal

import numpy as np
from numpy.typing import NDArray

from hybridmap.vision.profile import Profile
from hybridmap.vision.search import Blocks, ProfileIndex, full_circle

Mode = Literal["literal", "ratio", "signed", "plain", "four-band"]
GBar = Literal["templates", "shifts"]
Floats = NDArray[np.float64]
Indices = NDArray[np.int64]

MODERATE_THRESHOLD: dict[Mode, float] = {"literal": 1.0, "ratio": 0.4, "signed": -0.38, "plain": 0.28, "four-band": 0.33}
"""c_t of each mode where candidates are not verified and the configuration names none (z-normalised profiles)."""
RELATIVE: tuple[Mode, ...] = ("literal", "ratio", "signed")
"""Readings of G that compare with a mean."""
FEWEST = 5
"""Least number of candidates of the search; G, with a shift for each band, ranks them."""


@dataclass(frozen=True, slots=True)
class Match:
    """Scores of one profile (the query) against n stored profiles.

    Attributes:
        indices: (n,) numbers of the stored profiles.
        score: (n,) G of eq. 13; smaller is better, but the mode `literal` is inverted (see `combine`).
        shift: (n,) best shift c_m, columns; positive when things lie farther right in the query.
    """

    indices: Indices
    score: Floats
    shift: Indices


_NOTHING = Match(np.zeros(0, dtype=np.int64), np.zeros(0), np.zeros(0, dtype=np.int64))


class ProfileStore:
    """Stored profiles, compared with a query over all shifts. Grows by blocks, without copies.

    Args:
        max_shift: largest shift tried, columns.
        circular: the profiles go full circle: every shift is tried, with full overlap, so that a place is recognised at any
            heading.
    """

    def __init__(self, max_shift: int, circular: bool = False) -> None:
        self._shifts = np.arange(-max_shift, max_shift + 1)
        self._circular = circular
        self._shape = (0, 0)
        self._rows = Blocks(0, np.float32)

    def __len__(self) -> int:
        return len(self._rows)

    @property
    def shifts(self) -> Indices:
        """(S,) horizontal shifts, in columns, at which a new profile is compared with the stored ones; ascending."""
        return self._shifts

    def add(self, profile: Profile) -> int:
        """Store a (bands, width) profile and return its number, counted from 0; all must have the shape of the first."""
        if not len(self):
            self._shape = (profile.shape[0], profile.shape[1])
            self._rows = Blocks(profile.size, np.float32)
            if self._circular:
                self._shifts = full_circle(profile.shape[1])
        self._rows.append(profile.ravel())
        return len(self) - 1

    def profile(self, number: int) -> Profile:
        """One stored profile, (bands, width) float32."""
        return self._rows.take(np.array([number])).reshape(self._shape).astype(np.float32)

    def differences(self, query: Profile, indices: Indices | None = None) -> Floats:
        """g(c) of eq. 12 for each band: mean absolute difference over the overlap of query and stored profile.

        Args:
            query: (bands, width), Ij of the equation; the stored profiles are Ik.
            indices: numbers of the stored profiles to be compared; all by default.

        Returns:
            (n, bands, S), for the S shifts of the property `shifts`.
        """
        numbers = np.arange(len(self)) if indices is None else indices
        stored = self._rows.take(numbers).reshape(len(numbers), *self._shape).transpose(1, 0, 2)
        return shifted_differences(np.asarray(query, dtype=np.float64), stored.astype(np.float64), self._shifts, self._circular)


def shifted_differences(query: Floats, stored: Floats, shifts: Indices, circular: bool = False) -> Floats:
    """g(c, Ij, Ik) = 1/(b - |c|) sum_{i=1..b-|c|} | Ij[i + max(c,0)] - Ik[i - min(c,0)] |  (eq. 12).

    One L1 distance serves all shifts: the shifted query is padded with zeros, and the sum of |Ik| outside the overlap is
    subtracted.

    Args:
        query: (bands, width), Ij.
        stored: (bands, n, width), Ik.
        shifts: (S,) columns, |c| < width.
        circular: columns that leave on one side come in on the other; the overlap is always whole.

    Returns:
        (n, bands, S).
    """
    from scipy.spatial.distance import cdist

    bands, width = query.shape
    table = _overlaps(width, tuple(shifts.tolist()), circular)
    margin = query if circular else np.zeros((bands, width))
    padded = np.concatenate([margin, query, margin], axis=1)[:, table.source]
    out = np.abs(stored) @ table.outside
    for band in range(bands):
        np.subtract(cdist(stored[band], padded[band], "cityblock"), out[band], out=out[band])
    out = np.maximum(out, 0.0) / table.overlap
    return out.transpose(1, 0, 2)


@dataclass(frozen=True, slots=True)
class _Overlaps:
    """Tables of a width and its shifts: columns of the padded query (S, width), what lies outside (width, S), overlaps (S,)."""

    source: Indices
    outside: Floats
    overlap: Floats


@lru_cache(maxsize=16)
def _overlaps(width: int, shifts: tuple[int, ...], circular: bool) -> _Overlaps:
    source = np.arange(width)[None, :] + np.array(shifts)[:, None]
    outside = ((source < 0) | (source >= width)) & (not circular)
    return _Overlaps(source + width, outside.T.astype(np.float64), width - outside.sum(axis=1).astype(np.float64))


def band_weights(bands: int, mu_r: float, mu_d: float) -> Floats:
    """Weight (bands,) of each band of a profile: mu_R over the first half (intensity), mu_D over the second half (depth).

    One lone band has all the weight.
    """
    if bands == 1:
        return np.ones(1)
    half = bands // 2
    return np.concatenate([np.full(half, mu_r / half), np.full(half, mu_d / half)])


def combine(
    g: Floats, shifts: Indices, mode: Mode, weights: Floats, g_bar: GBar = "templates", g_bar_of: Floats | None = None
) -> tuple[Floats, Indices]:
    """Score G and best shift of n pairs of profiles (eq. 13), in one of several ways (modes).

    `literal`: sum mu |g_min - g_bar|, as printed (inverted: a true match lies far from the mean); `ratio`: sum mu g_min/g_bar;
    `signed`: sum mu (g_min - g_bar); `plain` and `four-band`: sum mu g_min. In all of them each band has its own best shift;
    g_min is its least difference over the shifts, mu its weight.

    Args:
        g: (n, bands, S) differences.
        shifts: (S,) the shifts.
        mode: which of the formulas above is G.
        weights: (bands,) mu, summing to 1.
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
    """Stores profiles and scores a query against them.

    Args:
        mode: formula of the score, see `combine`.
        mu_r, mu_d: weights of intensity and depth.
        max_shift: largest shift tried, columns.
        g_bar: see `combine`.
        sequence: number of views in a row that are compared (as in SeqSLAM); 1: single views.
        circular: the profiles go full circle, see `ProfileStore`.

    Attributes:
        store: the profiles.
    """

    def __init__(
        self,
        mode: Mode,
        mu_r: float,
        mu_d: float,
        max_shift: int,
        g_bar: GBar = "templates",
        sequence: int = 1,
        circular: bool = False,
    ) -> None:
        self.store = ProfileStore(max_shift, circular)
        self._max_shift = max_shift
        self._circular = circular
        self._index: ProfileIndex | None = None
        self._mode: Mode = mode
        self._mu = (mu_r, mu_d)
        self._g_bar: GBar = g_bar
        self._sequence = sequence

    def add(self, profile: Profile) -> int:
        """Store a (bands, width) profile and return its number, counted from 0."""
        if self._index is None:
            weights = band_weights(len(profile), *self._mu)
            self._index = ProfileIndex(weights, profile.shape[1], self._max_shift, self._circular)
        self._index.add(profile)
        return self.store.add(profile)

    def score(self, query: Profile, indices: Indices) -> Match:
        """Return the scores (n,) of a query against the stored profiles with the numbers `indices`, in their order.

        If the score uses the mean difference `g_bar`, that is the mean over all stored profiles, not only over `indices`.
        """
        weights = band_weights(len(query), *self._mu)
        every = self.store.differences(query) if self._mode in RELATIVE and self._g_bar == "templates" else None
        g = self.store.differences(query, indices) if every is None else every[indices]
        score, shift = combine(g, self.store.shifts, self._mode, weights, self._g_bar, every)
        return Match(np.asarray(indices, dtype=np.int64), score, shift)

    def best(self, query: Profile, count: int, among: Indices | None = None, ending_at: int | None = None) -> Match:
        """Find the stored profiles with the smallest scores G, the smallest first: in the mode `literal` too, as printed.

        In the modes `plain` and `four-band` this is an exact search over 8-bit profiles, then a full score of the nearest. The
        other modes need the score of every profile and compute them all.

        Args:
            query: (bands, width).
            count: number of profiles to return at most.
            among: numbers of the stored profiles to be compared, ascending; by default all, the query too if it is stored.
            ending_at: number under which the query itself is stored, to compare sequences; None: compare single views.
        """
        numbers = np.arange(len(self.store)) if among is None else among
        if self._index is None or count < 1 or len(numbers) == 0:
            return _NOTHING
        searched = max(count, FEWEST)
        if self._mode not in RELATIVE and len(numbers) > searched:
            numbers = np.sort(self._index.nearest(query, searched, among).numbers)
        match = self.score(query, numbers)
        if self._sequence > 1 and ending_at is not None:
            earlier = self._of_earlier(ending_at)
            score = in_sequence(match.score, match.indices, ending_at, self._sequence, earlier, self._circular)
            match = Match(match.indices, score, match.shift)
        order = np.argsort(match.score, kind="stable")[:count]
        return Match(match.indices[order], match.score[order], match.shift[order])

    def _of_earlier(self, ending_at: int) -> Callable[[int, Indices], Floats]:
        return lambda back, numbers: self.score(self.store.profile(ending_at - back), numbers).score


def in_sequence(
    scores: Floats,
    indices: Indices,
    ending_at: int,
    sequence: int,
    earlier: Callable[[int, Indices], Floats],
    both_ways: bool = False,
) -> Floats:
    """Mean score over the last views, each compared with the stored profiles seen just before (as in SeqSLAM).

    For each view the best of three neighbouring stored profiles counts. Views without a partner, at the beginning of the drive,
    are left out.

    Args:
        scores: (n,) of the last view.
        indices: (n,) numbers of the stored profiles that the last view was compared with.
        ending_at: number of the last view itself.
        sequence: number of views in a row.
        earlier: (how many views back, (m,) numbers, ascending) -> (m,) scores of that view against those profiles.
        both_ways: the stored views may also have been seen in the opposite order; the better of the two counts.

    Returns:
        (n,) mean scores.
    """
    directions = (-1, 1) if both_ways else (-1,)
    means = [_mean_along(scores, indices, ending_at, sequence, earlier, step) for step in directions]
    return np.asarray(np.min(means, axis=0))


def _mean_along(
    scores: Floats, indices: Indices, ending_at: int, sequence: int, earlier: Callable[[int, Indices], Floats], step: int
) -> Floats:
    total, views = scores.copy(), np.ones(len(scores))
    for back in range(1, min(sequence, ending_at + 1)):
        partners = indices[:, None] + step * back + np.arange(-1, 2)
        known = (partners >= 0) & (partners < ending_at - back)
        numbers = np.unique(partners[known])
        if len(numbers) == 0:
            break
        at = np.searchsorted(numbers, partners).clip(0, len(numbers) - 1)
        of_partner = np.where(known, earlier(back, numbers)[at], np.inf).min(axis=1)
        total += np.where(known.any(axis=1), of_partner, 0.0)
        views += known.any(axis=1)
    return np.asarray(total / views)


@dataclass(frozen=True, slots=True)
class Recognition:
    """The view template that a frame was recognised as.

    Attributes:
        template: number of the template: the nearest one, even where it does not match yet, or the new one.
        founded: whether a new template was made from this frame.
        difference: mean absolute difference to the nearest older template, a match up to the threshold; inf for the first one.
        shift: best shift against the template, columns; positive when things lie farther right in the frame.
    """

    template: int
    founded: bool
    difference: float
    shift: int


THRESHOLD = 0.5
"""A view is new when its profile differs by more than this from every template (mean absolute difference of z-normalised
profiles): two views of one place a step apart differ by less."""
STABLE_FRAMES = 3
"""A view founds a template once it is new in so many consecutive frames: a blurred frame founds none."""


class ViewTemplates:
    """View templates: profiles of distinct views. A new one is made once several consecutive frames match none.

    Args:
        max_shift: largest shift tried, columns.
        mu_r, mu_d: weights of intensity and depth.
        threshold: largest difference of two views that are one.
        stable_frames: consecutive frames that must match no template before a new one is made.
    """

    def __init__(
        self, max_shift: int, mu_r: float, mu_d: float, threshold: float = THRESHOLD, stable_frames: int = STABLE_FRAMES
    ) -> None:
        self._matcher = Matcher("plain", mu_r, mu_d, max_shift)
        self._threshold, self._stable_frames = threshold, stable_frames
        self._new_for = 0

    def __len__(self) -> int:
        return len(self._matcher.store)

    def recognise(self, profile: Profile) -> Recognition:
        """Recognise the profile of the next frame as one of the view templates.

        A new template is made from it if it and the frames just before match none; until then the nearest template is returned.
        """
        if len(self) == 0:
            return Recognition(self._matcher.add(profile), True, float("inf"), 0)
        match = self._matcher.best(profile, 1)
        best, difference, shift = int(match.indices[0]), float(match.score[0]), int(match.shift[0])
        self._new_for = self._new_for + 1 if difference > self._threshold else 0
        if self._new_for < self._stable_frames:
            return Recognition(best, False, difference, shift)
        self._new_for = 0
        return Recognition(self._matcher.add(profile), True, difference, 0)
