"""A world prepared for ray casting: triangles, and one texture atlas with the light baked in."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property

import cv2
import numpy as np
import open3d as o3d
from numpy.typing import NDArray

from hybridmap.geometry import Array
from hybridmap.simulation.paints import Image
from hybridmap.simulation.surfaces import Facet, World


@dataclass(frozen=True, slots=True, eq=False)
class Hits:
    """Results of ray casting; every array has the shape of the rays without its last axis.

    Attributes:
        hit: whether the ray hit a surface.
        length: float32 distance to the hit, in units of the length of the ray's direction vector.
        surface: int32 index of the surface (0 without a hit).
        across: float32 texture coordinate 0..1 from the left edge of the surface.
        down: float32 texture coordinate 0..1 from its upper edge.
    """

    hit: NDArray[np.bool_]
    length: NDArray[np.float32]
    surface: NDArray[np.int32]
    across: NDArray[np.float32]
    down: NDArray[np.float32]


class Caster:
    """Casts rays at a list of rectangular surfaces; they are numbered in the order of the list."""

    def __init__(self, surfaces: Sequence[Facet]) -> None:
        corner = np.array([s.corner for s in surfaces])
        along, up = np.array([s.along for s in surfaces]), np.array([s.up for s in surfaces])
        vertices = np.stack([corner, corner + along, corner + along + up, corner + up], axis=1).reshape(-1, 3)
        first = 4 * np.arange(len(surfaces))[:, None, None]
        triangles = (first + np.array([[0, 1, 2], [0, 2, 3]])).reshape(-1, 3)
        self._scene = o3d.t.geometry.RaycastingScene()
        self._scene.add_triangles(
            o3d.core.Tensor.from_numpy(vertices.astype(np.float32)), o3d.core.Tensor.from_numpy(triangles.astype(np.uint32))
        )

    def cast(self, rays: NDArray[np.float32]) -> Hits:
        """The first surface that each ray hits.

        Args:
            rays: (..., 6) float32, origin (m) and direction of each ray.
        """
        found = self._scene.cast_rays(o3d.core.Tensor.from_numpy(rays))
        length = found["t_hit"].numpy()
        hit = np.isfinite(length)
        triangle = np.where(hit, found["primitive_ids"].numpy(), 0).astype(np.int32)
        uv = found["primitive_uvs"].numpy()
        a, b = uv[..., 0], uv[..., 1]
        second = (triangle & 1).astype(bool)
        across = np.where(second, a, a + b)
        height = np.where(second, a + b, b)
        return Hits(hit, length, triangle >> 1, across, np.float32(1.0) - height)

    def blocked(self, rays: NDArray[np.float32]) -> NDArray[np.bool_]:
        """Whether each ray (..., 6), float32, origin and direction, m, hits a surface before its direction vector ends."""
        return np.asarray(self._scene.test_occlusions(o3d.core.Tensor.from_numpy(rays), tnear=0.0, tfar=0.999).numpy())


class Scene:
    """The surfaces of a world, prepared for a camera and a laser.

    Attributes:
        normals: (S, 3) float32, unit normal of each surface, towards the painted side.
        px_per_m: (S,) float32, texels per metre.
        in_depth: (S,) bool, whether a depth camera sees the surface.
        foliage_m: (S,) how far a laser beam goes on behind the surface at most, m.
        walkers: people who move.
    """

    def __init__(self, world: World) -> None:
        surfaces = world.surfaces
        self._caster = Caster(surfaces)
        normals = np.cross([s.along for s in surfaces], [s.up for s in surfaces])
        self.normals = (normals / np.linalg.norm(normals, axis=1, keepdims=True)).astype(np.float32)
        self.px_per_m = np.array([s.px_per_m for s in surfaces], dtype=np.float32)
        self.in_depth = np.array([s.in_depth for s in surfaces])
        self.foliage_m = np.array([s.foliage_m for s in surfaces])
        self.walkers = world.walkers
        self._world = world

    @cached_property
    def atlas(self) -> TextureAtlas:
        """Textures of all surfaces with the light on them; painted when a camera first needs them."""
        surfaces = self._world.surfaces
        shadow_makers = Caster([s for s in surfaces if not s.decal])
        generators = np.random.default_rng(self._world.texture_seed).spawn(len(surfaces))
        lights = bake(surfaces, shadow_makers)
        return build_atlas(
            [
                light.apply(s.paint(rng, texture_size(s), s.px_per_m))
                for s, rng, light in zip(surfaces, generators, lights, strict=True)
            ]
        )

    def cast(self, origin: Array, directions: NDArray[np.float32]) -> Hits:
        """First hits of rays from one point: origin (3,), m; directions `(..., 3)` float32."""
        start = np.broadcast_to(origin.astype(np.float32), directions.shape)
        return self._caster.cast(np.concatenate([start, directions], axis=-1))


def texture_size(surface: Facet) -> tuple[int, int]:
    """Height and width of a surface's texture, texels, at least 3 each."""
    height, width = (float(np.linalg.norm(edge)) * surface.px_per_m for edge in (surface.up, surface.along))
    return max(3, round(height)), max(3, round(width))


