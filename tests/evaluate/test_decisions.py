"""Decisions against the settings that made them, and the story of nodes and instants."""

from __future__ import annotations

import json

import numpy as np
import pytest

from hybridmap.config import Config
from hybridmap.errors import EvaluationError, StoreError
from hybridmap.evaluate.checks import checks_of, otherwise
from hybridmap.evaluate.explain import Explainer
from hybridmap.geometry import RelativePose
from hybridmap.graph.edges import Edge, EdgeKind, Status
from hybridmap.session import run
from hybridmap.simulation import SimulatedStream
from tests.store.sessions import ring_map, write_session

SETTINGS = Config.load("rgbd").model_dump(mode="json")
MEASURED = RelativePose(np.zeros(3), np.eye(3))


def edge(status, reason, kind=EdgeKind.LOOP, **scores):
    return Edge(9, 2, kind, status, reason, MEASURED, scores)


def explained(of, held=False, settings=SETTINGS):
    checks = checks_of(of, settings, held)
    return {check.rule.figure: check.passed for check in checks}, otherwise(of, checks, settings)


def test_the_first_figure_that_missed_says_what_had_to_be_different():
    passed, needed = explained(edge(Status.REJECTED, "only 8", profile_G=0.3, matches=20.0, inliers=8.0))
    assert passed == {"matches": True, "inliers": False}
    assert needed == "inliers >= 12 instead of 8, or vision.rgbd.pnp.min_inliers at most 8"
    passed, needed = explained(edge(Status.REJECTED, "off the floor", matches=20.0, inliers=18.0, height_m=-0.25))
    assert passed["height_m"] is False
    assert needed == "height_m <= 0.1 instead of -0.25, or vision.rgbd.pnp.max_height_m at least 0.25"


def test_a_carried_camera_has_wider_limits():
    of = edge(Status.ACCEPTED, "fine", matches=20.0, inliers=18.0, height_m=-0.25)
    assert explained(of)[0]["height_m"] is False
    assert explained(of, held=True)[0]["height_m"] is True


def test_an_accepted_edge_says_what_would_have_refused_it():
    _, needed = explained(edge(Status.ACCEPTED, "agree", matches=60.0, inliers=13.0, tilt_deg=0.5))
    assert needed == "refused with vision.rgbd.pnp.min_inliers above 13 (now 12)"


def test_depth_alone_scans_and_steps_have_rules_of_their_own():
    by_depth = edge(Status.REJECTED, "slides", depth_inliers=0.9, overlap=0.5, points=200.0, slack_m=0.2)
    assert explained(by_depth)[1].startswith("slack_m <= 0.05 instead of 0.2")
    scans = edge(Status.REJECTED, "fit", near=0.9, fit=0.4, violation=0.0)
    assert explained(scans)[1].startswith("fit >= 0.7 instead of 0.4, or vision.laser.probes.fit_min")
    step = edge(Status.REJECTED, "only 20%", EdgeKind.REGISTRATION, inliers=0.2)
    assert "vision.rgbd.registration.min_inliers at most 0.2" in explained(step)[1]
    laser_step = edge(Status.REJECTED, "weak", EdgeKind.REGISTRATION, inliers=0.2, fit=0.9)
    assert "vision.laser.tracking.inliers_weak" in explained(laser_step)[1]


@pytest.mark.parametrize(
    ("reason", "said"),
    [
        ("no other edge supports it", "at most 12 away, agreeing to 0.15 m and 3 deg"),
        ("no cluster by the end", "3 probes that agree"),
        ("contradicts the cluster of 4 probes", "a cluster of its own"),
        ("contradicted by registration: x", "edges.drop_contradicted: false"),
        ("lost: waits for others that put the robot there", "over 0.75 m"),
        ("lost: waits for other submaps that put the robot there", "submaps of 4 nodes over 1.5 m"),
        ("too few other submaps put the robot there", "submaps of 4 nodes"),
        ("features and depth agree on 1.50 m, 3.0 deg from the map, 9.1 sigma of it", "a map that is less sure"),
        ("something nobody foresaw", ""),
    ],
)
def test_reasons_without_a_figure_say_what_was_missing(reason, said):
    assert said in explained(edge(Status.REJECTED, reason))[1]


def test_a_reason_that_is_no_figure_goes_before_figures_that_were_not_asked_for():
    far = edge(Status.REJECTED, "3.1 m, 2.0 deg from the expected pose: outside the gate", near=0.9, fit=0.9, loosest_m=9.0)
    assert "a wider gate: 2.5 sigma + 2.5 m" in explained(far)[1]


