"""`campus`: a round of about 500 m outdoors past trees, hedges, parked cars and far buildings; another one for every seed.

The round ends some 30 m after its start, so that the only places seen twice are the first metres and the last. A long side of
it is a park: trees, and no building nearby. Heights are above the plane of the laser; there is no ground.
"""

from __future__ import annotations

from dataclasses import dataclass
from itertools import pairwise

import numpy as np

from hybridmap.geometry import Array
from hybridmap.simulation import paints
from hybridmap.simulation.surfaces import Facet, Walker, World, box

SPEED_M_S = 1.5
"""Cruising speed: a small vehicle among pedestrians."""
ROUND_M, PAST_START_M = 470.0, 30.0
"""Length of the round, and how far the drive goes on after it, m."""
LONG_SIDE_M, CORNER_M = (135.0, 165.0), 9.0
"""Length of the round's long sides (least, most) and radius of its corners, m: what a car steers with ease."""
SWAY_M, SWAYS = 2.0, 5
"""The road leaves a straight line by so much to either side, so many times a round, m."""
NEAR_BUILDINGS_M, PARK_BUILDINGS_M = (14.0, 42.0), (55.0, 75.0)
"""Distance of the fronts from the road (least, most), m: elsewhere, and along the park."""
TREES, TRUNK_M, TREE_CLEAR_M = 260, (0.12, 0.7), 2.5
"""Number of trees, diameter of their trunks (least, most), m, and how far they keep from the middle of the road, m."""
TRUNK_SIDES = 9
HEDGES, HEDGE_DEPTH_M = 24, 0.5
"""Number of hedges, and how far a beam gets into the leaves, m."""
CARS, CAR_M = 40, (4.3, 1.8, 1.4)
PEOPLE, PERSON_RADIUS_M = 24, 0.25
_HIGH_M = 4.0
_STEP_M = 0.5
_GREY = paints.plain((150, 150, 150))


def campus(seed: int) -> World:
    """The campus of a seed, which determines everything in it: road, buildings, trees, cars, people and drive."""
    rng = np.random.default_rng([seed, 0xCA])
    road = _road(rng)
    buildings = _buildings(rng, road)
    things = [facet for b in buildings for facet in box(b.middle, (*b.size, _HIGH_M), _GREY)]
    things += _trees(rng, road, buildings) + _hedges(rng, road, buildings) + _cars(rng, road)
    people = tuple(_person(rng, road) for _ in range(PEOPLE))
    start = int(rng.integers(len(road)))
    drive = np.roll(road, -start, axis=0)[np.arange(len(road) + round(PAST_START_M / _STEP_M)) % len(road)]
    return World("campus", tuple(things), (drive,), walkers=people, speed_m_s=SPEED_M_S, laser_only=True)


@dataclass(frozen=True, slots=True)
class _Building:
    """A building with walls along x and y: its middle (2,) and its size in x and y, m."""

    middle: Array
    size: tuple[float, float]

    def distance_m(self, points: Array) -> Array:
        """Distance (N,) of points (N, 2) from its walls, m; 0 inside."""
        outside = np.maximum(np.abs(points - self.middle) - 0.5 * np.asarray(self.size), 0.0)
        return np.asarray(np.hypot(*outside.T))


def _sides(rng: np.random.Generator) -> tuple[float, float]:
    """Lengths of the straight pieces of the round along x and y, m."""
    length = rng.uniform(*LONG_SIDE_M)
    return length, 0.5 * (ROUND_M - 2.0 * np.pi * CORNER_M) - length


def _road(rng: np.random.Generator) -> Array:
    """Points (N, 2) every half metre round a rectangle with round corners, swaying a little; its middle is the origin."""
    length, width = _sides(rng)
    arc = np.linspace(0.0, 0.5 * np.pi, 24)
    corners = [(1, -1, -0.5), (1, 1, 0.0), (-1, 1, 0.5), (-1, -1, 1.0)]
    outline = np.concatenate(
        [
            np.array([0.5 * length * x, 0.5 * width * y])
            + CORNER_M * np.column_stack([np.cos(arc + np.pi * turn), np.sin(arc + np.pi * turn)])
            for x, y, turn in corners
        ]
    )
    closed = np.vstack([outline, outline[:1]])
    travelled = np.concatenate([[0.0], np.cumsum(np.hypot(*np.diff(closed, axis=0).T))])
    at = np.arange(0.0, travelled[-1], _STEP_M)
    line = np.column_stack([np.interp(at, travelled, closed[:, axis]) for axis in (0, 1)])
    sway = SWAY_M * np.sin(2.0 * np.pi * SWAYS * at / travelled[-1] + rng.uniform(0.0, 2.0 * np.pi))
    road = line + sway[:, None] * _left_of(line)
    return np.asarray(road if rng.random() < 0.5 else road[::-1])


def _left_of(road: Array) -> Array:
    """Unit vectors (N, 2) to the left of a closed road, averaged over some metres."""
    ahead = np.roll(road, -8, axis=0) - np.roll(road, 8, axis=0)
    ahead /= np.hypot(*ahead.T)[:, None]
    return np.column_stack([-ahead[:, 1], ahead[:, 0]])


