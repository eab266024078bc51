"""`corridor` and `corridor-landmarks`: 16.8 m there, back, and there again, so that one direction is driven twice."""

from __future__ import annotations

import numpy as np

from hybridmap.geometry import Array
from hybridmap.simulation import furniture, paints, pictures
from hybridmap.simulation.surfaces import Facet, Paint, World, panel, partition, slab

LENGTH_M, WIDTH_M, HEIGHT_M = 19.2, 2.4, 2.6
DRIVE_M = 16.8


def corridor() -> World:
    """The featureless corridor: one colour a wall, even light; driven there, back and there again."""
    wall = paints.plain((206, 202, 192))
    shell = _shell(wall, paints.plain((120, 118, 114)), paints.plain((228, 227, 222)), ends=wall)
    return World("corridor", tuple(shell), _there_and_back_and_there(), texture_seed=31)


def corridor_landmarks() -> World:
    """The corridor of `corridor` and the same drive, with doors, posters and boxes under lamps."""
    floor, ceiling = paints.carpet((104, 108, 116)), paints.ceiling_tiles()
    shell = _shell(paints.plaster((208, 202, 188)), floor, ceiling, ends=paints.bricks())
    world = (*shell, *_lamps(), *_doors(), *_pictures(), *_things())
    return World("corridor-landmarks", world, _there_and_back_and_there(), texture_seed=32)


def _there_and_back_and_there() -> tuple[Array, ...]:
    begin = np.array([0.5 * (LENGTH_M - DRIVE_M), 0.5 * WIDTH_M])
    end = begin + np.array([DRIVE_M, 0.0])
    return np.array([begin, end]), np.array([end, begin]), np.array([begin, end])


def _shell(wall: Paint, floor: Paint, ceiling: Paint, *, ends: Paint) -> list[Facet]:
    out = [
        slab((0, 0), (LENGTH_M, WIDTH_M), 0.0, floor, facing_up=True),
        slab((0, 0), (LENGTH_M, WIDTH_M), HEIGHT_M, ceiling, facing_up=False),
    ]
    for y in (-0.06, WIDTH_M + 0.06):
        out += partition((0.0, y), (LENGTH_M, y), wall, height_m=HEIGHT_M)
    for x in (-0.06, LENGTH_M + 0.06):
        out += partition((x, 0.0), (x, WIDTH_M), ends, height_m=HEIGHT_M)
    return out


def _lamps() -> list[Facet]:
    white = paints.plain((250, 250, 244))
    return [
        slab((x - 0.6, 1.0), (x + 0.6, 1.4), HEIGHT_M - 0.01, white, facing_up=False, glow=1.0)
        for x in np.arange(1.6, LENGTH_M, 3.2)
    ]


def _doors() -> list[Facet]:
    south = [panel((x, 0, 0.0), 90, (0.95, 2.05), pictures.door()) for x in (2.4, 7.1, 11.6, 16.2)]
    north = [panel((x, WIDTH_M, 0.0), -90, (0.95, 2.05), pictures.door((96, 116, 128))) for x in (4.9, 9.3, 14.4)]
    return south + north


def _pictures() -> list[Facet]:
    out = [panel((x, 0, 1.05), 90, (0.6, 0.85), pictures.poster(), px_per_m=240) for x in (3.9, 5.4, 9.0, 13.6, 17.6)]
    out += [panel((x, WIDTH_M, 1.05), -90, (0.6, 0.85), pictures.poster(), px_per_m=240) for x in (2.2, 6.9, 12.3, 16.9)]
    out.append(panel((10.2, 0, 1.0), 90, (1.1, 0.85), pictures.notice_board(), px_per_m=240))
    out.append(panel((11.0, WIDTH_M, 1.1), -90, (0.9, 0.65), pictures.painting(), px_per_m=240))
    out.append(panel((0, 1.2, 1.0), 0, (0.9, 0.7), pictures.notice_board(), px_per_m=240))
    out.append(panel((LENGTH_M, 1.2, 0.9), 180, (1.0, 1.2), pictures.poster(), px_per_m=200))
    return out


def _things() -> list[Facet]:
    out = furniture.crate((3.3, 0.25), 8) + furniture.crate((3.3, 0.26), -14, (0.3, 0.36, 0.28), bottom_m=0.4)
    out += furniture.bin_((5.9, WIDTH_M - 0.22))
    out += furniture.cabinet((8.0, 0.23), 90, 0.5, 1.3)
    out += furniture.plant((10.4, WIDTH_M - 0.3))
    out += furniture.crate((13.0, 0.26), -10, (0.36, 0.5, 0.6))
    out += furniture.book_case((15.6, WIDTH_M - 0.13), -90, 0.9, 1.8, 0.24)
    out += furniture.crate((18.3, 0.3), 25) + furniture.bin_((0.6, WIDTH_M - 0.3), (140, 70, 60))
    return out
