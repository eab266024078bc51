"""The offset between the clock of the views and that of the odometry, estimated while driving.

Between two consecutive nodes the turn by registration must be that of the wheels, at times that are shifted by the offset d:

    turn_registered(k - 1, k) = (1 + g) [yaw(t_k - d) - yaw(t_k-1 - d)] + b s + error,

g the error of the wheels' turn gain, b their heading bias and s the way in metres. For each d the two are fitted with Cauchy
weights; the lowest cost wins, refined by a parabola. Only changes of the turn rate tell the offset: a robot that drives
straight, or circles at one speed, leaves it open.
"""

from __future__ import annotations

from dataclasses import dataclass
from enum import StrEnum
from math import hypot, inf, nan

import numpy as np
from numpy.typing import NDArray

from hybridmap.geometry import Array, robust_sigma, wrap_angle

TRANSPORT_S = 0.5
"""Largest offset that the transport of messages explains, s. A larger one is another time base, and is not corrected."""
TIME_BASE_S = 10.0
"""How far an offset between two time bases is looked for, s."""
STEP_S, COARSE_STEP_S = 0.02, 0.05
"""Steps of the offsets that are tried, s: a turn begins and ends within some tenths of a second."""
SIGMAS = 3.0
"""Factor on the standard deviation that the fit gives. Over 70 windows of 20 and 30 m of two robots the estimates scatter 1.2
to 3 times as much: the delay of a serial line is not constant."""
SIGMA_MAX_S = 0.03
"""Largest standard deviation (with that factor) of an offset that is said to be known, s; of a large one, more."""
SIGMA_SHARE = 0.25
"""Largest standard deviation of a large offset, as a share of it: to correct such an offset is far better than to leave it."""
RIVAL_MIN = 15.0
"""Least cost, in nats, of every offset further than `RIVAL_S` from the best one. A single turn is no evidence."""
RIVAL_S = 0.1
GAP_MAX_S = 0.3
"""Registrations at whose ends the odometry has a longer gap are left out, s: the turn rate changes within it. With every second
to fifth message of two logs left out, the estimate errs by up to 0.05 of the gap up to here, and by more beyond."""
GAP_SHARE = 0.05
JITTER_S = 0.01
"""Standard deviation of a single stamp, s."""
WANDER_DEG, TURN_NOISE = 0.6, 0.02
"""Noise of the heading by usual wheels: degrees per root metre, radians per root radian turned. Its scale is estimated."""
GAIN_SIGMA, BIAS_SIGMA_RAD_M = 0.05, 0.03
"""Standard deviations of g and b before the drive: those of usual wheels."""
MATTERS_S = 0.02
"""Least offset that is corrected, s: the turn of a robot in that time is less than the registrations' error."""
_FEWEST = 12  # registrations: three unknowns and a scale
_LEAST_SIGMA_RAD = float(np.deg2rad(0.2))  # of a registered turn: what two scans have in common and residuals do not show
_WEAK_RAD = float(np.deg2rad(1.0))  # a registration less certain than that does not count
_CAUCHY = 2.385  # in units of the scale: 95 % efficiency for normal residuals
_SCALE_MIN = 0.5  # of residuals over their assumed standard deviation: fewer residuals may agree by chance
_ITERATIONS = 8
_RATE_S = 0.1  # half of the time over which a turn rate is taken


class ClockState(StrEnum):
    """Whether the offset is known, or why not."""

    KNOWN = "known"
    OPEN = "the drive tells too little (few turns, few registrations, or too short)"
    SPARSE = "odometry messages are too far apart"
    TIME_BASE = "another time base"


@dataclass(frozen=True, slots=True)
class ClockOffset:
    """How much later views are stamped than odometry of the same moment, as far as a drive tells.

    Attributes:
        state: whether it is known, or why not.
        offset_s: the offset beside `sensors.odometry_delay_s`, s, positive if views are stamped later; NaN if not known. With
            `TIME_BASE` it is rough.
        sigma_s: its standard deviation, s; infinite if not known.
        used_s: the offset that the map was corrected by, s; 0 if it was not.
        travel_m: path length of the drive that it is estimated from, m.
    """

    state: ClockState = ClockState.OPEN
    offset_s: float = nan
    sigma_s: float = inf
    used_s: float = 0.0
    travel_m: float = 0.0

    @property
    def known(self) -> bool:
        """Whether offset and standard deviation are known."""
        return self.state is ClockState.KNOWN

    @property
    def matters(self) -> bool:
        """Whether it is known, above `MATTERS_S`, and above two of its standard deviations: then it is worth a correction."""
        return self.known and abs(self.offset_s) > max(MATTERS_S, 2.0 * self.sigma_s)

    @property
    def left_s(self) -> float:
        """`offset_s` less `used_s`, s, positive if views are still stamped later; NaN if unknown, rough with `TIME_BASE`."""
        return self.offset_s - self.used_s

    def __str__(self) -> str:
        if self.state is ClockState.TIME_BASE:
            late = f"views are stamped about {self.offset_s:+.1f} s from the odometry"
            return f"{late}: two time bases, not a delay; not corrected: give both one clock"
        if not self.known:
            return f"the offset between the clocks of views and odometry is not known: {self.state}"
        later = "later" if self.offset_s >= 0 else "earlier"
        said = f"views are stamped {1e3 * abs(self.offset_s):.0f} ms {later} than odometry (+- {1e3 * self.sigma_s:.0f} ms)"
        return f"{said}; corrected" if self.used_s else said


