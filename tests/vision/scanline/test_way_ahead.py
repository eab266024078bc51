"""The way ahead by depth, and the gain of the wheels by it."""

from __future__ import annotations

import numpy as np
import pytest

from hybridmap.vision.scanline.way_ahead import GainMeter, way_ahead
from tests.narrowing import known

BEARINGS = np.deg2rad(np.linspace(30.0, -30.0, 121))
REACH_M = 4.5


def way(older, newer, yaw=0.0):
    return way_ahead(np.asarray(older), np.asarray(newer), BEARINGS, yaw, REACH_M)


def wall(distance_m):
    return np.full(121, distance_m)


def test_a_wall_ahead_tells_how_far_the_robot_came():
    assert way(wall(3.0), wall(2.6)) == pytest.approx(0.4)
    assert way(wall(2.6), wall(3.0)) == pytest.approx(-0.4)


def test_columns_are_compared_by_direction_where_the_robot_turned():
    """A slanted wall: only the same directions tell."""
    slanted = 2.5 + 0.8 * BEARINGS
    turned = np.deg2rad(10.0)
    ahead_of_older = np.interp(-(BEARINGS - turned), -BEARINGS, slanted) - 0.3
    newer = ahead_of_older * np.cos(BEARINGS) / np.cos(BEARINGS - turned)
    assert way(slanted, newer, turned) == pytest.approx(0.3, abs=0.01)
    assert way(slanted, newer, 0.0) != pytest.approx(0.3, abs=0.1)


@pytest.mark.parametrize("turned_deg", [-15.0, 5.0, 10.0, 20.0])
def test_a_robot_that_only_turned_came_no_way(turned_deg):
    turned = np.deg2rad(turned_deg)
    newer = 3.0 * np.cos(BEARINGS) / np.cos(BEARINGS - turned)
    assert way(wall(3.0), newer, turned) == pytest.approx(0.0, abs=0.005)


def test_what_does_not_tell_gives_nothing():
    nothing, rng = np.full(121, np.nan), np.random.default_rng(0)
    assert way(nothing, wall(2.0)) is None
    assert way(wall(2.0), nothing) is None
    assert way(wall(5.0), wall(4.0)) is None  # beyond reach
    assert way(wall(0.9), wall(0.5)) is None  # too near
    assert way(wall(3.0) + rng.normal(scale=0.3, size=121), wall(2.6)) is None  # several depths
    hidden = np.where(np.abs(BEARINGS) < np.deg2rad(3.0), np.nan, 2.0)
    assert way(hidden, wall(1.6)) is None


def test_a_sensor_that_does_not_look_ahead_tells_nothing():
    assert way_ahead(wall(3.0), wall(2.6), BEARINGS + np.pi / 2, 0.0, REACH_M) is None


def test_the_gain_is_the_median_of_straight_steps_and_waits_for_enough():
    meter, rng = GainMeter(), np.random.default_rng(1)
    for k in range(40):
        assert (meter.gain is None) == (k < 10)
        meter.step(np.array([0.3, 0.0, 0.0]), 0.3 * 0.97 + rng.normal(scale=0.01))
        meter.step(np.array([0.3, 0.0, 0.1]), 0.6)  # a turn
        meter.step(np.array([0.05, 0.0, 0.0]), 0.5)  # too short
        meter.step(np.array([0.3, 0.0, 0.0]), None)
    gain = known(meter.gain)
    assert gain.steps == 40
    assert abs(gain.gain - 0.97) < 3.0 * gain.sigma < 0.05
    meter.rescale(0.97)
    assert known(meter.gain).gain == pytest.approx(gain.gain / 0.97)