def test_settings_that_an_older_session_has_not_are_left_out():
    assert explained(edge(Status.REJECTED, "x", matches=2.0), settings={}) == ({}, "")


def test_the_story_of_a_node(tmp_path):
    write_session(tmp_path / "s", ring_map(false_loop=True))
    with Explainer(tmp_path / "s") as explainer:
        story = explainer.node(59)
        assert explainer.node(0).moved is None
    assert story.moved == pytest.approx((0.314, 9.5), abs=0.1)
    assert [decision.edge.target for decision in story.loops] == [19, 29, 3]
    assert [str(decision.edge.status) for decision in story.loops] == ["accepted", "rejected", "accepted"]
    assert story.loops[0].error == pytest.approx((0.01, 0.0), abs=1e-6)
    assert story.loops[1].error is None
    assert story.loops[2].error[0] > 1.0
    assert story.loops[0].weights == {"gtsam-lm": 1.0}
    assert story.nearest[0] == 19
    assert story.nearest[1] == pytest.approx(0.0, abs=1e-9)
    assert [decision.edge.kind for decision in story.chain] == [EdgeKind.ODOMETRY]
    assert story.no_loops == ""
    assert json.loads(json.dumps(story.to_json()))["loops"][1]["reason"] == "too few inliers"


def test_a_run_that_was_killed_and_figures_that_are_not_finite_are_told_too(tmp_path):
    experiences = ring_map(0.5)
    experiences.add_edge(edge(Status.REJECTED, "no figure", matches=float("nan"), slack_m=float("inf")))
    write_session(tmp_path / "s", experiences, solve=False)
    with Explainer(tmp_path / "s") as explainer:
        story = explainer.node(9)
    assert set(story.poses) == {"odometry"}
    assert story.nearest is None
    told = json.loads(json.dumps(story.to_json(), allow_nan=False))
    assert told["loops"][0]["scores"] == {"matches": None, "slack_m": None}


def test_the_story_of_an_instant(tmp_path):
    write_session(tmp_path / "s", ring_map())
    with Explainer(tmp_path / "s") as explainer:
        at_node, after = explainer.frame(12.0), explainer.frame(12.34)
        assert explainer.frame(0.0).reason == "first experience"
        assert explainer.frame(59.0).next_node is None
        for wrong in (75.0, -3.0, 1.7e9):
            with pytest.raises(EvaluationError, match=r"expected 0\.\.59\.400 s from the start"):
                explainer.frame(wrong)
        for wrong in (-1, 60):
            with pytest.raises(EvaluationError, match=r"expected one of 0\.\.59"):
                explainer.node(wrong)
    assert (at_node.made, at_node.at_node) == (True, 12)
    assert at_node.moved == pytest.approx((0.0, 0.0), abs=1e-9)
    assert (after.made, after.at_node, after.next_node, after.next_time_s) == (False, 12, 13, 13.0)
    assert after.time_s == pytest.approx(12.3)
    assert after.moved[0] == pytest.approx(0.094, abs=0.001)
    assert set(after.poses) == {"odometry", "gtsam-lm"}


def test_what_is_no_session_is_refused(tmp_path):
    with pytest.raises(StoreError, match="no such session folder"):
        Explainer(tmp_path / "gone")
    with pytest.raises(StoreError, match="holds no session"):
        Explainer(tmp_path)


def test_a_mapped_session_has_its_gates(tmp_path):
    small = {"simulation.duration_s": 26.0, "simulation.camera.rate_hz": 2.0, "backends.names": ["odometry"]}
    config = Config.load("lab", small | {"simulation.camera.width_px": 96, "simulation.camera.height_px": 72})
    done = run(SimulatedStream(config.simulation, 1), config, tmp_path / "s")
    with Explainer(done.folder.path) as explainer:
        last = explainer.node(int(next(m.value for m in done.metrics if m.name == "nodes")) - 1)
        first = explainer.node(0)
    assert last.gate.older > 3
    assert last.gate.radius_m >= config.vision.rgbd.closing.gate_m
    assert last.gate.inside >= len(last.ranked)
    assert (np.diff(last.ranked[:, 1]) >= 0).all()
    assert first.gate.older == 0
    assert "vision.rgbd.closing.min_age_s" in first.no_loops
