"""Verification of a loop candidate: PnP by features in both directions, planarity, then a joint refinement with depth."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray

from hybridmap.geometry import Array, RelativePose, between, loosest_direction, wrap_angle
from hybridmap.graph.edges import Check, Edge, EdgeKind, Lack, Method, Proposer, Search, passed
from hybridmap.streams.rgbd import Camera
from hybridmap.vision.rgbd import checks
from hybridmap.vision.rgbd.depth_registration import register
from hybridmap.vision.rgbd.features import Correspondences, Features, match
from hybridmap.vision.rgbd.keyframe import Keyframe
from hybridmap.vision.rgbd.noise_level import NoiseLevel
from hybridmap.vision.rgbd.pairs import point_pairs
from hybridmap.vision.rgbd.stance import FloorPose, from_planar, inverse_rigid, level_pair, to_floor

ITERATIONS = 200
"""RANSAC draws at most: enough for 30 % of inliers with certainty of 99 %."""
REPROJECTION_PX = 3.0
"""An inlier's largest reprojection error, pixels at the working width."""


@dataclass(frozen=True, slots=True)
class Pnp:
    """A pose estimated by PnP and its inliers.

    Attributes:
        T_image_points: (4, 4) the camera that gave the points, seen from the camera that gave the image (optical frames).
        inliers: indices into the matches, of those that agree with the pose.
    """

    T_image_points: Array
    inliers: NDArray[np.int64]


class PnpSolver:
    """PnP-RANSAC for one camera.

    Args:
        camera: pinhole at the working width.
        min_inliers: least number of matches to try.
        seed: seed of RANSAC, set again in every call: equal calls give equal results.
    """

    def __init__(self, camera: Camera, min_inliers: int, seed: int) -> None:
        self._matrix = np.array([[camera.fx_px, 0, camera.cx_px], [0, camera.fy_px, camera.cy_px], [0, 0, 1.0]])
        self._min_inliers = min_inliers
        self._seed = seed % 2**31

    def solve(self, points: Features, image: Features, of_points: NDArray[np.int64], of_image: NDArray[np.int64]) -> Pnp | None:
        """Estimate the pose between two keyframes from the points of one and the image of the other.

        Args:
            points, image: features of the two keyframes.
            of_points, of_image: (M,) indices of matching keypoints in either.

        Returns:
            None if there are fewer than `min_inliers` matches, or if fewer than four agree. The inliers of a pose may be fewer
            than `min_inliers`.
        """
        import cv2

        if len(of_points) < self._min_inliers:
            return None
        space, pixels = points.points[of_points], image.pixels[of_image]
        cv2.setRNGSeed(self._seed)
        ok, rotation, translation, inliers = cv2.solvePnPRansac(
            space,
            pixels,
            self._matrix,
            None,
            iterationsCount=ITERATIONS,
            reprojectionError=REPROJECTION_PX,
            confidence=0.999,
            flags=cv2.SOLVEPNP_AP3P,
        )
        if not ok or inliers is None or len(inliers) < 4:
            return None
        kept = inliers.ravel()
        rotation, translation = cv2.solvePnPRefineLM(space[kept], pixels[kept], self._matrix, None, rotation, translation)
        T = np.eye(4)
        T[:3, :3] = cv2.Rodrigues(rotation)[0]
        T[:3, 3] = np.ravel(translation)
        return Pnp(T, kept.astype(np.int64))


FLOORS, HELD_FLOORS = (0.0001, 0.005), (0.01, 0.2)
"""Least standard deviations of a loop edge, m and degrees: of a mounted camera, and of one whose tilt comes from the floor."""
KEYPOINT_REACH_M = 0.3
"""Largest distance of matched keypoints at a guess, beside the error of the guess, m."""
ROUGH_M, ROUGH_DEG = 0.1, 3.0
"""Standard deviations of a pose by features as prior of its refinement, m and degrees."""
ALONE_M, ALONE_DEG = 0.1, 1.5
"""Standard deviations of an edge by the least number of features alone, m and degrees."""
GUESSED = 2.0
"""Factor on the standard deviation of a guess within which features are matched."""


@dataclass(frozen=True, slots=True)
class Candidate:
    """Why two views are compared as a possible loop.

    Attributes:
        search: by which search the pair was found.
        proposed_by: what proposed it first.
        shift: columns of the profile, positive when things lie farther right in the newer view than in the older one.
        figures: values measured by the search, by name.
    """

    search: Search
    proposed_by: Proposer | None
    shift: int = 0
    figures: Mapping[str, float] = field(default_factory=dict)


