"""The simulated camera and laser: geometry against the known corridor, noise, holes, exposure, texture."""

from __future__ import annotations

from functools import cache
from inspect import signature

import cv2
import numpy as np
import pytest

from hybridmap.config.inputs import CameraConfig, LaserScannerConfig
from hybridmap.simulation import pictures, sensor_models
from hybridmap.simulation.scene import Scene, build_atlas
from hybridmap.simulation.sensor_models import CameraModel, LaserModel
from hybridmap.simulation.worlds import build_world

CAMERA = CameraConfig(width_px=160, height_px=120)
WIDTH_M, HEIGHT_M, LENGTH_M = 2.4, 2.6, 19.2


@cache
def scene(world: str) -> Scene:
    return Scene(build_world(world))


def frame(world: str = "corridor", pose=(9.0, 1.2, 0.0), time_s: float = 0.0, seed: int = 0, noise: float = 1.0, **changes):
    model = CameraModel(scene(world), CAMERA.model_copy(update=changes), np.random.default_rng(1), noise)
    return model, model.frame(0, time_s, np.array(pose), np.random.default_rng(seed))


def points_in_base(model, depth_m):
    c = model.camera
    v, u = np.nonzero(depth_m)
    z = depth_m[v, u].astype(np.float64)
    optical = np.column_stack([(u - c.cx_px) / c.fx_px * z, (v - c.cy_px) / c.fy_px * z, z, np.ones(len(z))])
    return (optical @ c.T_base_camera.T)[:, :3]


def test_depth_puts_walls_floor_and_ceiling_where_they_are():
    model, seen = frame(pose=(9.0, 1.0, 0.0), noise=0.0)
    x, y, z = points_in_base(model, seen.depth_m).T
    assert (x > 0.4).all()
    left, right = np.abs(y - 1.4) < 0.01, np.abs(y + 1.0) < 0.01
    floor, ceiling = np.abs(z) < 0.01, np.abs(z - HEIGHT_M) < 0.01
    assert (left | right | floor | ceiling).all()
    assert min(left.sum(), right.sum(), floor.sum(), ceiling.sum()) > 300


def test_depth_is_whole_millimetres_within_its_range():
    _, seen = frame()
    assert seen.depth_m.dtype == np.float32
    millimetres = np.rint(seen.depth_m.astype(np.float64) * 1000.0)
    np.testing.assert_array_equal(seen.depth_m, (millimetres / 1000.0).astype(np.float32))
    valid = seen.depth_m[seen.depth_m > 0]
    assert valid.min() >= np.float32(0.4)
    assert valid.max() <= np.float32(5.0)


@pytest.mark.parametrize("distance_m", [1.0, 2.5, 4.5])
def test_depth_noise_grows_with_the_square_of_the_distance(distance_m, monkeypatch):
    monkeypatch.setattr(sensor_models, "HOLE_FRACTION", 0.0)
    _, seen = frame(pose=(LENGTH_M - 0.1 - distance_m, 1.2, 0.0))
    middle = seen.depth_m[50:70, 70:90].astype(np.float64)
    expected = 0.0012 + 0.0019 * (distance_m - 0.4) ** 2
    assert middle.mean() == pytest.approx(distance_m, abs=0.01)
    assert middle.std() == pytest.approx(expected, rel=0.2)


def test_holes_where_depth_jumps_and_in_patches(monkeypatch):
    found = []
    for share in (0.0, 0.05):
        monkeypatch.setattr(sensor_models, "HOLE_FRACTION", share)
        found.append(frame("lab", (2.0, 0.72, 0.0))[1])
    whole, patchy = found
    assert np.count_nonzero(patchy.depth_m == 0) > np.count_nonzero(whole.depth_m == 0) + 100
    clean = cv2.medianBlur(whole.depth_m, 5)
    torn = (cv2.dilate(clean, np.ones((3, 3))) - cv2.erode(clean, np.ones((3, 3)))) > 0.5
    inside = (clean > 0.5) & (clean < 3.5)
    assert (whole.depth_m == 0)[torn & inside].mean() > 3 * (whole.depth_m == 0)[~torn & inside].mean()


