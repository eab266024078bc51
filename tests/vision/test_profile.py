import numpy as np
import pytest

from hybridmap.vision.profile import FARTHEST_M, UNIT_M, image_profile, laser_profile, normalised, panoramic_profile

RNG = np.random.default_rng(5)


def frame(height=48, width=128):
    grey = RNG.integers(0, 255, (height, width), dtype=np.uint8)
    depth = RNG.uniform(0.5, 4.0, (height, width)).astype(np.float32)
    return grey, depth


def test_intensity_band_is_the_column_sum():
    grey, depth = frame()
    profile = image_profile(grey, depth, width=64)
    sums = grey.astype(float).sum(axis=0).reshape(64, 2).sum(axis=1)
    assert profile.shape == (2, 64)
    assert profile.dtype == np.float32
    assert np.allclose(profile[0], (sums - sums.mean()) / sums.std(), atol=1e-4)


def test_depth_band_is_the_mean_of_valid_pixels_only():
    grey, depth = frame()
    depth[RNG.random(depth.shape) < 0.5] = 0.0
    profile = image_profile(grey, depth, width=64)
    pairs = depth.reshape(48, 64, 2).transpose(1, 0, 2).reshape(64, -1).astype(float)
    means = pairs.sum(axis=1) / (pairs > 0).sum(axis=1)
    assert np.allclose(profile[1], (means - means.mean()) / means.std(), atol=1e-3)


def test_columns_without_depth_say_nothing():
    grey, depth = frame()
    depth[:, :32] = 0.0
    profile = image_profile(grey, depth, width=64)
    assert np.allclose(profile[1, :16], 0.0, atol=1e-4)
    assert np.isfinite(image_profile(grey, np.zeros_like(depth), width=64)).all()


def test_four_bands_cover_the_rows_top_first():
    grey, depth = frame()
    profile = image_profile(grey, depth, width=64, bands=4)
    assert profile.shape == (8, 64)
    top = image_profile(grey[:12], depth[:12], width=64)
    assert np.allclose(profile[[0, 4]], top, atol=1e-4)


def test_z_profile_ignores_exposure():
    grey, depth = frame()
    brighter = (0.5 * grey.astype(float) + 60.0).round().astype(np.uint8)
    assert np.allclose(image_profile(grey, depth, 64)[0], image_profile(brighter, depth, 64)[0], atol=0.05)


def test_normalisations():
    bands = RNG.uniform(1.0, 5.0, (3, 64))
    z = normalised(bands, "z")
    assert np.allclose(z.mean(axis=1), 0.0)
    assert np.allclose(z.std(axis=1), 1.0)
    assert np.allclose(normalised(bands, "mean").mean(axis=1), 1.0)
    assert np.allclose(normalised(np.full((1, 8), 3.0), "z"), 0.0)


def test_laser_profile_resamples_by_bearing_and_skips_invalid():
    bearings = np.linspace(-np.pi / 2, np.pi / 2, 256)
    ranges = (3.0 + np.sin(2.0 * bearings)).astype(np.float32)
    whole = laser_profile(ranges, bearings, 64)
    assert whole.shape == (1, 64)
    assert np.allclose(laser_profile(ranges[::-1], bearings[::-1], 64), whole, atol=1e-5)
    holes = ranges.copy()
    holes[1::2] = np.nan
    assert np.abs(laser_profile(holes, bearings, 64) - whole).max() < 0.2
    assert np.argmax(whole) == pytest.approx(48, abs=1)  # sin(2 b) peaks at b = pi / 4


def test_each_column_of_a_scan_is_the_mean_of_its_returns_from_the_first_to_the_last():
    ranges = np.arange(1.0, 9.0, dtype=np.float32)
    bearings = np.linspace(-1.0, 1.0, 8)  # one beam a column
    assert np.allclose(laser_profile(ranges, bearings, 8, "mean")[0], ranges / ranges.mean())
    ranges[2] = np.nan  # that column takes the mean of the others
    expected = np.where(np.isnan(ranges), np.nanmean(ranges), ranges) / np.nanmean(ranges)
    assert np.allclose(laser_profile(ranges, bearings, 8, "mean")[0], expected)
    pairs = np.repeat(np.arange(1.0, 9.0), 2) + np.tile([-0.25, 0.25], 8)
    assert np.allclose(laser_profile(pairs.astype(np.float32), np.linspace(-1, 1, 16), 8, "mean")[0], np.arange(1.0, 9.0) / 4.5)


def test_a_panorama_holds_the_nearest_and_the_farthest_point_of_each_column():
    bearings = np.deg2rad([0.5, 1.0, 91.0])
    away = np.array([2.0, 6.0, 40.0])
    profile = panoramic_profile(away[:, None] * np.column_stack([np.cos(bearings), np.sin(bearings)]), 8)
    assert profile.shape == (2, 8)
    assert profile.dtype == np.float32
    farthest = np.log(FARTHEST_M / UNIT_M)
    expected = np.full((2, 8), farthest)
    expected[:, 4] = np.log(np.array([2.0, 6.0]) / UNIT_M)  # straight ahead is the middle; what is too far is not seen
    assert np.allclose(profile, expected)


def test_a_turn_of_the_robot_shifts_a_panorama():
    points = RNG.uniform(-8.0, 8.0, (400, 2))
    turn = 2.0 * np.pi * 5 / 64
    cos, sin = np.cos(turn), np.sin(turn)
    seen = points @ np.array([[cos, -sin], [sin, cos]])  # by a robot that turned left by five columns
    assert np.allclose(np.roll(panoramic_profile(points, 64), -5, axis=1), panoramic_profile(seen, 64), atol=1e-5)


def test_without_points_a_panorama_is_open_all_around():
    assert np.allclose(panoramic_profile(np.zeros((0, 2)), 16), np.log(FARTHEST_M / UNIT_M))