_ATLAS_WIDTH_PX = 4096
_ATLAS_SIDE_LIMIT_PX = 32767  # cv2.remap keeps coordinates in 16 bits
_SMALLEST_PX = 3


@dataclass(frozen=True, slots=True, eq=False)
class TextureAtlas:
    """The textures of all surfaces, each at several resolutions, in one image.

    Attributes:
        image: (H, W, 3) uint8, RGB.
        levels: (S,) int32, number of resolutions of each surface.
        places: (S * L, 4) float32, L being the largest number of resolutions: left, top, width - 1 and height - 1, texels, of
            surface s at resolution l (0 is the finest) in row s * L + l.
    """

    image: Image
    levels: NDArray[np.int32]
    places: NDArray[np.float32]

    def sample(
        self,
        surface: NDArray[np.int32],
        across: NDArray[np.float32],
        down: NDArray[np.float32],
        footprint_texels: NDArray[np.float32],
    ) -> NDArray[np.float32]:
        """Colour (H, W, 3) float32, RGB 0..255, where a ray hit a surface; trilinear between the two nearest resolutions.

        Args:
            surface: (H, W) index of the surface hit.
            across: (H, W) texture coordinate 0..1 from left to right.
            down: (H, W) texture coordinate 0..1 from top to bottom.
            footprint_texels: (H, W) how many texels of the full resolution one pixel covers.
        """
        top_level = (self.levels[surface] - 1).astype(np.float32)
        level = np.clip(np.log2(np.maximum(footprint_texels, 1.0)), 0.0, top_level)
        lower = np.floor(level)
        share = (level - lower)[..., None]
        fine = self._bilinear(surface, across, down, lower)
        coarse = self._bilinear(surface, across, down, np.minimum(lower + 1.0, top_level))
        return np.asarray(fine + share * (coarse - fine))

    def _bilinear(
        self, surface: NDArray[np.int32], across: NDArray[np.float32], down: NDArray[np.float32], level: NDArray[np.float32]
    ) -> NDArray[np.float32]:
        stride = len(self.places) // len(self.levels)
        place = self.places[surface * stride + level.astype(np.int32)]
        u = place[..., 0] + across * place[..., 2]
        v = place[..., 1] + down * place[..., 3]
        return np.asarray(cv2.remap(self.image, u, v, cv2.INTER_LINEAR), dtype=np.float32)


