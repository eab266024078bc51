"""Measures of rate maps used in physiology: gridness, stripes, single fields."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

import numpy as np
from numpy.typing import NDArray

from hybridmap.geometry import Array

_FIELD_THRESHOLD = 0.2
_SMALLEST_FIELD_BINS = 3
_LARGEST_SHARE = 0.5
_CENTRAL_PEAK = 0.5


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

    Only bins that both shifted maps cover count; lags with fewer than 20 such bins are 0 (Sargolini et al. 2006).
    """
    height, width = rates.shape
    shape = (2 * height - 1, 2 * width - 1)

    def correlate(a: Array, b: Array) -> Array:
        product = np.fft.rfft2(a, shape) * np.conj(np.fft.rfft2(b, shape))
        return np.asarray(np.fft.fftshift(np.fft.irfft2(product, shape)))

    map_ = rates - rates.mean()
    one = np.ones_like(map_)
    n = np.round(correlate(one, one))
    first, second = correlate(map_, one), correlate(one, map_)
    square = map_ * map_
    variance = (n * correlate(square, one) - first**2) * (n * correlate(one, square) - second**2)
    covariance = n * correlate(map_, map_) - first * second
    seen = (n >= 20) & (variance > 1e-12 * variance.max())
    return np.where(seen, covariance / np.sqrt(np.where(seen, variance, 1.0)), 0.0)


def gridness(rates: Array) -> float:
    """Grid score of a rate map (H, W) (Sargolini et al. 2006).

    The autocorrelogram is masked to the annulus that holds the six inner peaks and not the central one, and correlated with
    itself turned: min(60, 120 degrees) - max(30, 90, 150 degrees). The annulus goes from the radius of the central peak (where
    it falls to half) to the mean distance of the six peaks plus that radius.

    Returns:
        The score, at most 2; NaN where there are no six peaks, or the annulus does not fit into the autocorrelogram.
    """
    from scipy import ndimage

    correlation = autocorrelogram(rates)
    distances, centre_radius = _inner_peaks(correlation)
    if len(distances) < 6:
        return float("nan")
    inner, outer = centre_radius, float(distances.mean()) + centre_radius
    half = int(np.ceil(outer)) + 1
    middle = np.array(correlation.shape) // 2
    if (middle < half).any():
        return float("nan")
    window = correlation[middle[0] - half : middle[0] + half + 1, middle[1] - half : middle[1] + half + 1]
    radius = np.hypot(*np.meshgrid(np.arange(-half, half + 1), np.arange(-half, half + 1), indexing="ij"))
    ring = (radius > inner) & (radius <= outer)

    def turned(degrees: float) -> float:
        other = ndimage.rotate(window, degrees, reshape=False, order=1, mode="nearest")
        return float(np.corrcoef(window[ring], other[ring])[0, 1])

    return min(turned(60.0), turned(120.0)) - max(turned(30.0), turned(90.0), turned(150.0))


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
