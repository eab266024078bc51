"""The simulated campus: its round and wheels, its seeds, and what its laser sees of walls, hedges and people."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from hybridmap.config import Config
from hybridmap.config.inputs import LaserScannerConfig, SimulationConfig
from hybridmap.errors import ConfigError
from hybridmap.geometry import between
from hybridmap.simulation import SimulatedStream
from hybridmap.simulation.scene import Scene
from hybridmap.simulation.sensor_models import LaserModel
from hybridmap.simulation.surfaces import Walker, World, box
from hybridmap.simulation.worlds import build_world
from hybridmap.streams.laser import LaserScan
from tests.simulation.test_stream import PERFECT_WHEELS, fingerprint

LASER = LaserScannerConfig(beams=361, range_max_m=80.0)


def campus(seed: int, **changes) -> SimulatedStream:
    return SimulatedStream(
        Config.load("campus", {f"simulation.{key}": value for key, value in changes.items()}).simulation, seed
    )


@pytest.mark.parametrize("seed", range(10))
def test_a_round_of_half_a_kilometre_with_good_wheels_that_steer(seed):
    stream = campus(seed)
    truth, odometry = stream.groundtruth.poses, stream.odometry.poses
    steps = between(truth[:-1], truth[1:])
    assert 480.0 < np.hypot(*steps[:, :2].T).sum() < 520.0
    again = np.hypot(*(truth[: len(truth) // 2, :2] - truth[-1, :2]).T)
    assert again.min() < 0.3
    moving = steps[:, 0] > 0.01
    assert (np.abs(steps[moving, 2]) < steps[moving, 0] / 3.0).all()  # a curve of 3 m at least
    assert (np.abs(steps[~moving, 2]) < 0.01).all()
    off = between(between(truth[0], truth[-1]), between(odometry[0], odometry[-1]))
    assert 0.05 < np.hypot(*off[:2]) < 8.0
    assert abs(np.rad2deg(off[2])) < 7.0


def test_another_seed_is_another_campus():
    one, other = (build_world("campus", seed) for seed in (1, 2))
    corners = [[facet.corner[:2].tolist() for facet in world.surfaces] for world in (one, other, build_world("campus", 1))]
    assert corners[0] == corners[2]
    assert not {*map(tuple, corners[0])} & {*map(tuple, corners[1])}
    short = [list(campus(3, duration_s=2.0)) for _ in range(2)]
    assert fingerprint(short[0]) == fingerprint(short[1])


def test_most_returns_lie_farther_than_indoors():
    scans = [s.ranges_m for s in campus(0, **{"laser.rate_hz": 0.1}) if isinstance(s, LaserScan)]
    assert np.nanmax(scans) > 75.0
    assert np.nanmedian(scans) > 15.0
    assert 0.3 < np.isfinite(scans).mean() < 0.9


def test_there_is_nothing_for_a_camera():
    with pytest.raises(ConfigError, match=r"simulation\.sensors.*campus.*laser"):
        SimulatedStream(SimulationConfig(world="campus"), 0)


def ahead(world: World, time_s: float = 0.0, seed: int = 0) -> float:
    """Range of the beam straight ahead at the origin, without noise."""
    model = LaserModel(Scene(world), LASER, noise=0.0)
    return float(model.scan(0, time_s, np.zeros(3), np.random.default_rng(seed)).ranges_m[180])


def test_a_beam_meets_people_where_they_are_and_leaves_at_some_depth():
    wall = box((20.0, 0.0), (1.0, 30.0, 3.0), lambda rng, shape, px_per_m: np.zeros((*shape, 3), np.uint8))
    world = World("wall", tuple(wall), ())
    assert ahead(world) == pytest.approx(19.35)
    person = Walker(np.array([10.0, 0.0]), np.array([10.0, 6.0]), 1.0, 0.25, 0.0)
    walked = replace(world, walkers=(person,))
    assert [ahead(walked, time_s) for time_s in (0.0, 3.0, 12.0)] == pytest.approx([9.6, 19.35, 9.6])
    hedge = replace(world, surfaces=tuple(replace(f, foliage_m=0.5) for f in wall))
    seen = np.array([ahead(hedge, seed=seed) for seed in range(20)])
    assert seen.min() >= 19.35 - 1e-4
    assert seen.max() < 19.85 + 1e-4
    assert np.ptp(seen) > 0.2


def test_perfect_wheels_feel_the_drive_itself():
    stream = campus(4, duration_s=60.0, wheels=PERFECT_WHEELS.model_dump())
    truth, odometry = stream.groundtruth.poses, stream.odometry.poses
    np.testing.assert_allclose(between(truth[0], truth[-1]), between(odometry[0], odometry[-1]), atol=2e-2)
