"""Measures of rate maps and tuning curves used in physiology: gridness, stripes, single fields, information, tuning."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal, NamedTuple

import numpy as np
from numpy.typing import NDArray

from hybridmap.geometry import Array

_FIELD_THRESHOLD = 0.2
_SMALLEST_FIELD_BINS = 3
_LARGEST_SHARE = 0.5
_CENTRAL_PEAK = 0.5
_WIDEST_CIRCLE = 0.9
"""Radius of Langston's largest circle over the shorter side of the map: 90 cm in her arena of 1 m."""
_CENTRE_ENDS = 0.2
"""Correlation below which the central peak ends for Langston."""
_CIRCLES = 3
"""Circles of neighbouring radii whose mean is one score: a single thin ring around the centre scores anything."""
_TURNS_DEG = (60.0, 120.0, 30.0, 90.0, 150.0)


@dataclass(frozen=True, slots=True)
class Stripe:
    """The strongest plane wave of a rate map.

    Attributes:
        orientation_rad: direction in which the rate changes, from the first axis of the map to the second, in [0, pi).
        period_m: distance between two stripes.
    """

    orientation_rad: float
    period_m: float


def autocorrelogram(rates: Array) -> Array:
    """Pearson correlation of a rate map (H, W) with itself at every lag, (2H-1, 2W-1), zero lag in the middle.

    Only bins that both shifted maps cover count, and of these the ones that are not NaN (never visited); lags with fewer than
    20 such bins are 0 (Sargolini et al. 2006).
    """
    from scipy import fft

    shape = [fft.next_fast_len(2 * count - 1, real=True) for count in rates.shape]
    lags = np.ix_(*[np.arange(1 - count, count) for count in rates.shape])
    visited = np.isfinite(rates)
    map_ = np.where(visited, rates - rates[visited].mean(), 0.0)
    one, first, square = (np.fft.rfft2(values, shape) for values in (visited.astype(np.float64), map_, map_ * map_))

    def correlate(a: NDArray[np.complexfloating], b: NDArray[np.complexfloating]) -> Array:
        return np.asarray(np.fft.irfft2(a * np.conj(b), shape)[lags])

    n, sums, squares = np.round(correlate(one, one)), correlate(first, one), correlate(square, one)
    other_sums, other_squares = sums[::-1, ::-1], squares[::-1, ::-1]  # of the map that is not shifted
    variance = (n * squares - sums**2) * (n * other_squares - other_sums**2)
    covariance = n * correlate(first, first) - sums * other_sums
    seen = (n >= 20) & (variance > 1e-12 * variance.max())
    return np.where(seen, covariance / np.sqrt(np.where(seen, variance, 1.0)), 0.0)


class GridScores(NamedTuple):
    """Two grid scores of one rate map, each at most 2; NaN where there is none.

    Attributes:
        sargolini: on the annulus that holds the six inner peaks (Sargolini et al. 2006).
        langston: the highest on circles that grow around the central peak, without it (Langston et al. 2010).
    """

    sargolini: float
    langston: float


def gridness(rates: Array) -> float:
    """Grid score of a rate map (H, W) after Sargolini; see `grid_scores`."""
    return grid_scores(rates).sargolini


def grid_scores(rates: Array) -> GridScores:
    """Both grid scores of a rate map (H, W), which is NaN where nobody was.

    Part of the autocorrelogram is correlated with itself turned: min(60, 120 degrees) - max(30, 90, 150 degrees). Sargolini's
    annulus goes from the radius of the central peak, where it falls to a half, to the mean distance of the six inner peaks
    plus that radius. Langston's circles grow bin by bin, to 0.9 of the map's shorter side. They leave out the central peak to
    where it falls below 0.2, or to the first minimum of the mean correlation over distance. Her score is the highest mean of
    three neighbouring circles.

    Returns:
        The scores. Sargolini's is NaN where there are no six peaks, or the annulus does not fit into the autocorrelogram.
    """
    correlation = autocorrelogram(rates)
    half = min(correlation.shape) // 2
    row, column = np.array(correlation.shape) // 2
    if correlation[row, column] < _CENTRAL_PEAK:  # a map that is the same everywhere
        return GridScores(float("nan"), float("nan"))
    window = correlation[row - half : row + half + 1, column - half : column + half + 1]
    rings = _rings_of(window)
    distances, inner = _inner_peaks(correlation)
    outer = float(distances.mean()) + inner if len(distances) == 6 else np.inf
    sargolini = float(rings.scores(inner, np.array([np.nextafter(outer, np.inf)]))[0]) if outer <= half - 1 else float("nan")
    first = _central_radius(rings)
    circles = rings.scores(first, np.arange(first + 1.0, _WIDEST_CIRCLE * (half + 1)))
    circles = circles[np.isfinite(circles)]
    if len(circles) < _CIRCLES:
        return GridScores(sargolini, float("nan"))
    return GridScores(sargolini, float(np.convolve(circles, np.full(_CIRCLES, 1.0 / _CIRCLES), "valid").max()))


