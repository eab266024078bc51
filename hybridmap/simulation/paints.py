"""Materials of the simulated surfaces: plaster, carpet, wood, bricks and the like.

A paint is a function that draws a texture of `(height_px, width_px)` texels with a random generator.
"""

from __future__ import annotations

from collections.abc import Callable
from functools import wraps
from inspect import signature
from typing import Concatenate, ParamSpec

import cv2
import numpy as np
from numpy.typing import NDArray

from hybridmap.simulation.surfaces import Paint

Image = NDArray[np.uint8]
Field = NDArray[np.float32]
Color = tuple[int, int, int]
Rng = np.random.Generator
Shape = tuple[int, int]
"""Height and width, texels."""
P = ParamSpec("P")
_DRAWN_WITH = 3
"""Parameters of a paint: generator, shape, texels per metre."""


def smooth_noise(rng: Rng, shape: Shape, cell_px: float) -> Field:
    """Smooth noise (H, W) float32 with mean 0 and a standard deviation of about 1; its blobs are about `cell_px` wide."""
    rows, columns = (max(2, round(side / max(cell_px, 1.0)) + 1) for side in shape)
    coarse = rng.standard_normal((rows, columns), dtype=np.float32)
    return np.asarray(cv2.resize(coarse, (shape[1], shape[0]), interpolation=cv2.INTER_CUBIC), dtype=np.float32)


def tint(color: Color, tone: Field) -> Image:
    """A texture (H, W, 3) uint8 of a colour whose brightness is multiplied by `tone` (H, W); 1 gives the colour itself."""
    return np.asarray(np.clip(tone[..., None] * np.asarray(color, dtype=np.float32), 0, 255).astype(np.uint8))


def vary(rng: Rng, color: Color, spread: int = 20) -> Color:
    """A random colour near another one: each channel differs by at most `spread`, within 0..255."""
    drawn = np.clip(np.asarray(color) + rng.integers(-spread, spread + 1, 3), 0, 255)
    return int(drawn[0]), int(drawn[1]), int(drawn[2])


def any_color(rng: Rng, low: int = 20, high: int = 235) -> Color:
    """A random colour, with each channel from `low` to `high` - 1."""
    drawn = rng.integers(low, high, 3)
    return int(drawn[0]), int(drawn[1]), int(drawn[2])


def material(draw: Callable[Concatenate[Rng, Shape, float, P], Image]) -> Callable[P, Paint]:
    """Decorator: a function that draws a texture takes its options alone (colours, sizes) from then on, and returns a paint.

    `plain((90, 90, 90))` is a paint, for instance. The renderer calls it with generator, shape and texels per metre.
    """

    @wraps(draw)
    def with_options(*args: P.args, **options: P.kwargs) -> Paint:
        return lambda rng, shape, px_per_m: draw(rng, shape, px_per_m, *args, **options)

    whole = signature(draw)
    options = list(whole.parameters.values())[_DRAWN_WITH:]
    vars(with_options)["__signature__"] = whole.replace(parameters=options, return_annotation="Paint")  # what `help` shows
    return with_options


@material
def plain(_rng: Rng, shape: Shape, _px_per_m: float, color: Color) -> Image:
    """`plain(color)` returns a paint that draws a single colour.

    Called with a generator, a shape (h, w) in texels and texels per metre, the paint returns (h, w, 3) uint8 RGB.
    """
    return np.full((*shape, 3), color, dtype=np.uint8)


