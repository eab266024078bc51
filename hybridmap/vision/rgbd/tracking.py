"""Refined self-motion: each new keyframe is registered to the ones before it, with the wheel odometry as prior."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from typing import Any

import numpy as np

from hybridmap.config.vision import VisionConfig
from hybridmap.geometry import Array, RelativePose, between, compose, compose_relative, log, loosest_direction
from hybridmap.graph.edges import Check, Edge, EdgeKind, Lack, Method, Search, Status, at_most, passed
from hybridmap.streams.rgbd import Camera
from hybridmap.vision.rgbd import checks
from hybridmap.vision.rgbd.depth_grid import place
from hybridmap.vision.rgbd.depth_registration import Registration, register
from hybridmap.vision.rgbd.features import match
from hybridmap.vision.rgbd.keyframe import Keyframe
from hybridmap.vision.rgbd.noise_level import NoiseLevel
from hybridmap.vision.rgbd.pairs import PointPairs, point_pairs
from hybridmap.vision.rgbd.stance import Stance, from_planar

BACK = 2
"""Number of earlier nodes that a new one is registered to: with 2, three registrations form a ring."""
KEYPOINT_REACH_M = 0.3
"""Largest distance of matched keypoints at the first guess, m: wheels err less over a step."""
FLOORS, HELD_FLOORS = (0.0001, 0.005), (0.002, 0.06)
"""Least standard deviations of a consecutive edge, m and degrees: of a mounted camera, and of one whose tilt comes from the
floor plane."""
HELD_SHARED = 2.0
"""Factor on the covariance of the consecutive edges of a hand-held camera. Three of them span each step. They share keyframes
whose tilt is measured, and their errors are correlated by about 0.55 (0.2 with a mounted camera in the simulated worlds). A
chain that takes them for independent claims less than half of its variance, although each edge alone claims the right one."""
ODD, ODD_FACTOR = 98.0, 1.5
"""A registration fits oddly badly where its outliers exceed this percentile of the drive's own times this factor."""
STRAIGHTENED_RAD = float(np.deg2rad(0.4))
STRAIGHTENED_M = 0.01
"""Standard deviations that a registration adds to a stance that it propagates."""


