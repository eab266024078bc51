"""`office`: a storey of 25 x 14.4 m; corridors on three sides and a row of rooms make a loop of about 70 m."""

from __future__ import annotations

import numpy as np

from hybridmap.geometry import Array
from hybridmap.simulation import furniture, paints, pictures
from hybridmap.simulation.surfaces import Facet, World, panel, partition, slab

EAST_M, NORTH_M, HEIGHT_M = 25.0, 14.4, 2.6
CORRIDOR_M = 2.0
CORE_NORTH_M = 8.4
"""The core of closed rooms lies between the south corridor and here; north of it are the open rooms."""
ROOM_WALLS_M = (9.6, 16.4)
"""Where walls part the northern rooms from each other."""
DOOR_M = 1.1
WEST_DOOR_Y, FIRST_DOOR_Y, SECOND_DOOR_Y, EAST_DOOR_Y = 11.6, 9.8, 12.4, 10.6
LAPS = 2.2


def office() -> World:
    """The office: corridors and rooms in a loop of about 70 m, driven round twice; the same at every call."""
    surfaces = [*_shell(), *_inner_walls(), *_lamps(), *_south(), *_east(), *_west(), *_room_a(), *_room_b(), *_room_c()]
    return World("office", tuple(surfaces), (_round(),), texture_seed=21)


def _shell() -> list[Facet]:
    cream = paints.plaster((216, 210, 196))
    rooms = (CORRIDOR_M, CORE_NORTH_M), (EAST_M - CORRIDOR_M, NORTH_M)
    out = [
        slab((0, 0), (EAST_M, CORRIDOR_M), 0.0, paints.carpet((96, 104, 118)), facing_up=True),
        slab((0, CORRIDOR_M), (CORRIDOR_M, NORTH_M), 0.0, paints.carpet((112, 100, 92)), facing_up=True),
        slab((EAST_M - CORRIDOR_M, CORRIDOR_M), (EAST_M, NORTH_M), 0.0, paints.carpet((96, 112, 100)), facing_up=True),
        slab(*rooms, 0.0, paints.wood((156, 122, 86), plank_m=0.16), facing_up=True),
        slab((0, 0), (EAST_M, NORTH_M), HEIGHT_M, paints.ceiling_tiles(), facing_up=False),
    ]
    corners = [(0.0, -0.06), (EAST_M, -0.06), (EAST_M + 0.06, 0.0), (EAST_M + 0.06, NORTH_M)]
    corners += [(EAST_M, NORTH_M + 0.06), (0.0, NORTH_M + 0.06), (-0.06, NORTH_M), (-0.06, 0.0)]
    for first, last in zip(corners[::2], corners[1::2], strict=True):
        out += partition(first, last, cream, height_m=HEIGHT_M)
    return out


def _inner_walls() -> list[Facet]:
    west, east = CORRIDOR_M, EAST_M - CORRIDOR_M
    paint, blue, green = paints.plaster((220, 216, 206)), paints.plaster((176, 192, 204)), paints.plaster((192, 204, 180))
    out = partition((west, CORRIDOR_M), (east, CORRIDOR_M), paint)
    out += partition((west, CORE_NORTH_M), (east, CORE_NORTH_M), blue)
    out += partition((west, CORRIDOR_M), (west, NORTH_M), paint, openings=[_opening(WEST_DOOR_Y - CORRIDOR_M)])
    out += partition((east, CORRIDOR_M), (east, NORTH_M), green, openings=[_opening(EAST_DOOR_Y - CORRIDOR_M)])
    for x, y in zip(ROOM_WALLS_M, (FIRST_DOOR_Y, SECOND_DOOR_Y), strict=True):
        out += partition((x, CORE_NORTH_M), (x, NORTH_M), green, openings=[_opening(y - CORE_NORTH_M)])
    return out


def _opening(middle_m: float) -> tuple[float, float]:
    return middle_m - 0.5 * DOOR_M, middle_m + 0.5 * DOOR_M


