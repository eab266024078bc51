"""All textures of a world in one picture, each at several resolutions, so that far surfaces do not alias."""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray

from hybridmap.simulation.paints import Image

_ATLAS_WIDTH_PX = 4096
_ATLAS_SIDE_LIMIT_PX = 32767  # cv2.remap keeps coordinates in 16 bits
_SMALLEST_PX = 3


@dataclass(frozen=True, slots=True, eq=False)
class Atlas:
    """Packed textures.

    Attributes:
        image: (H, W, 3) uint8, RGB.
        levels: (S,) int32, number of resolutions of each surface.
        places: (S * L, 4) float32: left, top, width - 1, height - 1 in texels of surface s at level l in row s * L + l.
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
        """Colour (H, W, 3) float32 where a ray hit a surface; trilinear between the two nearest resolutions.

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


def build_atlas(textures: list[Image]) -> Atlas:
    """Pack textures (h, w, 3) uint8 and their halved copies."""
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
    return Atlas(packed, np.array([len(pyramid) for pyramid in pyramids], dtype=np.int32), places)


def _pyramid(texture: Image) -> list[Image]:
    levels = [texture]
    while min(levels[-1].shape[:2]) >= 2 * _SMALLEST_PX:
        height, width = levels[-1].shape[:2]
        levels.append(
            np.asarray(cv2.resize(levels[-1], (width // 2, height // 2), interpolation=cv2.INTER_AREA), dtype=np.uint8)
        )
    return levels
