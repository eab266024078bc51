"""Regression of odometry on known poses: a robust estimate of gain, turn gain, heading bias and delay.

It compares pieces of the drive ("legs"), and differs from plain least squares in two ways. Legs are long and overlap: the
drift grows with a leg, while the noise of its end poses does not. The delay between odometry and the sensor is estimated as
well: a scan with a stamp 0.1 s late looks like an error of 10 deg in heading at each end of a fast turn.

Only two components of a leg are used: the heading at its end, linear in turn gain, bias and delay, and its length along the
measured chord, linear in the gain. The lateral component depends on the sensor's mounting and on *where* on the leg the
heading error arose, and would bias the estimate.

If turn gain and heading bias are unobservable, the drive is refused. An unobservable gain or delay is left out of the fit
and is not changed by `Estimate.kept`.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from hybridmap.calibration.estimate import SIGNIFICANT_SIGMAS, Estimate
from hybridmap.calibration.legs import Legs, Motion
from hybridmap.errors import EvaluationError, counted
from hybridmap.geometry import Array, between, robust_sigma, wrap_angle
from hybridmap.odometry_model import NEUTRAL, Gains

LEG_M = (1.0, 16.0)
"""Shortest and longest leg, m; the longest is about the window over which dead reckoning is judged."""
INDEPENDENT_LEGS = 16.0
"""Legs are so short that the way holds this many one after the other, as far as the limits allow."""

SHORTEST_M = 0.1
"""Shortest leg that may be asked for, m: on less, the noise of the poses is all there is."""

CAUCHY = 2.0
"""Scale of the Cauchy weights, in robust standard deviations: about 95 % efficiency for Gaussian noise."""

MAX_CONDITION = 400.0
"""Of the information with a unit diagonal: turning a metre that varies by a tenth of its mean. Recorded drives have 1 to 7."""

MIN_TURN = 3.0
"""Root mean square of the legs' turns over their standard deviation; below it odometry's own noise makes up the turns."""

MAX_SIGMA = 1.0 / SIGNIFICANT_SIGMAS
"""Above it an estimate would not even differ significantly from one that is wrong by 1, 1, 1 rad/m or 1 s."""

DELAY_LIMIT_S = 1.0
"""As far as `sensors.odometry_delay_s` goes."""
_ROUNDS = 40
_FLOOR_RAD = np.radians(0.5)
_WALK_RAD = np.radians(1.0)  # per sqrt(m)
_PER_TURN = 0.03  # per sqrt(rad)
_FLOOR_M, _WALK_M = 0.02, 0.03
_STRAIGHT = 0.3  # a leg shorter than this share of its way says little about lengths
_STRAIGHT_LEGS = 4
_RUNAWAY_S = 10.0  # a delay that the fit may pass through, but not go beyond
_HEADING = ("turn gain", "heading bias", "delay")


@dataclass(frozen=True, slots=True)
class Sighting:
    """A drive with known poses, e.g. those of its nodes on a map, or of a reference.

    Attributes:
        motion: raw odometry.
        stamps_ns: (N,) int64 stamps of the known poses, increasing.
        poses: (N, 3) the known poses, in any frame, m and rad.
    """

    motion: Motion
    stamps_ns: NDArray[np.int64]
    poses: Array


@dataclass(frozen=True, slots=True)
class _Drive:
    legs: Legs
    measured: Array  # (L, 3)
    travel_m: float


def regress(sightings: Sequence[Sighting], leg_m: float | None = None) -> Estimate:
    """Estimate one calibration from one or more drives, by comparing pieces of them ("legs") with the known poses.

    Args:
        sightings: drives of one robot (or of robots of one kind).
        leg_m: length of the legs, m, `SHORTEST_M` or more; None: a sixteenth of the mean drive, within the limits `LEG_M`.

    Raises:
        EvaluationError: too little travel between known poses, unobservable turn gain or heading bias, or an estimate out
            of range.
    """
    if leg_m is not None:
        require_leg(leg_m)
    ways = [_travel_at(sighting) for sighting in sightings]
    total = float(sum(way[-1] - way[0] for way in ways))
    length = leg_length(total / len(ways)) if leg_m is None else leg_m
    drives = [cut(sighting, way, length) for sighting, way in zip(sightings, ways, strict=True)]
    count = sum(len(drive.legs) for drive in drives)
    if total < 4.0 * length or count < 8:
        raise EvaluationError(
            f"calibration: found {counted(count, 'piece')} of {length:.1f} m in {total:.1f} m of odometry between known poses, "
            f"expected at least 8 pieces and {4.0 * length:.1f} m; give a longer drive, or a smaller --leg"
        )
    return _solve(drives, length, total)


def require_leg(leg_m: float) -> None:
    """Check a length of the pieces of a drive that are compared, m.

    Raises:
        EvaluationError: the length is not finite or below `SHORTEST_M`.
    """
    if not SHORTEST_M <= leg_m < math.inf:
        raise EvaluationError(f"calibration: --leg: found {leg_m:g} m, expected {SHORTEST_M:g} m or more")


def require_told_by(sighting: Sighting) -> None:
    """Refuse a drive whose odometry alone shows that turn gain and heading bias are unobservable.

    Only the odometry and the stamps of the sighting are used, not its poses.

    Raises:
        NotToldError: the drive hardly turns, or turn gain and heading bias have the same effect on all of it.
    """
    way = _travel_at(sighting)
    legs = cut(sighting, way, leg_length(float(way[-1] - way[0]))).legs
    require_told(legs.jacobian(NEUTRAL)[:, 2, 1:3] / leg_sigmas(legs)[1][:, None])


def leg_length(travel_m: float) -> float:
    """Length of the pieces in which a drive of this travel is compared, m."""
    return float(np.clip(travel_m / INDEPENDENT_LEGS, *LEG_M))


def leg_sigmas(legs: Legs) -> tuple[Array, Array]:
    """Assumed standard deviations (L,) of the legs' lengths (m) and of the headings at their ends (rad)."""
    travel, turned = legs.travel_m, legs.turned_rad
    length = np.sqrt(_FLOOR_M**2 + _WALK_M**2 * travel)
    return length, np.sqrt(_FLOOR_RAD**2 + _WALK_RAD**2 * travel + _PER_TURN**2 * turned)