def build_atlas(textures: list[Image]) -> TextureAtlas:
    """Pack textures and their copies at half, quarter, ... resolution into one image.

    Args:
        textures: (h, w, 3) uint8, one per surface, in the order of the surfaces, RGB, with the light on them already.
    """
    pyramids = [_pyramid(texture) for texture in textures]
    stride = max(len(pyramid) for pyramid in pyramids)
    rows = [(index * stride + level, image) for index, pyramid in enumerate(pyramids) for level, image in enumerate(pyramid)]
    rows.sort(key=lambda row: (-row[1].shape[0], row[0]))
    width = max(_ATLAS_WIDTH_PX, max(image.shape[1] for _, image in rows))
    places = np.zeros((len(textures) * stride, 4), dtype=np.float32)
    left = top = shelf = 0
    for row, image in rows:
        if left + image.shape[1] > width:
            left, top, shelf = 0, top + shelf, 0
        places[row] = left, top, image.shape[1] - 1, image.shape[0] - 1
        left, shelf = left + image.shape[1], max(shelf, image.shape[0])
    height = top + shelf
    assert max(width, height) <= _ATLAS_SIDE_LIMIT_PX, "the world has more texture than one atlas holds"
    packed = np.zeros((height, width, 3), dtype=np.uint8)
    for row, image in rows:
        x, y = int(places[row, 0]), int(places[row, 1])
        packed[y : y + image.shape[0], x : x + image.shape[1]] = image
    return TextureAtlas(packed, np.array([len(pyramid) for pyramid in pyramids], dtype=np.int32), places)


def _pyramid(texture: Image) -> list[Image]:
    levels = [texture]
    while min(levels[-1].shape[:2]) >= 2 * _SMALLEST_PX:
        height, width = levels[-1].shape[:2]
        levels.append(
            np.asarray(cv2.resize(levels[-1], (width // 2, height // 2), interpolation=cv2.INTER_AREA), dtype=np.uint8)
        )
    return levels


_CELL_M = 0.22
_RAYS = 40
_LAMP_REACH_M = 6.0
_LIFT_M = 0.004
_AMBIENT, _DIRECT = 0.78, 0.9


@dataclass(frozen=True, slots=True, eq=False)
class LightMap:
    """Brightness `factors` (h, w) float32 on a coarse grid over one surface, row 0 at the top; 1 leaves a colour as it is."""

    factors: NDArray[np.float32]

    def apply(self, texture: Image) -> Image:
        """A copy of a texture (H, W, 3) uint8 multiplied by the brightness factors, interpolated to its size."""
        height, width = texture.shape[:2]
        smooth = cv2.resize(self.factors, (width, height), interpolation=cv2.INTER_LINEAR)
        return np.asarray(np.clip(texture * smooth[..., None], 0, 255), dtype=np.uint8)


def bake(surfaces: Sequence[Facet], caster: Caster) -> list[LightMap]:
    """Compute the light on every surface; light sources have full brightness. A world without lamps is lit evenly.

    Args:
        surfaces: all surfaces of the world.
        caster: of those that cast shadows.

    Returns:
        One map per surface, in their order.
    """
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


def _normal(surface: Facet) -> Array:
    normal = np.cross(surface.along, surface.up)
    return np.asarray(normal / np.linalg.norm(normal))


def _grid_shape(surface: Facet) -> tuple[int, int]:
    rows, columns = (max(1, round(float(np.linalg.norm(edge)) / _CELL_M)) for edge in (surface.up, surface.along))
    return rows, columns


def _grid_points(surface: Facet, shape: tuple[int, int]) -> Array:
    rows = 1.0 - (np.arange(shape[0]) + 0.5) / shape[0]
    columns = (np.arange(shape[1]) + 0.5) / shape[1]
    grid = surface.corner + columns[None, :, None] * surface.along + rows[:, None, None] * surface.up
    return np.asarray(grid.reshape(-1, 3))


def _openness(points: Array, normals: Array, caster: Caster) -> Array:
    """Ambient light (N,): mean over cosine-weighted directions, less if surfaces are close."""
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


def _lamp_light(points: Array, normals: Array, lamps: Sequence[Facet], caster: Caster) -> Array:
    """Light (N,) from the middle of each lamp within reach that is not blocked."""
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
