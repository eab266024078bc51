"""A robot that is carried away: the truth jumps, the wheels and the views know nothing of it."""

from __future__ import annotations

import numpy as np
import pytest

from hybridmap.config.inputs import CameraConfig, SimulationConfig
from hybridmap.errors import ConfigError
from hybridmap.geometry import between, compose, wrap_angle
from hybridmap.simulation import SimulatedStream
from hybridmap.simulation.motion import carry
from hybridmap.streams.rgbd import RgbdFrame
from tests.simulation.test_stream import PERFECT_WHEELS, fingerprint


def stream(world="lab", **changes):
    camera = CameraConfig(width_px=32, height_px=24, rate_hz=0.5)
    return SimulatedStream(SimulationConfig(world=world, carried_m=20.0, camera=camera, **changes), 3)


def test_it_is_put_down_in_a_known_place_as_far_away_as_it_was_said():
    carried = stream("office")
    truth, carry = carried.groundtruth.poses, carried.carry
    assert carry.distance_m == pytest.approx(20.0, abs=0.5)
    assert np.hypot(*(truth[carry.last] - truth[carry.first])[:2]) == pytest.approx(carry.distance_m)
    before = truth[: carry.first]
    near = np.hypot(*(before[:, :2] - truth[carry.last, :2]).T) < 0.5
    assert np.any(np.abs(wrap_angle(before[near, 2] - truth[carry.last, 2])) < 0.4)
    travel = np.hypot(*np.diff(truth[carry.last :, :2], axis=0).T).sum()
    assert travel > 10.0


def test_the_wheels_stand_still_and_nothing_is_seen_on_the_way():
    carried = stream(wheels=PERFECT_WHEELS)
    truth, odometry, carry = carried.groundtruth, carried.odometry, carried.carry
    assert len(truth) == len(odometry)
    assert np.allclose(odometry.poses[carry.first : carry.last], odometry.poses[carry.first])
    after = compose(truth.poses[carry.last], between(odometry.poses[carry.last], odometry.poses[carry.last :]))
    assert np.allclose(after[:, :2], truth.poses[carry.last :, :2], atol=2e-3)
    up, down = truth.stamps_ns[carry.first], truth.stamps_ns[carry.last]
    seen = np.array([sample.stamp_ns for sample in carried if isinstance(sample, RgbdFrame)])
    assert not np.any((seen > up) & (seen < down))
    assert np.any(seen > down)
    assert carried.expected_observations == len(seen)


def test_where_the_world_is_smaller_it_is_carried_as_far_as_there_is_a_known_place():
    carried = stream("lab")
    assert 5.0 < carried.carry.distance_m < 10.0
    next(iter(carried))
    assert any("7.3 m" in remark for remark in carried.report.remarks)
    enough = stream("office")
    next(iter(enough))
    assert enough.report.remarks == []


@pytest.mark.parametrize("world", ["lab", "office"])
@pytest.mark.parametrize("distance_m", [0.3, 0.5, 1.0, 1.5, 2.0, 3.0])
def test_it_can_be_carried_any_distance(world, distance_m):
    camera = CameraConfig(width_px=32, height_px=24, rate_hz=0.5)
    carried = SimulatedStream(SimulationConfig(world=world, carried_m=distance_m, camera=camera), 3)
    carry = carried.carry
    assert carry is not None
    assert carry.distance_m == pytest.approx(distance_m, abs=0.02)
    last = carried.groundtruth.poses[carry.last]
    before = carried.groundtruth.poses[: carry.first // 2]
    near = np.hypot(*(before[:, :2] - last[:2]).T) < 0.5
    assert np.any(np.abs(wrap_angle(before[near, 2] - last[2])) < 0.4)


def test_until_it_is_picked_up_it_is_the_same_drive():
    whole, carried = SimulatedStream(SimulationConfig(world="lab"), 3), stream("lab")
    first = carried.carry.first
    assert np.array_equal(whole.groundtruth.poses[:first], carried.groundtruth.poses[:first])
    assert SimulatedStream(SimulationConfig(world="lab"), 3).carry is None


def test_the_same_seed_gives_the_same_bytes():
    def end(of):
        return [sample for sample in of if sample.stamp_ns > of.groundtruth.stamps_ns[-60]]

    assert fingerprint(end(stream("lab"))) == fingerprint(end(stream("lab")))


def test_a_drive_that_is_too_short_or_never_comes_back_is_refused():
    with pytest.raises(ConfigError, match=r"simulation\.carried_m.*longer"):
        stream("lab", duration_s=20.0)
    straight = np.column_stack([np.linspace(0, 40, 2400), np.zeros((2400, 2))])
    with pytest.raises(ConfigError, match="no place twice"):
        carry(straight, 20.0, 1 / 30)
