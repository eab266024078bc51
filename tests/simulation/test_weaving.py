"""Laps that wander from side to side, each at other places."""

from __future__ import annotations

import numpy as np
import pytest

from hybridmap.config.inputs import CameraConfig, SimulationConfig
from hybridmap.simulation import SimulatedStream
from hybridmap.simulation.motion import weaving

LEG = np.array([[0.0, 0.0], [40.0, 0.0]])


def length_m(path):
    return np.hypot(*np.diff(path, axis=0).T).sum()


def test_a_leg_keeps_its_ends_and_hardly_grows():
    (woven,) = weaving([LEG], 0.12)
    assert woven[[0, -1]] == pytest.approx(LEG)
    assert np.abs(woven[:, 1]).max() == pytest.approx(0.12, abs=0.005)
    assert length_m(woven) == pytest.approx(40.0, rel=0.02)


def test_it_goes_to_both_sides_and_each_lap_elsewhere():
    first, second = weaving([LEG, LEG], 0.12)
    assert first[:, 1].min() < -0.1
    apart = np.abs(first[:, 1] - second[:, 1])
    assert 0.02 < np.median(apart) < 0.24
    assert np.abs(first[:, 0] - second[:, 0]).max() < 1e-6


def test_without_amplitude_the_path_is_the_path():
    (woven,) = weaving([LEG], 0.0)
    assert woven[:, 1] == pytest.approx(0.0)


def test_a_leg_of_a_few_centimetres_is_taken():
    (woven,) = weaving([np.array([[0.0, 0.0], [0.01, 0.0]])], 0.2)
    assert woven[[0, -1]] == pytest.approx(np.array([[0.0, 0.0], [0.01, 0.0]]))


def test_laps_of_a_world_no_longer_retrace_each_other():
    def apart_m(weave_m):
        camera = CameraConfig(width_px=32, height_px=24, rate_hz=0.5)
        truth = SimulatedStream(SimulationConfig(world="lab", weave_m=weave_m, camera=camera), 0).groundtruth.poses
        travel = np.concatenate([[0.0], np.cumsum(np.hypot(*np.diff(truth[:, :2], axis=0).T))])
        late, early = truth[travel > 0.6 * travel[-1]][::20], truth[travel < 0.4 * travel[-1]]
        return np.median([np.hypot(*(early[:, :2] - pose[:2]).T).min() for pose in late])

    assert apart_m(0.0) < 0.05
    assert apart_m(0.12) > 0.05
