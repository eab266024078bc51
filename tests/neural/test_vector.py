"""The grid code as a vector: displacements from stored phases alone."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from hybridmap.config.mapping import NeuralConfig
from hybridmap.errors import ConfigError
from hybridmap.geometry import compose, wrap_angle
from hybridmap.neural import PathIntegrator
from hybridmap.neural.path_integrator import Reanchoring
from hybridmap.neural.vector import GridVectors
from tests.neural.neural_drives import arc

CELLS = NeuralConfig()
VECTORS = GridVectors(CELLS)
WAVES = PathIntegrator(CELLS).bands.wave_vectors[:, [0, 2]]


@dataclass
class Places:
    """Nodes of a drive: their phases (N, M, 2), true poses (N, 3) and the poses (N, 3) that the cells showed."""

    phases: np.ndarray
    true: np.ndarray
    shown: np.ndarray

    def errors(self, pairs: int = 250) -> np.ndarray:
        """Rows: distance, error against the truth, error against what the cells showed (m), whether the modules agreed."""
        rows, rng = [], np.random.default_rng(0)
        for first, last in rng.integers(0, len(self.true), (pairs, 2)):
            vector = VECTORS.between(self.phases[first], self.phases[last])
            ways = [poses[last, :2] - poses[first, :2] for poses in (self.true, self.shown)]
            rows.append([np.hypot(*ways[0]), *(np.hypot(*(vector.displacement_m - way)) for way in ways), float(vector.agreed)])
        return np.array(rows)


def driven(noise: float, distance_m: float = 80.0) -> Places:
    """Wander 80 m about a hall of 18 m, a node every half metre."""
    integrator = PathIntegrator(NeuralConfig(neuron_noise=noise), np.random.default_rng(1))
    rng, pose, omega, travel_m = np.random.default_rng(0), np.zeros(3), 0.0, 0.0
    found: list[tuple[np.ndarray, ...]] = []
    while travel_m < distance_m:
        omega += rng.normal(0.0, 0.15) - 0.05 * omega
        if np.hypot(*pose[:2]) > 9.0:
            omega = float(2.0 * np.clip(wrap_angle(np.arctan2(-pose[1], -pose[0]) - pose[2]), -1.0, 1.0))
        delta = arc(0.7, omega, 1 / 15)
        integrator.step(delta, 1 / 15)
        pose = compose(pose, delta)
        travel_m += 0.7 / 15
        if travel_m >= 0.5 * len(found):
            found.append((integrator.grid.phases(), pose, integrator.pose))
    return Places(*(np.array(part) for part in zip(*found, strict=True)))


@pytest.fixture(scope="module")
def quiet():
    return driven(0.0)


@pytest.fixture(scope="module")
def noisy():
    return driven(0.05)


def test_without_noise_every_vector_is_exact_and_none_is_flagged(quiet):
    distance, error, _, agreed = quiet.errors().T
    assert distance.max() > 14.0
    assert error.max() < 1e-3
    assert agreed.all()


def test_with_noise_a_vector_is_that_between_the_poses_shown_with_their_drift(noisy):
    distance, error, against_shown, agreed = noisy.errors().T
    assert distance.max() > 14.0
    assert against_shown.max() < 1e-3
    assert agreed.all()
    near, far = (float(np.median(error[(distance >= low) & (distance < high)])) for low, high in ((0, 5), (10, 20)))
    assert 0.2 < near < far


def test_closures_take_the_drift_out_of_the_vectors():
    integrator = PathIntegrator(NeuralConfig(neuron_noise=0.05), np.random.default_rng(2))
    cells, phases = Reanchoring(integrator, 1.0), []
    for lap in range(2):
        for side in range(4):
            phases.append(integrator.grid.phases())
            if lap == 0:
                cells.remember(side)
            else:
                cells.recalibrate(side, np.array([0.1, 0.0, 0.0]))
                phases[-1] = integrator.grid.phases()
            for _ in range(80):
                integrator.step((0.05, 0.0, 0.25 * np.pi / 80 * 2.0), 0.1)
    for side in range(4):
        back = VECTORS.between(phases[side], phases[4 + side])
        assert back.agreed
        assert np.hypot(*back.displacement_m) == pytest.approx(0.1, abs=1e-3)


def at(place: np.ndarray) -> np.ndarray:
    """Grid phases (M, 2), cycles, at a place (2,), m."""
    return np.asarray((WAVES @ place) % 1.0)


PLACE = st.tuples(st.floats(-10.0, 10.0), st.floats(-10.0, 10.0)).map(np.array)


@settings(max_examples=25, deadline=None)
@given(first=PLACE, last=PLACE, seed=st.integers(0, 1000))
def test_noise_of_the_phases_costs_millimetres_and_the_way_back_is_the_opposite(first, last, seed):
    noise = np.random.default_rng(seed).normal(0.0, 0.02, (2, *WAVES.shape[:2]))
    here, away = at(first) + noise[0], at(last) + noise[1]
    there, back = (VECTORS.between(*codes, 29.0) for codes in ((here, away), (away, here)))
    assert there.agreed
    assert np.hypot(*(there.displacement_m - (last - first))) < 0.02
    assert back.displacement_m == pytest.approx(-there.displacement_m, abs=1e-9)
    assert back.misfit_cycles == pytest.approx(there.misfit_cycles)


def test_phases_of_no_place_a_lost_module_and_too_long_ways_are_flagged():
    rng, here = np.random.default_rng(5), at(np.zeros(2))
    assert not any(VECTORS.between(here, rng.uniform(size=here.shape)).agreed for _ in range(100))
    lost = at(np.array([3.0, 4.0]))
    lost[2] += (0.4, 0.3)
    assert not VECTORS.between(here, lost).agreed
    far = at(np.array([16.0, 20.0]))
    assert not VECTORS.between(here, far).agreed
    farther = VECTORS.between(here, far, reach_m=26.0)
    assert farther.agreed
    assert farther.displacement_m == pytest.approx([16.0, 20.0], abs=1e-9)


def test_the_square_metric_has_vectors_too():
    config = NeuralConfig(metric="square")
    integrator = PathIntegrator(config)
    before = integrator.grid.phases()
    for _ in range(50):
        integrator.step((0.1, 0.02, 0.0), 0.1)
    assert GridVectors(config).between(before, integrator.grid.phases()).displacement_m == pytest.approx([5.0, 1.0], abs=1e-3)


@pytest.mark.parametrize(
    ("phases", "reach_m"), [(np.zeros((7, 2)), 20.0), (np.full((8, 2), np.nan), 20.0), (np.zeros((8, 2)), 0.0)]
)
def test_what_is_no_code_of_these_cells_is_refused(phases, reach_m):
    with pytest.raises(ConfigError, match="grid code: expected"):
        VECTORS.between(np.zeros((8, 2)), phases, reach_m)
