"""Re-anchoring: the cells go back to a stored activity, the pose in `odom` goes on."""

from __future__ import annotations

import hypothesis.strategies as st
import numpy as np
import pytest
from hypothesis import given, settings

from hybridmap.config.mapping import NeuralConfig
from hybridmap.errors import StreamError
from hybridmap.geometry import between, compose
from hybridmap.neural import PathIntegrator
from hybridmap.neural.path_integrator import Reanchoring

SOFTPLUS = NeuralConfig(rectifier="softplus")
DELTA = st.tuples(st.floats(-0.6, 0.6), st.floats(-0.6, 0.6), st.floats(-2.0, 2.0)).map(np.array)


def away(integrator: PathIntegrator) -> None:
    """Drive a few metres off, round a bend."""
    for _ in range(40):
        integrator.step((0.07, 0.0, 0.03), 0.1)


@settings(max_examples=8, deadline=None)
@given(delta=DELTA, weight=st.sampled_from([1.0, 1.0 - 1e-12]))
def test_stored_activity_is_put_back_moved_by_the_measured_pose(delta, weight):
    integrator = PathIntegrator(SOFTPLUS)
    integrator.step((0.3, 0.1, 0.7), 0.1)
    stored, stood = integrator.snapshot(), integrator.pose
    away(integrator)
    integrator.restore(stored, weight, delta)
    assert between(compose(stood, delta), integrator.pose) == pytest.approx(np.zeros(3), abs=1e-4)
    assert integrator.attractor.unwrapped_m(integrator.pose[:2]) == pytest.approx(integrator.pose[:2], abs=1e-3)
    assert integrator.decode().agreed


@pytest.mark.parametrize("weight", [1.0, 0.5])
def test_odom_is_continuous_while_the_cells_jump(weight):
    integrator = PathIntegrator(SOFTPLUS)
    cells = Reanchoring(integrator, weight)
    cells.remember(0)
    away(integrator)
    odom, of_cells = cells.pose_odom_robot, integrator.pose
    cells.recalibrate(0, np.array([0.1, 0.0, 0.2]))
    assert np.linalg.norm(integrator.pose[:2] - of_cells[:2]) > 0.5
    assert cells.pose_odom_robot == pytest.approx(odom, abs=1e-9)
    integrator.step((0.2, 0.0, 0.1), 0.1)
    chord = np.array([0.2, 0.0, 0.1])
    assert between(odom, cells.pose_odom_robot) == pytest.approx(chord, abs=1e-4)


def test_a_known_place_has_its_old_code_again():
    integrator = PathIntegrator(SOFTPLUS)
    cells = Reanchoring(integrator, 1.0)
    cells.remember(0)
    code = integrator.place_code
    away(integrator)
    assert float(code @ integrator.place_code) < 0.1
    cells.recalibrate(0, np.zeros(3))
    _ = integrator.pose
    assert float(code @ integrator.place_code) == pytest.approx(1.0, abs=1e-6)


def test_without_a_weight_nothing_happens():
    integrator = PathIntegrator(SOFTPLUS)
    cells = Reanchoring(integrator, 0.0)
    cells.remember(0)
    away(integrator)
    before = integrator.pose
    cells.recalibrate(0, np.zeros(3))
    assert np.array_equal(integrator.pose, before)
    assert np.array_equal(cells.pose_odom_robot, before)


@pytest.mark.parametrize("weight", [1.0, 1.0 - 1e-12])
def test_the_place_pattern_comes_back_wherever_its_bump_had_gone(weight):
    integrator = PathIntegrator(SOFTPLUS)
    stored, stood = integrator.snapshot(), integrator.place_code
    integrator.attractor.step(np.array([1.1, -0.7]))
    assert float(stood @ integrator.place_code) < 0.1
    integrator.restore(stored, weight)
    _ = integrator.pose
    assert float(stood @ integrator.place_code) == pytest.approx(1.0, abs=1e-5)


@pytest.mark.parametrize("delta", [(float("nan"), 0.0, 0.0), (1.0, 2.0), (1e9, 0.0, 0.0), (0.0, 0.0, float("inf"))])
def test_a_relative_pose_that_is_none_is_refused(delta):
    integrator = PathIntegrator(SOFTPLUS)
    before = integrator.pose
    with pytest.raises(StreamError, match="re-anchoring: expected a pose"):
        integrator.restore(integrator.snapshot(), 1.0, delta)
    assert np.array_equal(integrator.pose, before)


def test_what_a_node_stores_is_what_it_was_before_the_cells_jumped():
    integrator = PathIntegrator(SOFTPLUS)
    cells = Reanchoring(integrator, 1.0)
    cells.remember(0)
    away(integrator)
    cells.remember(1)
    there = integrator.decode().position_m
    cells.recalibrate(0, np.zeros(3))
    assert cells.activity_at(1)["near_m"] == pytest.approx(there, abs=1e-6)


def test_poses_of_nodes_are_those_that_the_cells_showed_last_at_each():
    integrator = PathIntegrator(SOFTPLUS)
    cells = Reanchoring(integrator, 1.0)
    assert cells.poses_of_nodes.shape == (0, 3)
    cells.remember(0)
    start = integrator.pose
    away(integrator)
    cells.remember(1)
    drifted = integrator.pose
    assert cells.poses_of_nodes == pytest.approx(np.array([start, drifted]))
    closure = np.array([0.1, -0.05, 0.2])
    cells.recalibrate(0, closure)
    assert cells.poses_of_nodes[1] == pytest.approx(drifted)
    cells.remember(1)
    assert cells.poses_of_nodes == pytest.approx(np.array([start, compose(start, closure)]), abs=1e-4)


def test_without_a_weight_the_poses_of_all_nodes_are_kept():
    integrator = PathIntegrator(SOFTPLUS)
    cells, shown = Reanchoring(integrator, 0.0), []
    for node in range(3):
        cells.remember(node)
        shown.append(integrator.pose)
        away(integrator)
    assert cells.poses_of_nodes == pytest.approx(np.array(shown))


@pytest.mark.parametrize("weight", [1.0, 0.5])
def test_nodes_made_while_lost_are_put_back_with_the_robot(weight):
    integrator = PathIntegrator(SOFTPLUS)
    cells = Reanchoring(integrator, weight)
    odom = []
    for node in range(4):
        cells.remember(node)
        odom.append(cells.pose_odom_robot)
        away(integrator)
    robot, stays = cells.pose_odom_robot, cells.poses_of_nodes[:2]
    cells.recalibrate(0, np.array([0.1, 0.0, 0.2]))
    shown = integrator.pose
    cells.put_back({node: between(robot, odom[node]) for node in (2, 3)})
    assert integrator.pose == pytest.approx(shown, abs=1e-6)
    assert cells.pose_odom_robot == pytest.approx(robot, abs=1e-6)
    assert cells.poses_of_nodes[:2] == pytest.approx(stays)
    for node in (2, 3):
        seen, was = between(shown, cells.poses_of_nodes[node]), between(robot, odom[node])
        assert between(was, seen) == pytest.approx(np.zeros(3), abs=1e-4)
        assert cells.activity_at(node)["near_m"] == pytest.approx(cells.poses_of_nodes[node, :2], abs=1e-6)


def test_without_a_weight_nothing_is_put_back():
    integrator = PathIntegrator(SOFTPLUS)
    cells = Reanchoring(integrator, 0.0)
    cells.remember(0)
    before = cells.poses_of_nodes
    cells.put_back({0: np.array([1.0, 0.0, 0.0])})
    assert np.array_equal(cells.poses_of_nodes, before)
