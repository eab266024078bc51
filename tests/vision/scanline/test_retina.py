"""What is taken of a frame, by camera and laser, however they are mounted."""

from __future__ import annotations

import numpy as np
import pytest

from hybridmap.config.vision import MatchingConfig, VisionConfig
from hybridmap.errors import ConfigError, StreamError
from hybridmap.geometry import compose
from hybridmap.streams.laser import Laser, LaserScan
from hybridmap.streams.rgbd import Camera, RgbdFrame
from hybridmap.vision.scanline.retina import CameraRetina, LaserRetina
from hybridmap.vision.scanline.sequences import Sequences
from tests.streams_for_tests import BEARINGS, scan

AHEAD = np.array([[0.0, 0.0, 1.0], [-1.0, 0.0, 0.0], [0.0, -1.0, 0.0]])
"""Axes of a level camera that looks ahead: right, down, forward, as columns in the base."""
CONFIG = VisionConfig.model_validate({"profile": {"width": 90}})


def turned(axis, angle_deg):
    one, two = [k for k in range(3) if k != axis]
    rotation = np.eye(3)
    cos, sin = np.cos(np.deg2rad(angle_deg)), np.sin(np.deg2rad(angle_deg))
    rotation[[one, one, two, two], [one, two, one, two]] = [cos, -sin, sin, cos]
    return rotation


def camera(rotation=AHEAD):
    pose = np.eye(4)
    pose[:3, :3] = rotation
    return Camera(80, 60, 60.0, 60.0, 39.5, 29.5, pose)


def of_wall(lens, distance_m):
    """A frame of a wall across the way, seen by a camera at the origin."""
    v, u = np.mgrid[: lens.height_px, : lens.width_px]
    rays = np.stack([(u - lens.cx_px) / lens.fx_px, (v - lens.cy_px) / lens.fy_px, np.ones(u.shape)])
    along = np.einsum("k,kij->ij", lens.T_base_camera[0, :3], rays)
    depth = np.where(along > 0.1, distance_m / np.maximum(along, 0.1), 0.0).astype(np.float32)
    return RgbdFrame(0, np.full((*u.shape, 3), 90, np.uint8), depth)


@pytest.mark.parametrize("mounting", [AHEAD, turned(1, 20.0) @ AHEAD, turned(2, 25.0) @ AHEAD, turned(0, 20.0) @ AHEAD])
def test_a_wall_across_the_way_is_as_far_in_every_column_however_the_camera_is_mounted(mounting):
    lens = camera(mounting)
    retina = CameraRetina(CONFIG, lens)
    seen = retina.glance(of_wall(lens, 3.0)).ahead_m
    assert np.isfinite(seen).mean() > 0.8
    assert seen[np.isfinite(seen)] == pytest.approx(3.0, abs=0.05)
    assert (np.diff(retina.bearings_rad) < 0.0).all()


def test_a_level_camera_sees_from_left_to_right_around_its_middle():
    bearings = CameraRetina(CONFIG, camera()).bearings_rad
    assert bearings[0] == pytest.approx(np.arctan2(39.5, 60.0))
    assert bearings == pytest.approx(-bearings[::-1])


def test_a_camera_that_looks_aside_has_nothing_ahead():
    bearings = CameraRetina(CONFIG, camera(turned(2, 90.0) @ AHEAD)).bearings_rad
    assert np.abs(bearings).min() > np.deg2rad(50.0)


@pytest.mark.parametrize("mounting", [turned(0, 90.0) @ AHEAD, turned(0, 180.0) @ AHEAD, turned(1, 80.0) @ AHEAD])
def test_a_camera_that_is_not_upright_is_refused(mounting):
    with pytest.raises(ConfigError, match="upright"):
        CameraRetina(CONFIG, camera(mounting))


def test_a_camera_whose_horizon_is_not_in_the_picture_sees_nothing_ahead():
    lens = camera(turned(1, 50.0) @ AHEAD)
    glance = CameraRetina(CONFIG, lens).glance(of_wall(lens, 3.0))
    assert np.isnan(glance.ahead_m).all()
    assert np.isfinite(glance.profile).all()


def test_pictures_without_depth_and_scans_without_return_have_a_profile_that_is_flat_where_nothing_is():
    lens = camera()
    blind = RgbdFrame(0, np.zeros((60, 80, 3), np.uint8), np.full((60, 80), np.inf, np.float32))
    glance = CameraRetina(CONFIG, lens).glance(blind)
    assert np.isnan(glance.ahead_m).all()
    assert (glance.profile == 0.0).all()
    glance = LaserRetina(CONFIG, laser()).glance(LaserScan(0, np.full(len(BEARINGS), np.nan, np.float32)))
    assert np.isnan(glance.ahead_m).all()
    assert (glance.profile == 0.0).all()


def laser(yaw=0.0, bearings=BEARINGS):
    return Laser(bearings, 0.05, 30.0, np.array([0.0, 0.0, yaw]))


def test_other_frames_are_refused():
    retina, by_laser = CameraRetina(CONFIG, camera()), LaserRetina(CONFIG, laser())
    with pytest.raises(StreamError, match="LaserScan"):
        retina.glance(LaserScan(0, np.ones(3, np.float32)))
    with pytest.raises(StreamError, match="expected"):
        retina.glance(RgbdFrame(0, np.zeros((3, 3, 3), np.uint8), np.zeros((3, 3), np.float32)))
    with pytest.raises(StreamError, match="RgbdFrame"):
        by_laser.glance(of_wall(camera(), 2.0))
    with pytest.raises(StreamError, match=f"expected {len(BEARINGS)} ranges"):
        by_laser.glance(LaserScan(0, np.ones(3, np.float32)))


@pytest.mark.parametrize("yaw", [0.0, 0.7, np.pi, -np.pi])
def test_a_laser_sees_the_same_ahead_however_it_is_turned(yaw):
    around = np.deg2rad(np.arange(-180.0, 180.0, 1.0))
    retina = LaserRetina(CONFIG, laser(yaw, around))
    bearings = around + yaw
    ranges = np.where(np.cos(bearings) > 0.1, 3.0 / np.maximum(np.cos(bearings), 0.1), np.nan)
    seen = retina.glance(LaserScan(0, ranges.astype(np.float32))).ahead_m
    assert (np.diff(retina.bearings_rad) < 0.0).all()
    near = np.abs(retina.bearings_rad) < np.deg2rad(60.0)
    assert near.sum() >= 119
    assert seen[near] == pytest.approx(3.0, abs=1e-3)


@pytest.mark.parametrize("turn_deg", [-12.0, 9.0])
def test_the_shift_of_the_profile_is_the_heading_of_the_older_view(turn_deg):
    pose = np.array([0.5, 0.3, 0.4])
    retina = LaserRetina(CONFIG, laser())
    sequences = Sequences(MatchingConfig(), 22)
    for at in (pose, compose(pose, np.array([0.0, 0.0, np.deg2rad(turn_deg)]))):
        sequences.add(retina.glance(LaserScan(0, scan(at))).profile)
    assert np.rad2deg(retina.yaw_rad(float(sequences.shifts[0]))) == pytest.approx(-turn_deg, abs=1.5)


def test_a_camera_that_turned_left_sees_things_farther_right():
    retina = CameraRetina(CONFIG, camera())
    assert retina.yaw_rad(10.0) == pytest.approx(-np.arctan2(10.0 * 80 / 90, 60.0))
