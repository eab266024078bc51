"""Single cells along a recorded path, as an experimenter sees them: spikes, rate maps, scores, and the scores by chance."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field
from typing import Any

import numpy as np
from numpy.typing import NDArray

from hybridmap.config.mapping import NeuralConfig
from hybridmap.geometry import Array
from hybridmap.neural import PathIntegrator
from hybridmap.verification.path_error import PathErrors, path_errors
from hybridmap.verification.physiology import grid_scores, spatial_information, tuning_width, vector_length
from hybridmap.verification.recorded import RATE_HZ, Arena, RecordedPath, Track, arena_of, track_of
from hybridmap.verification.verification import Task, run_tasks

GRID, BAND, PLACE, HEADING = "grid", "band", "place", "head-direction"
PEAK_HZ = {GRID: 15.0, BAND: 10.0, PLACE: 15.0, HEADING: 40.0}
"""Rate, Hz, of a cell where it fires most, as usual in rats; the model's rates have no unit."""
SCORES = {
    GRID: ("sargolini", "langston", "information"),
    BAND: ("sargolini", "langston", "information"),
    PLACE: ("information",),
    HEADING: ("vector_length",),
}
"""What the cells of each kind are judged by; band cells, which have stripes, are a control of the grid scores."""
CHANCE = 0.95
"""Quantile of the scores of the shuffled spikes that a cell must exceed."""
_SHIFT_S = 20.0
"""Spikes are shifted by at least this, so that they are elsewhere."""
HEADING_BINS = 60
_GRID_CELLS_PER_MODULE, _HEADING_CELLS, _PLACE_CELLS = 3, 8, 16
_CHUNK = 4096


@dataclass(frozen=True, slots=True)
class Cell:
    """A cell that was recorded from.

    Attributes:
        kind: `grid`, `band`, `place` or `head-direction`.
        module: number of its grid module; -1 where it has none.
        spacing_m: spacing of its grid or period of its stripes, m; NaN where it has none.
        preferred_rad: its preferred heading, or the direction across its stripes, in the frame of the path, rad; NaN where
            it has none.
    """

    kind: str
    module: int = -1
    spacing_m: float = float("nan")
    preferred_rad: float = float("nan")


@dataclass(frozen=True, slots=True)
class CellScores:
    """What the spikes of one cell show.

    Attributes:
        rates: (H, W) rate map, Hz, NaN where the path never was.
        tuning: (60,) rate over heading, Hz, NaN at headings that never occurred.
        scores: name of the measure -> score, of those in `SCORES` for its kind; NaN where there is none.
        chance: same names -> 95th percentile of the scores of the shuffled spikes.
        true_scores: same names -> score of the rate itself in place of the spikes.
        width_rad: width of the tuning curve at half height.
    """

    rates: Array
    tuning: Array
    scores: dict[str, float]
    chance: dict[str, float]
    true_scores: dict[str, float]
    width_rad: float


@dataclass(frozen=True, slots=True)
class PathVerification:
    """The cells along a recorded path.

    Attributes:
        track, arena: the path, and the bins of the rate maps.
        cells: the C cells that were recorded from.
        rates_hz: (C, T) float32, rate of each at each sample of the track.
        spikes: of each cell, the samples (S,) among the K known ones in which it fired, sorted, one entry a spike.
        spike_times_s: of each cell, the times (S,) of the same spikes, s from the start of the track.
        results: of each cell, what its spikes show.
        errors: errors of the path integrator.
        spacings_m: (M,) spacing of each grid module.
        heading_concentration: of the head-direction cells' von Mises tuning; 0: the paper's cosine.
        settings: settings of the cells (`NeuralConfig`).
    """

    track: Track
    arena: Arena
    cells: list[Cell]
    rates_hz: NDArray[np.float32]
    spikes: list[NDArray[np.int64]]
    spike_times_s: list[Array]
    results: list[CellScores]
    errors: PathErrors
    spacings_m: Array
    heading_concentration: float = 0.0
    settings: dict[str, object] = field(default_factory=dict)

    def of_kind(self, kind: str) -> list[tuple[int, Cell, CellScores]]:
        """Number, cell and results of all cells of a kind."""
        found = enumerate(zip(self.cells, self.results, strict=True))
        return [(number, cell, scores) for number, (cell, scores) in found if cell.kind == kind]


