"""The record of a decision: its verdict, its reason in words and what would have had to be different."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from hybridmap.geometry import RelativePose
from hybridmap.graph.edges import (
    Check,
    Edge,
    EdgeKind,
    Lack,
    Method,
    Need,
    Search,
    Status,
    at_least,
    at_most,
)

MEASURED = RelativePose(np.zeros(3), np.eye(3))
CHECKS = st.builds(
    Check,
    st.sampled_from(["near", "off_m"]),
    st.floats(-9, 9) | st.just(float("nan")),
    st.sampled_from(Need),
    st.floats(-9, 9),
    st.none() | st.just("vision.x"),
)


def edge(*checks, **more):
    return Edge.decided(9, 2, EdgeKind.LOOP, MEASURED, checks, **more)


@pytest.mark.parametrize(
    ("check", "passed"),
    [
        (at_least("near", 0.5, 0.5), True),
        (at_least("near", 0.49, 0.5), False),
        (at_most("off_m", 1.0, 1.0), True),
        (at_most("off_m", 1.01, 1.0), False),
        (at_least("near", float("nan"), 0.5), False),
        (at_most("off_m", float("nan"), 1.0), False),
    ],
)
def test_a_check_holds_its_figure_against_its_limit(check, passed):
    assert check.passed is passed
    assert (check.slack >= 0) is passed


@given(st.lists(CHECKS, max_size=4), st.none() | st.sampled_from(Lack))
def test_the_status_follows_from_the_record(checks, lack):
    decided = edge(*checks, lack=lack)
    assert (decided.status is Status.ACCEPTED) == (lack is None and not decided.failed)
    assert (decided.status is Status.PENDING) == (lack is Lack.WAITING and not decided.failed)
    assert decided.reason
    assert bool(decided.otherwise) == bool(checks or lack)


@given(st.lists(CHECKS, max_size=3), st.lists(CHECKS, max_size=3), st.none() | st.sampled_from(Lack))
def test_settling_adds_to_the_record(before, more, lack):
    settled = edge(*before, lack=Lack.WAITING).settled(*more, lack=lack)
    assert settled.checks == (*before, *more) or any(np.isnan(c.value) for c in (*before, *more))
    assert settled.status is edge(*before, *more, lack=lack).status


INLIERS, GATE = "vision.rgbd.pnp.min_inliers", "vision.closing.gate_sigmas"


def test_a_missed_check_says_what_had_to_be_different():
    missed = edge(at_least("matches", 20, 12, GATE), at_least("feature_inliers", 8, 12, INLIERS))
    assert missed.otherwise == f"feature_inliers >= 12 instead of 8, or {INLIERS} at most 8"
    assert missed.reason == "feature_inliers 8 < 12"
    assert edge(at_most("off_m", 3.0, 1.0)).otherwise == "off_m <= 1 instead of 3"


def test_all_checks_that_were_missed_are_named():
    missed = edge(at_most("off_m", 3.0, 1.0), at_least("near", 0.7, 0.5), at_least("feature_inliers", 8, 12, INLIERS))
    assert missed.otherwise == f"off_m <= 1 instead of 3; and feature_inliers >= 12 instead of 8, or {INLIERS} at most 8"


def test_a_value_that_the_setting_cannot_have_is_not_advised():
    assert edge(at_least("feature_inliers", 1, 12, INLIERS)).otherwise == "feature_inliers >= 12 instead of 1"
    assert edge(at_most("off_m", float("nan"), 1.0, GATE)).otherwise == "off_m <= 1 instead of nan"


def test_an_accepted_edge_says_what_would_have_refused_it():
    accepted = edge(at_least("matches", 60, 12, GATE), at_least("feature_inliers", 13, 12, INLIERS))
    assert accepted.otherwise == f"refused with {INLIERS} above 13 (now 12)"


@pytest.mark.parametrize("lack", Lack)
def test_every_lack_says_what_it_is_and_what_was_needed(lack):
    lacking = edge(at_least("near", 0.9, 0.5), lack=lack)
    assert lacking.reason.startswith(lack.words)
    assert lacking.otherwise == lack.needed


def test_the_reason_says_how_an_edge_was_found_and_measured():
    assert edge(method=Method.SCANS, search=Search.WHOLE_MAP).reason == "scans agree; found on the whole map"
    assert all(method.words for method in Method)
    assert "kidnapped" in edge(kidnapped_m=5.0).reason
    assert "violation 0.4 > 0.13" in edge(broken_by=(at_most("violation", 0.4, 0.13),)).reason
