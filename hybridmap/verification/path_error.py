"""The path integrator against exact integration of the same input, decoded from its activity only."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from hybridmap import geometry
from hybridmap.config.mapping import NeuralConfig
from hybridmap.geometry import Array
from hybridmap.neural import PathIntegrator
from hybridmap.neural.rings import HeadDirectionRing, cells_needed
from hybridmap.verification.drives import ExactDrive, corridor, wander

_NODE_M = 0.5
VON_MISES = 5.0
"""Concentration of the sharper tuning that is shown: 61 degrees wide at half height, mean vector length 0.89, as many real
cells of the postsubiculum."""


@dataclass(frozen=True, slots=True)
class PathErrors:
    """Errors of the neural path integrator along a drive, every half metre.

    Attributes:
        distance_m: (S,) distance driven.
        module: (S, M) phase error of each of the M grid modules, as a share of its spacing.
        position_m: (S,) distance of the position decoded from all modules together from the true one.
        heading_rad: (S,) error of the decoded heading, never negative.
    """

    distance_m: Array
    module: Array
    position_m: Array
    heading_rad: Array


def path_errors(
    config: NeuralConfig,
    drive: ExactDrive,
    rng: np.random.Generator | None = None,
    integrator: PathIntegrator | None = None,
    after_step: Callable[[int], None] = lambda _step: None,
) -> PathErrors:
    """Drive a new path integrator and compare it with the exact poses.

    Args:
        config: settings of the cells.
        drive: motion and exact poses.
        rng: random generator for `config.neuron_noise`; None: one with a fixed seed.
        integrator: the path integrator, at the origin; None: one is made from `config` and `rng`.
        after_step: called with the number of each step that has been taken, from 0.
    """
    integrator = integrator or PathIntegrator(config, rng)
    dt, next_m = 1.0 / drive.hz, 0.0
    rows: list[tuple[float, Array, float, float]] = []
    last = len(drive.deltas) - 1
    for k, delta in enumerate(drive.deltas):
        integrator.step(delta, dt)
        after_step(k)
        if drive.distance_m[k] < next_m and k != last:
            continue
        next_m += _NODE_M
        pose, exact = integrator.pose, drive.poses[k]
        away = float(np.hypot(*(pose[:2] - exact[:2])))
        turned = abs(float(geometry.wrap_angle(pose[2] - exact[2])))
        rows.append((float(drive.distance_m[k]), integrator.module_errors(exact), away, turned))
    distance, module, position, heading = zip(*rows, strict=True)
    return PathErrors(np.array(distance), np.array(module), np.array(position), np.array(heading))


def room_errors(seed: np.random.SeedSequence, settings: dict[str, object], distance_m: float, hz: float) -> PathErrors:
    """Errors of the path integrator on a random drive through the 10 x 3 m room.

    Args:
        seed: seed of the drive.
        settings: settings of the cells (`NeuralConfig`).
        distance_m: length of the drive.
        hz: steps per second.
    """
    drive = wander(np.random.default_rng(seed), distance_m, hz)
    return path_errors(NeuralConfig.model_validate(settings), drive)


def corridor_errors(seed: np.random.SeedSequence, settings: dict[str, object]) -> PathErrors:
    """Errors of the path integrator with these settings (`NeuralConfig`) on a drive down the 16.8 m corridor, 30 Hz."""
    return path_errors(NeuralConfig.model_validate(settings), corridor(np.random.default_rng(seed), 30.0))


def noise_errors(
    drive_seed: np.random.SeedSequence,
    noise_seed: np.random.SeedSequence,
    settings: dict[str, object],
    noise: float,
    distance_m: float,
) -> PathErrors:
    """Errors of the path integrator with multiplicative noise on the rates of all cells, on a drive through the room, 30 Hz.

    Args:
        drive_seed, noise_seed: seeds of the drive and of the noise.
        settings: settings of the cells (`NeuralConfig`).
        noise: standard deviation of the noise, as a share of the rate.
        distance_m: length of the drive.
    """
    drive = wander(np.random.default_rng(drive_seed), distance_m, 30.0)
    config = NeuralConfig.model_validate(settings | {"neuron_noise": noise})
    return path_errors(config, drive, np.random.default_rng(noise_seed))


@dataclass(frozen=True, slots=True)
class HeadDirectionResult:
    """The error of the head-direction ring after many full turns, and its firing rates.

    Attributes:
        error_rad: `float64`, `float32` (precision of the paper's ring) or `von_mises` (a ring of that tuning) -> error of the
            decoded heading after the last turn.
        curves: `cosine` or `von_mises` -> (360,) firing rate of one cell at headings of 0 to 359 degrees.
        preferred_rad: (m,) preferred directions of the cells.
        tuning: (6, 360) firing rates of six cells at headings of 0 to 359 degrees.
        turn_rates_rad_s: (R,) turn rates shown in the figure.
        rates: (R, m) firing rates of all cells at those turn rates.
    """

    error_rad: dict[str, float]
    curves: dict[str, Array]
    preferred_rad: Array
    tuning: Array
    turn_rates_rad_s: Array
    rates: Array


def head_direction(seed: np.random.SeedSequence, settings: dict[str, object], steps: int) -> HeadDirectionResult:
    """Turn rings of head-direction cells by random turns, in float32, in float64 and with von Mises's tuning.

    Their headings are compared with the sum of the turns. With fewer cells than von Mises's tuning needs, that ring has as
    many as it needs.

    Args:
        seed: seed of the turns.
        settings: settings of the cells (`NeuralConfig`).
        steps: number of turns.
    """
    turns = np.random.default_rng(seed).normal(0.002, 0.02, steps)
    cells = NeuralConfig.model_validate(settings).head_direction_cells
    sharp = max(cells, cells_needed(VON_MISES)), np.float64, VON_MISES
    rings = {
        "float64": HeadDirectionRing(cells),
        "float32": HeadDirectionRing(cells, np.float32),
        "von_mises": HeadDirectionRing(*sharp),
    }
    errors = {}
    for name, ring in rings.items():
        for turn in turns:
            ring.turn(float(turn))
        errors[name] = abs(float(geometry.wrap_angle(ring.heading_rad - turns.sum())))
    degrees = np.radians(np.arange(360))
    curves = {
        name: np.array([ring.rates_at(heading)[0] for heading in degrees])
        for name, ring in (("cosine", rings["float64"]), ("von_mises", rings["von_mises"]))
    }
    ring = HeadDirectionRing(cells)
    tuning = []
    for _ in range(360):
        tuning.append(ring.activity[:: len(ring.activity) // 6][:6].copy())
        ring.turn(np.radians(1.0))
    turn_rates = np.array([0.0, 0.5, 1.0, 2.0])
    rates = np.array([ring.rates(float(rate)) for rate in turn_rates])
    return HeadDirectionResult(errors, curves, ring.preferred_rad, np.array(tuning).T, turn_rates, rates)


@dataclass(frozen=True, slots=True)
class StandstillResult:
    """How far the path integrator's state moves while the robot stands still.

    Attributes:
        pose_change: largest change of a coordinate of the pose over the steps without motion, m or rad.
        ungated: rectifier -> how far a grid sheet drifted when its dynamics kept running, as a share of the spacing.
    """

    pose_change: float
    ungated: dict[str, float]


def standstill(seed: np.random.SeedSequence, settings: dict[str, object], steps: int) -> StandstillResult:
    """Drive two metres, then stand still: once with the path integrator as it is, once with its dynamics kept running.

    Args:
        seed: seed of the drive.
        settings: settings of the cells (`NeuralConfig`); both rectifiers are tried.
        steps: steps at standstill; a twentieth of them with the dynamics kept running.
    """
    drive = wander(np.random.default_rng(seed), 2.0, 30.0)
    ungated, change = {}, 0.0
    for rectifier in ("relu", "softplus"):
        integrator = PathIntegrator(NeuralConfig.model_validate(settings | {"rectifier": rectifier}))
        for delta in drive.deltas:
            integrator.step(delta, 1.0 / drive.hz)
        before = integrator.pose
        for _ in range(steps):
            integrator.step((0.0, 0.0, 0.0), 1.0 / drive.hz)
        change = max(change, float(np.abs(integrator.pose - before).max()))
        for _ in range(steps // 20):
            motion = integrator.bands.step(np.zeros(2))
            integrator.grid.step(motion.advance, motion.phasors)
        ungated[rectifier] = float(integrator.module_errors(drive.poses[-1]).max())
    return StandstillResult(change, ungated)
