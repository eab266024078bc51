"""The checks that decide about edges of a camera, with their limits: registrations, candidates, loops."""

from __future__ import annotations

from collections.abc import Sequence

from hybridmap.graph.edges import Check, at_least, at_most

_MIN_INLIERS = "vision.rgbd.pnp.min_inliers"
DEPTH_INLIERS_MIN = 0.5
"""Least share of the points in common view that fit: half of a view may have changed."""
CONTRADICTION_SIGMA = 8.0
"""A good registration contradicts the odometry beyond so many standard deviations: slips do, drift does not."""
MIN_INLIERS_ALONE = 30
"""Fewest keypoints that agree where there is too little depth in common view to refine on."""
MAX_HEIGHT_M, MAX_TILT_DEG = 0.1, 3.0
"""The robot stays on the floor: largest change of height, m, and tilt, degrees."""
REVERSE_M, REVERSE_DEG = 0.1, 2.0
"""The two directions must give the same pose within this, m and degrees."""
MAP_INLIERS, MAP_OVERLAP, MAP_POINTS, MAP_SIGMA_M = 0.8, 0.35, 150, 0.05
"""By depth alone, from the map's guess: least share of the points in common view that fit, least share of a keyframe's points
that the other one sees, fewest matched points, largest standard deviation in the loosest direction, m. All are stricter than
with features: one wall fits any other."""
SURE_INLIERS, SURE_SLACK_M = 0.8, 0.03
"""A registration may contradict odometry only where it fits better than this and is surer than this in every direction."""
HELD_HEIGHT, HELD_TILT = 3.0, 2.0
"""Factors on the limits of height and tilt where the camera's tilt was measured and not taken from the mounting."""
REFINED = 3.0
"""Largest distance of depth's pose from the features', as a multiple of that between the two directions."""
PLAUSIBLE_SIGMA = 16.3**0.5
"""Mahalanobis distance from the map that is exceeded once in a thousand (3 degrees of freedom)."""


def of_step(depth_inliers: float, slack_m: float, odometry_sigma: float) -> tuple[Check, ...]:
    """Check the depth registration of a new node: share of inliers and, unless it is certain, distance from the odometry.

    Args:
        depth_inliers: measured share of the points in common view that fit, 0..1.
        slack_m: the registration's standard deviation in its loosest direction, m. The registration is certain, and the
            odometry is not asked, if this is below `SURE_SLACK_M` and `depth_inliers` is above `SURE_INLIERS`.
        odometry_sigma: distance of the registration from the odometry, in standard deviations.
    """
    checks = of_depth(depth_inliers)
    if not (depth_inliers > SURE_INLIERS and slack_m < SURE_SLACK_M):
        checks += (at_most("odometry_sigma", odometry_sigma, CONTRADICTION_SIGMA),)
    return checks


def of_depth(depth_inliers: float) -> tuple[Check, ...]:
    """Check that enough of the points in common view fit after depth registration; `depth_inliers` is their share."""
    return (at_least("depth_inliers", depth_inliers, DEPTH_INLIERS_MIN),)


def of_profile(profile_G: float, c_t: float) -> tuple[Check, ...]:
    """Check a loop that is accepted by profile alone: its score `profile_G` (eq. 13) is at most the threshold `c_t`."""
    return (at_most("profile_G", profile_G, c_t, "vision.matching.c_t"),)


def of_matches(matches: int, least: int) -> tuple[Check, ...]:
    """Check that the number of matching features of two views (`matches`) is at least `least`."""
    return (at_least("matches", matches, least, _MIN_INLIERS),)


def of_pose(feature_inliers: int, least: int) -> tuple[Check, ...]:
    """Check that the pose of the target in the source, estimated from features, has at least `least` inliers."""
    return (at_least("feature_inliers", feature_inliers, least, _MIN_INLIERS),)


def of_reverse_pose(feature_inliers_reverse: int, least: int) -> tuple[Check, ...]:
    """Check that the pose of the source in the target, estimated from features, has at least `least` inliers."""
    return (at_least("feature_inliers_reverse", feature_inliers_reverse, least, _MIN_INLIERS),)


def of_plane(height_m: float, tilt_deg: float, reverse_m: float, reverse_deg: float, held: bool) -> tuple[Check, ...]:
    """Check that a pose from features is planar, and agrees with the pose estimated in the reverse direction.

    Args:
        height_m, tilt_deg: measured height (absolute) and tilt of the pose, which should be 0.
        reverse_m, reverse_deg: measured difference of the poses in the two directions.
        held: the camera's tilt was measured and not taken from the mounting; then the limits are wider.
    """
    height, tilt = (HELD_HEIGHT, HELD_TILT) if held else (1.0, 1.0)
    return (
        at_most("height_m", height_m, MAX_HEIGHT_M * height),
        at_most("tilt_deg", tilt_deg, MAX_TILT_DEG * tilt),
        at_most("reverse_m", reverse_m, REVERSE_M),
        at_most("reverse_deg", reverse_deg, REVERSE_DEG),
    )


def of_refinement(off_m: float, off_deg: float, depth_inliers: float) -> tuple[Check, ...]:
    """Check a depth registration that started from a pose by features.

    Args:
        off_m, off_deg: its measured distance from that pose.
        depth_inliers: measured share of the points in common view that fit, 0..1.
    """
    return (
        at_most("off_features_m", off_m, REFINED * REVERSE_M),
        at_most("off_features_deg", off_deg, REFINED * REVERSE_DEG),
        *of_depth(depth_inliers),
    )


def of_features_alone(feature_inliers_both: int) -> tuple[Check, ...]:
    """Check a pose from features where depth cannot confirm it: it needs more features.

    `feature_inliers_both` is the number of those that are inliers in both directions.
    """
    return (at_least("feature_inliers_both", feature_inliers_both, MIN_INLIERS_ALONE),)


def of_depth_alone(depth_inliers: float, overlap: float, points: int, slack_m: float) -> tuple[Check, ...]:
    """Check a depth registration that started from the map's pose and has no features to confirm it.

    Args:
        depth_inliers: measured share of the points in common view that fit, 0..1.
        overlap: measured share of the points that are in the other frame's view, 0..1.
        points: number of matched points.
        slack_m: standard deviation in the loosest direction, m, see `Registration`.
    """
    return (
        at_least("depth_inliers", depth_inliers, MAP_INLIERS),
        at_least("overlap", overlap, MAP_OVERLAP),
        at_least("points", points, MAP_POINTS),
        at_most("slack_m", slack_m, MAP_SIGMA_M),
    )


def of_map(map_sigma: float) -> tuple[Check, ...]:
    """Check that a loop differs from the map's relative pose by no more than the covariances of both allow.

    `map_sigma` is the measured difference, standard deviations (Mahalanobis distance).
    """
    return (at_most("map_sigma", map_sigma, PLAUSIBLE_SIGMA),)


def of_support(supporting: int) -> tuple[Check, ...]:
    """Check that at least one other measured loop nearby agrees with a loop; `supporting` is their number."""
    return (at_least("supporting", supporting, 1),)


def unexpected(failed: Sequence[Check]) -> bool:
    """Whether all failed checks are of what the map and other loops say: the views fit, but not where the map expected it."""
    return all(check.figure in ("map_sigma", "supporting") for check in failed)