def cut(sighting: Sighting, travel_m: Array, leg_m: float) -> _Drive:
    """Cut a drive into legs that start at every known pose and end at the first known pose `leg_m` or more further on.

    A leg of twice that length or more, because known poses are missing, is left out. `travel_m` (N,) is the path length by raw
    odometry at each known pose.
    """
    last = np.searchsorted(travel_m, travel_m + leg_m)
    first = np.flatnonzero(last < len(travel_m))
    last = last[first]
    near = travel_m[last] - travel_m[first] < 2.0 * leg_m
    first, last = first[near], last[near]
    legs = Legs(sighting.motion, sighting.stamps_ns[first], sighting.stamps_ns[last])
    measured = between(sighting.poses[first], sighting.poses[last])
    return _Drive(legs, measured, float(travel_m[-1] - travel_m[0]))


def _travel_at(sighting: Sighting) -> Array:
    motion = sighting.motion
    return np.asarray(np.interp(sighting.stamps_ns, motion.stamps_ns, motion.travel_m))


def _solve(drives: list[_Drive], leg_m: float, total_m: float) -> Estimate:
    travel = np.concatenate([drive.legs.travel_m for drive in drives])
    sigmas = [leg_sigmas(drive.legs) for drive in drives]
    sigma_m, sigma_rad = (np.concatenate([pair[which] for pair in sigmas]) for which in (0, 1))
    overlap = max(1.0, float(travel.sum()) / total_m)
    heading = _heading(drives, sigma_rad, overlap)
    turn_gain, bias, delay_s = heading.values
    length = _fit_length(drives, Gains(1.0, turn_gain, bias), delay_s, sigma_m, travel, overlap)
    gain, variance = (NEUTRAL.gain, math.inf) if length is None else (float(length.values[0]), length.covariance[0, 0])
    covariance = np.zeros((4, 4))
    covariance[0, 0] = variance
    covariance[1:, 1:] = heading.covariance
    return Estimate(
        gains=Gains(gain, float(turn_gain), float(bias)).checked("calibration"),
        delay_s=float(delay_s),
        covariance=covariance,
        leg_m=leg_m,
        legs=len(travel) / overlap,
        travel_m=total_m,
        unit_variance=heading.unit_variance,
        downweighted=float(np.mean(heading.weights < 0.5)),
    )