def test_exposure_changes_over_time_and_can_be_turned_off():
    bright = [frame(time_s=t)[1].color.mean() for t in (0.0, 3.0, 7.0, 12.0)]
    steady = [frame(time_s=t, noise=0.0)[1].color.mean() for t in (0.0, 3.0, 7.0, 12.0)]
    assert np.ptp(bright) > 8
    assert np.ptp(steady) < 1


def corners(image) -> int:
    return len(cv2.ORB.create(500).detect(cv2.cvtColor(image, cv2.COLOR_RGB2GRAY)))


def test_the_corridor_is_featureless_and_the_landmarks_are_not():
    for x in (3.0, 9.0, 14.0):
        assert corners(frame("corridor", (x, 1.2, 0.0))[1].color) <= 15
        assert corners(frame("corridor-landmarks", (x, 1.2, 0.0))[1].color) > 60


def test_the_same_place_gives_features_that_match_from_elsewhere():
    orb = cv2.ORB.create(500)
    found = []
    for pose in ((4.0, 1.15, 0.0), (4.3, 1.25, 0.05)):
        grey = cv2.cvtColor(frame("corridor-landmarks", pose, width_px=240, height_px=180)[1].color, cv2.COLOR_RGB2GRAY)
        found.append(orb.detectAndCompute(grey, None)[1])
    pairs = cv2.BFMatcher(cv2.NORM_HAMMING).knnMatch(found[0], found[1], k=2)
    assert sum(first.distance < 0.75 * second.distance for first, second in pairs) > 25


def test_laser_measures_the_corridor(monkeypatch):
    monkeypatch.setattr(sensor_models, "DROP_FRACTION", 0.0)
    model = LaserModel(scene("corridor"), LaserScannerConfig(range_max_m=8.0))
    bearings = model.laser.bearings_rad
    np.testing.assert_array_equal(bearings, bearings[0] + np.arange(180) * np.float64(np.float32(np.pi / 179)))
    errors = []
    for seed in range(20):
        ranges = model.scan(0, 0.0, np.array([9.0, 1.0, 0.0]), np.random.default_rng(seed)).ranges_m
        assert ranges.dtype == np.float32
        y = ranges * np.sin(bearings)
        errors.append(np.where(bearings > 0, y - 1.4, y + 1.0) / np.abs(np.sin(bearings)))
    seen = np.isfinite(errors)
    assert np.nanstd(errors) == pytest.approx(0.01, rel=0.1)
    assert not seen[:, np.abs(bearings) < 0.05].any()  # the far end is beyond its range
    assert seen[:, np.abs(bearings) > 0.3].all()


def test_far_textures_come_from_smaller_copies():
    checker = (np.indices((64, 64)).sum(axis=0) % 2 * 255).astype(np.uint8)
    atlas = build_atlas([np.repeat(checker[..., None], 3, axis=2), np.full((9, 9, 3), 40, np.uint8)])
    surface = np.zeros((8, 8), np.int32)
    across, down = np.meshgrid(np.linspace(0.1, 0.9, 8, dtype=np.float32), np.linspace(0.1, 0.9, 8, dtype=np.float32))
    near = atlas.sample(surface, across, down, np.ones((8, 8), np.float32))
    far = atlas.sample(surface, across, down, np.full((8, 8), 8.0, np.float32))
    assert near.std() > 30
    np.testing.assert_allclose(far, 127.5, atol=2.0)
    np.testing.assert_allclose(atlas.sample(surface + 1, across, down, np.ones((8, 8), np.float32)), 40.0)


def test_a_paint_is_made_from_its_options_alone_as_its_signature_says():
    assert list(signature(pictures.books).parameters) == ["shelves"]
    drawn = pictures.books(3)(np.random.default_rng(0), (90, 60), 100.0)
    assert drawn.shape == (90, 60, 3)
    assert drawn.dtype == np.uint8
