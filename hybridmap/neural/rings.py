"""Ring attractors: the head-direction ring, and three rings of band cells a grid module, whose stripes drive the sheets."""

from __future__ import annotations

import math
from typing import Literal, NamedTuple

import numpy as np
from numpy.typing import DTypeLike, NDArray

from hybridmap.errors import ConfigError

Metric = Literal["hexagonal", "square"]
BAND_CELLS = 32
"""Cells of a band ring (three rings a module): a stripe is then some three cells wide."""
BAND_WIDTH = 0.1
"""Stripe width r as a share of the period; the rate is exp(-(s - l/2)^2 / (2 r^2))."""
MODULATION_S = 0.1
"""Gain of the head-direction rates per turn rate, s: real cells fire more while the head turns."""
_COSINE_CELLS, _CELLS_AT_LEAST, _CELLS_PER_ROOT = 3, 6.0, 8.0
ORIENTATIONS_DEG = (0.0, 60.0, 120.0)
SQUARE_ORIENTATIONS_DEG = (0.0, 45.0, 90.0)


def cells_needed(concentration: float) -> int:
    """Fewest head-direction cells whose population vector gives the heading to 1e-13 rad, with a tuning so concentrated."""
    return math.ceil(_CELLS_AT_LEAST + _CELLS_PER_ROOT * math.sqrt(concentration)) if concentration > 0.0 else _COSINE_CELLS


class HeadDirectionRing:
    """Ring attractor of m cells with preferred directions theta_i = 2 pi i / m (paper eq. 1).

    The rates are d_i = 1 + cos(theta_i - phi): never negative, and with D = [cos theta; sin theta] the read-out
    (2/m) D d is exactly (cos phi, sin phi). A turn acts through the rank-two recurrent weights (2/m) D' R(dphi) D; the
    length of the population vector is restored at each turn (divisive inhibition), so rounding cannot let it grow or fade.

    The mean vector length of every such cosine is 0.5; real cells are sharper. With a concentration k the net input
    cos(theta_i - phi) passes through the transfer function h -> 2 exp(k (h - 1)), and the tuning is von Mises's. Its population
    vector still points exactly along phi if there are enough cells: what is missed is of order I_(m-1)(k) / I_1(k).

    Attributes:
        activity: (m,) firing rates, 0..2; the whole state.
        concentration: k of the von Mises tuning; 0: the paper's cosine.
    """

    def __init__(self, cells: int, dtype: DTypeLike = np.float64, concentration: float = 0.0) -> None:
        """Make a ring of m `cells` that points along 0.

        Args:
            cells: m.
            dtype: floating-point type of the rates.
            concentration: k of a von Mises tuning; 0: the paper's cosine.

        Raises:
            ConfigError: a concentration below 0, or one for which there are too few cells to decode the heading exactly.
        """
        if not 0.0 <= concentration < math.inf:
            raise ConfigError(f"head-direction cells: expected a concentration of at least 0, found {concentration:g}")
        if cells < (needed := cells_needed(concentration)):
            raise ConfigError(f"head-direction cells: a concentration of {concentration:g} needs {needed} cells, found {cells}")
        preferred = 2.0 * np.pi * np.arange(cells) / cells
        self.preferred_rad: NDArray[np.float64] = preferred
        self._kernel = np.stack([np.cos(preferred), np.sin(preferred)]).astype(dtype)
        self._readout = (self._kernel * (2.0 / cells)).astype(dtype)
        self._tuning = np.concatenate([self._kernel, np.ones_like(self._kernel[:1])])
        self._vector = np.ones(3, dtype=dtype)
        self.concentration = concentration
        self.activity: NDArray[np.floating] = 1.0 + self._kernel[0] if concentration == 0.0 else self.rates_at(0.0)

    def direction(self) -> tuple[float, float]:
        """Return (cos, sin) of the decoded heading."""
        c, s = self._readout.dot(self.activity).tolist()
        norm = math.hypot(c, s)
        return c / norm, s / norm

    def heading_of(self, activity: NDArray[np.floating]) -> float:
        """The heading that an activity (m,) stands for, rad in [-pi, pi]; no state changes."""
        c, s = (self._readout @ activity).tolist()
        return math.atan2(s, c)

    def rates_at(self, heading_rad: float) -> NDArray[np.floating]:
        """The rates (m,), 0..2, at a heading, rad; no state changes."""
        vector = np.array([math.cos(heading_rad), math.sin(heading_rad), 1.0])
        return self._rates(vector.astype(self._tuning.dtype))

    def _rates(self, vector: NDArray[np.floating]) -> NDArray[np.floating]:
        """The rates (m,) of a ring that points along a vector (cos, sin, 1)."""
        cosines = np.asarray(vector.dot(self._tuning))
        if self.concentration == 0.0:
            return cosines
        return np.asarray(2.0 * np.exp(self.concentration * (cosines - 2.0)), dtype=cosines.dtype)

    @property
    def heading_rad(self) -> float:
        """Decoded heading, rad in [-pi, pi]."""
        return self.heading_of(self.activity)

    def turn(self, angle_rad: float) -> tuple[float, float]:
        """Turn the ring by an angle, rad, left positive.

        Returns:
            (cos, sin) of the mid-point heading, half of the turn ahead of where the ring stood.
        """
        c, s = self.direction()
        if angle_rad == 0.0:
            return c, s
        cos, sin = math.cos(0.5 * angle_rad), math.sin(0.5 * angle_rad)
        middle_c, middle_s = c * cos - s * sin, c * sin + s * cos
        self._vector[0] = middle_c * cos - middle_s * sin
        self._vector[1] = middle_c * sin + middle_s * cos
        self.activity = self._rates(self._vector)
        return middle_c, middle_s

    def rates(self, turn_rate_rad_s: float = 0.0) -> NDArray[np.floating]:
        """Return the rates (m,) times 1 + `MODULATION_S` |turn_rate_rad_s|, as of real cells that turn; no state changes."""
        return self.activity * (1.0 + MODULATION_S * abs(turn_rate_rad_s))


