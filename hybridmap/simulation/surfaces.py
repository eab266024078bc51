"""Building blocks of a simulated world: painted rectangles, and boxes, panels and partitions made of them."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from itertools import pairwise

import numpy as np
from numpy.typing import ArrayLike, NDArray

from hybridmap.geometry import Array

Paint = Callable[[np.random.Generator, tuple[int, int], float], NDArray[np.uint8]]
"""`(generator, (height_px, width_px), px_per_m)` -> (height_px, width_px, 3) uint8, RGB, row 0 at the top."""

UP: Array = np.array([0.0, 0.0, 1.0])
DOOR_HEIGHT_M = 2.05
SPEED_M_S = 0.5
"""Cruising speed indoors: a robot that moves among people."""


@dataclass(frozen=True, slots=True, eq=False)
class Facet:
    """A painted rectangle; its painted front faces the direction `along x up`.

    Attributes:
        corner: (3,) lower left corner seen from the front, m.
        along: (3,) edge from there to the right, m.
        up: (3,) edge from there upwards, m.
        paint: function that draws its texture.
        px_per_m: texels per metre.
        glow: light given off, arbitrary unit; 0 for all but lamps and windows.
        decal: whether it is so thin that it casts no shadow (posters, doors).
        in_depth: whether a depth camera sees it (not glass and screens).
        foliage_m: how far a laser beam goes on behind it at most, m, by chance: the leaves of a hedge; 0: a solid face.
    """

    corner: Array
    along: Array
    up: Array
    paint: Paint
    px_per_m: float = 100.0
    glow: float = 0.0
    decal: bool = False
    in_depth: bool = True
    foliage_m: float = 0.0


@dataclass(frozen=True, slots=True, eq=False)
class Walker:
    """A person who walks to and fro between two points, seen by the laser as an upright cylinder.

    Attributes:
        start, end: (2,) the two points, m.
        speed_m_s: walking speed.
        radius_m: radius of the cylinder.
        ahead_m: way that the person has walked when the drive begins.
    """

    start: Array
    end: Array
    speed_m_s: float
    radius_m: float
    ahead_m: float

    def at(self, time_s: float) -> Array:
        """Position (2,), m, some time after the beginning of the drive."""
        length = float(np.linalg.norm(self.end - self.start))
        walked = (self.ahead_m + self.speed_m_s * time_s) % (2.0 * length)
        return np.asarray(self.start + (self.end - self.start) * (min(walked, 2.0 * length - walked) / length))


@dataclass(frozen=True, slots=True, eq=False)
class World:
    """Surroundings and the drive through them.

    Attributes:
        name: name of the world on the command line.
        surfaces: every surface that a sensor can see.
        legs: way points (N, 2), m, of each piece of the drive; between pieces the robot stops and turns on the spot.
        texture_seed: seed of the textures, independent of the seed of the sensor noise.
        walkers: people who move; only a laser sees them.
        speed_m_s: cruising speed of the drive.
        laser_only: whether there is nothing for a camera to see: no ground, no textures.
    """

    name: str
    surfaces: tuple[Facet, ...]
    legs: tuple[Array, ...]
    texture_seed: int = 1
    walkers: tuple[Walker, ...] = ()
    speed_m_s: float = SPEED_M_S
    laser_only: bool = False


def _direction(yaw_rad: float) -> Array:
    return np.array([np.cos(yaw_rad), np.sin(yaw_rad), 0.0])


def box(
    center: ArrayLike,
    size: Sequence[float],
    paint: Paint,
    *,
    bottom_m: float = 0.0,
    yaw_deg: float = 0.0,
    faces: Mapping[str, Paint] | None = None,
    px_per_m: float = 100.0,
    foliage_m: float = 0.0,
) -> list[Facet]:
    """Surfaces of an upright box.

    Args:
        center: x and y of its middle, m.
        size: extent along its own x (front to back), y and z, m.
        paint: paint of every face that `faces` does not name.
        bottom_m: height of its lower face; a box on the floor (0) has none.
        yaw_deg: direction of its own x axis, from the x axis of the world, counter-clockwise.
        faces: paints of `front` (+x), `back`, `left` (+y), `right`, `top`, `bottom`.
        px_per_m: texels per metre.
        foliage_m: how far a laser beam gets into it at most, m.
    """
    ex = _direction(np.deg2rad(yaw_deg)) * size[0]
    ey = _direction(np.deg2rad(yaw_deg + 90.0)) * size[1]
    ez = UP * size[2]
    low = np.append(np.asarray(center, dtype=np.float64), bottom_m) - 0.5 * (ex + ey)
    rectangles = {
        "front": (low + ex, ey, ez),
        "back": (low + ey, -ey, ez),
        "left": (low + ex + ey, -ex, ez),
        "right": (low, ex, ez),
        "top": (low + ez, ex, ey),
        "bottom": (low, ey, ex),
    }
    if bottom_m <= 0.0:
        del rectangles["bottom"]
    paints = faces or {}
    return [Facet(*edges, paints.get(name, paint), px_per_m, foliage_m=foliage_m) for name, edges in rectangles.items()]


def panel(
    middle: Sequence[float],
    yaw_deg: float,
    size: Sequence[float],
    paint: Paint,
    *,
    px_per_m: float = 200.0,
    stand_off_m: float = 0.012,
    glow: float = 0.0,
    in_depth: bool = True,
) -> Facet:
    """A thin upright rectangle on a wall, such as a poster.

    Args:
        middle: x, y and height of the middle of its lower edge on the wall, m.
        yaw_deg: direction that it faces, from the x axis of the world, counter-clockwise.
        size: width and height, m.
        paint: paint of its front.
        px_per_m: texels per metre.
        stand_off_m: distance from the wall.
        glow: light given off, arbitrary unit.
        in_depth: whether a depth camera sees it.
    """
    yaw = np.deg2rad(yaw_deg)
    right = _direction(yaw + 0.5 * np.pi) * size[0]
    corner = np.asarray(middle, dtype=np.float64) + stand_off_m * _direction(yaw) - 0.5 * right
    return Facet(corner, right, UP * size[1], paint, px_per_m, glow=glow, decal=True, in_depth=in_depth)


def slab(
    low: Sequence[float], high: Sequence[float], height_m: float, paint: Paint, *, facing_up: bool, glow: float = 0.0
) -> Facet:
    """A horizontal rectangle at the height `height_m`: floor, ceiling or lamp.

    Args:
        low, high: (x, y) of its two opposite corners, m.
        height_m: height above the floor.
        paint: paint of its visible side.
        facing_up: whether the visible side is the upper one.
        glow: light given off, arbitrary unit.
    """
    corner = np.array([low[0], low[1], height_m])
    ex, ey = np.array([high[0] - low[0], 0.0, 0.0]), np.array([0.0, high[1] - low[1], 0.0])
    along, up = (ex, ey) if facing_up else (ey, ex)
    return Facet(corner, along, up, paint, px_per_m=80.0, glow=glow, decal=glow > 0.0)


def partition(
    start: ArrayLike,
    end: ArrayLike,
    paint: Paint,
    *,
    openings: Sequence[tuple[float, float]] = (),
    height_m: float = 2.6,
) -> list[Facet]:
    """Surfaces of a straight wall, 12 cm thick, with door openings; above an opening the wall continues.

    Args:
        start, end: (2,) end points of the wall, m.
        paint: paint of its faces.
        openings: (start, end) of each opening, metres from `start`, in ascending order.
        height_m: height of the wall.
    """
    first, last = np.asarray(start, dtype=np.float64), np.asarray(end, dtype=np.float64)
    length = float(np.linalg.norm(last - first))
    direction = (last - first) / length
    yaw_deg = float(np.rad2deg(np.arctan2(direction[1], direction[0])))
    edges = [0.0, *[edge for opening in openings for edge in opening], length]
    out: list[Facet] = []
    for index, (a, b) in enumerate(pairwise(edges)):
        if b - a < 1e-6:
            continue
        bottom = DOOR_HEIGHT_M if index % 2 else 0.0
        middle = first + 0.5 * (a + b) * direction
        out += box(middle, (b - a, 0.12, height_m - bottom), paint, bottom_m=bottom, yaw_deg=yaw_deg)
    return out
