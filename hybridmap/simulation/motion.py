"""Motion of the simulated robot: it follows way points, may be kidnapped, and its wheels measure the motion with errors."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from hybridmap.config.inputs import WheelErrorConfig
from hybridmap.errors import ConfigError
from hybridmap.geometry import Array, between, compose, interpolate, quaternion_from_yaw, wrap_angle, yaw_from_quaternion

_STEP_OF_PATH_M = 0.02
_LOOK_AHEAD_M = 0.45
_WEAVE_M = 5.9
"""Length of a weave, m: no multiple of a lap of any world, so that the laps differ."""


@dataclass(frozen=True, slots=True)
class DriveLimits:
    """Largest speeds and accelerations of the simulated robot: m/s, rad/s, m/s^2, rad/s^2."""

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
    """Simulate a drive along pieces of a path; between two pieces the robot stops and turns on the spot.

    Args:
        legs: way points (M, 2) of each piece, m; each piece begins where the one before ends.
        limits: largest speeds and accelerations.
        dt_s: time step, s.

    Returns:
        True poses (N, 3), m and rad, one per time step; the first at the first way point, towards the second.
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


def weaving(legs: Sequence[Array], amplitude_m: float) -> list[Array]:
    """Way points (M, 2) of pieces of a path that weave from side to side by `amplitude_m`, at another place in each lap.

    Every piece keeps its two ends, and its length to a few per cent.
    """
    out, travelled_m = [], 0.0
    for leg in legs:
        path = _resample(leg)
        along = np.gradient(path, axis=0)
        left = np.column_stack([-along[:, 1], along[:, 0]]) / np.maximum(np.hypot(*along.T), 1e-9)[:, None]
        here_m = _STEP_OF_PATH_M * np.arange(len(path))
        from_ends_m = np.minimum(here_m, here_m[::-1])
        sideways_m = amplitude_m * np.minimum(from_ends_m / _WEAVE_M, 1.0)
        sideways_m *= np.sin(2.0 * np.pi * (travelled_m + here_m) / _WEAVE_M)
        out.append(path + sideways_m[:, None] * left)
        travelled_m += float(here_m[-1])
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
    """Turn on the spot to a heading, the shorter way (left if both are equal)."""
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


_KNOWN_M, _KNOWN_RAD = 0.5, float(np.deg2rad(20.0))
"""The robot is put down where it drove before, this near and looking the same way."""
_WALK_M_S = 1.0
_EVERY = 15
"""Steps of the drive between two moments that are tried."""


@dataclass(frozen=True, slots=True)
class KidnappedDrive:
    """A drive on which the robot is kidnapped: picked up, carried, and put down elsewhere.

    Attributes:
        first, last: indices of the poses at which the robot is picked up and put down.
        distance_m: straight distance between the two, m.
        truth: (N, 3) true poses, including the kidnapping, m and rad.
        felt: (N, 3) poses that wheels without errors measure, m and rad; they stand still while the robot is carried.
    """

    first: int
    last: int
    distance_m: float
    truth: Array
    felt: Array