def verify_along(
    recorded: RecordedPath,
    seed: int,
    settings: dict[str, object],
    heading_concentration: float = 0.0,
    shuffles: int = 100,
    workers: int | None = None,
    progress: Callable[[int, int | None], None] | None = None,
) -> PathVerification:
    """Run the cells along a recorded path, let some of them spike, and score each against its own shuffled spikes.

    The same seed gives the same results, on any number of cores.

    Args:
        recorded: the path.
        seed: seed of the choice of cells, of the spikes, of the shuffles and of neuron noise.
        settings: settings of the cells (`NeuralConfig`).
        heading_concentration: of the head-direction cells' von Mises tuning; 0: the paper's cosine.
        shuffles: how often the spikes of each cell are shifted in time.
        workers: number of processes; None: one per core.
        progress: called with the number of finished cells and of all.

    Raises:
        ConfigError: the settings do not allow a working network.
        StreamError: the path is too short, or covers too little for a rate map.
    """
    config = NeuralConfig.model_validate(settings)
    track = track_of(recorded)
    arena = arena_of(track, config.spacing_min_m)
    choice, noise, firing = np.random.SeedSequence(seed).spawn(3)
    integrator = PathIntegrator(config, np.random.default_rng(noise), heading_concentration=heading_concentration)
    cells, rates, errors = _recorded_from(integrator, track, np.random.default_rng(choice))
    known = rates[:, track.known]
    started_s = track.stamps_s[track.known]
    tasks: dict[tuple[Any, ...], Task] = {}
    spikes, times = [], []
    for number, (cell, cell_seed) in enumerate(zip(cells, firing.spawn(len(cells)), strict=True)):
        of_spikes, of_shuffles = cell_seed.spawn(2)
        fired, at_s = poisson_spikes(np.random.default_rng(of_spikes), known[number], started_s)
        spikes.append(fired)
        times.append(at_s)
        tasks[number,] = scores_of, (cell.kind, fired, known[number], arena, of_shuffles, shuffles)
    done = run_tasks(tasks, workers, progress)
    results = [done[number,] for number in range(len(cells))]
    return PathVerification(
        track, arena, cells, rates, spikes, times, results, errors, integrator.spacings_m, heading_concentration, settings
    )


def _recorded_from(
    integrator: PathIntegrator, track: Track, rng: np.random.Generator
) -> tuple[list[Cell], NDArray[np.float32], PathErrors]:
    """Drive the integrator along a track; the sampled cells, their rates (C, T) in Hz, and the errors of the path."""
    modules, side = integrator.grid.activity.shape[:2]
    of_module = np.repeat(np.arange(modules), _GRID_CELLS_PER_MODULE)
    row, column = rng.integers(0, side, (2, len(of_module)))
    band = np.asarray(rng.integers(0, 3, modules))
    of_ring = rng.integers(0, integrator.bands.activity.shape[-1], modules)
    ring = integrator.head_direction
    of_heading = np.arange(_HEADING_CELLS) * len(ring.preferred_rad) // _HEADING_CELLS
    count = len(track.stamps_s)
    grid, bands, headings = (np.empty((count, n), np.float32) for n in (len(of_module), modules, len(of_heading)))
    inputs = np.empty((count, integrator.place.weights.shape[1]), np.float32)

    def look(step: int) -> None:
        grid[step + 1] = integrator.grid.activity[of_module, row, column]
        bands[step + 1] = integrator.bands.activity[np.arange(modules), band, of_ring]
        headings[step + 1] = ring.activity[of_heading]
        inputs[step + 1] = integrator.place.inputs(integrator.grid.activity)

    look(-1)
    errors = path_errors(integrator.config, track.drive, integrator=integrator, after_step=look)
    picked = np.unique(np.linspace(0, len(integrator.place.weights) - 1, _PLACE_CELLS).round().astype(int))
    chunks = (inputs[start : start + _CHUNK].T for start in range(0, count, _CHUNK))
    place = np.concatenate([integrator.place.respond(chunk)[picked] for chunk in chunks], axis=1).T
    highest = np.array([grid[:, of_module == module].max() for module in of_module])
    scaled = ((GRID, grid / highest), (BAND, bands), (PLACE, place), (HEADING, 0.5 * headings))
    waves, spacings = integrator.bands, integrator.spacings_m
    cells = [Cell(GRID, int(module), float(spacings[module])) for module in of_module]
    across = (waves.orientations_rad[np.arange(modules), band] + track.poses[0, 2]) % np.pi  # the cells start at heading 0
    cells += [Cell(BAND, m, float(waves.periods_m[m, b]), float(across[m])) for m, b in enumerate(band)]
    cells += [Cell(PLACE)] * len(picked)
    preferred = (ring.preferred_rad[of_heading] + track.poses[0, 2]) % (2.0 * np.pi)
    cells += [Cell(HEADING, preferred_rad=float(angle)) for angle in preferred]
    rates = np.concatenate([(np.float32(PEAK_HZ[kind]) * np.maximum(values, 0.0)).T for kind, values in scaled])
    return cells, np.asarray(rates, dtype=np.float32), errors


