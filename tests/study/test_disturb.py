"""Disturbances of a drive: the same bits for the same seed, nothing at strength zero, and each as it says."""

from itertools import pairwise

import numpy as np
import pytest

from hybridmap.geometry import between
from hybridmap.streams.base import Observation, Rig, Sample, SelfMotion
from hybridmap.streams.laser import LaserScan
from hybridmap.streams.rgbd import Camera, RgbdFrame
from hybridmap.study.disturb import TABLE, by_chance, disturbed

RIG = Rig(camera=Camera(32, 24, 30.0, 30.0, 15.5, 11.5, np.eye(4)))
SCANS = 12
STRENGTHS: dict[str, float | tuple[float, ...]] = {
    "scan_range_m": 4.0,
    "depth_range_m": 3.0,
    "views_late_s": 0.15,
    "kidnapped_s": (0.4, 1.2, 2.3),
    "color_noise": 9.0,
}


@pytest.fixture(scope="module")
def drive():
    """2.4 s at 10 Hz on a circle, a scan and a frame every second odometry message, at its stamp."""
    rng = np.random.default_rng(0)
    samples: list[Sample] = []
    for k in range(2 * SCANS):
        stamp_ns = 1_000_000_000 + 100_000_000 * k
        samples.append(SelfMotion(stamp_ns, np.array([np.sin(0.2 * k), 1.0 - np.cos(0.2 * k), 0.2 * k])))
        if k % 2 == 0:
            samples.append(LaserScan(stamp_ns, rng.uniform(0.5, 8.0, 60).astype(np.float32)))
            color = rng.integers(0, 256, (24, 32, 3), dtype=np.uint8)
            samples.append(RgbdFrame(stamp_ns, color, rng.uniform(0.5, 5.0, (24, 32)).astype(np.float32)))
    return samples


def worse(drive, name, strength, seed=3):
    return list(disturbed(drive, RIG, {name: strength}, seed))


def bits(samples):
    """Everything that a sample holds, as bytes."""
    rows = []
    for sample in samples:
        values = [getattr(sample, name) for name in sample.__slots__]
        rows.append((type(sample), *(v.tobytes() + str(v.dtype).encode() if isinstance(v, np.ndarray) else v for v in values)))
    return rows


def scans(samples):
    return np.array([sample.ranges_m for sample in samples if isinstance(sample, LaserScan)])


def frames(samples):
    return [sample for sample in samples if isinstance(sample, RgbdFrame)]


def steps(samples):
    poses = np.array([sample.pose_odom_robot for sample in samples if isinstance(sample, SelfMotion)])
    return between(poses[:-1], poses[1:])


@pytest.mark.parametrize("name", TABLE)
def test_the_same_seed_gives_the_same_bits_and_no_strength_changes_nothing(drive, name):
    strength = STRENGTHS.get(name, 0.5)
    once = bits(worse(drive, name, strength))
    assert once != bits(drive)
    assert bits(worse(drive, name, strength)) == once
    assert (bits(worse(drive, name, strength, seed=4)) != once) == TABLE[name].by_chance == by_chance({name: strength})
    assert bits(worse(drive, name, 0.0)) == bits(drive)
    assert not by_chance({name: 0.0})


def test_a_disturbance_draws_the_same_beside_another(drive):
    both = list(disturbed(drive, RIG, {"beams_lost": 0.3, "wheel_slips_per_m": 2.0}, 3))
    assert scans(both).tobytes() == scans(worse(drive, "beams_lost", 0.3)).tobytes()
    assert np.array_equal(steps(both), steps(worse(drive, "wheel_slips_per_m", 2.0)))


def test_scans_get_worse_as_told(drive):
    clean = scans(drive)
    assert np.array_equal(np.isnan(scans(worse(drive, "scan_range_m", 4.0))), clean >= 4.0)
    covered = np.isnan(scans(worse(drive, "scan_covered", 1 / 3)))
    assert covered[:, :10].all()
    assert covered[:, 50:].all()
    assert not covered[:, 10:50].any()
    assert np.std(scans(worse(drive, "scan_noise_m", 0.03)) - clean) == pytest.approx(0.03, rel=0.1)
    assert np.isnan(scans(worse(drive, "beams_lost", 0.3))).mean() == pytest.approx(0.3, abs=0.06)
    short = scans(worse(drive, "beams_short", 0.2))
    assert (short <= clean).all()
    assert (short < clean).mean() == pytest.approx(0.2, abs=0.05)


