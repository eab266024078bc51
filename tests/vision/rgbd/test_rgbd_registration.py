import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from hybridmap.geometry import RelativePose, between, compose
from hybridmap.vision.rgbd.depth_grid import make_grid, place
from hybridmap.vision.rgbd.depth_registration import register
from hybridmap.vision.rgbd.stance import (
    Stance,
    apply,
    camera_on,
    from_planar,
    inverse_rigid,
    level_pair,
    rotation_of,
    to_floor,
)
from tests.narrowing import known
from tests.vision.rgbd.rgbd_room import CUPBOARD, HIGH, LOW, camera, render

DEPTH_SIGMA = 0.003
LEVEL = (np.deg2rad(0.2), 0.004)


def surface(view, pose, noise=0.0, seed=0, believed=None, sigma: tuple[float, float] = LEVEL):
    frame = render(view, pose, noise=noise, rng=np.random.default_rng(seed))
    tilt_rad, height_m = sigma
    stance = Stance(view.T_base_camera if believed is None else believed, tilt_rad, height_m, believed is not None)
    return place(make_grid(frame.depth_m, view, 5, DEPTH_SIGMA), stance)


def test_rigid_transforms():
    T = from_planar(np.array([0.3, -0.2, 2.5])) @ np.block(
        [[rotation_of(np.array([0.02, -0.05, 0.0])), np.array([[0.0], [0.0], [0.1]])], [np.zeros((1, 3)), 1.0]]
    )
    assert np.allclose(T @ inverse_rigid(T), np.eye(4))
    flat = to_floor(T)
    assert flat.delta == pytest.approx([0.3, -0.2, 2.5], abs=2e-3)
    assert flat.height_m == pytest.approx(0.1)
    assert flat.tilt_rad == pytest.approx(np.hypot(0.02, 0.05), rel=1e-3)
    turned = Rotation.from_rotvec([0.3, -0.2, 0.1]).as_matrix()
    assert rotation_of(np.array([0.3, -0.2, 0.1])) == pytest.approx(turned)


def test_grid_points_and_normals_lie_on_the_walls():
    view = camera()
    placed = surface(view, [-1.0, 0.0, 0.0])
    ahead = placed.points[:, 0] > 3.95  # the far wall, 4 m from the robot
    assert ahead.sum() > 50
    assert np.median(np.abs(placed.points[ahead, 0] - 4.0)) < 1e-3
    assert np.median(placed.normals[ahead, 0]) == pytest.approx(-1.0, abs=1e-3)
    floor = placed.points[:, 2] < 0.01
    assert np.median(placed.normals[floor, 2]) == pytest.approx(1.0, abs=1e-3)


@pytest.mark.parametrize(("lost", "share"), [(0.3, 0.9), (0.6, 0.4)])
def test_missing_pixels_cost_few_cells_and_no_accuracy(lost, share):
    """Single pixels without depth, as grazing or dark surfaces give them: what is left of a cell is put where it was seen."""
    view, rng = camera(height_m=1.2, pitch_deg=-25.0), np.random.default_rng(2)
    pose = np.array([-1.0, 0.0, 0.5])
    frame = render(view, pose)
    stance = Stance(view.T_base_camera, *LEVEL, False)
    whole = make_grid(frame.depth_m, view, 5, DEPTH_SIGMA)
    torn = frame.depth_m * (rng.random(frame.depth_m.shape) >= lost)
    left = place(make_grid(torn, view, 5, DEPTH_SIGMA), stance)
    assert len(left.points) > share * whole.valid.sum()
    in_room = apply(from_planar(pose), left.points)
    off = np.abs(np.concatenate([in_room - LOW, in_room - HIGH, in_room - CUPBOARD[0]], axis=1)).min(axis=1)
    assert np.quantile(off, 0.85) < 1e-5  # of some a corner runs through
    assert np.median(left.sigma_m) > np.median(whole.sigma_m[whole.valid])


def test_registration_recovers_the_motion_from_a_wrong_start():
    view = camera()
    first, second = np.array([0.3, 0.1, -0.7]), np.array([0.5, 0.0, -0.5])
    truth = between(first, second)
    fit = register(surface(view, first), surface(view, second), from_planar(truth + np.array([0.04, -0.03, 0.03])), None)
    assert fit is not None
    assert fit.inliers > 0.9
    assert fit.relative.delta == pytest.approx(truth, abs=2e-3)


