import numpy as np
import pytest

from hybridmap.geometry import RelativePose, loosest_direction
from hybridmap.graph.edges import Edge, EdgeKind, Status
from hybridmap.graph.experience_map import ExperienceMap, Node
from hybridmap.graph.gaps import free_lengths, unobserved
from tests.narrowing import known

ODOMETRY = np.diag([0.02, 0.02, 0.01]) ** 2
HELD = np.diag([0.002, 0.002, 0.001]) ** 2


def slides_along(angle_rad, sigma_m=0.3):
    turn = np.array([[np.cos(angle_rad), -np.sin(angle_rad)], [np.sin(angle_rad), np.cos(angle_rad)]])
    covariance = HELD.copy()
    covariance[:2, :2] = turn @ np.diag([sigma_m**2, 0.002**2]) @ turn.T
    return covariance


def drive(registrations, yaw=0.0):
    """Half a metre a step at a heading; `registrations` has a covariance, or None, for each."""
    experiences, step = ExperienceMap(), np.array([0.5, 0.0, 0.0])
    poses = np.array([[0.5 * k * np.cos(yaw), 0.5 * k * np.sin(yaw), yaw] for k in range(len(registrations) + 1)])
    for k, pose in enumerate(poses):
        experiences.add_node(Node(k, pose, np.zeros(1, np.float32), -1, 0.5 * k), pose)
    for k, covariance in enumerate(registrations, start=1):
        odometry = RelativePose(step, ODOMETRY)
        experiences.add_edge(Edge(k - 1, k, EdgeKind.ODOMETRY, Status.ACCEPTED, odometry))
        status = Status.REJECTED if covariance is None else Status.ACCEPTED
        measured = RelativePose(step, HELD if covariance is None else covariance)
        experiences.add_edge(Edge(k - 1, k, EdgeKind.REGISTRATION, status, measured))
    return experiences, poses


def test_a_corridor_is_free_along_itself_in_the_map():
    found = known(unobserved(*drive([HELD, *[slides_along(0.02), slides_along(-0.02)] * 3], yaw=1.0)))
    assert (found.sliding_m, found.blind_m, found.travel_m) == pytest.approx((3.0, 0.0, 3.5))
    assert found.direction_rad == pytest.approx(1.0)
    assert found.alike > 0.99
    assert str(found) == (
        "on 3.0 m of 3.5 m nothing seen held the motion along 57 deg of the map: there the map rests on odometry"
    )


def test_there_and_back_is_one_axis():
    there, _ = drive([slides_along(0.0)] * 4)
    poses = np.zeros((5, 3))
    poses[3:, 2] = np.pi
    assert known(unobserved(there, poses)).alike == pytest.approx(1.0)


def test_a_room_is_held_and_no_remark():
    found = known(unobserved(*drive([HELD] * 5)))
    assert (found.sliding_m, found.blind_m) == (0.0, 0.0)
    assert str(found) == "registration held all of the way"


def test_registrations_as_certain_as_good_wheels_hold_the_motion():
    found = known(unobserved(*drive([1.2 * ODOMETRY] * 5)))
    assert (found.sliding_m, found.blind_m) == (0.0, 0.0)


def test_what_was_not_registered_is_blind():
    found = known(unobserved(*drive([HELD, None, None])))
    assert found.blind_m == pytest.approx(1.0)
    assert "nothing seen held it at all" in str(found)


def test_lengths_of_the_free_steps():
    experiences, _ = drive([HELD, None, slides_along(0.0)])
    assert free_lengths(experiences).tolist() == pytest.approx([0.0, 0.0, 0.5, 0.5])


def test_a_loose_registration_that_beats_odometry_holds():
    assert known(unobserved(*drive([slides_along(0.5, sigma_m=0.019)] * 3))).sliding_m == 0.0


def test_without_any_registration_there_is_nothing_to_say():
    assert unobserved(*drive([None, None])) is None


def test_loosest_direction_is_an_axis():
    for angle in (0.3, 0.3 + np.pi, -1.2):
        sigma_m, direction = loosest_direction(slides_along(angle))
        assert sigma_m == pytest.approx(0.3)
        assert np.sin(direction - angle) == pytest.approx(0.0, abs=1e-9)
        assert -0.5 * np.pi <= direction < 0.5 * np.pi