def test_frames_get_worse_as_told(drive):
    clean = frames(drive)
    for before, after in zip(clean, frames(worse(drive, "darker", 0.9)), strict=True):
        assert np.array_equal(after.color, np.rint(0.1 * before.color))
    assert not any(frame.color.any() for frame in frames(worse(drive, "darker", 1.0)))
    grain = [a.color - b.color.astype(float) for a, b in zip(frames(worse(drive, "color_noise", 9.0)), clean, strict=True)]
    assert np.std(grain) == pytest.approx(9.0, rel=0.1)
    for name, limit in (("depth_range_m", 3.0), ("depth_lost", 0.4)):
        after = np.array([frame.depth_m for frame in frames(worse(drive, name, limit))])
        before = np.array([frame.depth_m for frame in clean])
        gone = after == 0.0
        assert np.array_equal(after[~gone], before[~gone])
        assert gone.mean() == pytest.approx((before > 3.0).mean() if name == "depth_range_m" else 0.4, abs=0.03)
    noisy = [
        (a.depth_m - b.depth_m) / b.depth_m**2 for a, b in zip(frames(worse(drive, "depth_noise_m", 0.01)), clean, strict=True)
    ]
    assert np.std(noisy) == pytest.approx(0.01, rel=0.1)
    blurred = frames(worse(drive, "blur_s", 0.1))  # 2 rad/s, 0.1 s, 30 px: 6 pixels
    assert np.array_equal(blurred[0].color, clean[0].color)  # it stood still before
    rows = blurred[5].color.astype(float)
    assert np.std(np.diff(rows, axis=1)) < 0.5 * np.std(np.diff(clean[5].color.astype(float), axis=1))
    assert np.std(np.diff(rows, axis=0)) > np.std(np.diff(rows, axis=1))


def test_wheels_get_worse_as_told(drive):
    clean = steps(drive)
    length = np.hypot(clean[:, 0], clean[:, 1])
    assert np.hypot(*steps(worse(drive, "wheel_scale", 0.05))[:, :2].T) == pytest.approx(1.05 * length)
    assert steps(worse(drive, "wheel_turn_scale", 0.1))[:, 2] == pytest.approx(1.1 * clean[:, 2])
    assert steps(worse(drive, "wheel_pull_deg_per_m", 2.0))[:, 2] - clean[:, 2] == pytest.approx(np.radians(2.0) * length)
    walk = (steps(worse(drive, "wheel_noise_deg_per_sqrt_m", 3.0)) - clean)[:, 2] / np.sqrt(length)
    assert np.degrees(np.std(walk)) == pytest.approx(3.0, rel=0.4)
    hit = (np.abs(steps(worse(drive, "wheel_slips_per_m", 2.0)) - clean) > 1e-9).any(axis=1)
    assert 2 <= hit.sum() <= 16
    assert [type(sample) for sample in worse(drive, "wheel_scale", 0.05)] == [type(sample) for sample in drive]


def test_views_are_lost_regularly_and_come_late_in_order(drive):
    kept = [s.stamp_ns for s in worse(drive, "views_lost", 0.75) if isinstance(s, LaserScan | RgbdFrame)]
    every = [s.stamp_ns for s in drive if isinstance(s, LaserScan | RgbdFrame)]
    assert kept == every[::4]
    for late_s in (0.15, -0.15):
        late = worse(drive, "views_late_s", late_s)
        assert [s.stamp_ns for s in late] == sorted(s.stamp_ns for s in late)
        apart_ns = round(1e9 * late_s)
        for kind, shift_ns in ((SelfMotion, apart_ns), (LaserScan, 0)):
            assert [s.stamp_ns + shift_ns for s in late if isinstance(s, kind)] == [
                s.stamp_ns for s in drive if isinstance(s, kind)
            ]
    together = worse(drive, "views_late_s", 0.1)  # onto the stamp of the next odometry: motion comes first
    for before, after in pairwise(together):
        assert not (before.stamp_ns == after.stamp_ns and isinstance(before, Observation) and isinstance(after, SelfMotion))


def test_a_kidnapped_robot_s_wheels_feel_nothing(drive):
    cut = worse(drive, "kidnapped_s", (0.4, 1.2, 2.0))
    stamps_s = np.array([(s.stamp_ns - drive[0].stamp_ns) / 1e9 for s in cut])
    assert not ((stamps_s > 0.4) & (stamps_s < 1.2)).any()
    assert stamps_s.max() == 2.0
    motion = {round((s.stamp_ns - drive[0].stamp_ns) / 1e8): s.pose_odom_robot for s in cut if isinstance(s, SelfMotion)}
    assert motion[12] == pytest.approx(motion[4])
    given = {k: np.array([np.sin(0.2 * k), 1.0 - np.cos(0.2 * k), 0.2 * k]) for k in (12, 20)}
    assert between(motion[12], motion[20]) == pytest.approx(between(given[12], given[20]))