class BandMotion(NamedTuple):
    """Output of the band rings for the grid sheets in one step, decoded from their rates.

    Attributes:
        advance: (M, 3) motion of each ring in the step, cycles in [-0.5, 0.5].
        phasors: (M, 3) unit phasors of the rings after the step.
    """

    advance: NDArray[np.floating]
    phasors: NDArray[np.complexfloating]


class BandRings:
    """Ring attractors of band cells, three orientations a module (paper eqs. 2-4).

    Cell alpha of a ring of period l fires at exp(-(s - l/2)^2 / (2 r^2)) with s = (d - alpha) mod l, so that its preferred
    displacement is alpha + l/2. No running integral d is kept: the ring feeds its rates back through cosine weights that the
    velocity along its orientation shifts, the net input h is normalised (divisive inhibition), and the transfer function
    h -> exp(-(l arccos(h) / 2 pi)^2 / (2 r^2)) gives back the printed stripe, which is the attractor of the ring.
    Periods are l = lambda sqrt(3)/2. On the square metric (for comparison) the bands are at 0 and 90 degrees with period
    lambda, and the ring between them, which drives no sheet, is their sum at 45 degrees.

    Attributes:
        activity: (M, 3, n) rates 0..1 in the order of `ORIENTATIONS_DEG`; the whole state. To be replaced, not written into:
            the array that a step leaves is read-only, so that it need not be decoded twice.
        periods_m, orientations_rad: (M, 3) distance between two stripes, and the direction across them.
        wave_vectors: (M, 3, 2) cycles per metre; the third is the second minus the first (phi60 = phi0 + phi120).
    """

    def __init__(
        self,
        spacings_m: NDArray[np.float64],
        orientations_rad: NDArray[np.float64],
        cells: int = BAND_CELLS,
        width: float = BAND_WIDTH,
        dtype: DTypeLike = np.float64,
        metric: Metric = "hexagonal",
    ) -> None:
        """Make the rings at phase zero.

        Args:
            spacings_m: (M,) grid spacing lambda of each module.
            orientations_rad: (M,) direction of each module's first band.
            cells: n, cells of a ring.
            width: r, width of a stripe as a share of the period.
            dtype: floating-point type of the rates.
            metric: lattice of the sheets that the bands drive.
        """
        square = metric == "square"
        angles = orientations_rad[:, None] + np.radians(SQUARE_ORIENTATIONS_DEG if square else ORIENTATIONS_DEG)
        period = np.array([1.0, np.sqrt(0.5), 1.0]) if square else np.full(3, np.sqrt(3.0) / 2.0)
        self.periods_m: NDArray[np.float64] = spacings_m[:, None] * period
        self.orientations_rad: NDArray[np.float64] = angles
        self.wave_vectors: NDArray[np.float64] = np.stack([np.cos(angles), np.sin(angles)], axis=-1) / self.periods_m[..., None]
        self._turn = _turning_weights(self.wave_vectors).astype(dtype)
        self._displacement = np.ones(3, dtype=dtype)
        preferred = 2.0 * np.pi * (np.arange(cells) / cells + 0.5)
        self._weights = np.stack([np.cos(preferred), np.sin(preferred)], axis=1).astype(dtype)
        self._sharpness = np.array(-1.0 / (2.0 * (2.0 * np.pi * width) ** 2), dtype=dtype)
        self._cycles = np.array(0.5 / np.pi, dtype=dtype)
        self._shape = (*angles.shape, cells)
        self._complex = np.result_type(np.dtype(dtype), np.complex64)
        rings = angles.shape
        self._turn_pairs = np.empty(2 * angles.size, dtype=dtype)
        self._turn_phasors = self._turn_pairs.view(self._complex).reshape(rings)
        self._turned = np.empty(rings, dtype=self._complex)
        self._turned_pairs = self._turned.view(dtype).reshape(-1, 2)
        self._turned_real, self._turned_imag = self._turned.real, self._turned.imag
        self._length = np.zeros(rings, dtype=self._complex)  # complex, since a division of mixed types is slow
        self._length_real = self._length.real
        inside = 1.0 - 4.0 * float(np.finfo(self._weights.dtype).eps)  # keeps rounding out of arccos' way
        self._tuning = np.ascontiguousarray(self._weights.T) * self._weights.dtype.type(inside)
        self._decoded: tuple[NDArray[np.floating] | None, NDArray[np.complexfloating]] = (None, np.empty(0, self._complex))
        self.activity: NDArray[np.floating] = self.rates_at(np.zeros((len(spacings_m), 3)))

    def phasors(self) -> NDArray[np.complexfloating]:
        """Return the unit phasors exp(2 pi i phi), (M, 3), decoded from the activity."""
        rates, known = self._decoded
        if rates is self.activity:
            return known
        vector = self.activity.reshape(-1, self._weights.shape[0]).dot(self._weights)
        z = vector.view(self._complex).reshape(self._length.shape)
        np.abs(z, out=self._length_real)
        z /= self._length
        if not self.activity.flags.writeable:
            self._decoded = self.activity, z
        return np.asarray(z)

    def phases(self) -> NDArray[np.float64]:
        """Return the decoded phases (M, 3), cycles in [0, 1)."""
        return np.asarray(np.angle(self.phasors().astype(np.complex128)) / (2.0 * np.pi)) % 1.0

    def rates_at(self, phases: NDArray[np.float64]) -> NDArray[np.floating]:
        """Return the stationary rates (M, 3, n), read-only, at given phases (M, 3), cycles; no state changes."""
        return self._rates(np.exp(2j * np.pi * phases.reshape(-1, 1)).astype(self._complex).view(self._weights.dtype))

    def step(self, displacement_m: NDArray[np.float64]) -> BandMotion:
        """Move every ring by a displacement (2,) in the world, m; returns the motion and phasors that drive the grid sheets."""
        before = self.phasors()
        self._displacement[:2] = displacement_m
        self._displacement.dot(self._turn, out=self._turn_pairs)
        np.cos(self._turn_pairs, out=self._turn_pairs)
        np.multiply(before, self._turn_phasors, out=self._turned)
        self.activity = self._rates(self._turned_pairs)
        after = self.phasors()
        np.conjugate(before, out=self._turned)
        self._turned *= after
        advance = np.arctan2(self._turned_imag, self._turned_real)
        advance *= self._cycles
        return BandMotion(advance, after)

    def _rates(self, phasor_pairs: NDArray[np.floating]) -> NDArray[np.floating]:
        """The stationary rates (M, 3, n) of rings at unit phasors (3 M, 2), as (real, imaginary); read-only."""
        offset = phasor_pairs.dot(self._tuning)
        np.arccos(offset, out=offset)
        offset *= offset
        offset *= self._sharpness
        np.exp(offset, out=offset)
        rates = offset.reshape(self._shape)
        rates.setflags(write=False)
        return np.asarray(rates)


def _turning_weights(wave_vectors: NDArray[np.float64]) -> NDArray[np.float64]:
    """Matrix (3, 6 M) from a displacement and a one to angles: their cosines are the turns of the rings, (real, imaginary)."""
    turn = 2.0 * np.pi * wave_vectors.reshape(-1, 2)
    angles = np.zeros((3, len(turn), 2))
    angles[:2] = turn.T[:, :, None]
    angles[2, :, 1] = -0.5 * np.pi
    return angles.reshape(3, -1)
