"""What a camera's edges are decided by: every check of registrations, candidates and loops, each with its limit."""

from __future__ import annotations

from hybridmap.config.rgbd import PnpConfig, RegistrationConfig, RgbdClosingConfig
from hybridmap.graph.edges import Check, at_least, at_most

_REGISTRATION, _PNP, _CLOSING = "vision.rgbd.registration", "vision.rgbd.pnp", "vision.rgbd.closing"
SURE_INLIERS, SURE_SLACK_M = 0.8, 0.03
"""A registration may contradict odometry only where it fits better than this and is surer than this in every direction."""
HELD_HEIGHT, HELD_TILT = 3.0, 2.0
"""Factors on the limits of height and tilt where the camera's tilt was measured and not taken from the mounting."""
REFINED = 3.0
"""Depth may lead away from the features' pose by so many times what the two directions may differ."""
PLAUSIBLE_SIGMA = 16.3**0.5
"""Deviations of the map that one as sure as it says exceeds once in a thousand (3 degrees of freedom)."""


def of_step(depth_inliers: float, slack_m: float, odometry_sigma: float, c: RegistrationConfig) -> tuple[Check, ...]:
    """Of the registration of a new node: its inliers; one that is not sure may not contradict the odometry."""
    checks = of_depth(depth_inliers, c)
    if not (depth_inliers > SURE_INLIERS and slack_m < SURE_SLACK_M):
        limit = f"{_REGISTRATION}.contradiction_sigma"
        checks += (at_most("odometry_sigma", odometry_sigma, c.contradiction_sigma, limit),)
    return checks


def of_depth(depth_inliers: float, c: RegistrationConfig) -> tuple[Check, ...]:
    """Of a registration: the share of the depth in common view that fits."""
    return (at_least("depth_inliers", depth_inliers, c.min_inliers, f"{_REGISTRATION}.min_inliers"),)


def of_profile(profile_G: float, c_t: float) -> tuple[Check, ...]:
    """Of a candidate that nothing verifies: how much its scanline differs."""
    return (at_most("profile_G", profile_G, c_t, "vision.matching.c_t"),)


def of_matches(matches: int, c: PnpConfig) -> tuple[Check, ...]:
    """Of two views: how many features match."""
    return (at_least("matches", matches, c.min_inliers, f"{_PNP}.min_inliers"),)


def of_pose(feature_inliers: int, c: PnpConfig) -> tuple[Check, ...]:
    """Of a pose by features: how many of them agree on it."""
    return (at_least("feature_inliers", feature_inliers, c.min_inliers, f"{_PNP}.min_inliers"),)


def of_reverse_pose(feature_inliers_reverse: int, c: PnpConfig) -> tuple[Check, ...]:
    """The same the other way round."""
    return (at_least("feature_inliers_reverse", feature_inliers_reverse, c.min_inliers, f"{_PNP}.min_inliers"),)


def of_plane(
    height_m: float, tilt_deg: float, reverse_m: float, reverse_deg: float, held: bool, c: PnpConfig
) -> tuple[Check, ...]:
    """Of a pose by features: the robot stays on the floor, and both ways round give the same; `held`: the tilt is measured."""
    height, tilt = (HELD_HEIGHT, HELD_TILT) if held else (1.0, 1.0)
    return (
        at_most("height_m", height_m, c.max_height_m * height, f"{_PNP}.max_height_m"),
        at_most("tilt_deg", tilt_deg, c.max_tilt_deg * tilt, f"{_PNP}.max_tilt_deg"),
        at_most("reverse_m", reverse_m, c.agree_m, f"{_PNP}.agree_m"),
        at_most("reverse_deg", reverse_deg, c.agree_deg, f"{_PNP}.agree_deg"),
    )


def of_refinement(
    off_m: float, off_deg: float, depth_inliers: float, pnp: PnpConfig, c: RegistrationConfig
) -> tuple[Check, ...]:
    """Of depth registered from the features' pose: how far it leads away from it, and whether it fits."""
    return (
        at_most("off_features_m", off_m, REFINED * pnp.agree_m, f"{_PNP}.agree_m"),
        at_most("off_features_deg", off_deg, REFINED * pnp.agree_deg, f"{_PNP}.agree_deg"),
        *of_depth(depth_inliers, c),
    )


def of_features_alone(feature_inliers_both: int, c: PnpConfig) -> tuple[Check, ...]:
    """Of a pose by features that no depth can object to: more of them must agree, both ways round."""
    return (at_least("feature_inliers_both", feature_inliers_both, c.min_inliers_alone, f"{_PNP}.min_inliers_alone"),)


def of_depth_alone(depth_inliers: float, overlap: float, points: int, slack_m: float, c: PnpConfig) -> tuple[Check, ...]:
    """Of depth registered from where the map has the two views, without features."""
    return (
        at_least("depth_inliers", depth_inliers, c.map_inliers, f"{_PNP}.map_inliers"),
        at_least("overlap", overlap, c.map_overlap, f"{_PNP}.map_overlap"),
        at_least("points", points, c.map_points, f"{_PNP}.map_points"),
        at_most("slack_m", slack_m, c.map_sigma_m, f"{_PNP}.map_sigma_m"),
    )


def of_map(map_sigma: float) -> tuple[Check, ...]:
    """Of a loop that fits elsewhere than the map has it: whether the map may be that wrong."""
    return (at_most("map_sigma", map_sigma, PLAUSIBLE_SIGMA),)


def of_support(supporting: int, c: RgbdClosingConfig) -> tuple[Check, ...]:
    """Of a measured loop: another one near it must agree."""
    return (at_least("supporting", supporting, min(c.support_nodes, 1), f"{_CLOSING}.support_nodes"),)