@dataclass(frozen=True, slots=True)
class Headings:
    """Heading and path length by odometry.

    Attributes:
        stamps_s: (S,) stamps by the odometry's clock, strictly increasing, s.
        yaw_rad: (S,) heading, not wrapped.
        travel_m: (S,) path length up to each stamp.
    """

    stamps_s: Array
    yaw_rad: Array
    travel_m: Array

    def turns(self, first_s: Array, last_s: Array, offset_s: float) -> tuple[Array, Array]:
        """Turn (R,) rad and way (R,) m between times (R,) on the views' clock, s, if that is `offset_s` late."""
        ends = [np.interp(at - offset_s, self.stamps_s, of) for of in (self.yaw_rad, self.travel_m) for at in (first_s, last_s)]
        return ends[1] - ends[0], ends[3] - ends[2]

    def rates(self, at_s: Array) -> Array:
        """(R,) turn rates at times (R,) on the odometry's clock, s, taken over 0.2 s; rad/s."""
        after, before = (np.interp(at_s + h, self.stamps_s, self.yaw_rad) for h in (_RATE_S, -_RATE_S))
        return np.asarray((after - before) / (2.0 * _RATE_S))

    def gaps(self, at_s: Array) -> Array:
        """(R,) time between the two messages around times (R,) on the odometry's clock, s; infinite outside."""
        after = np.searchsorted(self.stamps_s, at_s)
        inside = (after > 0) & (after < len(self.stamps_s))
        after = np.clip(after, 1, len(self.stamps_s) - 1)
        return np.asarray(np.where(inside, self.stamps_s[after] - self.stamps_s[after - 1], inf))


@dataclass(frozen=True, slots=True)
class Turns:
    """R registered turns between two views each.

    Attributes:
        first_s, last_s: (R,) stamps of the two views, s.
        turn_rad: (R,) turn from the first to the second by registration.
        sigma_rad: (R,) its standard deviation.
    """

    first_s: Array
    last_s: Array
    turn_rad: Array
    sigma_rad: Array

    def __len__(self) -> int:
        return len(self.first_s)

    def select(self, kept: NDArray[np.bool_]) -> Turns:
        """The turns chosen by a mask (R,)."""
        return Turns(self.first_s[kept], self.last_s[kept], self.turn_rad[kept], self.sigma_rad[kept])


def offset_of(headings: Headings, turns: Turns, *, wide: bool = False) -> ClockOffset:
    """Estimate the offset from registered turns and odometry; costs some 200 robust fits of two unknowns to the R turns.

    Args:
        headings: the odometry.
        turns: the registrations, with stamps that count from the same moment as those of the odometry.
        wide: whether to look for another time base too, at ten times the cost, if no delay is found.
    """
    turns = turns.select(turns.sigma_rad < _WEAK_RAD)
    if len(turns) < _FEWEST or len(headings.stamps_s) < 2:
        return ClockOffset()
    gap_s = np.maximum(headings.gaps(turns.first_s), headings.gaps(turns.last_s))
    dense = gap_s <= GAP_MAX_S
    if 2 * int(dense.sum()) < len(turns):
        return ClockOffset(ClockState.SPARSE)
    fit, kept_gap_s = _Fit(headings, turns.select(dense)), float(np.median(gap_s[dense]))
    if int(dense.sum()) < _FEWEST:
        return ClockOffset()
    found = fit.best(_grid(TRANSPORT_S, STEP_S))
    if found is not None:
        sigma_s = hypot(SIGMAS * found.sigma_s, GAP_SHARE * kept_gap_s)
        if found.rival >= RIVAL_MIN and sigma_s <= max(SIGMA_MAX_S, SIGMA_SHARE * abs(found.offset_s)):
            return ClockOffset(ClockState.KNOWN, found.offset_s, sigma_s)
    far = fit.best(_grid(TIME_BASE_S, COARSE_STEP_S)) if wide else None
    if far is not None and abs(far.offset_s) > TRANSPORT_S and far.rival >= RIVAL_MIN:
        return ClockOffset(ClockState.TIME_BASE, far.offset_s, COARSE_STEP_S)
    return ClockOffset()


