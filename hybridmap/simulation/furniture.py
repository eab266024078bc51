"""Furniture of the simulated worlds. Each piece is a list of surfaces, placed on the floor at `at` = (x, y), m; its front
faces the direction `yaw_deg`.
"""

from __future__ import annotations

import numpy as np

from hybridmap.simulation import paints, pictures
from hybridmap.simulation.paints import Color
from hybridmap.simulation.surfaces import Facet, box, panel

Spot = tuple[float, float]


def _beside(at: Spot, yaw_deg: float, forward_m: float, left_m: float) -> Spot:
    cos, sin = np.cos(np.deg2rad(yaw_deg)), np.sin(np.deg2rad(yaw_deg))
    return float(at[0] + cos * forward_m - sin * left_m), float(at[1] + sin * forward_m + cos * left_m)


def table(at: Spot, yaw_deg: float, size: tuple[float, float], height_m: float = 0.74) -> list[Facet]:
    """Surfaces of a table on four legs at (x, y), m: `size` is its depth (along `yaw_deg`) and width, m."""
    out = box(at, (*size, 0.04), paints.wood((168, 126, 84)), bottom_m=height_m - 0.04, yaw_deg=yaw_deg)
    leg = paints.metal((88, 90, 96))
    for forward in (-0.5 * size[0] + 0.05, 0.5 * size[0] - 0.05):
        for left in (-0.5 * size[1] + 0.05, 0.5 * size[1] - 0.05):
            out += box(_beside(at, yaw_deg, forward, left), (0.05, 0.05, height_m - 0.04), leg, yaw_deg=yaw_deg)
    return out


def desk(at: Spot, yaw_deg: float, width_m: float = 1.4) -> list[Facet]:
    """Surfaces of a desk at (x, y), m, with drawers, papers, and a screen that faces `yaw_deg`."""
    out = table(at, yaw_deg, (0.7, width_m))
    drawers = {"front": paints.metal((128, 132, 140), drawers=3)}
    out += box(
        _beside(at, yaw_deg, 0.0, 0.5 * width_m - 0.28),
        (0.6, 0.4, 0.6),
        paints.metal((128, 132, 140)),
        faces=drawers,
        yaw_deg=yaw_deg,
    )
    monitor = _beside(at, yaw_deg, -0.12, -0.1)
    dark = paints.plain((34, 34, 38))
    out += box(monitor, (0.04, 0.06, 0.14), dark, bottom_m=0.74, yaw_deg=yaw_deg)
    out += box(monitor, (0.05, 0.54, 0.34), dark, bottom_m=0.86, yaw_deg=yaw_deg)
    face = _beside(monitor, yaw_deg, 0.025, 0.0)
    out.append(panel((*face, 0.87), yaw_deg, (0.52, 0.32), pictures.screen(), px_per_m=260, stand_off_m=0.004, in_depth=False))
    out += box(
        _beside(at, yaw_deg, 0.05, 0.42 * width_m), (0.3, 0.21, 0.08), pictures.poster(), bottom_m=0.74, yaw_deg=yaw_deg + 9
    )
    return out


def chair(at: Spot, yaw_deg: float, color: Color = (52, 74, 116)) -> list[Facet]:
    """Surfaces of a chair at (x, y), m, whose front faces `yaw_deg`."""
    cloth = paints.fabric(color)
    out = box(at, (0.44, 0.44, 0.07), cloth, bottom_m=0.43, yaw_deg=yaw_deg)
    out += box(_beside(at, yaw_deg, -0.22, 0.0), (0.05, 0.42, 0.46), cloth, bottom_m=0.52, yaw_deg=yaw_deg)
    steel = paints.metal((70, 70, 74))
    out += box(at, (0.06, 0.06, 0.43), steel, yaw_deg=yaw_deg)
    out += box(at, (0.5, 0.06, 0.05), steel, yaw_deg=yaw_deg + 45)
    out += box(at, (0.06, 0.5, 0.05), steel, yaw_deg=yaw_deg + 45)
    return out


def book_case(at: Spot, yaw_deg: float, width_m: float = 1.0, height_m: float = 2.0, depth_m: float = 0.3) -> list[Facet]:
    """Surfaces of a filled book case at (x, y), m, whose front faces `yaw_deg`."""
    front = {"front": pictures.books(max(2, round(height_m / 0.38)))}
    return box(at, (depth_m, width_m, height_m), paints.wood((128, 94, 64)), yaw_deg=yaw_deg, faces=front, px_per_m=160)


def cabinet(
    at: Spot, yaw_deg: float, width_m: float = 0.5, height_m: float = 1.3, color: Color = (150, 154, 158)
) -> list[Facet]:
    """Surfaces of a filing cabinet at (x, y), m, whose front faces `yaw_deg`, with something on top."""
    front = {"front": paints.metal(color, drawers=4)}
    out = box(at, (0.45, width_m, height_m), paints.metal(color), yaw_deg=yaw_deg, faces=front, px_per_m=140)
    return out + crate(at, yaw_deg + 12, (0.3, 0.32, 0.24), bottom_m=height_m)


def crate(at: Spot, yaw_deg: float, size: tuple[float, float, float] = (0.4, 0.5, 0.4), bottom_m: float = 0.0) -> list[Facet]:
    """Surfaces of a cardboard box at (x, y), m: `size` is depth, width and height, `bottom_m` the height of its lower face."""
    return box(at, size, pictures.parcel(), yaw_deg=yaw_deg, bottom_m=bottom_m, px_per_m=170)


def plant(at: Spot, height_m: float = 1.3) -> list[Facet]:
    """Surfaces of a pot plant at (x, y), m."""
    out = box(at, (0.34, 0.34, 0.36), paints.fabric((168, 96, 66)), yaw_deg=20)
    crown, middle = height_m - 0.42, 0.42
    out += box(at, (0.5, 0.5, crown * 0.6), pictures.leaves(), bottom_m=middle, yaw_deg=35, px_per_m=140)
    return out + box(at, (0.34, 0.34, crown * 0.4), pictures.leaves(), bottom_m=middle + 0.6 * crown, yaw_deg=70, px_per_m=140)


def sofa(at: Spot, yaw_deg: float) -> list[Facet]:
    """Surfaces of a sofa at (x, y), m, whose front faces `yaw_deg`."""
    width_m, cloth = 1.8, paints.fabric((146, 62, 52))
    out = box(at, (0.8, width_m, 0.42), cloth, yaw_deg=yaw_deg)
    out += box(_beside(at, yaw_deg, -0.32, 0.0), (0.18, width_m, 0.4), cloth, bottom_m=0.42, yaw_deg=yaw_deg)
    for left in (-0.5 * width_m + 0.09, 0.5 * width_m - 0.09):
        out += box(_beside(at, yaw_deg, 0.0, left), (0.8, 0.18, 0.2), cloth, bottom_m=0.42, yaw_deg=yaw_deg)
    return out + box(
        _beside(at, yaw_deg, -0.1, 0.2 * width_m), (0.14, 0.4, 0.36), pictures.painting(), bottom_m=0.42, yaw_deg=yaw_deg + 14
    )


def bin_(at: Spot, color: Color = (60, 110, 90)) -> list[Facet]:
    """Surfaces of a waste bin at (x, y), m."""
    return box(at, (0.3, 0.3, 0.5), paints.metal(color, drawers=1), yaw_deg=30)
