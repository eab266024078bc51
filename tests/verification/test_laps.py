"""Closures bound the error of cells that are noisy, drift or are partly lost; without them it grows."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest

from hybridmap import geometry
from hybridmap.config.mapping import NeuralConfig
from hybridmap.neural import PathIntegrator
from hybridmap.verification import laps
from hybridmap.verification.drives import ExactDrive, office_laps
from hybridmap.verification.laps import lap_errors

HZ, LAP_M, LAPS = 15.0, 24.0, 4
LOST = 0.05
DRIFT = {"gain": 1.02, "turn_gain": 1.03}


def rounds() -> ExactDrive:
    """Four laps of a ring of 24 m that wander by a decimetre."""
    angle = np.linspace(0.0, 2.0 * np.pi * LAPS, round(LAP_M * LAPS / 0.7 * HZ))
    radius = LAP_M / (2.0 * np.pi) + 0.05 * np.sin(2.37 * angle)
    path = radius[:, None] * np.stack([np.cos(angle), np.sin(angle)], axis=1)
    ways = np.gradient(path, axis=0)
    poses = np.column_stack([path, np.arctan2(ways[:, 1], ways[:, 0])])
    deltas = geometry.between(poses[:-1], poses[1:])
    return ExactDrive(deltas, geometry.between(poses[0], poses[1:]), np.cumsum(np.hypot(*deltas[:, :2].T)), HZ)


class Lossy(PathIntegrator):
    """Cells of which some, always the same, are silent: of the head-direction ring, the sheets and the attractor."""

    def __init__(self, *args):
        super().__init__(*args)
        rng = np.random.default_rng(5)
        self._lossy: list[Any] = [self.head_direction, self.grid, self.attractor]
        self._alive = [rng.uniform(size=population.activity.shape) >= LOST for population in self._lossy]

    def step(self, delta_robot, dt_s):
        super().step(delta_robot, dt_s)
        for population, alive in zip(self._lossy, self._alive, strict=True):
            population.activity = population.activity * alive


def errors(closures, **settings):
    return lap_errors(
        NeuralConfig.model_validate(settings), rounds(), LAP_M, np.random.default_rng(3), closures=closures
    ).of_laps()


def test_quiet_cells_need_no_closure():
    assert errors(False).max() < 2e-3


@pytest.mark.parametrize(("noise", "bound_m"), [(0.01, 0.02), (0.05, 0.06), (0.1, 0.12)])
def test_closures_bound_the_error_of_noisy_cells(noise, bound_m):
    with_closures, alone = (errors(closures, neuron_noise=noise) for closures in (True, False))
    assert with_closures.max() < bound_m
    assert alone.max() > 5.0 * with_closures.max()


def test_closures_bound_the_drift_of_wrong_gains():
    with_closures, alone = (errors(closures, **DRIFT) for closures in (True, False))
    assert with_closures.max() < 0.02
    assert 0.5 < alone[0] < alone[1] - 0.5 < alone[2] - 1.0


def test_closures_bound_the_error_of_lost_cells(monkeypatch):
    monkeypatch.setattr(laps, "PathIntegrator", Lossy)
    with_closures, alone = errors(True), errors(False)
    assert with_closures.max() < 0.06
    assert alone.max() > 10.0 * with_closures.max()


def test_a_step_asks_no_more_place_cells_lap_after_lap():
    drive = rounds()
    found = lap_errors(NeuralConfig(neuron_noise=0.05), drive, LAP_M, np.random.default_rng(3))
    second, third, last = ((found.distance_m // LAP_M) == lap for lap in (1, 2, 3))
    assert found.asked[third].mean() < 1.6 * found.asked[second].mean()  # fields beside the first lap's
    assert found.asked[last].mean() < 1.2 * found.asked[third].mean()


def test_laps_of_the_office_come_back_to_where_they_began():
    drive, lap_m = office_laps(150.0)
    assert drive.distance_m[-1] == pytest.approx(150.0, abs=0.05)
    assert 60.0 < lap_m < 75.0
    again = drive.poses[np.abs(drive.distance_m - lap_m) < 1.0]
    assert np.hypot(*again[:, :2].T).min() < 0.3
    pose = np.zeros(3)
    for delta, exact in zip(drive.deltas[:300], drive.poses, strict=False):
        pose = geometry.compose(pose, delta)
        assert geometry.between(exact, pose) == pytest.approx(np.zeros(3), abs=1e-9)