@dataclass(frozen=True, slots=True)
class _Fit:
    values: Array  # (K,)
    covariance: Array  # (K, K)
    unit_variance: float
    weights: Array  # (L,)


def _heading(drives: list[_Drive], sigma: Array, overlap: float) -> _Fit:
    """Turn gain, bias and delay; an unobservable delay is 0 with infinite variance."""
    try:
        return _fit_heading(drives, sigma, overlap, 3)
    except NotToldError:
        two = _fit_heading(drives, sigma, overlap, 2)
    covariance = np.diag([0.0, 0.0, np.inf])
    covariance[:2, :2] = two.covariance
    return _Fit(np.append(two.values, 0.0), covariance, two.unit_variance, two.weights)


def _fit_heading(drives: list[_Drive], sigma: Array, overlap: float, unknowns: int) -> _Fit:
    """Turn gain, bias and (of three unknowns) delay from the headings at the legs' ends, by robust Gauss-Newton."""
    values = np.array([NEUTRAL.turn_gain, NEUTRAL.heading_bias_rad_m, 0.0])
    measured = np.concatenate([drive.measured[:, 2] for drive in drives])
    for _ in range(_ROUNDS):
        gains, delay_s = Gains(1.0, values[0], values[1]), float(values[2])
        predicted = np.concatenate([drive.legs.predict(gains, delay_s)[:, 2] for drive in drives])
        slope = np.concatenate([drive.legs.jacobian(gains, delay_s)[:, 2, 1 : 1 + unknowns] for drive in drives])
        residual, slope = wrap_angle(predicted - measured) / sigma, slope / sigma[:, None]
        weights = _weights(residual)
        require_told(np.sqrt(weights / weights.mean())[:, None] * slope)
        fit = _weigh(residual, slope, overlap)
        values[:unknowns] -= fit.values
        sigmas = np.sqrt(np.diag(fit.covariance))
        if np.all(np.abs(fit.values) < 1e-3 * sigmas) or abs(values[2]) > _RUNAWAY_S:
            break
    _require_found(values, fit.values, sigmas)
    return _Fit(values[:unknowns], fit.covariance, fit.unit_variance, fit.weights)


def _require_found(values: Array, last_step: Array, sigmas: Array) -> None:
    """Refuse a fit that is too uncertain, has not converged, or has an impossible delay."""
    vague = [name for name, sigma in zip(_HEADING, sigmas, strict=False) if not sigma <= MAX_SIGMA]
    if vague:
        raise NotToldError(
            f"calibration: the drive does not determine the {' and the '.join(vague)}: found a standard deviation of "
            f"{np.max(sigmas):.2g}, expected at most {MAX_SIGMA:.2g}; give a longer drive, one that turns"
        )
    require_delay(float(values[2]))
    if np.any(np.abs(last_step) > sigmas + 1e-9):
        raise EvaluationError(
            f"calibration: the fit did not converge in {_ROUNDS} rounds; are odometry and poses of one recording?"
        )


