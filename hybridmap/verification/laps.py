"""Recalibration of noisy cells: laps of a building with and without closures, and where in the map the cells show the robot."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from hybridmap.config.mapping import NeuralConfig
from hybridmap.geometry import Array, between, compose, wrap_angle
from hybridmap.neural import PathIntegrator
from hybridmap.neural.path_integrator import Reanchoring
from hybridmap.verification.drives import ExactDrive, office_laps

NODE_M = 0.25
"""A node every so many metres of the first lap, as the configuration `bionic` makes them."""
CLOSURE_M = 0.75
"""From the second lap on, a closure every so many metres: as often as `bionic` closes loops on its second lap of the office."""
LAPS_NOISE = 0.05
"""Neuron noise of the laps, as a share of every rate."""
BESIDE = 3
"""So many nodes before and after one are beside it."""
_METRES_A_RADIAN = 1.0
"""Weight of the heading beside the place, when the node is looked for that the cells show."""


@dataclass(frozen=True, slots=True)
class LapErrors:
    """Where the cells showed the robot in the map, from the second lap on, every 0.25 m.

    Attributes:
        distance_m: (S,) distance driven.
        error_m: (S,) distance of the place that the cells showed in the map from the true one, m.
        lap_m: length of a lap, m.
        asked: (S,) number of place cells that were asked there.
    """

    distance_m: Array
    error_m: Array
    lap_m: float
    asked: NDArray[np.int64]

    def of_laps(self) -> Array:
        """(L,) largest error, m, in each lap from the second on."""
        lap = ((self.distance_m - self.lap_m) // self.lap_m).astype(int)
        return np.array([self.error_m[lap == number].max() for number in range(lap.max() + 1)])


def office_errors(seed: np.random.SeedSequence, settings: dict[str, object], distance_m: float, closures: bool) -> LapErrors:
    """Errors on laps of the simulated office with `LAPS_NOISE`.

    Args:
        seed: seed of the noise.
        settings: settings of the cells (`NeuralConfig`).
        distance_m: length of the drive; more than a lap of 67 m.
        closures: whether there are any.
    """
    drive, lap_m = office_laps(distance_m)
    config = NeuralConfig.model_validate(settings | {"neuron_noise": LAPS_NOISE})
    return lap_errors(config, drive, lap_m, np.random.default_rng(seed), closures=closures)


def lap_errors(
    config: NeuralConfig, drive: ExactDrive, lap_m: float, rng: np.random.Generator, *, closures: bool = True
) -> LapErrors:
    """Drive laps with a new path integrator. Nodes are made in the first one, with their true poses in the map.

    The cells say where in the map the robot is: at that node, of those beside the one where it was, whose pose of the cells is
    nearest to the present one, and from there by the difference of the two. At a closure the cells are re-anchored at the truly
    nearest node, by the true pose seen from there; without closures the robot stays beside the last node.

    Args:
        config: settings of the cells.
        drive: motion and exact poses.
        lap_m: length of a lap, m.
        rng: random generator of the neuron noise.
        closures: whether there are any.
    """
    integrator = PathIntegrator(config, rng)
    cells = Reanchoring(integrator, 1.0)
    nodes: list[Array] = []
    rows, at, next_m, closed_m = [], 0, 0.0, lap_m
    for delta, true, driven_m in zip(drive.deltas, drive.poses, drive.distance_m, strict=True):
        integrator.step(delta, 1.0 / drive.hz)
        if driven_m < next_m:
            continue
        next_m += NODE_M
        if driven_m < lap_m:
            at = len(nodes)
            cells.remember(at)
            nodes.append(true)
            continue
        pose, of_cells = integrator.pose, cells.poses_of_nodes
        beside = np.arange(max(at - BESIDE, 0), min(at + BESIDE + 1, len(nodes)))
        at = int(beside[_nearest(of_cells[beside], pose)])
        shown = compose(nodes[at], between(of_cells[at], pose))
        rows.append((driven_m, np.hypot(*(shown - true)[:2]), len(integrator.place.around(pose[:2]))))
        if closures and driven_m >= closed_m:
            closed_m += CLOSURE_M
            at = _nearest(np.array(nodes), true)
            cells.recalibrate(at, between(nodes[at], true))
    distance, error, asked = zip(*rows, strict=True)
    return LapErrors(np.array(distance), np.array(error), lap_m, np.array(asked))


def _nearest(poses: Array, pose: Array) -> int:
    away_m = np.hypot(*(poses - pose)[:, :2].T)
    return int(np.argmin(away_m + _METRES_A_RADIAN * np.abs(wrap_angle(poses[:, 2] - pose[2]))))
