"""Proposals become edges; loops that a back-end gave no weight are reported and measured again."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from hybridmap.config import Config
from hybridmap.config.mapping import EdgesConfig
from hybridmap.edge_book import EdgeBook
from hybridmap.geometry import IDENTITY, RelativePose, between
from hybridmap.graph.edges import Edge, EdgeKind, Lack, Search, Status
from hybridmap.graph.experience_map import ExperienceMap, Node
from hybridmap.mapper import Mapper
from tests.narrowing import known
from tests.streams_for_tests import RoomDrive

COVARIANCE = np.diag([1e-4, 1e-4, 1e-5])


def proposal(key: int, status: Status = Status.ACCEPTED, kind: EdgeKind = EdgeKind.LOOP, contradicts: bool = False) -> Edge:
    relative = None if status is Status.REJECTED else RelativePose(np.array([1.0, 0, 0]), COVARIANCE)
    source = 2 if contradicts else 0
    return Edge(3, source, kind, status, relative, key=key, contradicts_odometry=contradicts)


@pytest.fixture
def experiences() -> ExperienceMap:
    experiences = ExperienceMap()
    for k in range(4):
        experiences.add_node(Node(k, IDENTITY, np.zeros(1, np.float32), -1, float(k)), IDENTITY)
        if k:
            chain = RelativePose(np.array([1.0, 0, 0]), COVARIANCE)
            experiences.add_edge(Edge(k - 1, k, EdgeKind.ODOMETRY, Status.ACCEPTED, chain))
    return experiences


@pytest.fixture
def book(experiences) -> EdgeBook:
    return EdgeBook(experiences, EdgesConfig())


def test_a_later_proposal_of_the_same_key_replaces_the_edge(book, experiences):
    assert book.enter([proposal(7, Status.PENDING)]) == [3]
    assert book.enter([proposal(7), proposal(8, Status.REJECTED)]) == [3, 4]
    assert [edge.status for edge in experiences.edges[3:]] == [Status.ACCEPTED, Status.REJECTED]


def test_a_proposal_without_a_key_is_always_a_new_edge(book, experiences):
    assert book.enter([proposal(-1), proposal(-1, Status.REJECTED)]) == [3, 4]
    assert [edge.status for edge in book.proposed([0, 3, 4])] == [Status.ACCEPTED, Status.REJECTED]


def test_a_contradicted_odometry_edge_is_dropped(book, experiences):
    assert book.enter([proposal(0, kind=EdgeKind.REGISTRATION, contradicts=True)]) == [3, 2]
    assert (experiences.edge(2).status, experiences.edge(2).lack) == (Status.RETRACTED, Lack.OVERRULED)


def driven(book: EdgeBook, experiences: ExperienceMap, nodes: int, wheel_yaw_rad: float = 0.0, first: int = 0) -> list[int]:
    """Drive a metre from node to node, each one registered; returns the numbers of edges that changed at the last node."""
    changed: list[int] = []
    for k in range(first, nodes):
        experiences.add_node(Node(k, IDENTITY, np.zeros(1, np.float32), -1, float(k)), IDENTITY)
        if k:
            changed = book.motion.join(k - 1, k, np.array([1.0, 0.0, wheel_yaw_rad]), (1.0, 0.0))
            seen = RelativePose(np.array([1.0, 0.0, 0.1 if k == 5 else 0.0]), COVARIANCE)
            edge = Edge(k - 1, k, EdgeKind.REGISTRATION, Status.ACCEPTED, seen, key=k, contradicts_odometry=k == 5)
            book.enter([edge])
    return changed


def odometry_into(experiences: ExperienceMap, node: int) -> Edge:
    return next(edge for edge in map(experiences.edge, experiences.edges_into(node)) if edge.kind is EdgeKind.ODOMETRY)


def test_wheels_that_prove_good_get_back_what_a_registration_dropped_and_all_edges_are_weighed_again():
    experiences = ExperienceMap()
    book = EdgeBook(experiences, EdgesConfig())
    driven(book, experiences, 90)
    before = odometry_into(experiences, 7)
    assert odometry_into(experiences, 5).status is Status.RETRACTED
    experiences = ExperienceMap()
    book = EdgeBook(experiences, EdgesConfig())
    assert len(driven(book, experiences, 102)) > 100
    assert odometry_into(experiences, 5).status is Status.ACCEPTED
    after = odometry_into(experiences, 7)
    assert known(after.relative).covariance[2, 2] < known(before.relative).covariance[2, 2]
    wrong = next(edge for edge in map(experiences.edge, experiences.edges_into(5)) if edge.kind is EdgeKind.REGISTRATION)
    assert known(wrong.relative).covariance[2, 2] > 100.0 * COVARIANCE[2, 2]


class Lenient:
    """No registration overrules the odometry."""

    def overrules(self, registration: RelativePose, odometry: RelativePose) -> bool:
        return False


def test_odometry_that_nothing_contradicts_any_more_stays_even_if_the_wheels_turn_out_bad():
    experiences = ExperienceMap()
    book = EdgeBook(experiences, EdgesConfig())
    driven(book, experiences, 102)
    assert book.motion.wheels.trusted
    bent = np.column_stack([np.arange(102.0), np.zeros(102), np.where(np.arange(102) % 2, 0.2, 0.0).cumsum()])
    book.motion.retime(bent, Lenient())
    assert not book.motion.wheels.trusted
    assert odometry_into(experiences, 5).status is Status.ACCEPTED


def test_an_edge_across_a_kidnapping_does_not_come_back():
    experiences = ExperienceMap()
    book = EdgeBook(experiences, EdgesConfig())
    driven(book, experiences, 90)
    number = experiences.edges.index(odometry_into(experiences, 5))
    experiences.update_edge(number, experiences.edge(number).settled(lack=Lack.KIDNAPPED))
    driven(book, experiences, 102, first=90)
    assert known(book.motion.wheels.learnt).good
    assert experiences.edge(number).lack is Lack.KIDNAPPED


def test_wheels_that_do_not_prove_good_change_nothing():
    experiences = ExperienceMap()
    book = EdgeBook(experiences, EdgesConfig())
    assert len(driven(book, experiences, 102, wheel_yaw_rad=0.1)) == 1
    assert known(book.motion.wheels.learnt).good is False
    assert odometry_into(experiences, 5).status is Status.RETRACTED


def test_proposed_edges_are_named_with_their_keys(book, experiences):
    book.enter([proposal(5), proposal(6)])
    assert [(edge.key, edge.source, edge.target) for edge in book.proposed([4])] == [(6, 3, 0)]
    assert book.proposed([]) == []
    assert book.proposed([1]) == []  # an edge of the chain was not proposed


def test_a_loop_that_is_not_found_again_is_retracted(book, experiences):
    book.enter([proposal(5), proposal(6)])
    assert book.enter_again([proposal(5), proposal(6, Status.REJECTED)]) == [3, 4]
    assert [edge.status for edge in experiences.edges[3:]] == [Status.ACCEPTED, Status.RETRACTED]
    assert book.tried_again == (3, 4)


def test_a_loop_that_was_measured_wrongly_is_measured_again_at_the_end():
    stream = RoomDrive(laps=2.2)
    mapper = Mapper(Config.load("laser", {"backends.names": ["gtsam-gnc"]}), stream.rig)
    for sample in stream:
        mapper.add(sample)
    mapper.finish()
    loop = next(e for e in mapper.map.edges if e.kind is EdgeKind.LOOP and e.status is Status.ACCEPTED)
    wrong = RelativePose(np.array([0.9, 0.8, 0.4]), COVARIANCE)
    [spoilt] = mapper.book.enter([replace(loop, relative=wrong, key=900, since_node=-1)])
    updates = mapper.finish()
    solution, edge = mapper.backends.solutions["gtsam-gnc"], mapper.map.edge(spoilt)
    assert mapper.book.tried_again == (spoilt,)
    assert any(spoilt in update.edges for update in updates)
    assert edge.status is Status.ACCEPTED
    assert edge.search is Search.AGAIN
    assert spoilt not in solution.report.rejected_edge_ids
    off = between(known(edge.relative).delta, between(*solution.poses[[edge.source, edge.target]]))
    assert np.hypot(off[0], off[1]) < 0.03


class Strict:
    """Registrations further than 0.2 m from the odometry overrule it."""

    def overrules(self, registration: RelativePose, odometry: RelativePose) -> bool:
        return bool(abs(registration.delta[0] - odometry.delta[0]) > 0.2)


@pytest.mark.parametrize(("step_m", "status"), [(1.1, Status.ACCEPTED), (1.5, Status.RETRACTED)])
def test_odometry_that_is_measured_again_counts_again_if_nothing_contradicts_it_any_more(step_m, status):
    experiences = ExperienceMap()
    book = EdgeBook(experiences, EdgesConfig())
    for k in range(3):
        experiences.add_node(Node(k, np.array([1.5 * k, 0, 0]), np.zeros(1, np.float32), -1, 1.5 * k), IDENTITY)
        if k:
            book.motion.join(k - 1, k, np.array([1.5, 0, 0]), (1.5, 0.0))
            registration = RelativePose(np.array([1.0, 0, 0]), COVARIANCE)
            book.enter([Edge(k - 1, k, EdgeKind.REGISTRATION, Status.ACCEPTED, registration, key=k, contradicts_odometry=True)])
    dropped = [n for n, edge in enumerate(experiences.edges) if edge.kind is EdgeKind.ODOMETRY]
    assert {experiences.edge(n).status for n in dropped} == {Status.RETRACTED}
    poses = np.array([[step_m * k, 0.0, 0.0] for k in range(3)])
    assert set(dropped) <= set(book.motion.retime(poses, Strict()))
    assert {experiences.edge(n).status for n in dropped} == {status}
    assert all(known(experiences.edge(n).relative).delta[0] == pytest.approx(step_m) for n in dropped)
    assert [node.pose_odom[0] for node in experiences.nodes] == poses[:, 0].tolist()
    np.testing.assert_allclose(experiences.initial, poses)