def _buildings(rng: np.random.Generator, road: Array) -> list[_Building]:
    """Buildings around the round and in its middle; few and far ones along the park, which is the side of least y."""
    low, high = road.min(axis=0), road.max(axis=0)
    out: list[_Building] = []
    for axis, edge in ((0, low[1]), (0, high[1]), (1, low[0]), (1, high[0])):
        park, outward = bool(axis == 0 and edge == low[1]), 1.0 if edge in high else -1.0
        at = float(low[axis]) - 25.0
        while at < high[axis] + 25.0:
            wide, deep = rng.uniform(15.0, 45.0), rng.uniform(10.0, 18.0)
            away = rng.uniform(*(PARK_BUILDINGS_M if park else NEAR_BUILDINGS_M))
            middle, size = np.empty(2), np.empty(2)
            middle[axis], middle[1 - axis] = at + 0.5 * wide, edge + outward * (away + 0.5 * deep)
            size[axis], size[1 - axis] = wide, deep
            out.append(_Building(middle, (float(size[0]), float(size[1]))))
            at += wide + rng.uniform(8.0, 30.0)
    for x in (-0.25, 0.25):
        middle = np.array([x * (high[0] - low[0]) + rng.uniform(-8.0, 8.0), rng.uniform(4.0, 10.0)])
        out.append(_Building(middle, (rng.uniform(18.0, 32.0), rng.uniform(9.0, 15.0))))
    return [b for b in out if b.distance_m(road).min() > 6.0]


def _free_spot(rng: np.random.Generator, road: Array, buildings: list[_Building], clear_m: float) -> Array:
    """A random place (2,) within 45 m of the round, away from the road and outside of the buildings."""
    low, high = road.min(axis=0) - 45.0, road.max(axis=0) + 45.0
    while True:
        spot = rng.uniform(low, high)
        if np.hypot(*(road - spot).T).min() > clear_m and all(b.distance_m(spot[None])[0] > 1.0 for b in buildings):
            return np.asarray(spot)


def _trees(rng: np.random.Generator, road: Array, buildings: list[_Building]) -> list[Facet]:
    out: list[Facet] = []
    for _ in range(TREES):
        diameter = float(np.clip(np.exp(rng.normal(np.log(0.28), 0.45)), *TRUNK_M))
        out += _trunk(_free_spot(rng, road, buildings, TREE_CLEAR_M), diameter, rng.uniform(0.0, 2.0 * np.pi))
    return out


def _trunk(middle: Array, diameter_m: float, turn_rad: float) -> list[Facet]:
    """Surfaces of an upright prism."""
    angle = turn_rad + np.linspace(0.0, 2.0 * np.pi, TRUNK_SIDES + 1)
    ring = middle + 0.5 * diameter_m * np.column_stack([np.cos(angle), np.sin(angle)])
    corners = np.column_stack([ring, np.zeros(len(ring))])
    up = np.array([0.0, 0.0, _HIGH_M])
    return [Facet(a, b - a, up, _GREY) for a, b in pairwise(corners)]


def _hedges(rng: np.random.Generator, road: Array, buildings: list[_Building]) -> list[Facet]:
    out: list[Facet] = []
    for _ in range(HEDGES):
        spot, yaw_deg = _free_spot(rng, road, buildings, 5.0), float(rng.uniform(0.0, 180.0))
        out += box(spot, (rng.uniform(1.5, 5.0), 0.9, 1.2), _GREY, yaw_deg=yaw_deg, foliage_m=HEDGE_DEPTH_M)
    return out


def _cars(rng: np.random.Generator, road: Array) -> list[Facet]:
    """Cars in rows beside the road, more or less parallel to it."""
    left, out = _left_of(road), []
    for _ in range(CARS // 8):
        first, side = int(rng.integers(len(road))), float(rng.choice([-1.0, 1.0]))
        for number in range(8):
            at = (first + round(number * 6.0 / _STEP_M)) % len(road)
            spot = road[at] + side * left[at] * rng.uniform(3.8, 4.3)
            if np.hypot(*(road - spot).T).min() < 0.5 * CAR_M[1] + 1.5 or rng.random() < 0.2:
                continue
            yaw_deg = float(np.rad2deg(np.arctan2(left[at, 1], left[at, 0]))) - 90.0 + rng.normal(0.0, 2.0)
            out += box(spot, CAR_M, _GREY, yaw_deg=yaw_deg)
    return out


def _person(rng: np.random.Generator, road: Array) -> Walker:
    """Somebody who walks to and fro along the road, never across it."""
    left = _left_of(road)
    while True:
        first = int(rng.integers(len(road)))
        last = (first + int(rng.integers(16, 60))) % len(road)
        beside = float(rng.choice([-1.0, 1.0])) * rng.uniform(2.5, 12.0)
        start, end = road[first] + beside * left[first], road[last] + beside * left[last]
        way = start + np.linspace(0.0, 1.0, 40)[:, None] * (end - start)
        if np.hypot(*(way[:, None] - road[None]).transpose(2, 0, 1)).min() > 1.5 and np.hypot(*(end - start)) > 5.0:
            return Walker(start, end, float(rng.uniform(0.8, 1.6)), PERSON_RADIUS_M, float(rng.uniform(0.0, 60.0)))
