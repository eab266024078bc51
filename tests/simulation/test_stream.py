"""The simulated stream: the same bytes for a seed, order and stamps, what each world must be, the wheels' errors."""

from __future__ import annotations

from itertools import pairwise

import numpy as np
import pytest

from hybridmap.config.inputs import CameraConfig, LaserScannerConfig, SimulationConfig, WheelErrorConfig
from hybridmap.errors import ConfigError
from hybridmap.geometry import align, between, compose, wrap_angle
from hybridmap.simulation import SimulatedStream, motion, world_names
from hybridmap.simulation.motion import DriveLimits, drive, wheel_odometry
from hybridmap.simulation.worlds import build_world
from hybridmap.streams.base import SelfMotion
from hybridmap.streams.laser import LaserScan
from hybridmap.streams.rgbd import RgbdFrame

SMALL = CameraConfig(width_px=80, height_px=60)
PERFECT_WHEELS = WheelErrorConfig(scale_bias=0, turn_bias=0, heading_bias_deg_per_m=0, noise=0)


def fingerprint(samples) -> list[tuple]:
    out = []
    for sample in samples:
        fields = [np.asarray(getattr(sample, name)) for name in sample.__slots__]
        out.append((type(sample).__name__, *((field.dtype.str, field.shape, field.tobytes()) for field in fields)))
    return out


def short(seed: int = 5, **changes) -> SimulatedStream:
    settings: dict[str, object] = {"world": "corridor", "duration_s": 2.0, "sensors": "both", "camera": SMALL}
    return SimulatedStream(SimulationConfig.model_validate(settings | changes), seed)


def ate_m(odometry, truth) -> float:
    offset = compose(align(truth, odometry), odometry)[:, :2] - truth[:, :2]
    return float(np.sqrt(np.mean(np.sum(offset**2, axis=1))))


def test_same_seed_same_bytes_however_often_it_is_iterated():
    stream = short()
    first = fingerprint(stream)
    partly = iter(stream)
    next(partly)
    assert fingerprint(stream) == first
    assert fingerprint(short()) == first


def test_another_seed_changes_every_sensor_but_not_the_drive():
    one, other = short(seed=1), short(seed=2)
    np.testing.assert_array_equal(one.groundtruth.poses, other.groundtruth.poses)
    samples = list(zip(one, other, strict=True))
    for kind in (SelfMotion, RgbdFrame, LaserScan):
        last = [pair for pair in samples if isinstance(pair[0], kind)][-1]
        assert fingerprint([last[0]]) != fingerprint([last[1]])


def test_a_shorter_drive_is_the_beginning_of_the_longer_one():
    longer = fingerprint(short(duration_s=2.0))
    shorter = fingerprint(short(duration_s=1.0))
    assert longer[: len(shorter)] == shorter


def test_order_stamps_and_counts():
    stream = short()
    samples = list(stream)
    stamps = [sample.stamp_ns for sample in samples]
    assert stamps == sorted(stamps)
    assert all(isinstance(stamp, int) for stamp in stamps)
    for before, after in pairwise(samples):
        if before.stamp_ns == after.stamp_ns:
            assert not isinstance(after, SelfMotion)
    motions = [sample for sample in samples if isinstance(sample, SelfMotion)]
    assert [sample.stamp_ns for sample in motions] == stream.groundtruth.stamps_ns.tolist()
    assert len(samples) - len(motions) == stream.expected_observations == 2 * 11
    assert stream.report.counts == {"odometry": 61, "frames": 11, "scans": 11}


def test_sensors_that_were_not_asked_for_are_absent():
    laser = short(sensors="laser", laser=LaserScannerConfig(beams=360, field_of_view_deg=360))
    assert "camera" not in laser.rig.sensors
    assert {type(sample) for sample in laser} == {SelfMotion, LaserScan}
    steps = np.diff(laser.rig.sensors["laser"].bearings_rad)
    assert len(steps) == 359
    assert np.allclose(np.rad2deg(steps), 1.0)
    camera = short(sensors="rgbd")
    assert "laser" not in camera.rig.sensors
    assert {type(sample) for sample in camera} == {SelfMotion, RgbdFrame}


def test_an_unknown_world_names_those_that_there_are():
    with pytest.raises(ConfigError, match=r"atlantis.*lab, office, corridor, corridor-landmarks, campus"):
        short(world="atlantis")


@pytest.mark.parametrize(
    ("world", "travel_m", "extent_m"),
    [("lab", (35, 45), (10, 3)), ("office", (140, 160), (25, 14.4)), ("corridor", (50, 51), (19.2, 2.4))],
)
def test_drives_keep_to_their_world_and_length(world, travel_m, extent_m):
    stream = SimulatedStream(SimulationConfig(world=world), 0)
    poses = stream.groundtruth.poses
    travel = np.hypot(*np.diff(poses[:, :2], axis=0).T).sum()
    assert travel_m[0] < travel < travel_m[1]
    assert (poses[:, :2] > 0.3).all()
    assert (poses[:, :2] < np.array(extent_m) - 0.3).all()


