"""Refined self-motion: each new keyframe is registered to the ones before it, with the wheel odometry as prior."""

from __future__ import annotations

from collections.abc import Callable, Sequence

import numpy as np

from hybridmap.config.rgbd import RegistrationConfig
from hybridmap.geometry import Array, RelativePose, between, compose, compose_relative, log
from hybridmap.vision.base import Proposal, Verdict
from hybridmap.vision.rgbd.depth_registration import LEVEL, MEASURED, Registration, register, with_floor
from hybridmap.vision.rgbd.keyframe import Keyframe
from hybridmap.vision.rgbd.spatial import from_planar

SURE_INLIERS = 0.8
SURE_SIGMA_M = 0.03
"""A registration may overrule odometry only when it fits this well and is this sure in every direction."""


class Tracker:
    """Registers node k to nodes k-1, k-2, ...; keeps the odometry between consecutive nodes."""

    def __init__(self, keyframes: Sequence[Keyframe], config: RegistrationConfig, new_key: Callable[[], int]) -> None:
        self._keyframes = keyframes
        self._config = config
        self._new_key = new_key
        self._steps: list[RelativePose] = []
        self._refined: list[Array] = []

    def track(self, node: int, odometry: RelativePose | None) -> list[Proposal]:
        """Proposals `registration` from earlier nodes to this one; `odometry` is its pose seen from node - 1."""
        if odometry is None or node == 0:
            return []
        self._steps.append(odometry)
        self._refined.append(odometry.delta)
        if not self._config.enabled:
            return []
        proposals = [self._register_back(node, back) for back in range(1, min(self._config.back, node) + 1)]
        first = proposals[0]
        if first.verdict is Verdict.ACCEPTED and first.relative is not None:
            self._refined[-1] = first.relative.delta
        return proposals

    def _register_back(self, node: int, back: int) -> Proposal:
        prior = self._steps[-back]
        start = self._refined[-back]
        for step, refined in zip(self._steps[len(self._steps) - back + 1 :], self._refined[-back + 1 :], strict=False):
            prior = compose_relative(prior, step)
            start = compose(start, refined)
        fixed, moving = self._keyframes[node - back], self._keyframes[node]
        floor = MEASURED if fixed.tilt_measured or moving.tilt_measured else LEVEL
        fit = register(fixed.surface, moving.surface, from_planar(start), prior, floor, self._config)
        return self._judge(node - back, node, fit, prior)

    def _judge(self, source: int, target: int, fit: Registration | None, prior: RelativePose) -> Proposal:
        key = self._new_key()
        if fit is None:
            return Proposal(key, "registration", source, target, Verdict.REJECTED, "too little depth in common view")
        relative = with_floor(fit.relative, self._config.translation_floor_m, self._config.rotation_floor_deg)
        error = log(between(prior.delta, relative.delta))
        distance = float(np.sqrt(error @ np.linalg.solve(prior.covariance + relative.covariance, error)))
        sigma_m = float(np.sqrt(np.linalg.eigvalsh(relative.covariance[:2, :2])[-1]))
        scores = {
            "points": float(fit.points),
            "inliers": fit.inliers,
            "residual_m": fit.residual_m,
            "overlap": fit.overlap,
            "sigma_m": sigma_m,
            "odometry_sigma": distance,
        }
        far = distance > self._config.contradiction_sigma
        sure = fit.inliers > SURE_INLIERS and sigma_m < SURE_SIGMA_M
        if fit.inliers < self._config.min_inliers:
            verdict, reason = Verdict.REJECTED, f"only {fit.inliers:.0%} of the depth in common view fits"
        elif far and not sure:
            verdict, reason = Verdict.REJECTED, f"{distance:.1f} sigma from odometry without being sure"
        else:
            verdict, reason = Verdict.ACCEPTED, "depth overrules odometry" if far else "depth registered"
        overrules = far and sure and verdict is Verdict.ACCEPTED
        return Proposal(key, "registration", source, target, verdict, reason, relative, scores, overrules)
