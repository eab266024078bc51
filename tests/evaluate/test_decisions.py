"""The story of nodes and instants."""

from __future__ import annotations

import json

import numpy as np
import pytest

from hybridmap.config import Config
from hybridmap.errors import EvaluationError, StoreError
from hybridmap.evaluate.explain import Explainer
from hybridmap.graph.edges import Edge, EdgeKind, at_most
from hybridmap.session import run
from hybridmap.simulation import SimulatedStream
from hybridmap.vision.gating import MIN_AGE_S
from tests.narrowing import known
from tests.store.sessions import ring_map, write_session


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
    assert known(story.loops[2].error)[0] > 1.0
    assert story.loops[0].weights == {"gtsam-lm": 1.0}
    node, distance_m, _ = known(story.nearest)
    assert node == 19
    assert distance_m == pytest.approx(0.0, abs=1e-9)
    assert [decision.edge.kind for decision in story.chain] == [EdgeKind.ODOMETRY]
    assert story.no_loops == ""
    assert json.loads(json.dumps(story.to_json()))["loops"][1]["checks"][0]["passed"] is False


def test_a_run_that_was_killed_and_figures_that_are_not_finite_are_told_too(tmp_path):
    experiences = ring_map(0.5)
    asked = [at_most("slack_m", float("inf"), 0.05)]
    experiences.add_edge(Edge.decided(9, 2, EdgeKind.LOOP, None, asked, figures={"matches": float("nan")}))
    write_session(tmp_path / "s", experiences, solve=False)
    with Explainer(tmp_path / "s") as explainer:
        story = explainer.node(9)
    assert set(story.poses) == {"odometry"}
    assert story.nearest is None
    told = json.loads(json.dumps(story.to_json(), allow_nan=False))
    assert told["loops"][0]["figures"] == {"matches": None}
    assert told["loops"][0]["checks"][0]["value"] is None


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
        first, second = explainer.node(0), explainer.node(1)
    gate = known(last.gate)
    assert gate.older > 3
    assert gate.radius_m >= config.vision.rgbd.closing.gate_m
    assert gate.inside >= len(last.ranked)
    assert (np.diff(last.ranked[:, 1]) >= 0).all()
    assert known(first.gate).older == 0
    assert first.no_loops == "it is the first node"
    assert second.no_loops == f"no node was old enough: {MIN_AGE_S:g} s"