def _lamps() -> list[Facet]:
    spots = [(x, 1.0) for x in np.arange(2.0, EAST_M, 3.5)]
    spots += [(x, y) for x in (1.0, EAST_M - 1.0) for y in (4.6, 8.0, 11.4)]
    spots += [(x, y) for x in (4.2, 7.6, 11.6, 14.6, 18.2, 21.4) for y in (10.2, 12.8)]
    white = paints.plain((250, 250, 244))
    return [slab((x - 0.5, y - 0.3), (x + 0.5, y + 0.3), HEIGHT_M - 0.01, white, facing_up=False, glow=1.0) for x, y in spots]


def _south() -> list[Facet]:
    north_wall = CORRIDOR_M - 0.06
    out = [panel((x, north_wall, 0), -90, (0.95, 2.05), pictures.door()) for x in (4.4, 9.2, 13.0, 19.4)]
    out += [panel((x, 0, 1.0), 90, (1.5, 1.1), pictures.window(), glow=0.4, in_depth=False) for x in (6.4, 12.2, 20.2)]
    out += [panel((x, 0, 1.05), 90, (0.6, 0.85), pictures.poster(), px_per_m=240) for x in (3.6, 8.8, 15.4, 17.8)]
    out += [panel((x, north_wall, 1.05), -90, (0.6, 0.85), pictures.poster(), px_per_m=240) for x in (6.2, 11.2, 17.2, 21.6)]
    out.append(panel((15.2, north_wall, 1.0), -90, (1.3, 0.9), pictures.notice_board(), px_per_m=240))
    out.append(panel((7.6, north_wall, 1.1), -90, (0.9, 0.65), pictures.painting(), px_per_m=240))
    out.append(panel((22.9, 0, 1.1), 90, (0.8, 0.6), pictures.painting(), px_per_m=240))
    out += furniture.cabinet((10.4, 0.24), 90) + furniture.plant((14.2, 0.32)) + furniture.bin_((5.3, north_wall - 0.24))
    out += furniture.crate((18.7, 0.28), 12) + furniture.crate((18.7, 0.28), -8, (0.3, 0.36, 0.3), bottom_m=0.4)
    out += furniture.book_case((16.4, 0.14), 90, 0.9, 1.7, 0.26)
    return out


def _east() -> list[Facet]:
    west_wall, east_wall = EAST_M - CORRIDOR_M + 0.06, EAST_M
    out = [panel((west_wall, y, 0), 0, (0.95, 2.05), pictures.door((96, 116, 128))) for y in (3.6, 7.0)]
    out += [panel((east_wall, y, 1.05), 180, (0.6, 0.85), pictures.poster(), px_per_m=240) for y in (2.2, 5.6, 12.2)]
    out += [panel((east_wall, y, 1.0), 180, (1.5, 1.1), pictures.window(), glow=0.4, in_depth=False) for y in (3.9, 7.4, 10.4)]
    out.append(panel((east_wall, 1.0, 0.95), 180, (1.1, 0.9), pictures.notice_board(), px_per_m=240))
    out.append(panel((west_wall, 5.3, 1.05), 0, (0.8, 0.6), pictures.painting(), px_per_m=240))
    out.append(panel((west_wall, 8.6, 1.05), 0, (0.6, 0.85), pictures.poster(), px_per_m=240))
    out.append(panel((24.0, NORTH_M, 1.0), -90, (1.2, 0.9), pictures.whiteboard()))
    out += furniture.plant((east_wall - 0.34, NORTH_M - 0.4), 1.5) + furniture.cabinet((east_wall - 0.24, 6.4), 180)
    return out + furniture.crate((west_wall + 0.28, 13.8), 5, (0.4, 0.5, 0.7))


