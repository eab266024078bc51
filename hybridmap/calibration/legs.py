"""Legs: pieces of raw odometry between known poses, and the derivative of their displacement by the calibration."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import TypeVar

import numpy as np
from numpy.typing import NDArray

from hybridmap.geometry import Array, between, log
from hybridmap.graph.paths import own_odometry
from hybridmap.graph.pose_graph import PoseGraph
from hybridmap.odometry_model import Gains, apply, chord_of_arc, twists
from hybridmap.trajectory import NS_PER_S

_Number = TypeVar("_Number", np.float64, np.complex128)

_DELAY_STEP_S = 0.02
"""Half of the time over which a derivative by the delay is taken: odometry comes at 10 to 100 Hz."""


@dataclass(frozen=True, slots=True)
class Motion:
    """Raw odometry over a recording, as S steps.

    Attributes:
        stamps_ns: (S + 1,) int64, strictly increasing.
        steps: (S, 3) raw displacement from each stamp to the next, in the frame of the pose before it, m and rad.
    """

    stamps_ns: NDArray[np.int64]
    steps: Array

    def poses(self, gains: Gains) -> Array:
        """Dead reckoning (S + 1, 3) from the origin with given gains, m and rad; headings are not wrapped."""
        return chain(apply(self.steps, gains))

    @property
    def travel_m(self) -> Array:
        """(S + 1,) path length by raw odometry up to each stamp."""
        return _running(np.hypot(self.steps[:, 0], self.steps[:, 1]))

    @property
    def turned_rad(self) -> Array:
        """(S + 1,) absolute angle turned by raw odometry up to each stamp."""
        return _running(np.abs(self.steps[:, 2]))


@dataclass(frozen=True, slots=True)
class Legs:
    """Pieces of raw odometry between pairs of times, given on the clock of the sensor that gave the poses.

    Times outside the odometry count as its first or last stamp.

    Attributes:
        motion: the odometry.
        first_ns, last_ns: (L,) int64, start and end of each leg.
    """

    motion: Motion
    first_ns: NDArray[np.int64]
    last_ns: NDArray[np.int64]

    def __len__(self) -> int:
        return len(self.first_ns)

    @property
    def travel_m(self) -> Array:
        """(L,) path length of each leg by raw odometry."""
        return self._difference(self.motion.travel_m, 0.0)

    @property
    def turned_rad(self) -> Array:
        """(L,) absolute angle turned on each leg by raw odometry."""
        return self._difference(self.motion.turned_rad, 0.0)

    def select(self, kept: NDArray[np.bool_] | NDArray[np.int64]) -> Legs:
        """The legs chosen by a mask (L,) or by indices."""
        return Legs(self.motion, self.first_ns[kept], self.last_ns[kept])

    def predict(self, gains: Gains, delay_s: float = 0.0) -> Array:
        """Displacement (L, 3) of each leg, in the frame of its start, m and rad.

        Args:
            gains: the calibration.
            delay_s: delay of the odometry clock: odometry of stamp t gives the pose at t + delay_s.
        """
        path = self.motion.poses(gains)
        first, last = self._at(path, self.first_ns, delay_s), self._at(path, self.last_ns, delay_s)
        return between(first, last)

    def jacobian(self, gains: Gains, delay_s: float = 0.0) -> Array:
        """Derivative (L, 3, 4) of `predict` by gain, turn gain, heading bias and delay, as a right perturbation.

        The heading of step k is the sum of the calibrated turns before it and half of its own; its derivatives are the same
        sums of raw turn and of raw forward travel. The chord of step k shortens as its own turn grows. The derivative by the
        delay is a central difference.
        """
        forward, left, turned = twists(self.motion.steps).T
        turn = gains.turn_gain * turned + gains.heading_bias_rad_m * forward
        z = (forward + 1j * left) * chord_of_arc(turn) * np.exp(1j * (np.cumsum(turn) - 0.5 * turn))
        to_end = np.exp(-1j * self._at(_running(turn), self.last_ns, delay_s))
        way = self._difference(_running(z), delay_s)
        out = np.zeros((len(self), 3, 4))
        out[:, 0, 0], out[:, 1, 0] = (way * to_end).real, (way * to_end).imag
        for column, raw in ((1, turned), (2, forward)):
            before = np.cumsum(raw) - 0.5 * raw
            start = self._at(_running(raw), self.first_ns, delay_s)
            bent = self._difference(_running(z * (1j * before + _shortening(turn) * raw)), delay_s) - 1j * start * way
            bent *= gains.gain * to_end
            out[:, 0, column], out[:, 1, column] = bent.real, bent.imag
            out[:, 2, column] = self._difference(_running(raw), delay_s)
        later, earlier = (self.predict(gains, delay_s + h) for h in (_DELAY_STEP_S, -_DELAY_STEP_S))
        out[:, :, 3] = log(between(earlier, later)) / (2.0 * _DELAY_STEP_S)
        return out

    def _difference(self, running: NDArray[_Number], delay_s: float) -> NDArray[_Number]:
        return np.asarray(self._at(running, self.last_ns, delay_s) - self._at(running, self.first_ns, delay_s))

    def _at(self, values: NDArray[_Number], stamps_ns: NDArray[np.int64], delay_s: float) -> NDArray[_Number]:
        """Values (S + 1, ...) along the odometry at given stamps on the legs' clock, linear within a step."""
        times = self.motion.stamps_ns
        wanted = np.clip(stamps_ns - round(delay_s * NS_PER_S), times[0], times[-1])
        right = np.clip(np.searchsorted(times, wanted), 1, len(times) - 1)
        share = (wanted - times[right - 1]) / (times[right] - times[right - 1])
        share = share.reshape(-1, *([1] * (values.ndim - 1)))
        return np.asarray(values[right - 1] + share * (values[right] - values[right - 1]))


def corrected(graph: PoseGraph, motion: Motion, stamps_ns: NDArray[np.int64], gains: Gains, delay_s: float = 0.0) -> PoseGraph:
    """Copy of the graph with the odometry edges from a node to the next recomputed from calibrated odometry.

    Their information, all other edges and the initial poses are unchanged.

    Args:
        graph: nodes and accepted edges.
        motion: raw odometry.
        stamps_ns: (N,) stamps of the nodes, ns.
        gains: the calibration.
        delay_s: delay of the odometry clock: odometry of stamp t gives the pose at t + delay_s.
    """
    own, deltas = own_odometry(graph), graph.deltas.copy()
    legs = Legs(motion, stamps_ns[graph.sources[own]], stamps_ns[graph.targets[own]])
    deltas[own] = legs.predict(gains, delay_s)
    return replace(graph, deltas=deltas)


def chain(steps: Array) -> Array:
    """Poses (S + 1, 3) from the origin along steps (S, 3), m and rad; headings are not wrapped."""
    heading = _running(steps[:, 2])
    z = (steps[:, 0] + 1j * steps[:, 1]) * np.exp(1j * heading[:-1])
    position = _running(z)
    return np.column_stack([position.real, position.imag, heading])


def _shortening(turn: Array) -> Array:
    """Derivative of the logarithm of `chord_of_arc` by the turn, 1/rad."""
    small = np.abs(turn) < 1e-3
    safe = np.where(small, 1.0, turn)
    return np.where(small, -turn / 12.0, 0.5 / np.tan(0.5 * safe) - 1.0 / safe)


def _running(values: NDArray[_Number]) -> NDArray[_Number]:
    return np.concatenate([np.zeros(1, dtype=values.dtype), np.cumsum(values)])
