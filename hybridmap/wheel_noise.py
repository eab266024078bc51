"""The noise of the wheels, learnt while driving from the registrations of consecutive nodes."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from hybridmap.config.mapping import EdgesConfig
from hybridmap.geometry import Array, RelativePose, between, log, robust_sigma
from hybridmap.graph.agreement import BOUND
from hybridmap.graph.paths import odometry_covariance

WINDOWS_M = (5.0, 10.0, 20.0, 50.0)
"""Lengths of the stretches over which the two headings are compared, m: errors of wheels show over metres, and heading biases
over tens of metres."""
FIRST_M, GROWTH = 100.0, 1.25
"""Path length at which the noise is first known, m, and by which factor it grows until it is learnt again."""
GOOD_DEG = 0.5
"""Wheels of less heading noise than this, degrees per root metre, are good: corridor robots have 0.5 to 0.7 and bad wheels 1.3
to 9."""
LEAST_DEG = 0.05
"""Wheels are never taken to have less heading noise than this, degrees per root metre."""
CONTRADICTED_MAX = 0.02
"""Largest share of registrations that contradict good wheels. One in a hundred does if the covariances are right. A laser has
0.1 % on a campus that it sees to 80 m, and 4 to 8 % among trees and hedges, or where it sees a quarter of the way. If more of
them do, residuals do not show how much they err, and a registration's heading is at best as uncertain as that of the wheels."""
GOOD_M = 0.1
"""So is its translation if the two differ by less than this, m per root metre. Wheels whose scale is wrong by 3 % differ by
twice that, and a registration knows better."""
MISSING_SHARE = 0.1
"""A stretch counts if at most this share of its way has no registration; the two headings are taken to agree there."""
FEWEST = 20
"""Least number of stretches of one length that count."""
UNSEEN: Array = np.full(3, np.nan)
UNSEEN.setflags(write=False)


@dataclass(frozen=True, slots=True)
class LearntNoise:
    """The noise of the wheels as learnt at one moment.

    Attributes:
        heading_deg: degrees per root metre; the largest over all lengths of stretches.
        translation_m: m per root metre, of the worse axis; likewise.
        contradicting: share of the registrations that contradict these wheels; 0 if they are not good.
        travel_m: path length at that moment.
    """

    heading_deg: float
    translation_m: float
    contradicting: float
    travel_m: float

    @property
    def good(self) -> bool:
        """Whether the wheels are so good that one registration must not overrule them."""
        return self.heading_deg < GOOD_DEG

    @property
    def overrules(self) -> bool:
        """Whether the wheels are good and the registrations are not."""
        return self.good and self.contradicting > CONTRADICTED_MAX


