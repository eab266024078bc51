"""A world made ready for ray casting: triangles, textures with the light baked in, and what a bundle of rays meets."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property

import numpy as np
import open3d as o3d
from numpy.typing import NDArray

from hybridmap.geometry import Array
from hybridmap.simulation.atlas import Atlas, build_atlas
from hybridmap.simulation.light import bake
from hybridmap.simulation.surfaces import Surface, World


@dataclass(frozen=True, slots=True, eq=False)
class Hits:
    """What rays met; every array has the rays' leading shape.

    Attributes:
        hit: whether there was anything.
        length: float32, in units of the ray's direction vector.
        surface: int32 index of the surface (0 where nothing was hit).
        across: float32 texture coordinate 0..1 along the surface.
        down: float32 texture coordinate 0..1 from its upper edge.
    """

    hit: NDArray[np.bool_]
    length: NDArray[np.float32]
    surface: NDArray[np.int32]
    across: NDArray[np.float32]
    down: NDArray[np.float32]


class Caster:
    """Casts rays at a list of surfaces, two triangles each."""

    def __init__(self, surfaces: Sequence[Surface]) -> None:
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
        """First hits of rays `(..., 6)` float32: origin, direction."""
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
        """Whether anything lies between 0 and 1 lengths of the direction of rays `(..., 6)`."""
        return np.asarray(self._scene.test_occlusions(o3d.core.Tensor.from_numpy(rays), tnear=0.0, tfar=0.999).numpy())


class Scene:
    """The surfaces of a world as a camera and a laser see them.

    Attributes:
        normals: (S, 3) float32, unit, towards the painted side.
        px_per_m: (S,) float32, texels a metre.
        in_depth: (S,) bool, whether a depth camera sees the surface.
    """

    def __init__(self, world: World) -> None:
        surfaces = world.surfaces
        self._caster = Caster(surfaces)
        normals = np.cross([s.along for s in surfaces], [s.up for s in surfaces])
        self.normals = (normals / np.linalg.norm(normals, axis=1, keepdims=True)).astype(np.float32)
        self.px_per_m = np.array([s.px_per_m for s in surfaces], dtype=np.float32)
        self.in_depth = np.array([s.in_depth for s in surfaces])
        self._world = world

    @cached_property
    def atlas(self) -> Atlas:
        """Textures with the light on them; painted when a camera first looks."""
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


def texture_size(surface: Surface) -> tuple[int, int]:
    """Height and width in texels."""
    height, width = (float(np.linalg.norm(edge)) * surface.px_per_m for edge in (surface.up, surface.along))
    return max(3, round(height)), max(3, round(width))
