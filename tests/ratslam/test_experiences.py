"""Which pairs of view cell and place on the pose cells are one experience."""

from __future__ import annotations

import numpy as np
import pytest

from hybridmap.neural.pose_cells import SIDE
from hybridmap.ratslam.experiences import Experience, Experiences

HERE, NEAR, FAR = np.array([1.0, 2.0, 3.0]), np.array([2.0, 2.5, 3.0]), np.array([9.0, 2.0, 3.0])


@pytest.fixture
def two():
    """Experience 0 of view 0, then 1 of view 1, at one place; the robot is in the second."""
    out = Experiences(reach_cells=2.0)
    for node in (0, 1):
        assert out.decide(node, HERE).changed
        out.enter(Experience(node, node, HERE))
    return out


def test_the_first_view_is_a_new_experience():
    decision = Experiences(2.0).decide(0, HERE)
    assert decision.changed
    assert decision.again is None


def test_the_same_view_near_its_place_changes_nothing(two):
    assert not two.decide(1, NEAR).changed


def test_the_same_view_elsewhere_is_a_new_experience(two):
    decision = two.decide(1, FAR)
    assert decision.changed
    assert decision.again is None


def test_an_older_view_near_its_place_is_the_older_experience(two):
    decision = two.decide(0, NEAR)
    assert decision.changed
    assert decision.again is not None
    assert decision.again.node == 0
    assert decision.apart_cells == pytest.approx(np.hypot(1.0, 0.5))
    two.enter(decision.again)
    assert not two.decide(0, NEAR).changed
    assert two.decide(1, HERE).again.node == 1


def test_of_several_experiences_of_a_view_the_nearest_one_is_had_again(two):
    two.enter(Experience(2, 0, FAR))
    two.enter(Experience(3, 1, FAR))
    assert two.decide(0, FAR + 0.5).again.node == 2
    assert two.decide(0, HERE + 0.5).again.node == 0


def test_places_are_near_across_the_edge_of_the_cells(two):
    assert two.decide(0, HERE + np.array([SIDE - 1.0, 0.0, 0.0])).again.node == 0
