"""`lab`: a room of 10 x 3 m with a row of benches in the middle; the robot drives round them."""

from __future__ import annotations

import numpy as np

from hybridmap.geometry import Array
from hybridmap.simulation import furniture, paints, pictures
from hybridmap.simulation.surfaces import Facet, World, box, panel, partition, slab

LENGTH_M, WIDTH_M, HEIGHT_M = 10.0, 3.0, 2.7
LAPS = 2.35


def lab(laps: float = LAPS) -> World:
    """The laboratory: a room of 10 x 3 m, driven round more than twice, or so many times; the same at every call."""
    return World(
        "lab", (*_shell(), *_benches(), *_along_the_walls(), *_on_the_walls()), (_round_the_benches(laps),), texture_seed=11
    )


def _shell() -> list[Facet]:
    cream, blue = paints.plaster((222, 214, 196)), paints.plaster((166, 186, 200))
    out = [
        slab((0, 0), (LENGTH_M, WIDTH_M), 0.0, paints.wood((158, 124, 88), plank_m=0.16), facing_up=True),
        slab((0, 0), (LENGTH_M, WIDTH_M), HEIGHT_M, paints.ceiling_tiles(), facing_up=False),
    ]
    corners = [(0.0, 0.0), (LENGTH_M, 0.0), (LENGTH_M, WIDTH_M), (0.0, WIDTH_M)]
    outward = [(0.0, -0.06), (0.06, 0.0), (0.0, 0.06), (-0.06, 0.0)]
    for index, paint in enumerate((cream, paints.bricks(), cream, blue)):
        shift = np.array(outward[index])
        out += partition(np.array(corners[index]) + shift, np.array(corners[(index + 1) % 4]) + shift, paint, height_m=HEIGHT_M)
    lamp = paints.plain((250, 250, 244))
    for x in (1.6, 5.0, 8.4):
        out.append(slab((x - 0.6, 1.2), (x + 0.6, 1.8), HEIGHT_M - 0.01, lamp, facing_up=False, glow=1.0))
    return out


def _benches() -> list[Facet]:
    out: list[Facet] = []
    for x in (3.4, 5.0, 6.6):
        out += furniture.table((x, 1.5), 0.0, (1.5, 0.56), height_m=0.72)
    out += furniture.crate((3.0, 1.5), 20, (0.32, 0.4, 0.3), bottom_m=0.72)
    out += furniture.crate((3.6, 1.48), -12, (0.26, 0.26, 0.44), bottom_m=0.72)
    out += box((4.6, 1.5), (0.4, 0.3, 0.2), paints.metal((70, 76, 84), drawers=2), bottom_m=0.72, yaw_deg=-70)
    out += furniture.plant((5.3, 1.5), 0.6)
    out += box((6.3, 1.52), (0.3, 0.4, 0.26), pictures.books(1), bottom_m=0.72, yaw_deg=75, px_per_m=170)
    out += furniture.crate((7.0, 1.5), 40, (0.4, 0.3, 0.22), bottom_m=0.72)
    out += furniture.crate((3.4, 1.5), 8, (0.5, 0.4, 0.36))
    out += furniture.bin_((5.1, 1.5))
    out += furniture.crate((6.7, 1.52), -25, (0.4, 0.34, 0.5))
    return out


def _along_the_walls() -> list[Facet]:
    out = furniture.book_case((2.6, 0.13), 90, 1.0, 1.9, 0.24)
    out += furniture.book_case((7.5, WIDTH_M - 0.13), -90, 1.2, 1.9, 0.24)
    out += furniture.cabinet((0.25, 2.6), 0, 0.5, 1.2)
    out += furniture.cabinet((LENGTH_M - 0.25, 0.4), 180, 0.5, 1.4, (96, 122, 104))
    out += furniture.plant((LENGTH_M - 0.35, 2.6), 1.5)
    out += furniture.crate((0.3, 0.35), 15, (0.4, 0.44, 0.5)) + furniture.crate(
        (0.3, 0.36), -10, (0.3, 0.36, 0.3), bottom_m=0.5
    )
    out += furniture.bin_((5.2, 0.18), (150, 60, 60))
    out += furniture.crate((3.6, WIDTH_M - 0.18), 5, (0.3, 0.3, 0.34))
    return out


def _on_the_walls() -> list[Facet]:
    south, north = 90.0, -90.0
    return [
        panel((1.3, 0, 0.0), south, (0.9, 2.03), pictures.door()),
        panel((4.3, 0, 1.0), south, (1.6, 1.0), pictures.whiteboard()),
        panel((5.9, 0, 1.05), south, (0.6, 0.85), pictures.poster(), px_per_m=240),
        panel((7.2, 0, 0.95), south, (1.2, 0.9), pictures.notice_board(), px_per_m=240),
        panel((8.7, 0, 1.1), south, (0.6, 0.85), pictures.poster(), px_per_m=240),
        panel((1.4, WIDTH_M, 1.0), north, (1.5, 1.1), pictures.window(), glow=0.5, in_depth=False),
        panel((3.0, WIDTH_M, 1.1), north, (0.6, 0.85), pictures.poster(), px_per_m=240),
        panel((4.5, WIDTH_M, 1.0), north, (1.5, 1.1), pictures.window(), glow=0.5, in_depth=False),
        panel((6.0, WIDTH_M, 1.05), north, (0.7, 0.5), pictures.painting(), px_per_m=240),
        panel((8.9, WIDTH_M, 1.0), north, (0.9, 0.8), pictures.notice_board(), px_per_m=240),
        panel((LENGTH_M, 1.4, 1.0), 180, (0.7, 1.0), pictures.poster(), px_per_m=240),
        panel((0, 1.35, 0.9), 0, (1.5, 1.0), pictures.whiteboard()),
    ]


def _round_the_benches(laps: float) -> Array:
    """Way points of an oval at 0.78 m from its middle line, so many times round."""
    near, far, radius, middle = 2.1, 7.9, 0.78, 0.5 * WIDTH_M
    arc = np.linspace(-np.pi / 2, np.pi / 2, 13)
    east = np.column_stack([far + radius * np.cos(arc), middle + radius * np.sin(arc)])
    west = np.column_stack([near - radius * np.cos(arc), middle - radius * np.sin(arc)])
    lap = np.vstack([east, west])
    points = np.vstack([[near, middle - radius], np.tile(lap, (int(laps) + 1, 1))])
    travelled = np.concatenate([[0.0], np.cumsum(np.linalg.norm(np.diff(points, axis=0), axis=1))])
    lap_m = 2.0 * (far - near) + 2.0 * np.pi * radius
    return points[travelled <= laps * lap_m]
