"""Registration of consecutive keyframes, and what their edges claim."""

from __future__ import annotations

import itertools

import numpy as np
import pytest

from hybridmap.config.vision import VisionConfig
from hybridmap.geometry import RelativePose, between
from hybridmap.vision.profile import image_profile
from hybridmap.vision.rgbd.depth_grid import make_grid, place
from hybridmap.vision.rgbd.features import detect
from hybridmap.vision.rgbd.keyframe import Keyframe
from hybridmap.vision.rgbd.noise_level import NoiseLevel
from hybridmap.vision.rgbd.stance import Stance
from hybridmap.vision.rgbd.tracking import Tracker
from tests.narrowing import known
from tests.vision.rgbd.rgbd_room import camera, render

VIEW = camera(1.5, -20.0)
POSES = np.array([[-2.0, -0.8, 0.3], [-1.9, -0.78, 0.33]])
FAR_ABOVE_THE_FLOORS = 1e4
CORRELATED = 0.55
"""Of the errors of two edges of a hand-held camera that span one step, as measured on a recording."""


def keyframe(pose: np.ndarray, seed: int, held: bool) -> Keyframe:
    frame = render(VIEW, pose, noise=0.002, rng=np.random.default_rng(seed))
    grey = frame.color[..., 0]
    stance = Stance(VIEW.T_base_camera, np.deg2rad(0.2), 0.004, held)
    surface = place(make_grid(frame.depth_m, VIEW, 5, 0.003), stance)
    profile = image_profile(grey, frame.depth_m, 64, 1)
    return Keyframe(profile, detect(grey, frame.depth_m, VIEW), surface)


def covariance_of_a_step(held: bool) -> np.ndarray:
    keyframes = [keyframe(POSES[0], 0, held)]
    tracker = Tracker(keyframes, VisionConfig(), VIEW, NoiseLevel(FAR_ABOVE_THE_FLOORS), itertools.count().__next__)
    assert tracker.track(0, None) == []
    keyframes.append(keyframe(POSES[1], 1, held))
    [edge] = tracker.track(1, RelativePose(between(POSES[0], POSES[1]), np.eye(3)))
    return known(edge.relative).covariance


def test_three_edges_of_a_hand_held_camera_that_span_a_step_claim_together_what_errors_in_common_leave():
    alone, claimed = covariance_of_a_step(held=False), covariance_of_a_step(held=True)
    left_by_three = (1.0 + 2.0 * CORRELATED) / 3.0
    assert claimed / 3.0 == pytest.approx(left_by_three * alone, rel=0.1)
