"""Verification of a loop candidate: features with depth, PnP both ways, planarity, then a joint refinement."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from hybridmap.config.rgbd import FeaturesConfig, PnpConfig, RegistrationConfig
from hybridmap.geometry import Array, RelativePose, between, loosest_direction, wrap_angle
from hybridmap.streams.rgbd import Camera
from hybridmap.vision.rgbd.depth_registration import Registration, register
from hybridmap.vision.rgbd.features import Correspondences, match
from hybridmap.vision.rgbd.keyframe import Keyframe
from hybridmap.vision.rgbd.noise_level import NoiseLevel
from hybridmap.vision.rgbd.pairs import point_pairs
from hybridmap.vision.rgbd.pnp_solver import PnpSolver
from hybridmap.vision.rgbd.stance import FloorPose, from_planar, inverse_rigid, level_pair, to_floor

GUESSED = 2.0
"""Standard deviations of a guess over which features are looked for around it."""


@dataclass(frozen=True, slots=True)
class Verification:
    """Outcome: a relative pose of the target in the source's frame, or None with the reason of refusal."""

    relative: RelativePose | None
    reason: str
    scores: Mapping[str, float]


class Verifier:
    """Verifies pairs of keyframes of one camera."""

    def __init__(
        self,
        camera: Camera,
        pnp: PnpConfig,
        features: FeaturesConfig,
        registration: RegistrationConfig,
        level: NoiseLevel,
        seed: int,
    ) -> None:
        self.solver = PnpSolver(camera, pnp, seed)
        self._focal_px = 0.5 * (camera.fx_px + camera.fy_px)
        self._pnp = pnp
        self._ratio = features.ratio
        self._registration = registration
        self._level = level

    def verify(self, source: Keyframe, target: Keyframe) -> Verification:
        """Measure the target's pose in the source's frame, or say why not."""
        pairs = match(source.features, target.features, self._ratio)
        scores: dict[str, float] = {"matches": float(len(pairs.first))}
        if len(pairs.first) < self._pnp.min_inliers:
            return Verification(None, f"only {len(pairs.first)} features match", scores)
        forward = self.solver.solve(target.features, source.features, pairs.second, pairs.first)
        scores["inliers"] = float(len(forward.inliers)) if forward else 0.0
        if forward is None or len(forward.inliers) < self._pnp.min_inliers:
            return Verification(None, f"only {scores['inliers']:.0f} features agree on a pose", scores)
        backward = self.solver.solve(source.features, target.features, pairs.first, pairs.second)
        scores["inliers_reverse"] = float(len(backward.inliers)) if backward else 0.0
        if backward is None or len(backward.inliers) < self._pnp.min_inliers:
            return Verification(None, f"only {scores['inliers_reverse']:.0f} features agree in reverse", scores)
        T = _between_bases(forward.T_image_points, source, target)
        T_reverse = _between_bases(inverse_rigid(backward.T_image_points), source, target)
        flat, reverse = _flat(T, source, target), _flat(T_reverse, source, target)
        refusal = self._implausible(flat, reverse, source.held or target.held, scores)
        if refusal is not None:
            return Verification(None, refusal, scores)
        both = np.intersect1d(forward.inliers, backward.inliers)
        return self._refined(source, target, flat, pairs.first[both], pairs.second[both], scores)

    def verify_on_map(self, source: Keyframe, target: Keyframe, guess: RelativePose) -> Verification:
        """Measure by depth alone, from where the map has the target (for views that share surfaces but no features).

        Args:
            source, target: the keyframes.
            guess: the target in the source's frame as the map has it, and how far that may be off.
        """
        fit = register(source.surface, target.surface, from_planar(guess.delta), guess, self._registration)
        if fit is None:
            return Verification(None, "too little depth in common view", {})
        scores = {"depth_inliers": fit.inliers, "overlap": fit.overlap, "points": float(fit.points), "slack_m": fit.slack_m}
        if fit.inliers < self._pnp.map_inliers:
            return Verification(None, f"only {fit.inliers:.0%} of the depth in common view fits", scores)
        if fit.overlap < self._pnp.map_overlap or fit.points < self._pnp.map_points:
            return Verification(None, f"only {fit.points} points of depth in common", scores)
        if fit.slack_m > self._pnp.map_sigma_m:
            direction = round(np.degrees(loosest_direction(fit.relative.covariance)[1]))
            return Verification(None, f"depth slides: free along {direction} deg ({fit.slack_m:.2f} m)", scores)
        return Verification(self._calibrated(fit.relative, source, target), "depth agrees with the map", scores)

    def verify_near(self, source: Keyframe, target: Keyframe, guess: RelativePose) -> Verification:
        """Measure from where the map has the target: by depth and the features that the guess brings together, else by depth.

        Args:
            source, target: the keyframes.
            guess: the target in the source's frame as the map has it, and how far that may be off.
        """
        pairs = point_pairs(
            source,
            target,
            match(source.features, target.features, self._ratio),
            self._focal_px,
            self._registration.depth_sigma,
        )
        start = from_planar(guess.delta)
        reach_m = self._registration.keypoint_reach_m + GUESSED * loosest_direction(guess.covariance)[0]
        close = None if pairs is None else pairs.near(start, reach_m)
        if close is None or len(close) < self._pnp.min_inliers:
            return self.verify_on_map(source, target, guess)
        fit = register(source.surface, target.surface, start, guess, self._registration, close)
        agreeing = 0 if fit is None else close.agreeing(fit.T_fixed_moving)
        if fit is None or agreeing < self._pnp.min_inliers or fit.inliers < self._registration.min_inliers:
            return self.verify_on_map(source, target, guess)
        scores = {"inliers": float(agreeing), "depth_inliers": fit.inliers, "overlap": fit.overlap, "points": float(fit.points)}
        return Verification(self._calibrated(fit.relative, source, target), "features and depth agree with the map", scores)

    def _implausible(self, flat: FloorPose, reverse: FloorPose, held: bool, scores: dict[str, float]) -> str | None:
        """Why the two poses cannot be right, or None."""
        gap = between(flat.delta, reverse.delta)
        apart_m, apart_deg = float(np.hypot(gap[0], gap[1])), float(np.rad2deg(abs(gap[2])))
        tilt_deg = float(np.rad2deg(flat.tilt_rad))
        scores |= {"height_m": flat.height_m, "tilt_deg": tilt_deg, "reverse_m": apart_m, "reverse_deg": apart_deg}
        if abs(flat.height_m) > self._pnp.max_height_m * (3.0 if held else 1.0):
            return f"off the floor by {abs(flat.height_m):.2f} m"
        if tilt_deg > self._pnp.max_tilt_deg * (2.0 if held else 1.0):
            return f"tilted by {tilt_deg:.1f} deg"
        if apart_m > self._pnp.agree_m or apart_deg > self._pnp.agree_deg:
            return f"the two directions differ by {apart_m:.2f} m, {apart_deg:.1f} deg"
        return None

    def _refined(
        self,
        source: Keyframe,
        target: Keyframe,
        flat: FloorPose,
        first: NDArray[np.int64],
        second: NDArray[np.int64],
        scores: dict[str, float],
    ) -> Verification:
        pairs = point_pairs(source, target, Correspondences(first, second), self._focal_px, self._registration.depth_sigma)
        rough = RelativePose(flat.delta, np.diag([0.1, 0.1, np.deg2rad(3.0)]) ** 2)
        fit: Registration | None = None
        if self._pnp.refine:
            start = from_planar(flat.delta)
            fit = register(source.surface, target.surface, start, rough, self._registration, pairs)
        if fit is None:
            return self._features_alone(flat, len(first), scores)
        gap = between(flat.delta, fit.relative.delta)
        scores |= {"depth_inliers": fit.inliers, "depth_residual_m": fit.residual_m, "overlap": fit.overlap}
        if np.hypot(gap[0], gap[1]) > 3.0 * self._pnp.agree_m or abs(wrap_angle(gap[2])) > np.deg2rad(
            3.0 * self._pnp.agree_deg
        ):
            return Verification(None, "depth leads away from the features' pose", scores)
        if fit.inliers < self._registration.min_inliers:
            return Verification(None, f"only {fit.inliers:.0%} of the depth in common view fits", scores)
        return Verification(self._calibrated(fit.relative, source, target), "features and depth agree", scores)

    def _features_alone(self, flat: FloorPose, inliers: int, scores: dict[str, float]) -> Verification:
        """No depth to refine on or to object: many features must agree, and the edge is looser."""
        if inliers < self._pnp.min_inliers_alone:
            return Verification(None, f"only {inliers} features, and too little depth in common view", scores)
        sigma = 0.1 * np.sqrt(self._pnp.min_inliers_alone / inliers)
        loose = RelativePose(flat.delta, np.diag([sigma, sigma, np.deg2rad(1.5)]) ** 2)
        return Verification(loose, "features agree", scores)

    def _calibrated(self, relative: RelativePose, source: Keyframe, target: Keyframe) -> RelativePose:
        return self._level.applied(relative, *self._pnp.floors(source.held or target.held))


def _flat(T_source_target: Array, source: Keyframe, target: Keyframe) -> FloorPose:
    """Planar pose between the levelled bases; height and tilt as the stances had them."""
    raw = to_floor(T_source_target)
    level = level_pair(T_source_target, source.surface.stance, target.surface.stance)
    return FloorPose(level.delta, raw.height_m, raw.tilt_rad)


def _between_bases(T_source_target_cameras: Array, source: Keyframe, target: Keyframe) -> Array:
    """From the optical frames to the bases: pose (4, 4) of the target's base in the source's."""
    return np.asarray(source.surface.stance.T_base_camera @ T_source_target_cameras @ target.surface.T_camera_base)
