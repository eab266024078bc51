"""What a calibration of odometry is, and what it does to a step: the one model of integrator, regression and graph.

Over a step the robot is taken to drive an arc: with the twist (x, y, w) = log(step) of a raw step, the calibrated one is

    exp(k_m x, k_m y, k_w w + b x),

k_m the gain, k_w the turn gain and b the heading bias, in radians a metre of arc. So a step that is cut into parts of the same
arc comes to the same, and odometry at 10 Hz, at 100 Hz and from node to node has one calibration. Seen from the heading
half-way through its turn, the chord of an arc lies along its (x, y), shorter by sin(w/2) / (w/2).

A fourth number, the delay, belongs to the clock and not to the step: odometry of stamp t tells where the robot is at t + delay.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Self

import numpy as np
from numpy.typing import ArrayLike
from pydantic import ValidationError

from hybridmap.config.mapping import NeuralConfig
from hybridmap.errors import EvaluationError
from hybridmap.geometry import Array, wrap_angle

GAIN_KEYS = ("gain", "turn_gain", "heading_bias_rad_m")
"""Their names in the section `neural` of a configuration."""

_STRAIGHT_RAD = 1e-9  # turn up to which chord and arc are the same number


@dataclass(frozen=True, slots=True)
class Gains:
    """Calibration of odometry.

    Attributes:
        gain: k_m, true metres in one metre of odometry.
        turn_gain: k_w, true radians in one radian of odometry.
        heading_bias_rad_m: b, radians added for each metre forward.
    """

    gain: float = 1.0
    turn_gain: float = 1.0
    heading_bias_rad_m: float = 0.0

    @classmethod
    def of(cls, config: NeuralConfig) -> Self:
        """The gains that a configuration sets."""
        return cls(config.gain, config.turn_gain, config.heading_bias_rad_m)

    @classmethod
    def from_array(cls, values: ArrayLike) -> Self:
        """Make gains from an array (3,): gain, turn gain, heading bias."""
        gain, turn_gain, bias = (float(value) for value in np.asarray(values, dtype=np.float64))
        return cls(gain, turn_gain, bias)

    def checked(self, origin: str) -> Self:
        """Return the same gains if a configuration may hold them; `origin` names their source in errors.

        Raises:
            EvaluationError: one lies outside its limits, e.g. a gain below zero.
        """
        try:
            NeuralConfig.model_validate(dict(zip(GAIN_KEYS, self.to_array().tolist(), strict=True)))
        except ValidationError as error:
            first = error.errors()[0]
            raise EvaluationError(
                f"{origin}: found {first['loc'][0]} {first['input']:.4g}, which no robot has ({first['msg'].lower()}); "
                f"are odometry and poses of one recording?"
            ) from None
        return self

    def to_array(self) -> Array:
        """The gains as an array (3,): gain, turn gain, heading bias."""
        return np.array([self.gain, self.turn_gain, self.heading_bias_rad_m])


NEUTRAL = Gains()


def step_of(dx_m: float, dy_m: float, dyaw_rad: float, gains: Gains) -> tuple[float, float, float]:
    """Calibrate one raw step, quickly.

    Returns:
        Its chord (forward, left; m) seen from the heading half-way through its turn, and its turn, rad.
    """
    cos, sin = math.cos(0.5 * dyaw_rad), math.sin(0.5 * dyaw_rad)
    forward, left = cos * dx_m + sin * dy_m, cos * dy_m - sin * dx_m
    shorter = 2.0 * sin / dyaw_rad if abs(dyaw_rad) > _STRAIGHT_RAD else 1.0
    turn = gains.turn_gain * dyaw_rad + gains.heading_bias_rad_m * (forward / shorter)
    scale = gains.gain
    if turn != dyaw_rad:
        scale *= (2.0 * math.sin(0.5 * turn) / turn if abs(turn) > _STRAIGHT_RAD else 1.0) / shorter
    return scale * forward, scale * left, turn


def twists(steps: Array) -> Array:
    """Twists (forward, left and turn along an arc; m and rad) (S, 3) of steps (S, 3), as by `geometry.log`."""
    turn = wrap_angle(steps[:, 2])
    cos, sin = np.cos(0.5 * turn), np.sin(0.5 * turn)
    forward, left = cos * steps[:, 0] + sin * steps[:, 1], cos * steps[:, 1] - sin * steps[:, 0]
    return np.column_stack([np.column_stack([forward, left]) / chord_of_arc(turn)[:, None], turn])


def steps_of(arcs: Array) -> Array:
    """Steps (S, 3) of twists (S, 3), m and rad: the inverse of `twists`, but headings are not wrapped."""
    turn = arcs[:, 2]
    cos, sin, shorter = np.cos(0.5 * turn), np.sin(0.5 * turn), chord_of_arc(turn)
    x, y = shorter * arcs[:, 0], shorter * arcs[:, 1]
    return np.column_stack([cos * x - sin * y, sin * x + cos * y, turn])


def apply(steps: Array, gains: Gains) -> Array:
    """Calibrate raw odometry steps (S, 3), m and rad; returns the calibrated steps (S, 3), whose turns are not wrapped.

    The turn of a raw step is taken to lie in [-pi, pi).
    """
    raw = twists(steps)
    turn = gains.turn_gain * raw[:, 2] + gains.heading_bias_rad_m * raw[:, 0]
    return steps_of(np.column_stack([gains.gain * raw[:, :2], turn]))


def remove(steps: Array, gains: Gains) -> Array:
    """Return the raw odometry steps (S, 3) of calibrated ones (S, 3): the inverse of `apply`."""
    arcs = twists(steps)
    way = arcs[:, :2] / gains.gain
    return steps_of(np.column_stack([way, (arcs[:, 2] - gains.heading_bias_rad_m * way[:, 0]) / gains.turn_gain]))


def chord_of_arc(turn_rad: Array) -> Array:
    """Length of an arc's chord as a share of the arc's length: sin(w/2) / (w/2)."""
    return np.asarray(np.sinc(turn_rad / (2.0 * np.pi)))