@material
def plaster(rng: Rng, shape: Shape, px_per_m: float, color: Color) -> Image:
    """`plaster(color)` returns a paint that draws a wall with faint clouds.

    Called with a generator, a shape (h, w) in texels and texels per metre, the paint returns (h, w, 3) uint8 RGB.
    It has a mark every two metres on average, and a skirting board if it is higher than 1.5 m.
    """
    tone = 1.0 + 0.012 * smooth_noise(rng, shape, 0.6 * px_per_m) + 0.012 * smooth_noise(rng, shape, 0.03 * px_per_m)
    image = tint(color, tone)
    for _ in range(rng.poisson(0.5 * shape[1] / px_per_m)):
        x, y = int(rng.integers(shape[1])), int(shape[0] * (1.0 - rng.beta(1.3, 4.0)))
        end = (x + int(rng.normal(0, 0.08) * px_per_m), y + int(rng.normal(0, 0.03) * px_per_m))
        shade = vary(rng, tuple(int(0.72 * channel) for channel in color), 25)  # type: ignore[arg-type]
        cv2.line(image, (x, y), end, shade, int(rng.integers(1, 3)), cv2.LINE_AA)
    if shape[0] > 1.5 * px_per_m:
        image[shape[0] - round(0.09 * px_per_m) :] = (92, 84, 76)
    return image