def _grid(half_s: float, step_s: float) -> Array:
    return np.asarray(np.arange(-round(half_s / step_s), round(half_s / step_s) + 1) * step_s, dtype=np.float64)


@dataclass(frozen=True, slots=True)
class _Minimum:
    """The offset of least cost, its standard deviation by the fit, and the cost of the best rival above that."""

    offset_s: float
    sigma_s: float
    rival: float


class _Fit:
    """Robust fits of g and b at given offsets."""

    def __init__(self, headings: Headings, turns: Turns) -> None:
        self._headings, self._turns = headings, turns
        self._precision = np.array([1.0 / GAIN_SIGMA**2, 1.0 / BIAS_SIGMA_RAD_M**2])
        self._scale = 1.0
        self._sigma = self._sigmas(0.0)

    def best(self, offsets_s: Array) -> _Minimum | None:
        """The minimum over a grid of offsets (D,), s; None if it lies at the rim."""
        for _ in range(3):  # scale and standard deviations follow from where the minimum is
            at = int(np.argmin(self._costs(offsets_s)))
            self._sigma = self._sigmas(float(offsets_s[at]))
            residuals = self._solve(float(offsets_s[at]))[1]
            self._scale = max(float(robust_sigma(residuals)), _SCALE_MIN)
        costs = self._costs(offsets_s)
        at = int(np.argmin(costs))
        if at in (0, len(offsets_s) - 1):
            return None
        step, (before, here, after) = float(offsets_s[1] - offsets_s[0]), costs[at - 1 : at + 2]
        offset_s = float(offsets_s[at]) + 0.5 * step * float((before - after) / max(before - 2.0 * here + after, 1e-12))
        far = np.abs(offsets_s - offset_s) > RIVAL_S
        return _Minimum(offset_s, self._sigma_of(offset_s), float(costs[far].min() - here))

    def _costs(self, offsets_s: Array) -> Array:
        return np.array([self._solve(float(offset_s))[2] for offset_s in offsets_s])

    def _sigmas(self, offset_s: float) -> Array:
        """(R,) standard deviation of the difference of the turns, rad: registration, wheels, and the jitter of both stamps."""
        t = self._turns
        turn, way = self._headings.turns(t.first_s, t.last_s, offset_s)
        wheels = np.deg2rad(WANDER_DEG) ** 2 * way + TURN_NOISE**2 * np.abs(turn)
        rates = [self._headings.rates(at - offset_s) for at in (t.first_s, t.last_s)]
        jitter = JITTER_S**2 * (rates[0] ** 2 + rates[1] ** 2)
        return np.asarray(np.sqrt(t.sigma_rad**2 + _LEAST_SIGMA_RAD**2 + wheels + jitter))

    def _solve(self, offset_s: float) -> tuple[Array, Array, float]:
        """Fit g and b at an offset; returns them (2,), the residuals (R,) in standard deviations, and the cost in nats."""
        t = self._turns
        turn, way = self._headings.turns(t.first_s, t.last_s, offset_s)
        design = np.column_stack([turn, way]) / self._sigma[:, None]
        missing = wrap_angle(t.turn_rad - turn) / self._sigma
        fitted: Array = np.zeros(2)
        kernel, prior = _CAUCHY * self._scale, np.diag(self._precision) * self._scale**2
        for _ in range(_ITERATIONS):
            weighted = design / (1.0 + ((missing - design @ fitted) / kernel) ** 2)[:, None]
            normal = weighted.T @ design + prior
            fitted = np.asarray(np.linalg.solve(normal, weighted.T @ missing), dtype=np.float64)
        residuals = missing - design @ fitted
        cost = 0.5 * _CAUCHY**2 * np.sum(np.log1p((residuals / kernel) ** 2)) + 0.5 * np.sum(self._precision * fitted**2)
        return fitted, residuals, float(cost)

    def _sigma_of(self, offset_s: float) -> float:
        """Standard deviation of the offset, s, given that g and b are estimated too."""
        t, (fitted, residuals, _) = self._turns, self._solve(offset_s)
        turn, way = self._headings.turns(t.first_s, t.last_s, offset_s)
        rates = [self._headings.rates(at - offset_s) for at in (t.first_s, t.last_s)]
        slope = (1.0 + fitted[0]) * (rates[1] - rates[0])
        design = np.column_stack([slope, turn, way]) / self._sigma[:, None]
        weights = 1.0 / (1.0 + (residuals / (_CAUCHY * self._scale)) ** 2) / self._scale**2
        information = design.T @ (design * weights[:, None]) + np.diag([1e-6, *self._precision])
        return float(np.sqrt(np.linalg.inv(information)[0, 0]))
