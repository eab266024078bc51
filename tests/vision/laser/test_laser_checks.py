"""Each check that decides a laser's edges: a figure just beyond its limit fails by name."""

from __future__ import annotations

import pytest

from hybridmap.config.laser import CommitmentConfig, LaserRelocalisingConfig, ProbeConfig, TrackingConfig
from hybridmap.vision.laser import checks

TRACKING, PROBES, COMMITMENT, LOST = TrackingConfig(), ProbeConfig(), CommitmentConfig(), LaserRelocalisingConfig()
HAIR = 1e-6
RULES = {
    "step": (lambda **f: checks.of_step(c=TRACKING, **f), {"inliers": TRACKING.inliers_weak, "off_odometry_m": 0.4}),
    "way": (lambda **f: checks.of_way(c=LOST, **f), {"odometry_sigma": LOST.contradiction_sigmas, "violation": LOST.violation}),
    "fit": (lambda **f: checks.of_fit(c=PROBES, **f), {"near": PROBES.near_min, "fit": PROBES.fit_min}),
    "gate": (lambda **f: checks.of_gate(radius_m=3.0, heading_deg=20.0, **f), {"off_m": 3.0, "off_deg": 20.0}),
    "place": (
        lambda **f: checks.of_place(c=PROBES, **f),
        {"loosest_m": PROBES.loosest_max_m, "ambiguity": PROBES.ambiguity_max},
    ),
    "free space": (lambda **f: checks.of_free_space(c=PROBES, **f), {"violation": PROBES.violation_max}),
    "cluster": (
        lambda **f: checks.of_cluster(least=3, least_m=2.0, c=COMMITMENT, **f),
        {"probes": 3, "span_m": 2.0, "rival": COMMITMENT.rival},
    ),
}
ARGUMENT = {"off_odometry_m": "off_m"}
DOWN = {"inliers", "near", "fit", "probes", "span_m"}


def failed(rule, **beyond):
    ask, limits = RULES[rule]
    asked = ask(**{ARGUMENT.get(figure, figure): beyond.get(figure, limit) for figure, limit in limits.items()})
    assert {check.figure for check in asked} == set(limits)
    return [check.figure for check in asked if not check.passed]


@pytest.mark.parametrize("rule", RULES)
def test_figures_at_their_limits_pass(rule):
    assert failed(rule) == []


@pytest.mark.parametrize(("rule", "figure"), [(rule, figure) for rule, (_, limits) in RULES.items() for figure in limits])
def test_a_figure_just_beyond_its_limit_fails_by_name(rule, figure):
    limit = RULES[rule][1][figure]
    assert failed(rule, **{figure: limit - HAIR if figure in DOWN else limit + HAIR}) == [figure]


def test_a_good_registration_may_lie_far_from_the_odometry():
    assert [check.figure for check in checks.of_step(TRACKING.inliers_min, 9.0, TRACKING)] == ["inliers"]