@material
def carpet(rng: Rng, shape: Shape, px_per_m: float, color: Color) -> Image:
    """`carpet(color)` returns a paint that draws carpet tiles of half a metre.

    Called with a generator, a shape (h, w) in texels and texels per metre, the paint returns (h, w, 3) uint8 RGB.
    """
    tile_px = max(2, round(0.5 * px_per_m))
    rows, columns = -(-shape[0] // tile_px), -(-shape[1] // tile_px)
    tones = 1.0 + 0.05 * rng.standard_normal((rows, columns), dtype=np.float32)
    tone = np.repeat(np.repeat(tones, tile_px, axis=0), tile_px, axis=1)[: shape[0], : shape[1]].copy()
    tone += 0.06 * smooth_noise(rng, shape, 0.04 * px_per_m) + 0.05 * smooth_noise(rng, shape, 0.15 * px_per_m)
    tone += 0.05 * rng.standard_normal(shape, dtype=np.float32)
    for _ in range(rng.poisson(0.25 * shape[0] * shape[1] / px_per_m**2)):
        center = (int(rng.integers(shape[1])), int(rng.integers(shape[0])))
        axes = (max(1, int(rng.uniform(0.03, 0.12) * px_per_m)), max(1, int(rng.uniform(0.02, 0.08) * px_per_m)))
        cv2.ellipse(tone, center, axes, float(rng.uniform(0, 180)), 0, 360, float(rng.uniform(0.6, 0.85)), -1, cv2.LINE_AA)
    return tint(color, tone)


@material
def wood(rng: Rng, shape: Shape, px_per_m: float, color: Color = (150, 108, 70), *, plank_m: float = 0.0) -> Image:
    """`wood(color)` returns a paint that draws wood.

    Called with a generator, a shape (h, w) in texels and texels per metre, the paint returns (h, w, 3) uint8 RGB.
    Its grain is parallel to the surface's edge `along`; with `plank_m` > 0 it has planks of that width.
    """
    stretched = smooth_noise(rng, (shape[0], max(2, shape[1] // 12)), 0.02 * px_per_m)
    grain = cv2.resize(stretched, (shape[1], shape[0]), interpolation=cv2.INTER_LINEAR)
    rings = np.sin(4.0 * smooth_noise(rng, shape, 0.35 * px_per_m) + 2.0 * grain)
    tone = 1.0 + 0.09 * grain + 0.06 * rings
    if plank_m > 0.0:
        plank_px = max(2, round(plank_m * px_per_m))
        rows = -(-shape[0] // plank_px)
        tones = 1.0 + 0.10 * rng.standard_normal(rows).astype(np.float32)
        tone *= np.repeat(tones, plank_px)[: shape[0], None]
        tone[::plank_px] *= 0.6
        for row in range(rows):
            joint = int(rng.integers(0, max(1, round(1.6 * px_per_m))))
            tone[row * plank_px : (row + 1) * plank_px, joint :: max(2, round(1.6 * px_per_m))] *= 0.6
    return tint(color, tone.astype(np.float32))


@material
def bricks(rng: Rng, shape: Shape, px_per_m: float) -> Image:
    """`bricks()` returns a paint that draws a wall of bricks, each of its own tone.

    Called with a generator, a shape (h, w) in texels and texels per metre, the paint returns (h, w, 3) uint8 RGB.
    """
    image = np.full((*shape, 3), (178, 170, 160), dtype=np.uint8)
    height, width = max(3, round(0.077 * px_per_m)), max(6, round(0.25 * px_per_m))
    gap = max(1, round(0.012 * px_per_m))
    for row, top in enumerate(range(0, shape[0], height)):
        for left in range(-(row % 2) * width // 2, shape[1], width):
            shade = tuple(int(c * rng.uniform(0.72, 1.15)) for c in (156, 82, 62))
            cv2.rectangle(image, (left, top), (left + width - gap - 1, top + height - gap - 1), shade, -1)
    tone = 1.0 + 0.05 * rng.standard_normal(shape, dtype=np.float32)
    return np.clip(image * tone[..., None], 0, 255).astype(np.uint8)


@material
def ceiling_tiles(rng: Rng, shape: Shape, px_per_m: float) -> Image:
    """`ceiling_tiles()` returns a paint that draws ceiling tiles of 60 cm.

    Called with a generator, a shape (h, w) in texels and texels per metre, the paint returns (h, w, 3) uint8 RGB.
    """
    tone = 1.0 - 0.10 * (rng.random(shape, dtype=np.float32) > 0.985)
    tile_px = max(2, round(0.6 * px_per_m))
    tones = 1.0 + 0.012 * rng.standard_normal((-(-shape[0] // tile_px), -(-shape[1] // tile_px)), dtype=np.float32)
    tone = tone * np.repeat(np.repeat(tones, tile_px, axis=0), tile_px, axis=1)[: shape[0], : shape[1]]
    tone[::tile_px] *= 0.8
    tone[:, ::tile_px] *= 0.8
    return tint((226, 224, 216), tone.astype(np.float32))


@material
def fabric(rng: Rng, shape: Shape, px_per_m: float, color: Color) -> Image:
    """`fabric(color)` returns a paint that draws woven, mottled cloth.

    Called with a generator, a shape (h, w) in texels and texels per metre, the paint returns (h, w, 3) uint8 RGB.
    """
    tone = 1.0 + 0.05 * rng.standard_normal(shape, dtype=np.float32) + 0.06 * smooth_noise(rng, shape, 0.1 * px_per_m)
    return tint(color, tone)


@material
def metal(rng: Rng, shape: Shape, px_per_m: float, color: Color = (150, 154, 158), *, drawers: int = 0) -> Image:
    """`metal(color)` returns a paint that draws sheet metal.

    Called with a generator, a shape (h, w) in texels and texels per metre, the paint returns (h, w, 3) uint8 RGB.
    With `drawers` > 0 it has so many of them, with handles and name plates.
    """
    image = tint(color, 1.0 + 0.02 * smooth_noise(rng, shape, 0.2 * px_per_m))
    dark = vary(rng, (70, 72, 76), 10)
    for index in range(drawers):
        top, bottom = index * shape[0] // drawers, (index + 1) * shape[0] // drawers - 1
        cv2.rectangle(image, (1, top + 1), (shape[1] - 2, bottom), dark, 1)
        middle, row = shape[1] // 2, top + (bottom - top) // 4
        half = max(2, shape[1] // 8)
        cv2.rectangle(image, (middle - half, row), (middle + half, row + max(1, round(0.02 * px_per_m))), dark, -1)
        if rng.random() < 0.7:
            plate = vary(rng, (225, 220, 190), 25)
            low = row + round(0.04 * px_per_m)
            cv2.rectangle(image, (middle - half // 2, low), (middle + half // 2, low + round(0.03 * px_per_m)), plate, -1)
    return image
