import numpy as np
import pytest

from hybridmap.streams.rgbd import Camera
from hybridmap.vision.rgbd.depth_grid import make_grid
from hybridmap.vision.rgbd.features import detect
from hybridmap.vision.rgbd.pnp import PnpSolver
from hybridmap.vision.rgbd.posture import Posture, find_floor, vertical_of_structure
from tests.vision.rgbd.rgbd_room import camera, render


def look(view: Camera, pose):
    frame = render(view, pose)
    grid = make_grid(frame.depth_m, view, 5, 0.003)
    return grid, detect(frame.color[..., 0], frame.depth_m, view)


def posture(mode, mounting):
    return Posture(mode, mounting.T_base_camera, PnpSolver(mounting, 12, 0))


def angle_deg(a, b):
    return np.rad2deg(np.arccos(np.clip(a @ b, -1.0, 1.0)))


@pytest.mark.parametrize(("pitch", "roll"), [(-35.0, 0.0), (-20.0, 6.0), (-10.0, -4.0)])
def test_floor_gives_tilt_and_height(pitch, roll):
    true = camera(1.5, pitch, roll)
    grid, _ = look(true, [-2.0, -0.8, 0.3])
    floor = find_floor(grid, camera(1.6).T_base_camera[2, :3], 1.6, 0.3, 40)
    assert floor is not None
    assert angle_deg(floor.up, true.T_base_camera[2, :3]) < 0.3
    assert floor.height_m == pytest.approx(1.5, abs=0.01)


def test_no_floor_is_not_invented_from_a_cupboard_or_a_wall():
    true = camera(1.5, 25.0)
    grid, _ = look(true, [-2.0, -0.8, 0.3])
    assert find_floor(grid, camera(1.5).T_base_camera[2, :3], 1.5, 0.3, 40) is None


def test_walls_give_the_vertical():
    true = camera(1.2, -12.0, 4.0)
    grid, _ = look(true, [0.0, 0.0, 0.7])
    normals = grid.normals[grid.valid]
    walls = normals[np.abs(normals @ true.T_base_camera[2, :3]) < 0.5]
    guess = camera(1.2, -20.0, 0.0).T_base_camera[2, :3]
    assert angle_deg(vertical_of_structure(walls, guess[None]), true.T_base_camera[2, :3]) < 1.0


def test_auto_stays_level_on_a_robot_and_follows_a_hand():
    mounting = camera(1.5, -20.0)
    auto = posture("auto", mounting)
    grid, features = look(mounting, [-2.0, -0.8, 0.3])
    assert not auto.stance(grid, features, None).held
    assert auto.stance(grid, features, None).T_base_camera is mounting.T_base_camera
    nodding = camera(1.5, -30.0)
    stance = auto.stance(*look(nodding, [-2.0, -0.8, 0.3]), None)
    assert stance.held
    assert stance.T_base_camera == pytest.approx(nodding.T_base_camera, abs=0.02)


def test_level_never_measures():
    mounting = camera(1.5, -20.0)
    stance = posture("level", mounting).stance(*look(camera(1.5, -30.0), [-2.0, -0.8, 0.3]), None)
    assert not stance.held
    assert np.array_equal(stance.T_base_camera, mounting.T_base_camera)
