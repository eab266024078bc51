"""Light baked into the textures: lamps with shadows, and ambient light that corners and undersides get less of."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING

import cv2
import numpy as np
from numpy.typing import NDArray

from hybridmap.geometry import Array
from hybridmap.simulation.paints import Image
from hybridmap.simulation.surfaces import Surface

if TYPE_CHECKING:
    from hybridmap.simulation.scene import Caster

_CELL_M = 0.22
_RAYS = 40
_LAMP_REACH_M = 6.0
_LIFT_M = 0.004
_AMBIENT, _DIRECT = 0.78, 0.9


@dataclass(frozen=True, slots=True, eq=False)
class LightMap:
    """Brightness factors (h, w) float32 on a coarse grid over one surface, row 0 at the top."""

    factors: NDArray[np.float32]

    def apply(self, texture: Image) -> Image:
        """Texture (H, W, 3) with the light on it."""
        height, width = texture.shape[:2]
        smooth = cv2.resize(self.factors, (width, height), interpolation=cv2.INTER_LINEAR)
        return np.asarray(np.clip(texture * smooth[..., None], 0, 255), dtype=np.uint8)


def bake(surfaces: Sequence[Surface], caster: Caster) -> list[LightMap]:
    """Light on every surface; those that glow are at full brightness. A world without lamps is lit evenly."""
    lamps = [s for s in surfaces if s.glow > 0.0]
    if not lamps:
        return [LightMap(np.ones((1, 1), dtype=np.float32)) for _ in surfaces]
    shapes = [_grid_shape(s) for s in surfaces]
    points = np.vstack([_grid_points(s, shape) for s, shape in zip(surfaces, shapes, strict=True)])
    counts = [h * w for h, w in shapes]
    normals = np.repeat(np.array([_normal(s) for s in surfaces]), counts, axis=0)
    points = points + _LIFT_M * normals
    brightness = _AMBIENT * _openness(points, normals, caster) + _DIRECT * _lamp_light(points, normals, lamps, caster)
    maps: list[LightMap] = []
    for surface, shape, values in zip(surfaces, shapes, np.split(brightness, np.cumsum(counts)[:-1]), strict=True):
        factors = np.ones(shape) if surface.glow > 0.0 else np.clip(values, 0.16, 1.25).reshape(shape)
        maps.append(LightMap(factors.astype(np.float32)))
    return maps


def _normal(surface: Surface) -> Array:
    normal = np.cross(surface.along, surface.up)
    return np.asarray(normal / np.linalg.norm(normal))


def _grid_shape(surface: Surface) -> tuple[int, int]:
    rows, columns = (max(1, round(float(np.linalg.norm(edge)) / _CELL_M)) for edge in (surface.up, surface.along))
    return rows, columns


def _grid_points(surface: Surface, shape: tuple[int, int]) -> Array:
    rows = 1.0 - (np.arange(shape[0]) + 0.5) / shape[0]
    columns = (np.arange(shape[1]) + 0.5) / shape[1]
    grid = surface.corner + columns[None, :, None] * surface.along + rows[:, None, None] * surface.up
    return np.asarray(grid.reshape(-1, 3))


def _openness(points: Array, normals: Array, caster: Caster) -> Array:
    """Ambient light (N,): mean over cosine-weighted directions, less where the next thing is close."""
    turn = np.pi * (3.0 - np.sqrt(5.0)) * np.arange(_RAYS)
    radius = np.sqrt((np.arange(_RAYS) + 0.5) / _RAYS)
    local = np.column_stack([radius * np.cos(turn), radius * np.sin(turn), np.sqrt(1.0 - radius**2)])
    helper = np.where(np.abs(normals[:, 2:3]) > 0.9, [[1.0, 0.0, 0.0]], [[0.0, 0.0, 1.0]])
    side = np.cross(helper, normals)
    side /= np.linalg.norm(side, axis=1, keepdims=True)
    frames = np.stack([side, np.cross(normals, side), normals], axis=1)
    directions = np.einsum("kc,ncd->nkd", local, frames)
    start = np.broadcast_to(points[:, None], directions.shape)
    hits = caster.cast(np.concatenate([start, directions], axis=-1).astype(np.float32))
    near = np.minimum(np.where(hits.hit, hits.length, np.float32(9.0)) / 0.8, 1.0)
    return np.asarray((0.15 + 0.85 * near).mean(axis=1), dtype=np.float64)


def _lamp_light(points: Array, normals: Array, lamps: Sequence[Surface], caster: Caster) -> Array:
    """Light (N,) from the middle of each lamp within reach, unless something is between."""
    middles = np.array([lamp.corner + 0.5 * (lamp.along + lamp.up) + 0.05 * _normal(lamp) for lamp in lamps])
    facing = np.array([_normal(lamp) for lamp in lamps])
    power = np.array([lamp.glow * np.linalg.norm(lamp.along) * np.linalg.norm(lamp.up) for lamp in lamps])
    total = np.zeros(len(points))
    for middle, face, strength in zip(middles, facing, power, strict=True):
        way = middle - points
        distance2 = np.einsum("ij,ij->i", way, way)
        distance = np.sqrt(distance2)
        seen = np.einsum("ij,ij->i", way, normals) / distance
        sent = -way @ face / distance
        index = np.flatnonzero((distance < _LAMP_REACH_M) & (seen > 0.0) & (sent > 0.0))
        rays = np.concatenate([points[index], way[index]], axis=1).astype(np.float32)
        lit = index[~caster.blocked(rays)]
        fade = 1.0 - distance[lit] / _LAMP_REACH_M
        total[lit] += 3.0 * strength * seen[lit] * sent[lit] * fade / (0.6 + distance2[lit])
    return total