class _Rings(NamedTuple):
    """Lags of an autocorrelogram from the centre outwards: radii (K,), values (K,), and the values turned (5, K).

    Of each lag and its opposite, which have the same value, one is here; the centre is not.
    """

    radius: Array
    values: Array
    turned: Array

    def scores(self, inner: float, outer: Array) -> Array:
        """Grid scores (R,) of the lags beyond a radius and below each of the radii (R,), bins; NaN where there is none."""
        start = int(np.searchsorted(self.radius, inner, side="right"))
        end = np.searchsorted(self.radius, outer, side="left") - start - 1
        most = int(end.max()) + start + 1 if len(end) else start
        if most <= start:
            return np.full(len(outer), np.nan)
        grown = np.array([_growing_correlation(self.values[start:most], other[start:most]) for other in self.turned])
        score = grown[:2].min(axis=0) - grown[2:].max(axis=0)
        return np.where(end >= 0, score[end], np.nan)


def _rings_of(window: Array) -> _Rings:
    """The lags of the middle of an autocorrelogram (2 half + 1 squared), as far as the circle that fits in."""
    from scipy import ndimage

    half = len(window) // 2
    y, x = (lag.ravel()[window.size // 2 + 1 :] for lag in np.mgrid[-half : half + 1, -half : half + 1])
    radius = np.hypot(y, x)
    outward = np.argsort(radius, kind="stable")[: np.count_nonzero(radius <= half)]
    y, x = y[outward], x[outward]
    angles = np.radians(_TURNS_DEG)[:, None]
    there = np.stack([np.cos(angles) * y + np.sin(angles) * x, np.cos(angles) * x - np.sin(angles) * y]) + half
    turned = ndimage.map_coordinates(window, there, order=1, mode="nearest")
    return _Rings(radius[outward], window[y + half, x + half], turned)


def _central_radius(rings: _Rings) -> float:
    """Radius, whole bins, of the disc that is as large as the central peak above 0.2, up to the first minimum around it."""
    bins = np.append(0, np.round(rings.radius).astype(np.int64))
    mean = np.bincount(bins, np.append(1.0, rings.values)) / np.bincount(bins)
    end = int(((mean < _CENTRE_ENDS) | np.append(np.diff(mean) > 0.0, True)).argmax())
    area = 1 + 2 * np.count_nonzero(rings.values[rings.radius <= end + 1] >= _CENTRE_ENDS)
    return float(np.floor(np.sqrt(area / np.pi)))


def _growing_correlation(a: Array, b: Array) -> Array:
    """Pearson correlation (K,) of the first 1, 2, ... K of the values (K,) of two arrays; NaN where one does not vary."""
    n = np.arange(1, len(a) + 1)
    sum_a, sum_b = np.cumsum(a), np.cumsum(b)
    covariance = n * np.cumsum(a * b) - sum_a * sum_b
    variance = (n * np.cumsum(a * a) - sum_a**2) * (n * np.cumsum(b * b) - sum_b**2)
    return np.where(variance > 0.0, covariance / np.sqrt(np.where(variance > 0.0, variance, 1.0)), np.nan)


def _inner_peaks(correlation: Array) -> tuple[Array, float]:
    """Distances of the six peaks nearest to the centre, and the radius of the central peak, bins."""
    from scipy import ndimage

    middle = np.array(correlation.shape) // 2
    peak = ndimage.label(correlation > _CENTRAL_PEAK)[0]
    area = int((peak == peak[tuple(middle)]).sum())
    radius = float(np.sqrt(area / np.pi))
    highest = ndimage.maximum_filter(correlation, size=2 * max(1, round(radius)) + 1)
    at = np.argwhere((correlation == highest) & (correlation > 0.1)) - middle
    distances = np.sort(np.hypot(at[:, 0], at[:, 1]))
    return distances[distances > radius][:6], radius


def ideal_map(
    side: int, spacing_bins: float, angle_rad: float = 0.0, metric: Literal["hexagonal", "square"] = "hexagonal"
) -> Array:
    """An ideal rate map (side, side): the sum of three (hexagonal) or two (square) plane waves, from 0 to 1.

    Args:
        side: bins along a side.
        spacing_bins: distance of two neighbouring peaks, bins.
        angle_rad: direction of the first wave, from the first axis to the second.
        metric: lattice of the peaks.
    """
    period = spacing_bins * (np.sqrt(3.0) / 2.0 if metric == "hexagonal" else 1.0)
    angles = angle_rad + np.radians((0.0, 60.0, 120.0) if metric == "hexagonal" else (0.0, 90.0))
    x, y = np.meshgrid(np.arange(side), np.arange(side), indexing="ij")
    waves = sum(np.cos(2.0 * np.pi * (np.cos(a) * x + np.sin(a) * y) / period) for a in angles)
    rates = np.asarray(waves, dtype=np.float64)
    return np.asarray((rates - rates.min()) / (rates.max() - rates.min()))


def stripe_of(rates: Array, pitch_m: float) -> Stripe:
    """Strongest plane wave of a rate map (H, W) with bins of `pitch_m`, by its Fourier transform, interpolated."""
    from scipy import optimize

    height, width = rates.shape
    window = np.outer(np.hanning(height + 2)[1:-1], np.hanning(width + 2)[1:-1])
    weighed = (rates - np.average(rates, weights=window)) * window
    shape = (4 * height, 4 * width)
    power = np.abs(np.fft.rfft2(weighed, shape))
    i, j = np.unravel_index(int(power.argmax()), power.shape)
    start = np.array([np.fft.fftfreq(shape[0])[i], np.fft.rfftfreq(shape[1])[j]])
    rows, columns = np.arange(height), np.arange(width)

    def loss(wave: NDArray[np.float64]) -> float:
        return -float(np.abs(np.exp(-2j * np.pi * wave[0] * rows) @ weighed @ np.exp(-2j * np.pi * wave[1] * columns)))

    simplex = start + 0.25 / np.array(shape) * np.array([[0, 0], [1, 0], [0, 1]])
    wave = optimize.minimize(loss, start, method="Nelder-Mead", options={"initial_simplex": simplex, "xatol": 1e-7}).x
    return Stripe(float(np.arctan2(wave[1], wave[0]) % np.pi), pitch_m / float(np.hypot(*wave)))


def field_counts(maps: NDArray[np.floating]) -> NDArray[np.int64]:
    """Number of firing fields of each rate map (C, H, W); 0 for a cell that never fires.

    A field is a connected region (corners included) of at least three bins above 20 % of the map's peak. A cell that fires
    above that in more than half of the map fires everywhere and has no field.
    """
    from scipy import ndimage

    counts = np.zeros(len(maps), dtype=np.int64)
    for cell, rates in enumerate(maps):
        peak = float(rates.max())
        firing = rates > _FIELD_THRESHOLD * peak
        if peak > 0.0 and firing.mean() <= _LARGEST_SHARE:
            regions, _ = ndimage.label(firing, structure=np.ones((3, 3)))
            counts[cell] = int((np.bincount(regions.ravel())[1:] >= _SMALLEST_FIELD_BINS).sum())
    return counts


def spatial_information(rates: Array, dwell_s: Array) -> float:
    """Information that one spike carries about the place, bits (Skaggs et al. 1993): sum p_i (r_i / r) log2(r_i / r).

    Args:
        rates: (H, W) rate map, NaN where nobody was.
        dwell_s: (H, W) time in each bin, s.

    Returns:
        The information; NaN for a cell that never fires.
    """
    visited = np.isfinite(rates)
    share = dwell_s[visited] / dwell_s[visited].sum()
    mean = float(share @ rates[visited])
    if not mean > 0.0:
        return float("nan")
    relative = rates[visited] / mean
    fires = relative > 0.0
    return float((share[fires] * relative[fires]) @ np.log2(relative[fires]))


def vector_length(curve: Array) -> float:
    """Length of the mean vector of a tuning curve (n,) over directions evenly spaced round the circle: 0 to 1.

    It is 0.5 for a cosine 1 + cos, and I_1(k) / I_0(k) for von Mises's tuning. NaN for a cell that never fires.
    """
    total = float(curve.sum())
    return float(abs(np.exp(2j * np.pi * np.arange(len(curve)) / len(curve)) @ curve)) / total if total > 0.0 else float("nan")


def tuning_width(curve: Array) -> float:
    """Width, rad, of a tuning curve (n,) round the circle half way between its lowest and its highest rate; NaN if it is flat.

    The half height is interpolated between the first directions on either side of the peak that are below it.
    """
    low, high = float(curve.min()), float(curve.max())
    if not high > low:
        return float("nan")
    half, count = 0.5 * (low + high), len(curve)
    from_peak = np.roll(curve, -int(curve.argmax()))

    def reach(side: Array) -> float:
        below = int(np.argmax(side < half))
        return float(below - (half - side[below]) / (side[below - 1] - side[below]))

    right, left = reach(from_peak), reach(np.roll(from_peak[::-1], 1))
    return float(2.0 * np.pi * (right + left) / count)