def _fit_length(
    drives: list[_Drive], gains: Gains, delay_s: float, sigma_m: Array, travel_m: Array, overlap: float
) -> _Fit | None:
    """The gain from the legs' lengths along the measured chords, None if unobservable; `gains` has a gain of one."""
    measured = np.concatenate([drive.measured[:, :2] for drive in drives])
    predicted = np.concatenate([drive.legs.predict(gains, delay_s)[:, :2] for drive in drives])
    length = np.hypot(measured[:, 0], measured[:, 1])
    straight = length > _STRAIGHT * travel_m
    along = np.sum(predicted * measured, axis=1)[straight] / length[straight]
    if len(along) < _STRAIGHT_LEGS or not np.any(along):
        return None
    sigma = sigma_m[straight]
    gain = 1.0
    for _ in range(_ROUNDS):
        fit = _weigh((gain * along - length[straight]) / sigma, (along / sigma)[:, None], overlap)
        gain -= float(fit.values[0])
        if abs(fit.values[0]) < 1e-3 * np.sqrt(fit.covariance[0, 0]):
            break
    told = np.sqrt(fit.covariance[0, 0]) <= MAX_SIGMA
    return _Fit(np.array([gain]), fit.covariance, fit.unit_variance, fit.weights) if told else None


def _weigh(residual: Array, slope: Array, overlap: float) -> _Fit:
    """One step of iteratively reweighted least squares; `values` are subtracted.

    Cauchy weights with the scale of the residuals' median. Overlapping legs count once: the information is divided by the
    number of legs over a place, and scaled by the weighted mean square of the residuals.
    """
    weights = _weights(residual)
    inverse = np.linalg.inv(slope.T @ (weights[:, None] * slope))
    independent = len(residual) / overlap
    freedom = max(independent - slope.shape[1], 1.0)
    unit_variance = float(weights @ residual**2 / weights.sum()) * independent / freedom
    step = inverse @ (slope.T @ (weights * residual))
    return _Fit(step, inverse * overlap * unit_variance, unit_variance, weights)


def _weights(residual: Array) -> Array:
    scale = max(float(robust_sigma(residual)), 1e-9)
    return np.asarray(1.0 / (1.0 + (residual / (CAUCHY * scale)) ** 2))


class NotToldError(EvaluationError):
    """The drive does not determine a value of the calibration that must be determined; the message names it."""


def require_told(slope: Array) -> None:
    """Refuse legs whose headings leave the calibration unobservable, so that such a value is never reported.

    On a circle at constant speed the turn per metre is known, but not whether turn gain or heading bias causes its error. The
    noise of odometry still separates the two columns of the fit, which would then fit noise.

    Args:
        slope: (L, K) derivatives of the whitened (and weighted) headings by turn gain, heading bias and, with K = 3, delay.

    Raises:
        NotToldError: the legs hardly turn, or two parameters have the same effect on all of them.
    """
    turn = float(np.sqrt(np.mean(slope[:, 0] ** 2)))
    if not turn >= MIN_TURN:
        raise NotToldError(
            f"calibration: the drive does not determine the turn gain: found turns of {turn:.1f} standard deviations of "
            f"the heading, expected {MIN_TURN:g} or more; give a drive that turns"
        )
    condition = condition_number(slope)
    if not condition <= MAX_CONDITION:
        raise NotToldError(
            f"calibration: the drive does not tell turn gain and heading bias apart: found a condition number of "
            f"{condition:.2g}, expected at most {MAX_CONDITION:g}; give a drive with straight parts and turns"
        )


def require_delay(delay_s: float) -> float:
    """Check that a delay is within what a sensor's clock can have; returns it.

    Raises:
        EvaluationError: the delay is beyond `DELAY_LIMIT_S`.
    """
    if abs(delay_s) <= DELAY_LIMIT_S:
        return delay_s
    raise EvaluationError(
        f"calibration: found a delay of {delay_s:.2f} s between odometry and the poses, expected at most {DELAY_LIMIT_S:g} s; "
        f"are both on one clock?"
    )


def condition_number(slope: Array) -> float:
    """Condition number of the information matrix J'J of derivatives J (L, K), with each parameter scaled to information 1."""
    norms = np.linalg.norm(slope, axis=0)
    if not (np.isfinite(norms).all() and np.all(norms > 0.0)):
        return float("inf")
    return float(np.linalg.cond(slope / norms)) ** 2