def _west() -> list[Facet]:
    east_wall = CORRIDOR_M - 0.06
    out = [panel((east_wall, y, 0), 180, (0.95, 2.05), pictures.door((120, 88, 96))) for y in (3.4, 6.2, 8.6)]
    out += [panel((0, y, 1.05), 0, (0.6, 0.85), pictures.poster(), px_per_m=240) for y in (2.6, 6.0, 9.2, 12.6)]
    out.append(panel((0, 4.3, 1.0), 0, (1.2, 0.9), pictures.notice_board(), px_per_m=240))
    out.append(panel((0, 7.6, 1.1), 0, (0.9, 0.65), pictures.painting(), px_per_m=240))
    out.append(panel((0, 11.0, 1.0), 0, (1.5, 1.1), pictures.window(), glow=0.4, in_depth=False))
    out.append(panel((0, 1.0, 1.0), 0, (0.9, 0.9), pictures.whiteboard()))
    out.append(panel((1.0, 0, 1.05), 90, (0.7, 0.9), pictures.poster(), px_per_m=240))
    out.append(panel((east_wall, 4.8, 1.05), 180, (0.6, 0.85), pictures.poster(), px_per_m=240))
    out.append(panel((east_wall, 7.4, 1.1), 180, (0.7, 0.5), pictures.painting(), px_per_m=240))
    out += furniture.book_case((0.14, 5.2), 0, 0.8, 1.8, 0.26) + furniture.bin_((0.24, 8.4), (60, 80, 130))
    out += furniture.crate((0.3, 13.8), 20) + furniture.cabinet((1.3, NORTH_M - 0.25), -90, 0.6, 1.2, (120, 96, 96))
    return out


def _room_a() -> list[Facet]:
    """The western room: desks."""
    out = furniture.desk((3.4, NORTH_M - 0.5), -90) + furniture.chair((3.4, NORTH_M - 1.15), 90)
    out += furniture.desk((6.2, NORTH_M - 0.5), -90) + furniture.chair((6.1, NORTH_M - 1.15), 80, (116, 58, 52))
    out += furniture.desk((3.3, CORE_NORTH_M + 0.5), 90) + furniture.chair((3.4, CORE_NORTH_M + 1.15), -95)
    out += furniture.book_case((5.6, CORE_NORTH_M + 0.22), 90, 1.2) + furniture.plant((8.9, NORTH_M - 0.5), 1.6)
    out += furniture.table((8.3, NORTH_M - 1.9), 0, (0.8, 0.8)) + furniture.crate(
        (8.3, 12.5), 30, (0.3, 0.3, 0.3), bottom_m=0.74
    )
    out += furniture.cabinet((CORRIDOR_M + 0.3, 10.3), 0) + furniture.bin_((4.6, CORE_NORTH_M + 0.3))
    out += [panel((x, NORTH_M, 1.15), -90, (1.7, 1.1), pictures.window(), glow=0.4, in_depth=False) for x in (3.5, 7.6)]
    out.append(panel((7.6, CORE_NORTH_M + 0.06, 1.0), 90, (1.6, 1.0), pictures.whiteboard()))
    out.append(panel((CORRIDOR_M + 0.06, 13.2, 1.0), 0, (0.6, 0.85), pictures.poster(), px_per_m=240))
    out.append(panel((ROOM_WALLS_M[0] - 0.06, 11.6, 1.0), 180, (0.9, 0.8), pictures.notice_board(), px_per_m=240))
    return out


def _room_b() -> list[Facet]:
    """The middle room: a meeting table under a painting, a sofa."""
    out = furniture.table((12.6, 10.0), 0, (1.9, 0.9)) + furniture.chair((12.2, 9.15), 90) + furniture.chair((13.2, 9.1), 95)
    out += furniture.crate((12.3, 10.0), 10, (0.3, 0.22, 0.2), bottom_m=0.74) + furniture.plant((13.1, 10.0), 0.6)[5:]
    out += furniture.sofa((12.0, NORTH_M - 0.5), -90) + furniture.plant((10.2, NORTH_M - 0.5), 1.5)
    out += furniture.book_case((15.2, CORE_NORTH_M + 0.22), 90, 1.3) + furniture.cabinet((14.4, NORTH_M - 0.3), -90)
    out += furniture.crate((10.2, 12.9), 10) + furniture.bin_((16.0, NORTH_M - 0.4))
    out.append(panel((13.0, NORTH_M, 1.15), -90, (1.0, 0.75), pictures.painting(), px_per_m=240))
    out.append(panel((11.2, NORTH_M, 1.1), -90, (0.6, 0.85), pictures.poster(), px_per_m=240))
    out.append(panel((12.6, CORE_NORTH_M + 0.06, 1.0), 90, (1.8, 1.0), pictures.whiteboard()))
    out.append(panel((ROOM_WALLS_M[0] + 0.06, 11.8, 1.05), 0, (0.8, 0.6), pictures.painting(), px_per_m=240))
    out.append(panel((ROOM_WALLS_M[1] - 0.06, 10.6, 1.0), 180, (1.2, 0.9), pictures.notice_board(), px_per_m=240))
    return out


