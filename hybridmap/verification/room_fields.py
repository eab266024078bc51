"""Place fields in a room as large as the paper's laboratory, learnt on a random drive through it."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from hybridmap.config.mapping import NeuralConfig
from hybridmap.geometry import Array
from hybridmap.neural import PathIntegrator
from hybridmap.verification.drives import room_lines, wander
from hybridmap.verification.rate_maps import PlaceMaps, fields_of, inputs_after

_SAMPLED = 400
"""Cells whose fields are mapped, evenly spaced in the order in which they were recruited."""
_AT_ONCE = 1000
"""Places for which the rates of all cells are held in memory."""


@dataclass(frozen=True, slots=True)
class RoomFields:
    """Fields of place cells in the room of 10 x 3 m.

    Attributes:
        pitch_m: side of a pixel.
        way_m: (P, 2) positions on the drive on which the cells learnt, from the middle of the room.
        recruited: number of cells that were recruited on it.
        sampled: fields of some of them over the whole room.
    """

    pitch_m: float
    way_m: Array
    recruited: int
    sampled: PlaceMaps


def room_fields(
    seed: np.random.SeedSequence,
    settings: dict[str, object],
    distance_m: float,
    sides_m: tuple[float, float],
    pitch_m: float,
) -> RoomFields:
    """Let place cells learn on a random drive through the room, and record their fields on a second one along lines.

    Args:
        seed: seed of the first drive.
        settings: settings of the cells (`NeuralConfig`).
        distance_m: length of the first drive.
        sides_m: length and width of what is mapped, around the middle of the room.
        pitch_m: side of a pixel.
    """
    config = NeuralConfig.model_validate(settings)
    learner, mapper = PathIntegrator(config), PathIntegrator(config)
    first = wander(np.random.default_rng(seed), distance_m, 30.0)
    for delta in first.deltas:
        learner.step(delta, 1.0 / first.hz)
    second, pixels = room_lines(sides_m, pitch_m)
    seen = np.array([inputs_after(mapper, delta) for delta in second.deltas])
    picked = np.unique(np.linspace(0, len(learner.place.weights) - 1, _SAMPLED).astype(int))
    parts = [learner.place.respond(seen[k : k + _AT_ONCE].T)[picked] for k in range(0, len(seen), _AT_ONCE)]
    maps = np.zeros((len(picked), *pixels.max(axis=0) + 1), dtype=np.float32)
    maps[:, pixels[:, 0], pixels[:, 1]] = np.concatenate(parts, axis=1)
    return RoomFields(pitch_m, first.poses[:, :2], len(learner.place.weights), fields_of(maps))
