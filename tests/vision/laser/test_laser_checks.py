"""Each check that decides a laser's edges: a figure just beyond its limit fails by name."""

from __future__ import annotations

from collections.abc import Callable

import pytest

from hybridmap.graph.edges import Check
from hybridmap.vision.laser import checks

HAIR = 1e-6
RULES: dict[str, tuple[Callable[..., tuple[Check, ...]], dict[str, float]]] = {
    "step": (checks.of_step, {"inliers": checks.INLIERS_WEAK, "off_odometry_m": checks.TRANSLATION_MAX_M}),
    "way": (checks.of_way, {"odometry_sigma": checks.CONTRADICTION_SIGMAS, "violation": checks.WAY_VIOLATION}),
    "fit": (lambda **f: checks.of_fit(fit_min=0.7, **f), {"near": checks.NEAR_MIN, "fit": 0.7}),
    "gate": (lambda **f: checks.of_gate(radius_m=3.0, heading_deg=20.0, **f), {"off_m": 3.0, "off_deg": 20.0}),
    "place": (checks.of_place, {"loosest_m": checks.LOOSEST_MAX_M, "ambiguity": checks.AMBIGUITY_MAX}),
    "free space": (checks.of_free_space, {"violation": checks.VIOLATION_MAX}),
    "division": (lambda fit_elsewhere: checks.of_division(fit_elsewhere), {"fit_elsewhere": checks.FIT_ELSEWHERE_MAX}),
    "cluster": (
        lambda **f: checks.of_cluster(least=3, least_m=2.0, **f),
        {"probes": 3, "span_m": 2.0, "rival": checks.RIVAL},
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
    assert [check.figure for check in checks.of_step(checks.INLIERS_MIN, 9.0)] == ["inliers"]


def test_a_limit_of_a_share_moves_by_the_standard_error_of_so_few_things():
    asked = checks.of_fit(0.45, 0.65, 0.7) + checks.of_free_space(0.19) + checks.of_place(0.02, 0.3)
    few, many = checks.loosened(asked, 60), checks.loosened(asked, 6000)
    assert all(check.passed for check in few)
    assert [check.figure for check in many if not check.passed] == ["near", "fit", "violation"]
    assert [check.limit for check in few[3:]] == [checks.LOOSEST_MAX_M, checks.AMBIGUITY_MAX]
    assert checks.loosened(asked, 0) == checks.loosened(asked, checks.PIECES_MIN - 1) == asked


def test_a_loop_is_unexpected_if_the_gate_alone_refuses_it():
    gate, place = checks.of_gate(4.0, 1.0, 3.0, 20.0), checks.of_place(0.05, 2.0)
    assert checks.unexpected([check for check in gate if not check.passed])
    assert not checks.unexpected([check for check in (*gate, *place) if not check.passed])