@pytest.mark.parametrize("world", world_names())
def test_drives_come_back_to_old_places_with_the_same_heading(world):
    poses = SimulatedStream(SimulationConfig(world=world, sensors="laser"), 0).groundtruth.poses
    last = poses[-1]
    earlier = poses[: len(poses) // 2]
    near = np.hypot(*(earlier[:, :2] - last[:2]).T) < 0.3
    assert (np.abs(wrap_angle(earlier[near, 2] - last[2])) < 0.2).any()


@pytest.mark.parametrize("world", world_names())
def test_the_robot_never_touches_the_furniture(world):
    stream = SimulatedStream(SimulationConfig(world=world, sensors="laser"), 0)
    from hybridmap.simulation.scene import Caster

    caster = Caster(build_world(world).surfaces)
    angle = np.linspace(-np.pi, np.pi, 48, endpoint=False)
    around = np.column_stack([np.cos(angle), np.sin(angle), np.zeros(48)])
    for height_m in (0.1, 0.45, 0.8, 1.05):
        start = np.column_stack([stream.groundtruth.poses[::15, :2], np.full(len(stream.groundtruth.poses[::15]), height_m)])
        rays = np.concatenate(np.broadcast_arrays(start[:, None], around[None]), axis=-1).astype(np.float32)
        assert caster.cast(rays).length.min() > 0.28


def test_a_late_clock_moves_the_odometry_against_everything_else():
    on_time, late = short(), short(clock_offset_s=0.21)
    np.testing.assert_array_equal(on_time.groundtruth.stamps_ns, late.groundtruth.stamps_ns)
    np.testing.assert_array_equal(on_time.odometry.stamps_ns - late.odometry.stamps_ns, 210_000_000)
    np.testing.assert_array_equal(on_time.odometry.poses, late.odometry.poses)
    views = [[s for s in stream if not isinstance(s, SelfMotion)] for stream in (on_time, late)]
    assert fingerprint(views[0]) == fingerprint(views[1])
    stamps = [sample.stamp_ns for sample in late]
    assert stamps == sorted(stamps)


def test_the_drive_keeps_to_its_limits():
    legs = (np.array([[0.0, 0.0], [4.0, 0.0], [4.0, 3.0]]), np.array([[4.0, 3.0], [4.0, 0.0]]))
    limits = DriveLimits(speed_m_s=0.5, turn_rate_rad_s=0.8)
    dt = 1 / 30
    poses = drive(legs, limits, dt)
    steps = between(poses[:-1], poses[1:])
    speed, turn = steps[:, 0] / dt, steps[:, 2] / dt
    assert speed.max() < 0.5 + 1e-6
    assert np.abs(turn).max() < 0.8 + 1e-6
    assert np.abs(np.diff(turn)).max() / dt < 3.1
    assert np.abs(steps[:, 1]).max() < 1e-3  # no sideways motion
    np.testing.assert_allclose(poses[-1], [4.0, 0.0, -np.pi / 2], atol=0.05)


def test_perfect_wheels_report_the_truth():
    truth = SimulatedStream(SimulationConfig(world="lab"), 0).groundtruth.poses
    odometry = wheel_odometry(truth, PERFECT_WHEELS, np.random.default_rng(0))
    np.testing.assert_allclose(compose(truth[0], odometry)[:, :2], truth[:, :2], atol=2e-3)


def test_each_wheel_error_does_what_it_says(monkeypatch):
    straight = np.column_stack([np.linspace(0.0, 10.0, 601), np.zeros((601, 2))])
    on_the_spot = np.column_stack([np.zeros((601, 2)), wrap_angle(np.linspace(0.0, np.pi / 2, 601))])
    rng = np.random.default_rng(0)

    def end(poses, **errors):
        return wheel_odometry(poses, PERFECT_WHEELS.model_copy(update=errors), rng)[-1]

    np.testing.assert_allclose(end(straight, scale_bias=0.02), [10.2, 0.0, 0.0], atol=1e-6)
    np.testing.assert_allclose(end(straight, heading_bias_deg_per_m=1.0)[2], np.deg2rad(10.0), atol=1e-6)
    np.testing.assert_allclose(end(on_the_spot, turn_bias=0.1)[2], 1.1 * np.pi / 2, atol=1e-6)
    monkeypatch.setattr(motion, "SLIPS_PER_M", 0.0)
    ends = np.array([end(straight, noise=2.0) for _ in range(300)])
    assert np.rad2deg(ends[:, 2].std()) == pytest.approx(2 * motion.ROTATION_DEG_PER_SQRT_M * np.sqrt(10.0), rel=0.15)
    assert ends[:, 0].std() == pytest.approx(2 * motion.TRANSLATION_M_PER_SQRT_M * np.sqrt(10.0), rel=0.25)
    monkeypatch.setattr(motion, "SLIPS_PER_M", 1.0)
    monkeypatch.setattr(motion, "SLIP_M", 0.1)
    slipped = np.array([end(straight, noise=1.0)[0] for _ in range(20)])
    assert slipped.max() < 10.0


def test_odometry_drifts_as_far_as_a_comparison_needs():
    for world, low, high in (("office", 1.0, 2.0), ("lab", 0.15, 0.5)):
        stream = SimulatedStream(SimulationConfig(world=world), 0)
        assert low < ate_m(stream.odometry.poses, stream.groundtruth.poses) < high