class WheelNoise:
    """Learns the noise of the wheels, and says what follows for the covariances of edges.

    For stretches of length L, D(L) = 1.48 median |sum of registration yaw - sum of wheel yaw| / sqrt(L), and likewise for the
    steps' translation. The noise is the largest D(L). It contains the noise of the registrations: the wheels are at least that
    good.

    Attributes:
        learnt: what is known now; None before `FIRST_M` of driving.
    """

    def __init__(self, config: EdgesConfig) -> None:
        """Start with the noise of the configuration."""
        self._config = self._effective = config
        self.learnt: LearntNoise | None = None
        self._steps: list[_Step] = []
        self._travel_m = 0.0
        self._due_m = FIRST_M

    @property
    def trusted(self) -> bool:
        """Whether the wheels are known to be good."""
        return self.learnt is not None and self.learnt.good

    def covariance(self, travel_m: float, turn_rad: float) -> Array:
        """Covariance (3, 3) of a stretch of dead reckoning, as `odometry_covariance`, with the noise that was learnt."""
        return odometry_covariance(self._effective, travel_m, turn_rad)

    def beside(self, registration: RelativePose, wheels: RelativePose) -> RelativePose:
        """A registration with the covariance that wheels which are trusted leave to it; unchanged if they are not.

        Where the two contradict each other, its covariance grows with the square of their distance, as a Geman-McClure kernel
        would have it: one registration does not overrule a good odometry. Where many do, none is surer than the wheels.

        Args:
            registration: the measurement.
            wheels: the same motion by the wheels, with the covariance of `covariance`.
        """
        if self.learnt is None or not self.learnt.good:
            return registration
        covariance = registration.covariance
        if self.learnt.overrules:
            in_all = self.learnt.translation_m < GOOD_M
            covariance = covariance + (wheels.covariance if in_all else np.diag([0.0, 0.0, wheels.covariance[2, 2]]))
        squared = _squared(RelativePose(registration.delta, covariance), wheels)
        return RelativePose(registration.delta, covariance * max(1.0, squared / BOUND) ** 2)

    def drive(self, travel_m: float, turn_rad: float, delta: Array) -> bool:
        """Add a step between two nodes; returns whether the covariances of earlier edges must change.

        The new step does not count yet, as its registration is still to come.

        Args:
            travel_m, turn_rad: path length of the step, and angle turned.
            delta: (3,) the motion by the wheels, m and rad.
        """
        was_trusted, learns = self.trusted, self._travel_m >= self._due_m
        if learns:
            self._due_m = GROWTH * self._travel_m
            self._learn()
        self._travel_m += travel_m
        self._steps.append(_Step(travel_m, turn_rad, delta))
        return learns and (was_trusted or self.trusted)

    def register(self, registration: RelativePose) -> None:
        """Add the motion of the newest step by registration: the pose of its last node in the frame of its first."""
        self._steps[-1].registration = registration

    def measure_again(self, deltas: Array) -> bool:
        """Replace the motion of all S steps by the wheels, (S, 3) m and rad, and learn again what was learnt from them.

        Returns:
            Whether the covariances of edges must change.
        """
        for step, delta in zip(self._steps, deltas, strict=True):
            step.wheels = delta
        was_trusted = self.trusted
        if self.learnt is not None:
            self._learn()
        return was_trusted or self.trusted

    def _learn(self) -> None:
        travel = np.cumsum([step.travel_m for step in self._steps])
        difference = np.array([step.difference for step in self._steps])
        missing = np.isnan(difference[:, 2])
        summed = np.cumsum(np.where(missing[:, None], 0.0, difference), axis=0)
        unseen = np.cumsum(np.where(missing, np.diff(travel, prepend=0.0), 0.0))
        noise = np.array([_over(length, travel, summed, unseen) for length in WINDOWS_M])
        if not np.isfinite(noise).any():
            return
        along, across, heading = np.nanmax(noise, axis=0).tolist()
        heading_deg = max(float(np.rad2deg(heading)), LEAST_DEG)
        good = heading_deg < GOOD_DEG
        self._effective = _with_heading_noise(self._config, heading_deg) if good else self._config
        self.learnt = LearntNoise(heading_deg, max(along, across), self._contradicting() if good else 0.0, float(travel[-1]))

    def _contradicting(self) -> float:
        """Share of the registrations that contradict the wheels."""
        squared = [
            _squared(step.registration, RelativePose(step.wheels, self.covariance(step.travel_m, step.turn_rad)))
            for step in self._steps
            if step.registration is not None
        ]
        return float(np.mean(np.array(squared) > BOUND))


@dataclass(slots=True)
class _Step:
    """The motion between two nodes, by wheels and by registration."""

    travel_m: float
    turn_rad: float
    wheels: Array
    registration: RelativePose | None = None

    @property
    def difference(self) -> Array:
        """(3,) the motion by registration as seen from that by the wheels; NaN without registration."""
        return UNSEEN if self.registration is None else between(self.wheels, self.registration.delta)


def _squared(registration: RelativePose, wheels: RelativePose) -> float:
    """Squared distance of two measurements of the same motion, over their covariance."""
    error = log(between(wheels.delta, registration.delta))
    return float(error @ np.linalg.solve(wheels.covariance + registration.covariance, error))


def _with_heading_noise(config: EdgesConfig, heading_deg: float) -> EdgesConfig:
    """The configuration with its three terms of heading noise reduced to so many degrees per root metre."""
    share = min(1.0, heading_deg / config.rotation_deg_per_sqrt_m) if config.rotation_deg_per_sqrt_m > 0.0 else 1.0
    return config.model_copy(
        update={
            "rotation_deg_per_sqrt_m": share * config.rotation_deg_per_sqrt_m,
            "rotation_floor_deg": share * config.rotation_floor_deg,
            "rotation_per_turn": share * config.rotation_per_turn,
        }
    )


def _over(length_m: float, travel: Array, summed: Array, unseen: Array) -> Array:
    """D(L) (3,) along, across and of the heading, m and rad per root metre; NaN if too few stretches have registrations.

    Args:
        length_m: L.
        travel: (N,) path length at each node, m.
        summed: (N, 3) differences of the steps up to each node, m and rad.
        unseen: (N,) path length without a registration up to each node, m.
    """
    end = np.searchsorted(travel, travel + length_m)
    start = np.flatnonzero(end < len(travel))
    end = end[start]
    driven = travel[end] - travel[start]
    seen = unseen[end] - unseen[start] <= MISSING_SHARE * driven
    if np.count_nonzero(seen) < FEWEST:
        return UNSEEN
    return robust_sigma((summed[end] - summed[start])[seen] / np.sqrt(driven[seen])[:, None])
