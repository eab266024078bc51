"""How the robot drives: a differential drive that pursues way points with bounded speed, turn rate and acceleration."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from hybridmap.geometry import Array, wrap_angle

_STEP_OF_PATH_M = 0.02
_LOOK_AHEAD_M = 0.45


@dataclass(frozen=True, slots=True)
class DriveLimits:
    """What the drive may do: m/s, rad/s, m/s^2, rad/s^2."""

    speed_m_s: float
    turn_rate_rad_s: float
    acceleration_m_s2: float = 0.5
    turn_acceleration_rad_s2: float = 1.5


@dataclass(slots=True)
class _State:
    x: float
    y: float
    yaw: float
    v: float = 0.0
    omega: float = 0.0

    def advance(self, dt_s: float) -> tuple[float, float, float]:
        """Move along the arc of the current speeds and return the new pose."""
        half = 0.5 * self.omega * dt_s
        chord = self.v * dt_s * (math.sin(half) / half if abs(half) > 1e-9 else 1.0)
        self.x += chord * math.cos(self.yaw + half)
        self.y += chord * math.sin(self.yaw + half)
        self.yaw += 2.0 * half
        return self.x, self.y, self.yaw


def drive(legs: Sequence[Array], limits: DriveLimits, dt_s: float) -> Array:
    """True poses (N, 3), m and rad, every `dt_s` seconds: along each leg, turning on the spot before the next.

    Args:
        legs: way points (M, 2), m; each leg begins where the one before ends.
        limits: of the drive.
        dt_s: step, s.
    """
    first = legs[0][1] - legs[0][0]
    state = _State(float(legs[0][0, 0]), float(legs[0][0, 1]), math.atan2(first[1], first[0]))
    poses = [(state.x, state.y, state.yaw)]
    for index, leg in enumerate(legs):
        if index:
            ahead = leg[1] - leg[0]
            poses += _turn(state, math.atan2(ahead[1], ahead[0]), limits, dt_s)
        poses += _follow(state, leg, limits, dt_s)
    out = np.array(poses)
    out[:, 2] = wrap_angle(out[:, 2])
    return out


def _follow(state: _State, leg: Array, limits: DriveLimits, dt_s: float) -> list[tuple[float, float, float]]:
    """Pure pursuit of the leg until its end, where the robot stops."""
    path = _resample(leg)
    nearest, poses = 0, []
    lead = round(_LOOK_AHEAD_M / _STEP_OF_PATH_M)
    extended = np.vstack([path, path[-1] + (path[-1] - path[-2]) * np.arange(1, lead + 2)[:, None]])
    last = len(path) - 1
    for _ in range(int(60.0 * 60.0 / dt_s)):
        window = path[nearest : nearest + lead]
        nearest += int(np.argmin((window[:, 0] - state.x) ** 2 + (window[:, 1] - state.y) ** 2))
        remaining = math.dist(path[last], (state.x, state.y)) if nearest > last - lead else (last - nearest) * _STEP_OF_PATH_M
        if nearest >= last:
            break
        curvature = _curvature(state, extended[nearest + lead])
        wanted = min(
            limits.speed_m_s,
            limits.turn_rate_rad_s / max(abs(curvature), 1e-6),
            max(0.03, math.sqrt(2.0 * 0.8 * limits.acceleration_m_s2 * remaining)),
        )
        state.v = _approach(state.v, wanted, limits.acceleration_m_s2 * dt_s)
        turn = max(-limits.turn_rate_rad_s, min(limits.turn_rate_rad_s, curvature * state.v))
        state.omega = _approach(state.omega, turn, limits.turn_acceleration_rad_s2 * dt_s)
        poses.append(state.advance(dt_s))
    state.v = state.omega = 0.0
    return poses


def _turn(state: _State, heading_rad: float, limits: DriveLimits, dt_s: float) -> list[tuple[float, float, float]]:
    """Turn on the spot to a heading, the shorter way round (left where both are equal)."""
    poses = []
    left = float(wrap_angle(heading_rad - state.yaw + 1e-3)) - 1e-3
    left = left + 2.0 * math.pi if left < -math.pi + 0.01 else left
    sign = math.copysign(1.0, left)
    left = abs(left)
    while left > 1e-3:
        wanted = min(limits.turn_rate_rad_s, math.sqrt(2.0 * 0.8 * limits.turn_acceleration_rad_s2 * left), left / dt_s)
        rate = _approach(abs(state.omega), wanted, limits.turn_acceleration_rad_s2 * dt_s)
        state.omega = sign * min(rate, left / dt_s)
        left -= abs(state.omega) * dt_s
        poses.append(state.advance(dt_s))
    state.omega = 0.0
    return poses


def _curvature(state: _State, target: Array) -> float:
    """Curvature, 1/m, of the arc through the target that leaves along the robot's heading."""
    dx, dy = float(target[0]) - state.x, float(target[1]) - state.y
    sideways = -math.sin(state.yaw) * dx + math.cos(state.yaw) * dy
    return 2.0 * sideways / max(dx * dx + dy * dy, 1e-4)


def _approach(value: float, wanted: float, most: float) -> float:
    return value + max(-most, min(most, wanted - value))


def _resample(leg: Array) -> Array:
    """Points (N, 2) every 2 cm along the way points."""
    travelled = np.concatenate([[0.0], np.cumsum(np.hypot(*np.diff(leg, axis=0).T))])
    at = np.linspace(0.0, travelled[-1], max(2, round(travelled[-1] / _STEP_OF_PATH_M) + 1))
    return np.column_stack([np.interp(at, travelled, leg[:, axis]) for axis in (0, 1)])
