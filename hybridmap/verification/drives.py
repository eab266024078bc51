"""Drives on which the cells are verified: the motion that the network gets, and the exact path."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from hybridmap import geometry
from hybridmap.geometry import Array
from hybridmap.simulation.motion import DriveLimits
from hybridmap.simulation.motion import drive as simulated_drive
from hybridmap.simulation.stream import ODOMETRY_RATE_HZ, TURN_RATE_RAD_S
from hybridmap.simulation.worlds import build_world

ROOM_M = (10.0, 3.0)
"""Length and width of the room of the drives: those of the paper's laboratory."""
_MARGIN_M = 0.9


@dataclass(frozen=True, slots=True)
class ExactDrive:
    """A drive with its exact path.

    Attributes:
        deltas: (N, 3) pose after each step in the frame of the robot before it, m and rad.
        poses: (N, 3) exact poses after each step, starting from the origin, m and rad.
        distance_m: (N,) distance driven up to each step.
        hz: steps per second.
    """

    deltas: Array
    poses: Array
    distance_m: Array
    hz: float


def wander(rng: np.random.Generator, distance_m: float, hz: float) -> ExactDrive:
    """A random drive of `distance_m` through a 10 x 3 m room at 0.3 to 1.1 m/s that turns away from the walls.

    Args:
        rng: random generator of speeds and turns.
        distance_m: the drive ends with the step that reaches it.
        hz: steps per second.
    """
    half = np.array(ROOM_M) / 2 - _MARGIN_M
    dt = 1.0 / hz
    x = y = yaw = omega = driven = 0.0
    v = 0.7
    keep, kick = np.exp(-dt / 0.5), np.sqrt(1.0 - np.exp(-2.0 * dt / 0.5))
    motions: list[tuple[float, float]] = []
    while driven < distance_m:
        noise = rng.standard_normal(2)
        omega = keep * omega + 0.7 * kick * noise[0]
        v = float(np.clip(0.7 + keep * (v - 0.7) + 0.15 * kick * noise[1], 0.3, 1.1))
        if abs(x) > half[0] or abs(y) > half[1]:
            omega = 2.0 * float(np.clip(geometry.wrap_angle(np.arctan2(-y, -x) - yaw), -1.0, 1.0))
        motions.append((v * dt, omega * dt))
        x += v * dt * np.cos(yaw + 0.5 * omega * dt)
        y += v * dt * np.sin(yaw + 0.5 * omega * dt)
        yaw += omega * dt
        driven += v * dt
    return _along(np.array(motions), hz)


def corridor(rng: np.random.Generator, hz: float) -> ExactDrive:
    """A drive of 16.8 m down a corridor at 0.5 m/s, swaying a little from a random phase; `hz` steps per second."""
    steps = round(16.8 / 0.5 * hz)
    sway = 0.05 * np.sin(np.arange(steps + 1) / hz * 2.0 * np.pi / 6.0 + rng.uniform(0.0, 2.0 * np.pi))
    return _along(np.stack([np.full(steps, 0.5 / hz), np.diff(sway)], axis=1), hz)


def raster(side_m: float, pitch_m: float, angle_rad: float, *, upright: bool = False) -> ExactDrive:
    """A drive back and forth along the lines of a square arena around the origin, one step per pixel.

    The first step leads to a corner. `pixel_order` tells which pixel each following step reaches.

    Args:
        side_m: side of the arena.
        pitch_m: side of a pixel.
        angle_rad: rotation of the arena.
        upright: drive along y instead of x.
    """
    count = round(side_m / pitch_m)
    ticks = (np.arange(count) - 0.5 * (count - 1)) * pitch_m
    order = pixel_order(count, upright=upright)
    points = np.stack([ticks[order[:, 0]], ticks[order[:, 1]]], axis=1)
    turn = np.array([[np.cos(angle_rad), -np.sin(angle_rad)], [np.sin(angle_rad), np.cos(angle_rad)]])
    return _through(points @ turn.T)


def pixel_order(count: int, *, upright: bool = False) -> NDArray[np.int64]:
    """The pixels (count^2, 2), (x index, y index), in the order in which the drive of `raster` reaches them."""
    order = _back_and_forth(count, count)
    return order[:, ::-1] if upright else order


def room_lines(sides_m: tuple[float, float], pitch_m: float) -> tuple[ExactDrive, NDArray[np.int64]]:
    """A drive from the middle of a room to a corner, then back and forth along its length, one step per pixel.

    Args:
        sides_m: length and width of the room.
        pitch_m: side of a pixel.

    Returns:
        The drive, and the pixel (x index, y index) that each of its steps reaches.
    """
    counts = np.round(np.array(sides_m) / pitch_m).astype(int)
    pixels = _back_and_forth(*counts.tolist())
    return _through((pixels - 0.5 * (counts - 1)) * pitch_m), pixels


def _back_and_forth(length: int, lines: int) -> NDArray[np.int64]:
    """(length x lines, 2): place on the line, and line, of each step along one line after the other."""
    there = np.arange(length)
    along = np.tile(np.concatenate([there, there[::-1]]), -(-lines // 2))[: length * lines]
    return np.stack([along, np.repeat(np.arange(lines), length)], axis=1)


def _through(points: Array) -> ExactDrive:
    """The drive from the origin straight to each of the points (N, 2) in turn, m; 30 points a second."""
    path = np.concatenate([np.zeros((1, 2)), points])
    ways = np.diff(path, axis=0)
    poses = np.column_stack([path, np.concatenate([[0.0], np.arctan2(ways[:, 1], ways[:, 0])])])
    deltas = geometry.between(poses[:-1], poses[1:])
    return ExactDrive(deltas, poses[1:], np.cumsum(np.linalg.norm(ways, axis=1)), 30.0)


def _along(motions: Array, hz: float) -> ExactDrive:
    """The drive of steps (N, 2): distance and turn, by the mid-point heading."""
    distance, turn = motions.T
    yaw = np.cumsum(turn)
    middle = yaw - 0.5 * turn
    position = np.cumsum(distance[:, None] * np.stack([np.cos(middle), np.sin(middle)], axis=1), axis=0)
    deltas = np.column_stack([distance * np.cos(0.5 * turn), distance * np.sin(0.5 * turn), turn])
    poses = np.column_stack([position, geometry.wrap_angle(yaw)])
    return ExactDrive(deltas, poses, np.cumsum(distance), hz)


def office_laps(distance_m: float) -> tuple[ExactDrive, float]:
    """Laps of the simulated office as its robot drives them, at 30 Hz; and the length of a lap along the way points, m.

    Args:
        distance_m: the drive ends with the step that reaches it.
    """
    world = build_world("office")
    points = world.legs[0]
    again = int(np.flatnonzero((points[1:] == points[0]).all(axis=1))[0]) + 1
    lap_m = float(np.hypot(*np.diff(points[: again + 1], axis=0).T).sum())
    laps = np.vstack([np.tile(points[:again], (int(distance_m / lap_m) + 2, 1)), points[:1]])
    poses = simulated_drive([laps], DriveLimits(world.speed_m_s, TURN_RATE_RAD_S), 1.0 / ODOMETRY_RATE_HZ)
    deltas = geometry.between(poses[:-1], poses[1:])
    driven_m = np.cumsum(np.hypot(deltas[:, 0], deltas[:, 1]))
    steps = int(np.searchsorted(driven_m, distance_m)) + 1
    from_start = geometry.between(poses[0], poses[1 : steps + 1])
    return ExactDrive(deltas[:steps], from_start, driven_m[:steps], ODOMETRY_RATE_HZ), lap_m
