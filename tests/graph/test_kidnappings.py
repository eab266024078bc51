"""Where the robot was carried, and a trajectory without it."""

import numpy as np
import pytest

from hybridmap.geometry import RelativePose
from hybridmap.graph.edges import Edge, EdgeKind, Status
from hybridmap.graph.experience_map import ExperienceMap, Node
from hybridmap.graph.gaps import grounded, kidnapping_edges, kidnappings, parted, pieces
from hybridmap.trajectory import Trajectory

SECOND = 10**9


def drive(*edges):
    """Six nodes, one a second and 0.5 m apart; a kidnapping between nodes 2 and 3 is found at node 5."""
    experiences = ExperienceMap()
    for k in range(6):
        pose = np.array([0.5 * k, 0.0, 0.0])
        experiences.add_node(Node(k * SECOND, pose, np.zeros(4, dtype=np.float32), -1, 0.5 * k), pose)
    relative = RelativePose(np.array([3.0, 4.0, 0.0]), np.eye(3))
    for kind, status, kidnapped_m in edges:
        experiences.add_edge(Edge(2, 3, kind, status, relative, kidnapped_m=kidnapped_m))
    return experiences


def test_a_carry_is_what_was_hung_in_the_place_of_a_broken_edge():
    hung = (EdgeKind.REGISTRATION, Status.ACCEPTED, 5.0)
    (one,) = kidnappings(drive(hung))
    assert (one.before, one.after, one.found_at, one.moved_m, one.search_m) == (
        2,
        3,
        5,
        5.0,
        1.0,
    )
    assert "between nodes 2 and 3: put down 5.0 m from where the odometry has it; localised 1.0 m later, at node 5" in str(one)


def test_what_was_taken_back_or_is_of_another_kind_is_no_carry():
    taken_back = (EdgeKind.REGISTRATION, Status.REJECTED, 5.0)
    ordinary = (EdgeKind.REGISTRATION, Status.ACCEPTED, None)
    assert kidnappings(drive(taken_back, ordinary)) == ()


def test_a_trajectory_has_no_pose_of_the_way_through_the_air():
    stamps = np.arange(0, 5 * SECOND + 1, SECOND // 2)
    way = Trajectory(stamps, np.zeros((len(stamps), 3)))
    hung = (EdgeKind.REGISTRATION, Status.ACCEPTED, 5.0)
    left = grounded(way, drive(hung)).stamps_ns / SECOND
    assert left.tolist() == [0.0, 0.5, 1.0, 1.5, 2.0, 3.5, 4.0, 4.5, 5.0]
    assert [len(piece) for piece in pieces(way, drive(hung))] == [5, 4]
    assert grounded(way, drive()) is way
    assert len(pieces(way, drive())) == 1


def test_a_line_through_the_nodes_breaks_where_the_robot_was_carried():
    experiences = drive((EdgeKind.REGISTRATION, Status.ACCEPTED, 5.0))
    found = kidnappings(experiences)
    assert parted(experiences.initial, found)[:, 0].tolist() == pytest.approx(
        [0.0, 0.5, 1.0, np.nan, 1.5, 2.0, 2.5], nan_ok=True
    )
    assert len(parted(experiences.initial[:3], found)) == 3  # nodes of before it alone
    assert parted(experiences.initial, ()).tolist() == experiences.initial.tolist()


def test_edges_through_the_air_are_those_of_motion_between_the_ends_of_a_carry():
    accepted = Status.ACCEPTED
    experiences = drive((EdgeKind.REGISTRATION, accepted, 5.0), (EdgeKind.LOOP, accepted, None))
    relative = RelativePose(np.array([0.5, 0.0, 0.0]), np.eye(3))
    experiences.add_edge(Edge(3, 4, EdgeKind.REGISTRATION, accepted, relative))
    graph = experiences.pose_graph()
    assert kidnapping_edges(graph, kidnappings(experiences)).tolist() == [True, False, False]
    assert not kidnapping_edges(graph, ()).any()