@dataclass(frozen=True, slots=True)
class Verification:
    """Result of comparing two keyframes: the pose of the target in the source's frame, and why it is accepted or not.

    Attributes:
        relative: the pose; None if a check failed or something else was lacking.
        method: what the pose was measured by, or would have been.
        checks: the checks, in the order in which they were made.
        lack: what was lacking beside checks; None if nothing was.
        figures: further measured values, by name.
    """

    relative: RelativePose | None
    method: Method
    checks: tuple[Check, ...] = ()
    lack: Lack | None = None
    figures: Mapping[str, float] = field(default_factory=dict)

    def proposed(self, source: int, target: int, key: int, candidate: Candidate, lack: Lack | None = None) -> Edge:
        """Make the edge from source to target, under a key; `lack` says why it is not accepted even if all checks passed."""
        return Edge.decided(
            source,
            target,
            EdgeKind.LOOP,
            self.relative,
            self.checks,
            lack if self.relative is not None else self.lack,
            method=self.method,
            search=candidate.search,
            proposed_by=candidate.proposed_by,
            shift=candidate.shift,
            figures={**candidate.figures, **self.figures},
            key=key,
        )


class Verifier:
    """Measures the relative pose of two keyframes of one camera, with checks; the keyframes are not changed.

    Args:
        camera: pinhole at the working width.
        min_inliers: least number of features that agree.
        depth_sigma: noise of depth at 1 m, m.
        level: factor on the covariances of registrations.
        seed: seed of RANSAC.

    Attributes:
        solver: estimates poses from features alone.
    """

    def __init__(
        self,
        camera: Camera,
        min_inliers: int,
        depth_sigma: float,
        level: NoiseLevel,
        seed: int,
    ) -> None:
        self.solver = PnpSolver(camera, min_inliers, seed)
        self._focal_px = 0.5 * (camera.fx_px + camera.fy_px)
        self._min_inliers, self._depth_sigma = min_inliers, depth_sigma
        self._level = level

    def verify(self, source: Keyframe, target: Keyframe) -> Verification:
        """Measure the target's pose in the source's frame: by features, refined by depth where enough is in common view."""
        pairs = match(source.features, target.features)
        asked = checks.of_matches(len(pairs.first), self._min_inliers)
        if not passed(asked):
            return Verification(None, Method.FEATURES, asked)
        forward = self.solver.solve(target.features, source.features, pairs.second, pairs.first)
        asked += checks.of_pose(len(forward.inliers) if forward else 0, self._min_inliers)
        if forward is None or not passed(asked):
            return Verification(None, Method.FEATURES, asked)
        backward = self.solver.solve(source.features, target.features, pairs.first, pairs.second)
        asked += checks.of_reverse_pose(len(backward.inliers) if backward else 0, self._min_inliers)
        if backward is None or not passed(asked):
            return Verification(None, Method.FEATURES, asked)
        T = _between_bases(forward.T_image_points, source, target)
        T_reverse = _between_bases(inverse_rigid(backward.T_image_points), source, target)
        flat, reverse = _flat(T, source, target), _flat(T_reverse, source, target)
        asked += self._plane(flat, reverse, source.held or target.held)
        if not passed(asked):
            return Verification(None, Method.FEATURES, asked)
        both = np.intersect1d(forward.inliers, backward.inliers)
        return self._refined(source, target, flat, pairs.first[both], pairs.second[both], asked)

    def verify_on_map(self, source: Keyframe, target: Keyframe, guess: RelativePose) -> Verification:
        """Measure the target's pose by depth alone, from the map's pose: for views that share surfaces but no features.

        Args:
            source, target: the keyframes.
            guess: the target in the source's frame on the map, with its covariance.
        """
        fit = register(source.surface, target.surface, from_planar(guess.delta), guess)
        if fit is None:
            return Verification(None, Method.DEPTH, lack=Lack.NO_DEPTH)
        asked = checks.of_depth_alone(fit.inliers, fit.overlap, fit.points, fit.slack_m)
        if not passed(asked):
            return Verification(None, Method.DEPTH, asked)
        return Verification(self._calibrated(fit.relative, source, target), Method.DEPTH, asked)

    def verify_near(self, source: Keyframe, target: Keyframe, guess: RelativePose) -> Verification:
        """Measure the target's pose from the map's pose: by depth and the features that match there, else by depth alone.

        Args:
            source, target: the keyframes.
            guess: the target in the source's frame on the map, with its covariance.
        """
        pairs = point_pairs(
            source,
            target,
            match(source.features, target.features),
            self._focal_px,
            self._depth_sigma,
        )
        start = from_planar(guess.delta)
        reach_m = KEYPOINT_REACH_M + GUESSED * loosest_direction(guess.covariance)[0]
        close = None if pairs is None else pairs.near(start, reach_m)
        if close is None or len(close) < self._min_inliers:
            return self.verify_on_map(source, target, guess)
        fit = register(source.surface, target.surface, start, guess, close)
        if fit is None:
            return self.verify_on_map(source, target, guess)
        asked = checks.of_pose(close.agreeing(fit.T_fixed_moving), self._min_inliers)
        asked += checks.of_depth(fit.inliers)
        if not passed(asked):
            return self.verify_on_map(source, target, guess)
        figures = {"overlap": fit.overlap, "points": float(fit.points)}
        relative = self._calibrated(fit.relative, source, target)
        return Verification(relative, Method.FEATURES_AND_DEPTH, asked, figures=figures)

    def _plane(self, flat: FloorPose, reverse: FloorPose, held: bool) -> tuple[Check, ...]:
        """Checks of the poses in both directions."""
        gap = between(flat.delta, reverse.delta)
        apart_m, apart_deg = float(np.hypot(gap[0], gap[1])), float(np.rad2deg(abs(gap[2])))
        tilt_deg = float(np.rad2deg(flat.tilt_rad))
        return checks.of_plane(abs(flat.height_m), tilt_deg, apart_m, apart_deg, held)

    def _refined(
        self,
        source: Keyframe,
        target: Keyframe,
        flat: FloorPose,
        first: NDArray[np.int64],
        second: NDArray[np.int64],
        asked: tuple[Check, ...],
    ) -> Verification:
        pairs = point_pairs(source, target, Correspondences(first, second), self._focal_px, self._depth_sigma)
        rough = RelativePose(flat.delta, np.diag([ROUGH_M, ROUGH_M, np.deg2rad(ROUGH_DEG)]) ** 2)
        fit = register(source.surface, target.surface, from_planar(flat.delta), rough, pairs)
        if fit is None:
            return self._features_alone(flat, len(first), asked)
        gap = between(flat.delta, fit.relative.delta)
        off_m, off_deg = float(np.hypot(gap[0], gap[1])), float(np.rad2deg(abs(wrap_angle(gap[2]))))
        asked += checks.of_refinement(off_m, off_deg, fit.inliers)
        relative = self._calibrated(fit.relative, source, target) if passed(asked) else None
        figures = {"depth_residual_m": fit.residual_m, "overlap": fit.overlap}
        return Verification(relative, Method.FEATURES_AND_DEPTH, asked, figures=figures)

    def _features_alone(self, flat: FloorPose, inliers: int, asked: tuple[Check, ...]) -> Verification:
        """Without depth in common view: more features must agree, and the edge is looser."""
        asked += checks.of_features_alone(inliers)
        if not passed(asked):
            return Verification(None, Method.FEATURES, asked)
        sigma = ALONE_M * np.sqrt(checks.MIN_INLIERS_ALONE / inliers)
        loose = RelativePose(flat.delta, np.diag([sigma, sigma, np.deg2rad(ALONE_DEG)]) ** 2)
        return Verification(loose, Method.FEATURES, asked)

    def _calibrated(self, relative: RelativePose, source: Keyframe, target: Keyframe) -> RelativePose:
        return self._level.applied(relative, *(HELD_FLOORS if source.held or target.held else FLOORS))


def _flat(T_source_target: Array, source: Keyframe, target: Keyframe) -> FloorPose:
    """Planar pose between the levelled bases; height and tilt before levelling."""
    raw = to_floor(T_source_target)
    level = level_pair(T_source_target, source.surface.stance, target.surface.stance)
    return FloorPose(level.delta, raw.height_m, raw.tilt_rad)


def _between_bases(T_source_target_cameras: Array, source: Keyframe, target: Keyframe) -> Array:
    """From the optical frames to the bases: pose (4, 4) of the target's base in the source's."""
    return np.asarray(source.surface.stance.T_base_camera @ T_source_target_cameras @ target.surface.T_camera_base)
