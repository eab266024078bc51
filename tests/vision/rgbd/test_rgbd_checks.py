"""Each check that decides a camera's edges: a figure just beyond its limit fails by name."""

from __future__ import annotations

from collections.abc import Callable

import pytest

from hybridmap.graph.edges import Check
from hybridmap.vision.rgbd import checks

HAIR = 1e-6
LEAST = 12
PLANE = {
    "height_m": checks.MAX_HEIGHT_M,
    "tilt_deg": checks.MAX_TILT_DEG,
    "reverse_m": checks.REVERSE_M,
    "reverse_deg": checks.REVERSE_DEG,
}
RULES: dict[str, tuple[Callable[..., tuple[Check, ...]], dict[str, float]]] = {
    "step": (
        lambda **f: checks.of_step(slack_m=0.0, **f),
        {"depth_inliers": checks.DEPTH_INLIERS_MIN, "odometry_sigma": checks.CONTRADICTION_SIGMA},
    ),
    "depth": (checks.of_depth, {"depth_inliers": checks.DEPTH_INLIERS_MIN}),
    "profile": (lambda **f: checks.of_profile(c_t=0.4, **f), {"profile_G": 0.4}),
    "matches": (lambda **f: checks.of_matches(least=LEAST, **f), {"matches": LEAST}),
    "pose": (lambda **f: checks.of_pose(least=LEAST, **f), {"feature_inliers": LEAST}),
    "reverse pose": (lambda **f: checks.of_reverse_pose(least=LEAST, **f), {"feature_inliers_reverse": LEAST}),
    "plane": (lambda **f: checks.of_plane(held=False, **f), PLANE),
    "plane, held": (
        lambda **f: checks.of_plane(held=True, **f),
        PLANE | {"height_m": 3.0 * checks.MAX_HEIGHT_M, "tilt_deg": 2.0 * checks.MAX_TILT_DEG},
    ),
    "refinement": (
        lambda off_features_m, off_features_deg, depth_inliers: checks.of_refinement(
            off_features_m, off_features_deg, depth_inliers
        ),
        {
            "off_features_m": 3.0 * checks.REVERSE_M,
            "off_features_deg": 3.0 * checks.REVERSE_DEG,
            "depth_inliers": checks.DEPTH_INLIERS_MIN,
        },
    ),
    "features alone": (checks.of_features_alone, {"feature_inliers_both": checks.MIN_INLIERS_ALONE}),
    "depth alone": (
        checks.of_depth_alone,
        {
            "depth_inliers": checks.MAP_INLIERS,
            "overlap": checks.MAP_OVERLAP,
            "points": checks.MAP_POINTS,
            "slack_m": checks.MAP_SIGMA_M,
        },
    ),
    "map": (checks.of_map, {"map_sigma": checks.PLAUSIBLE_SIGMA}),
    "support": (checks.of_support, {"supporting": 1}),
}
DOWN = {
    *("depth_inliers", "matches", "feature_inliers", "feature_inliers_reverse", "feature_inliers_both"),
    *("overlap", "points", "supporting"),
}


def failed(rule, **beyond):
    ask, limits = RULES[rule]
    asked = ask(**(limits | beyond))
    assert [check.figure for check in asked] == list(limits)
    return [check.figure for check in asked if not check.passed]


@pytest.mark.parametrize("rule", RULES)
def test_figures_at_their_limits_pass(rule):
    assert failed(rule) == []


@pytest.mark.parametrize(("rule", "figure"), [(rule, figure) for rule, (_, limits) in RULES.items() for figure in limits])
def test_a_figure_just_beyond_its_limit_fails_by_name(rule, figure):
    limit = RULES[rule][1][figure]
    assert failed(rule, **{figure: limit - HAIR if figure in DOWN else limit + HAIR}) == [figure]


def test_a_sure_registration_may_contradict_the_odometry():
    sure = checks.of_step(0.9, 0.01, 99.0)
    assert [check.figure for check in sure] == ["depth_inliers"]
    for inliers, slack_m in ((checks.SURE_INLIERS, 0.01), (0.9, checks.SURE_SLACK_M)):
        assert not checks.of_step(inliers, slack_m, 99.0)[-1].passed


def test_a_loop_is_unexpected_if_map_and_other_loops_alone_refuse_it():
    far, alone, misfit = checks.of_map(9.0), checks.of_support(0), checks.of_depth(0.1)
    assert checks.unexpected((*far, *alone))
    assert not checks.unexpected((*far, *misfit))
