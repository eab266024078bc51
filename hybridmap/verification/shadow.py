"""Test that the cells' activity alone holds the position: activity is overwritten, and the decoded pose must follow."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

import numpy as np

from hybridmap.config.mapping import NeuralConfig
from hybridmap.geometry import Array
from hybridmap.neural import PathIntegrator
from hybridmap.neural.grid import shift_sheets
from hybridmap.verification.drives import ExactDrive, wander

Cells = Literal["sheets", "rings", "both"]
CELLS: tuple[Cells, ...] = ("sheets", "rings", "both")
STEPS_ON = 100
_HZ = 30.0
_DRIVE_M = 4.0  # at the fastest some 109 steps, so a few come before the overwriting
_SHIFT_SPACINGS = 0.25


@dataclass(frozen=True, slots=True)
class Overwriting:
    """Response of the decoded pose when the activity of cells is shifted as if the robot stood elsewhere.

    Attributes:
        at_once: (draws,) difference between the pose's response and the shift of the grid sheets, before any further step, in
            spacings of the finest module.
        shift_m: length of the shifts after which the robot drives on.
        shown: (which cells are shifted, whether stripes drive the sheets) -> (STEPS_ON + 1,) share of the shift that the pose
            shows after each further step, relative to an unchanged network; mean over some directions.
        driving_on: largest error of the response if rings and sheets are shifted together, in spacings of the finest module.
    """

    at_once: Array
    shift_m: float
    shown: dict[tuple[Cells, bool], Array]
    driving_on: float


def overwritten(seed: np.random.SeedSequence, settings: dict[str, object], draws: int, directions: int) -> Overwriting:
    """Shift the activity of grid sheets, band rings, or both, and decode the pose at once and while the robot drives on.

    Args:
        seed: seed of the drives and shifts.
        settings: settings of the cells (`NeuralConfig`).
        draws: number of shifts that are decoded at once.
        directions: number of shifts after which the robot drives on.
    """
    rng = np.random.default_rng(seed)
    config = NeuralConfig.model_validate(settings)
    at_once = _at_once(rng, config, draws)
    drive = wander(rng, _DRIVE_M, _HZ)
    shift_m = _SHIFT_SPACINGS * config.spacing_min_m
    angles = rng.uniform(0.0, 2.0 * np.pi) + 2.0 * np.pi * np.arange(directions) / directions
    ways = shift_m * np.stack([np.cos(angles), np.sin(angles)], axis=1)
    shown: dict[tuple[Cells, bool], Array] = {}
    driving_on = 0.0
    for stripes in (True, False):
        setting = config if stripes else config.model_copy(update={"band_drive": 0.0})
        alone = _positions_after(setting, drive)
        for cells in CELLS:
            moved = np.array([_positions_after(setting, drive, cells, way) - alone for way in ways])
            shown[cells, stripes] = np.einsum("dsk,dk->s", moved, ways) / (shift_m**2 * directions)
            if stripes and cells == "both":
                driving_on = float(np.linalg.norm(moved - ways[:, None], axis=2).max() / config.spacing_min_m)
    return Overwriting(at_once, shift_m, shown, driving_on)


def _at_once(rng: np.random.Generator, config: NeuralConfig, draws: int) -> Array:
    """By how much the pose misses shifts (draws,) of the sheets, in finest spacings."""
    misses = np.zeros(draws)
    integrator = PathIntegrator(config)
    for delta in wander(rng, 3.0, _HZ).deltas:
        integrator.step(delta, 1.0 / _HZ)
    sheets = integrator.grid.activity.copy()
    for draw in range(draws):
        integrator.grid.activity = sheets
        before, way = integrator.pose, rng.uniform(-0.6, 0.6, 2)
        integrator.grid.activity = shift_sheets(sheets, integrator.bands.wave_vectors[:, [0, 2]] @ way)
        moved = integrator.pose - before
        misses[draw] = float(np.hypot(*(moved[:2] - way)) / integrator.spacings_m.min())
    return misses


def _positions_after(config: NeuralConfig, drive: ExactDrive, cells: Cells | None = None, way_m: Array | None = None) -> Array:
    """Positions (STEPS_ON + 1, 2) over the last steps of a drive; the cells named are shifted by `way_m` (2,) before them."""
    integrator = PathIntegrator(config)
    for delta in drive.deltas[:-STEPS_ON]:
        integrator.step(delta, 1.0 / drive.hz)
    if cells is not None and way_m is not None:
        overwrite(integrator, cells, way_m)
    positions = [integrator.pose[:2]]
    for delta in drive.deltas[-STEPS_ON:]:
        integrator.step(delta, 1.0 / drive.hz)
        positions.append(integrator.pose[:2])
    return np.array(positions)


def overwrite(integrator: PathIntegrator, cells: Cells, way_m: Array) -> None:
    """Shift the activity of some of the integrator's cells to that of a robot displaced by `way_m` (2,), m."""
    shift = integrator.bands.wave_vectors @ way_m
    if cells != "sheets":
        integrator.bands.activity = integrator.bands.rates_at(integrator.bands.phases() + shift)
    if cells != "rings":
        integrator.grid.activity = shift_sheets(integrator.grid.activity, shift[:, [0, 2]])
