"""Run every experiment of the verification, on as many cores as there are."""

from __future__ import annotations

import logging
import multiprocessing
import os
from collections.abc import Callable, Iterator
from concurrent.futures import Future, ProcessPoolExecutor
from contextlib import contextmanager
from dataclasses import dataclass, field
from typing import Any

import numpy as np

from hybridmap.config.mapping import NeuralConfig
from hybridmap.errors import ConfigError
from hybridmap.neural import PathIntegrator
from hybridmap.study.pools import one_thread_for_children
from hybridmap.verification import laps, path_error, rate_maps, shadow
from hybridmap.verification.drives import ROOM_M
from hybridmap.verification.laps import LapErrors
from hybridmap.verification.path_error import HeadDirectionResult, PathErrors, StandstillResult
from hybridmap.verification.rate_maps import LatticeMaps, PlaceResult
from hybridmap.verification.room_fields import RoomFields, room_fields
from hybridmap.verification.shadow import Overwriting

RECTIFIERS = ("relu", "softplus")
RATES_HZ = (30.0, 100.0)


@dataclass(frozen=True, slots=True)
class Scale:
    """Size of the experiments. The limits in the table hold for the defaults.

    Attributes:
        paths, distance_m: number and length of the drives through the room, at each step rate with each rectifier.
        heading_steps, still_steps: number of turns of the head-direction ring, and of steps at standstill.
        overwrites: number of shifts of the activity that are decoded at once.
        overwritten_drives: number of directions in which activity is shifted before driving on.
        arena_m: side of the arena of all rate maps.
        lattice_pitch_m, lattice_cells: pixel of the maps of band and grid cells; sampled grid cells per module.
        place_pitch_m, place_cells, place_epochs: pixel of the place cells' maps; cells and passes of the paper's rule.
        room_m, room_pitch_m: part of the room of 10 x 3 m over which place cells are mapped, and pixel of these maps.
        noise: standard deviations of the neuron noise, as a share of the rate; `noise_repeats` drives of `noise_distance_m`
            for each.
        laps_m, laps_alone_m: length of the drive in laps of the office with noisy neurons, with closures and without.
        workers: number of processes; None: one per core.
    """

    paths: int = 5
    distance_m: float = 240.0
    heading_steps: int = 24_000
    still_steps: int = 100_000
    overwrites: int = 20
    overwritten_drives: int = 2
    arena_m: float = 1.6
    lattice_pitch_m: float = 0.0125
    lattice_cells: int = 6
    place_pitch_m: float = 0.02
    place_cells: int = 512
    place_epochs: int = 10
    room_m: tuple[float, float] = ROOM_M
    room_pitch_m: float = 0.03
    noise: tuple[float, ...] = (0.01, 0.02, 0.05, 0.1)
    noise_repeats: int = 12
    noise_distance_m: float = 40.0
    laps_m: float = 1000.0
    laps_alone_m: float = 400.0
    workers: int | None = None


@dataclass(frozen=True, slots=True)
class CellVerification:
    """Results of all experiments of the verification.

    Attributes:
        head_direction: the head-direction ring after many turns.
        standstill: the path integrator while the robot stands still.
        lattice, square: rate maps with the hexagonal and with the square metric.
        place: place fields.
        room_fields: place fields in the room of 10 x 3 m.
        room: (rectifier, steps per second) -> errors of every drive through the room.
        corridor: rectifier -> errors of the drive down the corridor.
        overwritten: rectifier -> response of the pose to a shift of the cells' activity.
        noise: standard deviation of the neuron noise -> errors of every drive with it.
        recalibrated, alone: laps of the office with noisy neurons, with closures and without.
        printed_kernel: error message for the paper's printed kernel; empty if it is stable.
    """

    head_direction: HeadDirectionResult
    standstill: StandstillResult
    lattice: LatticeMaps
    square: LatticeMaps
    place: PlaceResult
    room_fields: RoomFields
    recalibrated: LapErrors
    alone: LapErrors
    room: dict[tuple[str, float], list[PathErrors]] = field(default_factory=dict)
    corridor: dict[str, PathErrors] = field(default_factory=dict)
    overwritten: dict[str, Overwriting] = field(default_factory=dict)
    noise: dict[float, list[PathErrors]] = field(default_factory=dict)
    printed_kernel: str = ""


Task = tuple[Callable[..., Any], tuple[Any, ...]]


def verify_cells(
    seed: int, scale: Scale, settings: dict[str, object], progress: Callable[[int, int | None], None] | None = None
) -> CellVerification:
    """Run every experiment; the same seed gives the same results, on any number of cores.

    Args:
        seed: seed of all drives, samples and noises.
        scale: size of the experiments.
        settings: settings of the cells (`NeuralConfig`), besides what an experiment varies.
        progress: called with the number of finished experiments and of all.

    Raises:
        ConfigError: the settings do not allow a working network.
    """
    PathIntegrator(NeuralConfig.model_validate(settings))  # fails at once if it cannot be made
    tasks = _tasks(np.random.SeedSequence(seed), scale, settings)
    done = run_tasks(tasks, scale.workers, progress)
    parts: dict[str, Any] = {key[0]: value for key, value in done.items() if len(key) == 1}
    return CellVerification(
        **parts,
        room={(f, hz): [done["room", f, hz, k] for k in range(scale.paths)] for f in RECTIFIERS for hz in RATES_HZ},
        corridor={f: done["corridor", f] for f in RECTIFIERS},
        overwritten={f: done["overwritten", f] for f in RECTIFIERS},
        noise={share: [done["noise", share, k] for k in range(scale.noise_repeats)] for share in scale.noise},
    )


