"""How far registrations are from the odometry of the same steps, and which of them are odd."""

import numpy as np
import pytest

from hybridmap.geometry import RelativePose
from hybridmap.graph.contradictions import contradictions
from hybridmap.graph.edges import Edge, EdgeKind, Lack, Status
from hybridmap.graph.experience_map import ExperienceMap, Node

SIGMA_M = 0.1


def drive(off_m):
    """A drive whose registrations lie this far ahead of the odometry, m."""
    experiences = ExperienceMap()
    for node in range(len(off_m) + 1):
        pose = np.array([0.5 * node, 0.0, 0.0])
        experiences.add_node(Node(node, pose, np.zeros(0, np.float32), -1, 0.5 * node), pose)
    for node, off in enumerate(off_m, start=1):
        for kind, ahead in ((EdgeKind.ODOMETRY, 0.0), (EdgeKind.REGISTRATION, off)):
            relative = RelativePose(np.array([0.5 + ahead, 0.0, 0.0]), SIGMA_M**2 * np.eye(3))
            experiences.add_edge(Edge(node - 1, node, kind, Status.ACCEPTED, relative))
    return experiences


def test_steps_are_measured_in_deviations_of_the_odometry_and_few_are_odd():
    off_m = [0.01] * 200
    off_m[99], off_m[149] = 0.3, -0.2
    found = contradictions(drive(off_m).edges)
    assert found.sigmas[100] == pytest.approx(3.0)
    assert found.sigmas[150] == pytest.approx(2.0)
    assert found.odd == pytest.approx(0.15)
    assert found.oddest(1, 200) == 100
    assert found.oddest(101, 200) == 150
    assert found.oddest(1, 99) is None


def test_a_step_across_a_kidnapping_and_one_without_a_registration_are_left_out():
    experiences = drive([0.01] * 5)
    for number, edge in enumerate(experiences.edges):
        if edge.target == 3:
            experiences.update_edge(number, edge.settled(lack=Lack.KIDNAPPED))
    assert sorted(contradictions(experiences.edges).sigmas) == [1, 2, 4, 5]
    assert contradictions(()).oddest(0, 9) is None
