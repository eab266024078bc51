"""Each check that decides a camera's edges: a figure just beyond its limit fails by name."""

from __future__ import annotations

import pytest

from hybridmap.config.rgbd import PnpConfig, RegistrationConfig, RgbdClosingConfig
from hybridmap.vision.rgbd import checks

PNP, REGISTRATION, CLOSING = PnpConfig(), RegistrationConfig(), RgbdClosingConfig()
HAIR = 1e-6
PLANE = {"height_m": PNP.max_height_m, "tilt_deg": PNP.max_tilt_deg, "reverse_m": PNP.agree_m, "reverse_deg": PNP.agree_deg}
RULES = {
    "step": (
        lambda **f: checks.of_step(slack_m=0.0, c=REGISTRATION, **f),
        {"depth_inliers": REGISTRATION.min_inliers, "odometry_sigma": REGISTRATION.contradiction_sigma},
    ),
    "depth": (lambda **f: checks.of_depth(c=REGISTRATION, **f), {"depth_inliers": REGISTRATION.min_inliers}),
    "profile": (lambda **f: checks.of_profile(c_t=0.4, **f), {"profile_G": 0.4}),
    "matches": (lambda **f: checks.of_matches(c=PNP, **f), {"matches": PNP.min_inliers}),
    "pose": (lambda **f: checks.of_pose(c=PNP, **f), {"feature_inliers": PNP.min_inliers}),
    "reverse pose": (lambda **f: checks.of_reverse_pose(c=PNP, **f), {"feature_inliers_reverse": PNP.min_inliers}),
    "plane": (lambda **f: checks.of_plane(held=False, c=PNP, **f), PLANE),
    "plane, held": (
        lambda **f: checks.of_plane(held=True, c=PNP, **f),
        PLANE | {"height_m": 3.0 * PNP.max_height_m, "tilt_deg": 2.0 * PNP.max_tilt_deg},
    ),
    "refinement": (
        lambda off_features_m, off_features_deg, depth_inliers: checks.of_refinement(
            off_features_m, off_features_deg, depth_inliers, PNP, REGISTRATION
        ),
        {
            "off_features_m": 3.0 * PNP.agree_m,
            "off_features_deg": 3.0 * PNP.agree_deg,
            "depth_inliers": REGISTRATION.min_inliers,
        },
    ),
    "features alone": (lambda **f: checks.of_features_alone(c=PNP, **f), {"feature_inliers_both": PNP.min_inliers_alone}),
    "depth alone": (
        lambda **f: checks.of_depth_alone(c=PNP, **f),
        {
            "depth_inliers": PNP.map_inliers,
            "overlap": PNP.map_overlap,
            "points": PNP.map_points,
            "slack_m": PNP.map_sigma_m,
        },
    ),
    "map": (lambda **f: checks.of_map(**f), {"map_sigma": checks.PLAUSIBLE_SIGMA}),
    "support": (lambda **f: checks.of_support(c=CLOSING, **f), {"supporting": 1}),
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
    sure = checks.of_step(0.9, 0.01, 99.0, REGISTRATION)
    assert [check.figure for check in sure] == ["depth_inliers"]
    for inliers, slack_m in ((checks.SURE_INLIERS, 0.01), (0.9, checks.SURE_SLACK_M)):
        assert not checks.of_step(inliers, slack_m, 99.0, REGISTRATION)[-1].passed


def test_no_support_is_asked_where_none_is_configured():
    assert all(check.passed for check in checks.of_support(0, RgbdClosingConfig(support_nodes=0)))