def carry(drive: Array, distance_m: float, step_s: float) -> KidnappedDrive:
    """Kidnap the robot: leave out a piece of a drive, so that it is carried to a place that it has visited before.

    The robot is picked up after the middle of the drive. It is put down at a pose of the rest of the drive that lies
    `distance_m` from there, to a step of the drive, and near a pose of the first half. If all such poses are nearer, the most
    distant one is used; if all are farther, the nearest.

    Args:
        drive: (N, 3) true poses, m and rad.
        distance_m: straight distance over which the robot is carried, m.
        step_s: time between two poses, s; it gives the speed at which the robot is carried.

    Raises:
        ConfigError: the drive visits no place twice.
    """
    onward = _onward(drive)
    known = np.array([_seen_before(drive, int(end), len(drive) // 2) for end in onward])
    best: tuple[int, int] | None = None
    farthest = 0.0
    for start in onward:
        away = np.hypot(*(drive[onward, :2] - drive[start, :2]).T)
        ends = np.flatnonzero(known & (onward > start) & (away > farthest))
        if len(ends):
            reached = np.flatnonzero(away[ends] >= distance_m)
            end = ends[reached[0]] if len(reached) else ends[int(np.argmax(away[ends]))]
            best, farthest = (int(start), int(onward[end])), float(min(away[end], distance_m))
        if farthest >= distance_m:
            break
    if best is None:
        raise ConfigError(
            "simulation.carried_m: this drive visits no place twice, to which the robot could be carried; leave it out"
        )
    return _cut(drive, best[0], _nearest_at(drive, *best, distance_m), step_s)


def _nearest_at(drive: Array, start: int, end: int, distance_m: float) -> int:
    """The first step since the moment tried before `end` that is this far from `start`, if it was seen before; else `end`."""
    steps = np.arange(max(start + 2, end - _EVERY + 1), end + 1)
    reached = steps[np.hypot(*(drive[steps, :2] - drive[start, :2]).T) >= distance_m]
    near = [int(step) for step in reached if _seen_before(drive, int(step), len(drive) // 2)]
    return near[0] if near else end


def _onward(drive: Array) -> np.ndarray[tuple[int], np.dtype[np.int64]]:
    """Steps after the middle of the drive; at least a tenth of the drive remains after the last."""
    return np.arange(len(drive) // 2, len(drive) - len(drive) // 10, _EVERY)


def _seen_before(drive: Array, step: int, middle: int) -> bool:
    earlier = drive[:middle:_EVERY]
    near = np.hypot(*(earlier[:, :2] - drive[step, :2]).T) <= _KNOWN_M
    return bool(np.any(near & (np.abs(wrap_angle(earlier[:, 2] - drive[step, 2])) <= _KNOWN_RAD)))


def _cut(drive: Array, start: int, end: int, step_s: float) -> KidnappedDrive:
    distance_m = float(np.hypot(*(drive[end, :2] - drive[start, :2])))
    steps = max(2, round(distance_m / _WALK_M_S / step_s))
    on_the_way = np.array([interpolate(drive[start], drive[end], at / steps) for at in range(1, steps)])
    truth = np.concatenate([drive[: start + 1], on_the_way, drive[end:]])
    after = compose(drive[start], between(drive[end], drive[end:]))
    felt = np.concatenate([drive[: start + 1], np.repeat(drive[start][None], steps - 1, axis=0), after])
    return KidnappedDrive(start, start + steps, distance_m, truth, felt)


TRANSLATION_M_PER_SQRT_M = 0.006
"""White noise of the distance, m per sqrt(m)."""
ROTATION_DEG_PER_SQRT_M = 0.6
"""White noise of the heading, degrees per sqrt(m) driven."""
ROTATION_PER_TURN = 0.012
"""White noise of the heading, radians per sqrt(radian) turned."""
SLIPS_PER_M = 0.02
"""Slips a metre driven, on average. With the noise above: a differential drive with rubber wheels on a smooth floor."""
SLIP_M, SLIP_DEG = 0.02, 1.0
"""Standard deviations of the distance and of the heading that a slip loses, m and degrees."""


def wheel_odometry(true_poses: Array, errors: WheelErrorConfig, rng: np.random.Generator) -> Array:
    """Poses (N, 3) of `base_link` in `odom` that the wheels report; the first is the identity.

    Args:
        true_poses: (N, 3) true poses in the world, m and rad.
        errors: systematic errors and noise of the wheels.
        rng: random generator for the noise.
    """
    steps = between(true_poses[:-1], true_poses[1:])
    ahead, turn = steps[:, 0] * 1.0, steps[:, 2] * 1.0
    metres, turned = np.abs(ahead), np.abs(turn)
    factor, noise = errors.noise, rng.standard_normal((3, len(steps)))
    ahead = ahead * (1.0 + errors.scale_bias) + factor * TRANSLATION_M_PER_SQRT_M * np.sqrt(metres) * noise[0]
    turn = turn * (1.0 + errors.turn_bias) + np.deg2rad(errors.heading_bias_deg_per_m) * metres
    turn += (
        np.deg2rad(factor * ROTATION_DEG_PER_SQRT_M) * np.sqrt(metres) * noise[1]
        + factor * ROTATION_PER_TURN * np.sqrt(turned) * noise[2]
    )
    slipping = rng.random(len(steps)) < factor * SLIPS_PER_M * metres
    ahead -= slipping * np.abs(rng.normal(0.0, factor * SLIP_M, len(steps)))
    turn += slipping * np.deg2rad(rng.normal(0.0, factor * SLIP_DEG, len(steps)))
    yaw = np.concatenate([[0.0], np.cumsum(turn)])
    middle = yaw[:-1] + 0.5 * turn
    position = np.cumsum(np.column_stack([ahead * np.cos(middle), ahead * np.sin(middle)]), axis=0)
    return np.column_stack([np.vstack([np.zeros(2), position]), as_transmitted(yaw)])


def as_transmitted(yaw_rad: Array) -> Array:
    """Headings (N,), rad, wrapped and rounded as by messages and files, which store them as quaternions."""
    return yaw_from_quaternion(*quaternion_from_yaw(wrap_angle(yaw_rad)).T)