class Tracker:
    """Registers node k to the nodes k-1 and k-2 before it.

    Args:
        keyframes: of all nodes, by number; it grows as nodes are made, and the newest one may be replaced.
        config: settings of the visual side.
        camera: pinhole at the working width.
        level: factor on the covariances of registrations, which is learnt here.
        new_key: returns the key of a new edge.
    """

    def __init__(
        self,
        keyframes: list[Keyframe],
        config: VisionConfig,
        camera: Camera,
        level: NoiseLevel,
        new_key: Callable[[], int],
    ) -> None:
        self._keyframes = keyframes
        self._enabled, self._depth_sigma = config.tracking.enabled, config.rgbd.registration.depth_sigma
        self._focal_px = 0.5 * (camera.fx_px + camera.fy_px)
        self._level = level
        self._new_key = new_key
        self._measured: dict[tuple[int, int], RelativePose] = {}
        self._steps: list[RelativePose] = []
        self._refined: list[Array] = []
        self._outliers: dict[int, float] = {}

    def track(self, node: int, odometry: RelativePose | None) -> list[Edge]:
        """Register a new node to the two before it; returns edges from these to the new node, rejected ones too.

        There are none for the first node, and with `vision.tracking.enabled` off. `odometry` is the pose of the new node in the
        frame of node - 1 (None for the first node). The new keyframe may get a stance (tilt and height of its camera) that is
        propagated from the one before.
        """
        if odometry is None or node == 0:
            return []
        self._steps.append(odometry)
        self._refined.append(odometry.delta)
        if not self._enabled:
            return []
        proposals = [self._register_back(node, back) for back in range(1, min(BACK, node) + 1)]
        first = proposals[0]
        if first.status is Status.ACCEPTED and first.relative is not None:
            self._refined[-1] = first.relative.delta
        self._learn(node)
        return proposals

    def way(self, node: int) -> tuple[Check, ...]:
        """Check that the registration of a node to the one before does not fit much worse than nearly all of the drive's.

        Empty if the node was not registered.
        """
        if node not in self._outliers:
            return ()
        limit = ODD_FACTOR * float(np.percentile(list(self._outliers.values()), ODD))
        return (at_most("depth_outliers", self._outliers[node], limit),)

    def _learn(self, node: int) -> None:
        """Give the noise level the ring of the newest three registrations."""
        sides = [self._measured.get(side) for side in ((node - 2, node - 1), (node - 1, node), (node - 2, node))]
        if sides[0] is not None and sides[1] is not None and sides[2] is not None:
            self._level.observe(sides[0], sides[1], sides[2])
        self._measured.pop((node - 2, node - 1), None)
        self._measured.pop((node - 2, node), None)

    def _register_back(self, node: int, back: int) -> Edge:
        prior = self._steps[-back]
        start = self._refined[-back]
        for step, refined in zip(self._steps[len(self._steps) - back + 1 :], self._refined[-back + 1 :], strict=False):
            prior = compose_relative(prior, step)
            start = compose(start, refined)
        fixed, moving = self._keyframes[node - back], self._keyframes[node]
        guess = from_planar(start)
        pairs = self._pairs(fixed, moving, guess)
        fit = register(fixed.surface, moving.surface, guess, prior, pairs)
        proposal = self._judge(node - back, node, fit, prior)
        if back == 1:
            self._outliers[node] = 1.0 if fit is None else 1.0 - fit.inliers
        if fit is not None and proposal.status is Status.ACCEPTED:
            if back <= 2:
                self._measured[node - back, node] = fit.relative
            if back == 1:
                self._keyframes[node] = _straightened(fixed, moving, fit)
        return proposal

    def _pairs(self, fixed: Keyframe, moving: Keyframe, guess: Array) -> PointPairs | None:
        matches = match(fixed.features, moving.features)
        pairs = point_pairs(fixed, moving, matches, self._focal_px, self._depth_sigma)
        return None if pairs is None else pairs.near(guess, KEYPOINT_REACH_M)

    def _judge(self, source: int, target: int, fit: Registration | None, prior: RelativePose) -> Edge:
        registered: dict[str, Any] = {"method": Method.DEPTH, "search": Search.CHAIN, "key": self._new_key()}
        if fit is None:
            return Edge.decided(source, target, EdgeKind.REGISTRATION, None, lack=Lack.NO_DEPTH, **registered)
        held = self._keyframes[source].held or self._keyframes[target].held
        relative = self._level.applied(fit.relative, *(HELD_FLOORS if held else FLOORS), HELD_SHARED if held else 1.0)
        distance = odometry_sigma(relative, prior)
        asked = checks.of_step(fit.inliers, fit.slack_m, distance)
        far = passed(asked) and distance > checks.CONTRADICTION_SIGMA
        figures = {
            "points": float(fit.points),
            "depth_residual_m": fit.residual_m,
            "overlap": fit.overlap,
            "slack_m": fit.slack_m,
            "odometry_sigma": distance,
            **_what_slides(relative, prior),
        }
        registered |= {"figures": figures, "contradicts_odometry": far}
        return Edge.decided(source, target, EdgeKind.REGISTRATION, relative, asked, **registered)


def odometry_sigma(registration: RelativePose, odometry: RelativePose) -> float:
    """Distance of a registration from the odometry of the same two nodes, in standard deviations."""
    error = log(between(odometry.delta, registration.delta))
    return float(np.sqrt(error @ np.linalg.solve(odometry.covariance + registration.covariance, error)))


def _what_slides(relative: RelativePose, odometry: RelativePose) -> dict[str, float]:
    """The loosest standard deviation of a registration; and that direction in the new node, if odometry knows it better."""
    loosest_m, direction = loosest_direction(relative.covariance)
    along = np.array([np.cos(direction), np.sin(direction)])
    if loosest_m**2 < along @ odometry.covariance[:2, :2] @ along:
        return {"loosest_m": loosest_m}
    return {"loosest_m": loosest_m, "free_deg": float(np.degrees(direction))}


def _straightened(fixed: Keyframe, moving: Keyframe, fit: Registration) -> Keyframe:
    """The moving keyframe with the stance propagated from its neighbour, if that is more certain than its own."""
    before, of = fixed.surface.stance, moving.surface.stance
    if before.tilt_sigma_rad + STRAIGHTENED_RAD >= of.tilt_sigma_rad:
        return moving
    tilt, height = np.hypot(before.tilt_sigma_rad, STRAIGHTENED_RAD), np.hypot(before.height_sigma_m, STRAIGHTENED_M)
    stance = Stance(fit.level.T_base_camera_moving, float(tilt), float(height), of.held)
    return replace(moving, surface=place(moving.surface.grid, stance))