def _tasks(seed: np.random.SeedSequence, scale: Scale, settings: dict[str, object]) -> dict[tuple[Any, ...], Task]:
    """Every experiment by name, the longest first; each has a seed of its own."""
    paths, others, noises = seed.spawn(3)
    path_seeds = paths.spawn(scale.paths)
    still, turns, lattice, square, place, corridor, overwritten, lapped, wandered = others.spawn(9)
    tasks: dict[tuple[Any, ...], Task] = {}
    tasks["recalibrated",] = laps.office_errors, (lapped, settings, scale.laps_m, True)
    tasks["alone",] = laps.office_errors, (lapped, settings, scale.laps_alone_m, False)
    for hz in reversed(RATES_HZ):
        for f in reversed(RECTIFIERS):
            for k, path_seed in enumerate(path_seeds):
                tasks["room", f, hz, k] = path_error.room_errors, (path_seed, settings | {"rectifier": f}, scale.distance_m, hz)
    tasks["room_fields",] = room_fields, (wandered, settings, scale.distance_m, scale.room_m, scale.room_pitch_m)
    pitch, cells = scale.lattice_pitch_m, scale.lattice_cells
    tasks["place",] = (
        rate_maps.place_maps,
        (place, settings, scale.arena_m, scale.place_pitch_m, scale.place_cells, scale.place_epochs),
    )
    tasks["lattice",] = rate_maps.lattice_maps, (lattice, settings, scale.arena_m, pitch, cells)
    tasks["square",] = rate_maps.lattice_maps, (square, settings | {"metric": "square"}, scale.arena_m, pitch, cells)
    for k, one in enumerate(noises.spawn(scale.noise_repeats)):
        drive_seed, noise_seed = one.spawn(2)
        for share in scale.noise:  # the same drives and draws for all, so that what differs is the noise
            arguments = (drive_seed, noise_seed, settings, share, scale.noise_distance_m)
            tasks["noise", share, k] = path_error.noise_errors, arguments
    tasks["standstill",] = path_error.standstill, (still, settings, scale.still_steps)
    tasks["head_direction",] = path_error.head_direction, (turns, settings, scale.heading_steps)
    for f in RECTIFIERS:
        tasks["corridor", f] = path_error.corridor_errors, (corridor, settings | {"rectifier": f})
        tasks["overwritten", f] = (
            shadow.overwritten,
            (overwritten, settings | {"rectifier": f}, scale.overwrites, scale.overwritten_drives),
        )
    tasks["printed_kernel",] = printed_kernel, (settings,)
    return tasks


def printed_kernel(settings: dict[str, object]) -> str:
    """The error message that the paper's printed kernel causes with these settings; an empty string if it is stable."""
    try:
        PathIntegrator(NeuralConfig.model_validate(settings | {"kernel": "printed"}))
    except ConfigError as error:
        return str(error)
    return ""


def run_tasks(
    tasks: dict[tuple[Any, ...], Task], workers: int | None, progress: Callable[[int, int | None], None] | None = None
) -> dict[tuple[Any, ...], Any]:
    """Run the tasks in so many processes (None: one per core), or here if there is to be one only; results by the same keys.

    Args:
        tasks: key -> function and its arguments, the longest first.
        workers: number of processes; None: one per core.
        progress: called with the number of finished tasks and of all.
    """
    count = min(workers or os.cpu_count() or 1, len(tasks))
    progress = progress or (lambda _done, _total: None)
    done = {}
    if count == 1:
        with _quiet():
            for number, (key, (function, arguments)) in enumerate(tasks.items()):
                progress(number, len(tasks))
                done[key] = function(*arguments)
        return done
    with (
        one_thread_for_children(),
        ProcessPoolExecutor(count, multiprocessing.get_context("spawn"), initializer=_be_quiet) as pool,
    ):
        running: dict[tuple[Any, ...], Future[Any]] = {
            key: pool.submit(function, *arguments) for key, (function, arguments) in tasks.items()
        }
        for number, (key, future) in enumerate(running.items()):
            progress(number, len(tasks))
            done[key] = future.result()
    return done


@contextmanager
def _quiet() -> Iterator[None]:
    """What is logged of the cells is left out, as in the processes of a pool."""
    logger = logging.getLogger("hybridmap")
    before = logger.level
    _be_quiet()
    try:
        yield
    finally:
        logger.setLevel(before)


def _be_quiet() -> None:
    logging.getLogger("hybridmap").setLevel(logging.ERROR)  # modules disagree in the noise runs: that is what they show