def _room_c() -> list[Facet]:
    """The eastern room: a workshop with shelves and boxes."""
    out = furniture.desk((18.4, CORE_NORTH_M + 0.5), 90, 1.6) + furniture.chair((18.4, CORE_NORTH_M + 1.2), -85, (60, 96, 70))
    out += furniture.book_case((20.6, CORE_NORTH_M + 0.22), 90, 1.4, 1.9) + furniture.crate((22.4, CORE_NORTH_M + 0.4), 6)
    out += furniture.table((20.2, NORTH_M - 0.5), -90, (0.7, 2.0)) + furniture.crate((19.8, NORTH_M - 0.5), 20, bottom_m=0.74)
    out += furniture.crate((20.7, NORTH_M - 0.45), -15, (0.3, 0.4, 0.24), bottom_m=0.74) + furniture.crate(
        (20.4, 13.8), 8, (0.4, 0.5, 0.5)
    )
    out += furniture.cabinet((18.0, NORTH_M - 0.3), -90, 0.6, 1.5, (96, 116, 140)) + furniture.cabinet((22.6, 13.4), 180)
    out += furniture.plant((16.9, CORE_NORTH_M + 0.5), 1.4) + furniture.bin_((22.6, 12.2), (130, 120, 50))
    out += [panel((x, NORTH_M, 1.2), -90, (1.6, 1.05), pictures.window(), glow=0.4, in_depth=False) for x in (19.2, 21.6)]
    out.append(panel((ROOM_WALLS_M[1] + 0.06, 10.3, 1.0), 0, (0.7, 0.95), pictures.poster(), px_per_m=240))
    out.append(panel((ROOM_WALLS_M[1] + 0.06, 13.8, 1.0), 0, (0.6, 0.85), pictures.poster(), px_per_m=240))
    out.append(panel((EAST_M - CORRIDOR_M - 0.06, 12.2, 1.05), 180, (0.6, 0.85), pictures.poster(), px_per_m=240))
    return out


def _round() -> Array:
    """Way points: east along the south corridor, north, west through the rooms, south again; `LAPS` times."""
    middle, east = 0.5 * CORRIDOR_M, EAST_M - 0.5 * CORRIDOR_M
    first, second = ROOM_WALLS_M
    lap = np.array(
        [
            (5.0, middle),
            (east - 0.6, middle),
            (east, middle + 0.6),
            (east, EAST_DOOR_Y - 0.7),
            (east - 0.7, EAST_DOOR_Y),
            (EAST_M - CORRIDOR_M - 0.6, EAST_DOOR_Y),
            (20.4, 10.9),
            (second + 1.0, SECOND_DOOR_Y),
            (second - 0.8, SECOND_DOOR_Y),
            (12.4, 11.9),
            (first + 0.9, FIRST_DOOR_Y),
            (first - 0.8, FIRST_DOOR_Y),
            (6.2, 11.0),
            (CORRIDOR_M + 0.7, WEST_DOOR_Y),
            (middle + 0.6, WEST_DOOR_Y),
            (middle, WEST_DOOR_Y - 0.6),
            (middle, middle + 0.6),
            (middle + 0.6, middle),
        ]
    )
    points = np.vstack([np.tile(lap, (int(LAPS) + 1, 1)), lap[:1]])
    travelled = np.concatenate([[0.0], np.cumsum(np.linalg.norm(np.diff(points, axis=0), axis=1))])
    end = LAPS * travelled[len(lap)]
    whole = points[travelled < end]
    last = [np.interp(end, travelled, points[:, axis]) for axis in (0, 1)]
    return np.vstack([whole, last])
