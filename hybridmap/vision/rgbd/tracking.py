"""Refined self-motion: each new keyframe is registered to the ones before it, with the wheel odometry as prior."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace

import numpy as np

from hybridmap.config.rgbd import RgbdConfig
from hybridmap.geometry import Array, RelativePose, between, compose, compose_relative, log, loosest_direction
from hybridmap.graph.edges import Edge, EdgeKind, Status
from hybridmap.streams.rgbd import Camera
from hybridmap.vision.rgbd.depth_grid import place
from hybridmap.vision.rgbd.depth_registration import Registration, register
from hybridmap.vision.rgbd.features import match
from hybridmap.vision.rgbd.keyframe import Keyframe
from hybridmap.vision.rgbd.noise_level import NoiseLevel
from hybridmap.vision.rgbd.pairs import PointPairs, point_pairs
from hybridmap.vision.rgbd.stance import Stance, from_planar

SURE_INLIERS = 0.8
SURE_SLACK_M = 0.03
"""A registration may overrule odometry only when it fits this well and is this sure in every direction."""
STRAIGHTENED_RAD = float(np.deg2rad(0.4))
STRAIGHTENED_M = 0.01
"""What a registration adds to the uncertainty of a posture that it hands on."""


class Tracker:
    """Registers node k to nodes k-1, k-2, ...; keeps the odometry between consecutive nodes."""

    def __init__(
        self, keyframes: list[Keyframe], config: RgbdConfig, camera: Camera, level: NoiseLevel, new_key: Callable[[], int]
    ) -> None:
        self._keyframes = keyframes
        self._config = config.registration
        self._ratio = config.features.ratio
        self._focal_px = 0.5 * (camera.fx_px + camera.fy_px)
        self._level = level
        self._new_key = new_key
        self._measured: dict[tuple[int, int], RelativePose] = {}
        self._steps: list[RelativePose] = []
        self._refined: list[Array] = []

    def track(self, node: int, odometry: RelativePose | None) -> list[Edge]:
        """Proposals `registration` from earlier nodes to this one; `odometry` is its pose seen from node - 1."""
        if odometry is None or node == 0:
            return []
        self._steps.append(odometry)
        self._refined.append(odometry.delta)
        if not self._config.enabled:
            return []
        proposals = [self._register_back(node, back) for back in range(1, min(self._config.back, node) + 1)]
        first = proposals[0]
        if first.status is Status.ACCEPTED and first.relative is not None:
            self._refined[-1] = first.relative.delta
        self._learn(node)
        return proposals

    def _learn(self, node: int) -> None:
        """Let the noise level see how well the newest three registrations close."""
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
        pairs = self._pairs(fixed, moving, guess) if self._config.keypoints else None
        fit = register(fixed.surface, moving.surface, guess, prior, self._config, pairs)
        proposal = self._judge(node - back, node, fit, prior)
        if fit is not None and proposal.status is Status.ACCEPTED:
            if back <= 2:
                self._measured[node - back, node] = fit.relative
            if back == 1:
                self._keyframes[node] = _straightened(fixed, moving, fit)
        return proposal

    def _pairs(self, fixed: Keyframe, moving: Keyframe, guess: Array) -> PointPairs | None:
        matches = match(fixed.features, moving.features, self._ratio)
        pairs = point_pairs(fixed, moving, matches, self._focal_px, self._config.depth_sigma)
        return None if pairs is None else pairs.near(guess, self._config.keypoint_reach_m)

    def _judge(self, source: int, target: int, fit: Registration | None, prior: RelativePose) -> Edge:
        key = self._new_key()
        if fit is None:
            reason = "too little depth in common view"
            return Edge(source, target, EdgeKind.REGISTRATION, Status.REJECTED, reason, None, key=key)
        held = self._keyframes[source].held or self._keyframes[target].held
        relative = self._level.applied(fit.relative, *self._config.floors(held))
        error = log(between(prior.delta, relative.delta))
        distance = float(np.sqrt(error @ np.linalg.solve(prior.covariance + relative.covariance, error)))
        scores = {
            "points": float(fit.points),
            "inliers": fit.inliers,
            "residual_m": fit.residual_m,
            "overlap": fit.overlap,
            "slack_m": fit.slack_m,
            "sigma_m": loosest_direction(relative.covariance)[0],
            "odometry_sigma": distance,
        }
        far = distance > self._config.contradiction_sigma
        sure = fit.inliers > SURE_INLIERS and fit.slack_m < SURE_SLACK_M
        if fit.inliers < self._config.min_inliers:
            status, reason = Status.REJECTED, f"only {fit.inliers:.0%} of the depth in common view fits"
        elif far and not sure:
            status, reason = Status.REJECTED, f"{distance:.1f} sigma from odometry without being sure"
        else:
            status, reason = Status.ACCEPTED, "depth overrules odometry" if far else "depth registered"
            reason += _what_slides(relative, prior)
        return Edge(
            source,
            target,
            EdgeKind.REGISTRATION,
            status,
            reason,
            relative,
            scores,
            key=key,
            contradicts_odometry=far and sure and status is Status.ACCEPTED,
        )


def _what_slides(relative: RelativePose, odometry: RelativePose) -> str:
    """Which direction, seen from the new node, odometry knows better than depth and features do; empty if none."""
    sigma_m, direction = loosest_direction(relative.covariance)
    along = np.array([np.cos(direction), np.sin(direction)])
    if sigma_m**2 < along @ odometry.covariance[:2, :2] @ along:
        return ""
    return f"; free along {round(np.degrees(direction))} deg ({sigma_m:.2f} m), where odometry holds it"


def _straightened(fixed: Keyframe, moving: Keyframe, fit: Registration) -> Keyframe:
    """The moving keyframe with the posture that its surer neighbour gives it; itself if it is as sure."""
    before, of = fixed.surface.stance, moving.surface.stance
    if before.tilt_sigma_rad + STRAIGHTENED_RAD >= of.tilt_sigma_rad:
        return moving
    tilt, height = np.hypot(before.tilt_sigma_rad, STRAIGHTENED_RAD), np.hypot(before.height_sigma_m, STRAIGHTENED_M)
    stance = Stance(fit.level.T_base_camera_moving, float(tilt), float(height), of.held)
    return replace(moving, surface=place(moving.surface.grid, stance))