def poisson_spikes(
    rng: np.random.Generator, rates_hz: NDArray[np.floating], started_s: Array
) -> tuple[NDArray[np.int64], Array]:
    """Draw Poisson spikes of a cell.

    Args:
        rng: random generator.
        rates_hz: (K,) rate of the cell in each sample.
        started_s: (K,) time at which each sample begins; it lasts 1 / `RATE_HZ`.

    Returns:
        The samples (S,) of the spikes and their times (S,), s, both sorted.
    """
    samples = np.repeat(np.arange(len(rates_hz)), rng.poisson(rates_hz.astype(np.float64) / RATE_HZ))
    times = started_s[samples] + rng.uniform(0.0, 1.0 / RATE_HZ, len(samples))
    return samples, np.sort(times)


def scores_of(
    kind: str,
    fired: NDArray[np.int64],
    rates_hz: NDArray[np.floating],
    arena: Arena,
    seed: np.random.SeedSequence,
    shuffles: int,
) -> CellScores:
    """Score the spikes of one cell, and the same spikes shifted round the known part of the path by random times.

    Args:
        kind: of the cell.
        fired: (S,) samples in which it fired.
        rates_hz: (K,) its rate in each known sample.
        arena: the bins.
        seed: of the shifts.
        shuffles: number of shifts, from 20 s to the length of the path less 20 s.
    """
    count = len(arena.bins)
    least = round(_SHIFT_S * RATE_HZ)
    shifts = np.random.default_rng(seed).integers(least, count - least, shuffles)
    by_chance = [_scores(kind, _counted((fired + shift) % count, count), arena) for shift in shifts]
    counts = _counted(fired, count)
    chance = {name: _quantile([scores[name] for scores in by_chance]) for name in SCORES[kind]}
    tuning = heading_tuning(counts, arena.headings_rad)
    return CellScores(
        arena.rate_map(counts),
        tuning,
        _scores(kind, counts, arena),
        chance,
        _scores(kind, rates_hz.astype(np.float64) / RATE_HZ, arena),
        tuning_width(_round_off(tuning)) if kind == HEADING else float("nan"),
    )


def _counted(fired: NDArray[np.int64], count: int) -> Array:
    """Number of spikes (K,) in each of `count` samples."""
    return np.bincount(fired, minlength=count).astype(np.float64)


def _scores(kind: str, counts: Array, arena: Arena) -> dict[str, float]:
    """The scores of a kind of cell, of spikes counted in each known sample (K,)."""
    if kind == HEADING:
        return {"vector_length": vector_length(np.nan_to_num(heading_tuning(counts, arena.headings_rad)))}
    rates = arena.rate_map(counts)
    found = {"information": spatial_information(rates, arena.dwell_s)}
    return (grid_scores(rates)._asdict() if "sargolini" in SCORES[kind] else {}) | found


def _quantile(values: list[float]) -> float:
    """The quantile `CHANCE`; a shuffle without a score, since its map has no six peaks, is no chance to beat."""
    there = [value for value in values if np.isfinite(value)]
    return float(np.quantile(there, CHANCE)) if there else float("nan")


def heading_tuning(counts: Array, headings_rad: Array) -> Array:
    """Rate (60,), Hz, over heading, of spikes counted in each sample (K,) at its heading (K,), rad; NaN where none occurred."""
    bins = np.round(headings_rad * (HEADING_BINS / (2.0 * np.pi))).astype(np.int64) % HEADING_BINS
    dwell = np.bincount(bins, minlength=HEADING_BINS) / RATE_HZ
    fired = np.bincount(bins, counts, minlength=HEADING_BINS)
    return np.where(dwell > 0.0, fired / np.where(dwell > 0.0, dwell, 1.0), np.nan)


def _round_off(tuning: Array) -> Array:
    """A tuning curve without gaps and without the steps of single spikes: each bin with its two neighbours."""
    filled = np.nan_to_num(tuning)
    return 0.25 * np.roll(filled, 1) + 0.5 * filled + 0.25 * np.roll(filled, -1)
