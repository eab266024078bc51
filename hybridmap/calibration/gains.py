"""The three numbers of an odometry calibration, and what they do to a step of self-motion."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Self

import numpy as np
from numpy.typing import ArrayLike
from pydantic import ValidationError

from hybridmap.config.mapping import NeuralConfig
from hybridmap.errors import EvaluationError
from hybridmap.geometry import Array

GAIN_KEYS = ("gain", "turn_gain", "heading_bias_rad_m")
"""Their names in the section `neural` of a configuration."""

_FIXED_POINT_ROUNDS = 6
"""The heading bias of a step changes its own mid-point heading by less than 1 %: each round wins two digits."""


@dataclass(frozen=True, slots=True)
class Gains:
    """Odometry calibration, as the path integrator applies it (`neural/path_integrator.py: PathIntegrator.step`).

    A raw step (dx, dy, dyaw) turns the robot by `turn_gain * dyaw + heading_bias_rad_m * dx`; its chord, turned back by
    half of the raw turn and forth by half of the calibrated one, is scaled by `gain`.

    Attributes:
        gain: k_m, metres a metre of odometry.
        turn_gain: k_w, radians a radian of odometry.
        heading_bias_rad_m: radians added a metre forward.
    """

    gain: float = 1.0
    turn_gain: float = 1.0
    heading_bias_rad_m: float = 0.0

    @classmethod
    def of(cls, config: NeuralConfig) -> Self:
        """The gains of a configuration."""
        return cls(config.gain, config.turn_gain, config.heading_bias_rad_m)

    @classmethod
    def from_array(cls, values: ArrayLike) -> Self:
        """From (3,): gain, turn gain, heading bias."""
        gain, turn_gain, bias = (float(value) for value in np.asarray(values, dtype=np.float64))
        return cls(gain, turn_gain, bias)

    def checked(self, origin: str) -> Self:
        """The same, if a configuration may hold them; `origin` names them in errors.

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
        """(3,): gain, turn gain, heading bias."""
        return np.array([self.gain, self.turn_gain, self.heading_bias_rad_m])


NEUTRAL = Gains()


def mid_chords(steps: Array) -> Array:
    """Chords (S, 2) of steps (S, 3), m, seen from the heading half-way through the step's own turn."""
    cos, sin = np.cos(0.5 * steps[:, 2]), np.sin(0.5 * steps[:, 2])
    return np.column_stack([cos * steps[:, 0] + sin * steps[:, 1], cos * steps[:, 1] - sin * steps[:, 0]])


def apply(steps: Array, gains: Gains) -> Array:
    """Calibrated steps (S, 3) of raw ones (S, 3), m and rad: what the path integrator makes of them."""
    turn = gains.turn_gain * steps[:, 2] + gains.heading_bias_rad_m * steps[:, 0]
    return _steps(gains.gain * mid_chords(steps), turn)


def remove(steps: Array, gains: Gains) -> Array:
    """Raw steps (S, 3) of calibrated ones (S, 3): the inverse of `apply`."""
    mid = mid_chords(steps) / gains.gain
    turn = steps[:, 2] / gains.turn_gain
    for _ in range(_FIXED_POINT_ROUNDS if gains.heading_bias_rad_m else 0):
        forward = np.cos(0.5 * turn) * mid[:, 0] - np.sin(0.5 * turn) * mid[:, 1]
        turn = (steps[:, 2] - gains.heading_bias_rad_m * forward) / gains.turn_gain
    return _steps(mid, turn)


def _steps(mid: Array, turn: Array) -> Array:
    cos, sin = np.cos(0.5 * turn), np.sin(0.5 * turn)
    return np.column_stack([cos * mid[:, 0] - sin * mid[:, 1], sin * mid[:, 0] + cos * mid[:, 1], turn])