def test_covariance_is_that_of_the_error_where_every_pixel_errs_by_itself():
    view, truth = camera(), np.array([0.2, 0.02, 0.1])
    first = np.array([0.3, 0.1, -0.7])
    moved = compose(first, truth)
    squared = []
    for seed in range(16):
        a, b = surface(view, first, 0.003, 2 * seed), surface(view, moved, 0.003, 2 * seed + 1)
        fit = known(register(a, b, from_planar(truth), None))
        error = between(truth, fit.relative.delta)
        assert np.hypot(error[0], error[1]) < 0.01
        assert abs(error[2]) < np.deg2rad(0.3)
        squared.append(error @ np.linalg.solve(fit.relative.covariance, error) / 3.0)
    assert 0.2 < np.mean(squared) < 2.5


def test_a_lone_wall_leaves_the_slide_along_it_to_odometry():
    view = camera(width=80)
    depth = np.full((60, 80), 2.0, dtype=np.float32)
    stance = Stance(view.T_base_camera, *LEVEL, False)
    wall = place(make_grid(depth, view, 5, DEPTH_SIGMA), stance)
    prior = RelativePose(np.array([0.0, 0.1, 0.0]), np.diag([0.02, 0.02, 0.01]) ** 2)
    fit = known(register(wall, wall, from_planar(prior.delta + np.array([0.05, 0.0, 0.02])), prior))
    sigma = np.sqrt(np.diag(fit.relative.covariance))
    assert fit.relative.delta == pytest.approx(prior.delta, abs=2e-3)
    assert sigma[0] < 0.01
    assert sigma[1] > 0.2  # the prior is taken out again


def test_noise_of_the_normals_does_not_pass_for_a_hold_along_a_wall():
    view, rng = camera(width=240), np.random.default_rng(4)
    stance = Stance(view.T_base_camera, *LEVEL, False)
    fits = []
    for _ in range(4):
        depth = [(2.5 + 0.012 * rng.normal(size=(180, 240))).astype(np.float32) for _ in range(2)]
        walls = [place(make_grid(one, view, 5, DEPTH_SIGMA), stance) for one in depth]
        fits.append(known(register(walls[0], walls[1], np.eye(4), None)))
    assert min(np.sqrt(fit.relative.covariance[1, 1]) for fit in fits) > 0.01  # squared noise would make it 4.5 mm
    assert min(fit.slack_m for fit in fits) > 0.05  # and this 24 mm


def test_no_overlap_is_no_registration():
    view = camera()
    fit = register(surface(view, [0.0, 0.0, 0.0]), surface(view, [0.0, 0.0, 3.1]), from_planar(np.array([0.0, 0.0, 3.1])), None)
    assert fit is None


def test_a_wrong_posture_is_straightened_by_a_sure_neighbour():
    tilted = camera(height_m=1.5, pitch_deg=-20.0)
    off = camera_on(camera(height_m=1.5, pitch_deg=-23.0).T_base_camera[2, :3], 1.5, tilted.T_base_camera)
    first, second = np.array([0.8, -0.1, -0.8]), np.array([1.0, -0.2, -0.7])
    sure = surface(tilted, first, believed=tilted.T_base_camera, sigma=(np.deg2rad(0.5), 0.02))
    unsure = surface(tilted, second, believed=off, sigma=(np.deg2rad(3.0), 0.06))
    truth = between(first, second)
    fit = known(register(sure, unsure, from_planar(truth), None))
    assert fit.relative.delta == pytest.approx(truth, abs=0.01)
    assert fit.level.T_base_camera_moving == pytest.approx(tilted.T_base_camera, abs=0.02)


def test_level_pair_gives_planar_motion_whatever_the_postures_claim():
    a, b = camera(1.6, -30.0, 5.0).T_base_camera, camera(1.6, 5.0, -3.0).T_base_camera
    delta = np.array([0.4, -0.1, 0.5])
    sure, unsure = Stance(a, 0.01, 0.02, True), Stance(camera(1.6, -5.0).T_base_camera, 10.0, 0.02, True)
    T_cameras = inverse_rigid(a) @ from_planar(delta) @ b
    level = level_pair(a @ T_cameras @ inverse_rigid(unsure.T_base_camera), sure, unsure)
    heading = [np.arctan2(T[1, 2], T[0, 2]) for T in (a, b)]
    assert heading == pytest.approx([heading[0]] * 2, abs=1e-9)
    assert level.delta == pytest.approx(delta, abs=1e-3)
    assert level.T_base_camera_moving == pytest.approx(b, abs=1e-3)
