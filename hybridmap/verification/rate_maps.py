"""Rate maps of band, grid and place cells, collected while the network drives along the lines of an arena."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from hybridmap.config.mapping import NeuralConfig
from hybridmap.geometry import Array
from hybridmap.neural import PathIntegrator
from hybridmap.neural.place import PlaceProjection
from hybridmap.verification.drives import pixel_order, raster
from hybridmap.verification.physiology import field_counts, grid_scores, stripe_of

_SETTLING_STEPS = 10
_LEARNING_STEPS = 4  # theta at 30 Hz
_FIRING = 0.2  # share of the highest rate of the sheet from which on a cell of it counts as firing


@dataclass(frozen=True, slots=True)
class LatticeMaps:
    """Rate maps of grid and band cells.

    Attributes:
        pitch_m: side of a pixel.
        spacings_m: (M,) spacing of each grid module.
        grid: (M, C, H, W) rate maps of C sampled grid cells of each module.
        gridness, langston: (M, C) grid scores of each of these maps, Sargolini's and Langston's.
        bands: (M, 3, H, W) rate map of one sampled cell of each band.
        band_orientation_error_deg, band_period_error: (M, 3) deviation of the measured stripes from the orientation and
            period for which the band was made; the period's as a share.
    """

    pitch_m: float
    spacings_m: Array
    grid: NDArray[np.float32]
    gridness: Array
    langston: Array
    bands: NDArray[np.float32]
    band_orientation_error_deg: Array
    band_period_error: Array


def lattice_maps(
    seed: np.random.SeedSequence, settings: dict[str, object], side_m: float, pitch_m: float, cells: int
) -> LatticeMaps:
    """Record rate maps of sampled grid and band cells over a square arena that is rotated by a random angle.

    Args:
        seed: seed of the angle and of the sampled cells.
        settings: settings of the cells (`NeuralConfig`).
        side_m: side of the arena.
        pitch_m: side of a pixel.
        cells: number of sampled cells per module.
    """
    rng = np.random.default_rng(seed)
    angle = float(rng.uniform(0.0, np.pi / 2.0))
    integrator = PathIntegrator(NeuralConfig.model_validate(settings))
    drive = raster(side_m, pitch_m, angle)
    modules, side = integrator.grid.activity.shape[:2]
    picked = rng.integers(0, side, (modules, cells, 2))
    at, of_ring = np.arange(modules), rng.integers(0, integrator.bands.activity.shape[-1], (modules, 3))
    count = round(side_m / pitch_m)
    grid = np.zeros((modules, cells, count, count), dtype=np.float32)
    bands = np.zeros((modules, 3, count, count), dtype=np.float32)
    for (i, j), delta in zip(pixel_order(count), drive.deltas, strict=True):
        integrator.step(delta, 1.0 / drive.hz)
        grid[:, :, i, j] = integrator.grid.activity[at[:, None], picked[..., 0], picked[..., 1]]
        bands[:, :, i, j] = integrator.bands.activity[at[:, None], np.arange(3), of_ring]
    stripes = [[stripe_of(bands[m, b], pitch_m) for b in range(3)] for m in range(modules)]
    seen = np.array([[stripe.orientation_rad + angle for stripe in row] for row in stripes])
    turned = np.degrees(seen - integrator.bands.orientations_rad)
    periods = np.array([[stripe.period_m for stripe in row] for row in stripes])
    scores = np.array([[grid_scores(rates) for rates in row] for row in grid])
    return LatticeMaps(
        pitch_m,
        integrator.spacings_m,
        grid,
        scores[..., 0],
        scores[..., 1],
        bands,
        np.abs((turned + 90.0) % 180.0 - 90.0),
        np.abs(periods / integrator.bands.periods_m - 1.0),
    )


@dataclass(frozen=True, slots=True)
class PlaceMaps:
    """Firing fields of one population of cells.

    Attributes:
        examples: (E, H, W) rate maps of some cells.
        fields: (C,) number of fields, by `field_counts`, of every cell that fires.
    """

    examples: NDArray[np.float32]
    fields: NDArray[np.int64]

    @property
    def single(self) -> float:
        """Share of the cells that fire which have exactly one field; NaN if none fires."""
        return float((self.fields == 1).mean()) if len(self.fields) else float("nan")


@dataclass(frozen=True, slots=True)
class PlaceResult:
    """Place cells and the attractor sheet to which they project, in two variants each.

    Place cells are `recruited` (one new cell for each new place) or `printed` (the paper's rule, from random weights). The
    sheet shows its `input`, or is `settled` (its cells have competed through their recurrent weights).

    Attributes:
        pitch_m: side of a pixel.
        recruited, printed: fields of the place cells.
        sheet: (`recruited` or `printed`, `input` or `settled`) -> fields of the sheet's cells.
        one_bump: same keys -> share of the places at which the sheet holds a single bump of activity.
    """

    pitch_m: float
    recruited: PlaceMaps
    printed: PlaceMaps
    sheet: dict[tuple[str, str], PlaceMaps]
    one_bump: dict[tuple[str, str], float]


def place_maps(
    seed: np.random.SeedSequence, settings: dict[str, object], side_m: float, pitch_m: float, cells: int, epochs: int
) -> PlaceResult:
    """Let place cells learn on one drive over a square arena, and record their fields on a second drive across the first.

    Args:
        seed: seed of all random choices.
        settings: settings of the cells (`NeuralConfig`).
        side_m: side of the arena.
        pitch_m: side of a pixel.
        cells, epochs: number of place cells, and of passes of learning, of the paper's rule.
    """
    rng = np.random.default_rng(seed)
    angle, count = float(rng.uniform(0.0, np.pi / 2.0)), round(side_m / pitch_m)
    config = NeuralConfig.model_validate(settings)
    integrator = PathIntegrator(config)
    inputs, bumps = [], []
    for k, delta in enumerate(raster(side_m, pitch_m, angle).deltas):
        integrator.step(delta, 1.0 / 30.0)
        if k % _LEARNING_STEPS == 0:
            inputs.append(integrator.place.inputs(integrator.grid.activity))
            bumps.append(integrator.attractor.activity.astype(np.float32).ravel())
    learnt, bump = np.array(inputs), np.array(bumps)
    drive = raster(side_m, pitch_m, angle, upright=True)
    mapper = PathIntegrator(config)
    seen = np.array([inputs_after(mapper, delta) for delta in drive.deltas])
    order = pixel_order(count, upright=True)
    printed = PrintedRule(rng, cells, learnt.shape[1], config.place.learning_rate)
    for _ in range(epochs):
        for drive_input in learnt[rng.permutation(len(learnt))]:
            printed.learn(drive_input)
    maps, sheet, one_bump = {}, {}, {}
    for name, population in (("recruited", integrator.place), ("printed", printed)):
        rates = population.respond(seen.T)
        maps[name] = fields_of(_as_maps(rates, order, count))
        shown = _onto_sheet(population.respond(learnt.T), bump, rates)
        for stage, activity in (("input", shown), ("settled", settled_sheets(integrator, shown))):
            sheet[name, stage] = fields_of(_as_maps(activity, order, count), floor=_FIRING)
            one_bump[name, stage] = one_bump_share(activity)
    return PlaceResult(pitch_m, maps["recruited"], maps["printed"], sheet, one_bump)


class PrintedRule:
    """Place cells by the paper's rule (eqs. 8-9) without recruitment: random weights, competition by one common inhibition.

    Two additions make the rule work: the weights are kept non-negative and of unit length, and the inhibition C_inh_p is set
    so that one cell in fifty fires.
    """

    def __init__(self, rng: np.random.Generator, cells: int, inputs: int, learning_rate: float) -> None:
        """Draw the weights (cells, inputs) with `rng`; `learning_rate` is that of the strongest cell in each step."""
        weights = np.maximum(rng.normal(size=(cells, inputs)), 0.0).astype(np.float32)
        self.weights: NDArray[np.float32] = weights / np.linalg.norm(weights, axis=1, keepdims=True)
        self._rate = np.float32(learning_rate)

    def respond(self, drive: NDArray[np.float32]) -> NDArray[np.float32]:
        """Return the rates of the place cells, (cells,) or (cells, P), to inputs (inputs,) or (inputs, P)."""
        received = self.weights @ drive
        return np.asarray(np.maximum(received - np.quantile(received, 0.98, axis=0), 0.0), dtype=np.float32)

    def learn(self, drive: NDArray[np.float32]) -> None:
        """Take one step of the Hebbian rule for the inputs `drive`; rates count relative to the strongest one."""
        rates = self.respond(drive)
        active = np.flatnonzero(rates)
        share = rates[active, None] / rates.max()
        grown = np.maximum(self.weights[active] + self._rate * share * (drive - drive.mean()), 0.0)
        self.weights[active] = grown / np.linalg.norm(grown, axis=1, keepdims=True)


def inputs_after(integrator: PathIntegrator, delta: Array) -> NDArray[np.float32]:
    """Take one step of 1/30 s; returns what the place cells then get from the grid cells, (inputs,)."""
    integrator.step(delta, 1.0 / 30.0)
    return integrator.place.inputs(integrator.grid.activity)


def _onto_sheet(learnt: NDArray[np.float32], bumps: NDArray[np.float32], rates: NDArray[np.float32]) -> NDArray[np.float32]:
    """Learn the projection onto the sheet from rates (C, T) and bumps (T, S); return the sheet's input (S, P) for rates (C, P).

    The input sums to one wherever there is any, as the sheet's activity does: what its cells get before they compete.
    """
    projection = PlaceProjection(bumps.shape[1])
    for fired, bump in zip(learnt.T, bumps, strict=True):
        projection.learn(fired, bump)
    shown = projection.onto(rates)
    total = shown.sum(axis=0)
    return np.asarray(shown / np.where(total > 0.0, total, 1.0), dtype=np.float32)


def settled_sheets(integrator: PathIntegrator, shown: NDArray[np.float32]) -> NDArray[np.float32]:
    """Activity (S, P) of the integrator's attractor after its cells have competed, starting from each of P inputs (S, P).

    The attractor is left in the last of these states; zero inputs give zeros.
    """
    attractor = integrator.attractor
    settled = np.zeros_like(shown)
    for pixel in np.flatnonzero(shown.sum(axis=0) > 0.0):
        attractor.activity = shown[:, pixel].reshape(attractor.activity.shape).astype(np.float64)
        attractor.settle(_SETTLING_STEPS)
        settled[:, pixel] = attractor.activity.ravel()
    return settled


def one_bump_share(activity: NDArray[np.float32]) -> float:
    """Share of the places at which the sheet holds exactly one bump; places without activity do not count; NaN if none has any.

    A bump is a cell above 20 % of the highest activity that no other cell within two cells exceeds.

    Args:
        activity: (N * N, P) of a square sheet with opposite edges joined, at P places.
    """
    from scipy import ndimage

    side = math.isqrt(len(activity))
    sheets = activity[:, activity.any(axis=0)].reshape(side, side, -1)
    highest = ndimage.maximum_filter(sheets, size=(5, 5, 1), mode="wrap")
    bumps = ((sheets == highest) & (sheets > _FIRING * sheets.max(axis=(0, 1)))).sum(axis=(0, 1))
    return float((bumps == 1).mean()) if bumps.size else float("nan")


def _as_maps(rates: NDArray[np.float32], order: NDArray[np.int64], count: int) -> NDArray[np.float32]:
    maps = np.zeros((len(rates), count, count), dtype=np.float32)
    maps[:, order[:, 0], order[:, 1]] = rates
    return maps


def fields_of(maps: NDArray[np.float32], floor: float = 0.0) -> PlaceMaps:
    """Count the fields of the cells, by their maps (C, H, W), whose peak is above a share of the population's highest."""
    peaks = maps.max(axis=(1, 2))
    firing = maps[(peaks > 0.0) & (peaks >= floor * peaks.max())]
    return PlaceMaps(firing[:: max(1, len(firing) // 12)][:12].copy(), field_counts(firing))
