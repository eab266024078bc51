"""Sightings of a lost robot wait for each other, and enter together with the edge that joins the broken chain again."""

from dataclasses import replace
from itertools import count

import numpy as np
import pytest

from hybridmap.geometry import RelativePose, between, compose
from hybridmap.graph.edges import Edge, EdgeKind, Lack, Status
from hybridmap.vision import relocalising
from hybridmap.vision.base import Belief
from hybridmap.vision.relocalising import ChainState, GlobalMatch, Relocaliser, Whereabouts

STEP_M = 0.3
X = (STEP_M * np.arange(200)).astype(np.float64)
BELIEF = Belief(np.column_stack([X, 0 * X, 0 * X]), np.arange(200.0), X, lambda _: np.zeros((200, 3, 3)))
"""A straight drive; its chain breaks at 40, and in truth nodes 40.. are where 10.. are."""
BROKEN_AT = 40
THERE, ELSEWHERE = 10, 25


class Search:
    """Gives a relocaliser what was seen from node after node, and keeps the last word on each."""

    def __init__(self, span_m=0.75, steps=()):
        self.keys = count()
        self.relocaliser = Relocaliser(Whereabouts(0), self.keys.__next__, span_m)
        self.relocaliser.tracked(BROKEN_AT, ChainState.BROKEN, list(steps))
        self.proposals = {}
        self.settlements = []

    def see(self, node, *sightings):
        """Each sighting: the old node, and how badly it fits or None."""
        found = []
        for target, mismatch in sightings:
            relative = RelativePose(np.zeros(3), np.eye(3) * 1e-4)
            edge = Edge(node, target, EdgeKind.LOOP, Status.PENDING, relative, key=next(self.keys))
            found.append(GlobalMatch(edge, mismatch or 0.0))
        self.settlements.append(self.relocaliser.settle(found, seen_until(node)))
        self.proposals |= {p.key: p for p in self.settlements[-1].proposals}
        return self

    def drive(self, nodes, place, mismatch=None):
        for node in nodes:
            self.see(node, (place + node - BROKEN_AT, mismatch))
        return self

    def verdicts(self, kind=EdgeKind.LOOP):
        return [p.status for p in self.proposals.values() if p.kind is kind]

    @property
    def lost(self):
        return self.relocaliser.whereabouts.lost


def seen_until(node):
    return Belief(BELIEF.poses_map_node[: node + 1], BELIEF.stamps_s[: node + 1], X[: node + 1], BELIEF.covariance_from)


def step(source, target, status=Status.ACCEPTED):
    key = 10**6 + source
    return Edge(source, target, EdgeKind.REGISTRATION, status, None, key=key, contradicts_odometry=True)


def test_sightings_wait_until_enough_of_them_agree():
    search = Search().drive(range(40, 43), THERE)
    assert search.verdicts() == [Status.PENDING] * 3
    assert search.lost
    search.drive([43], THERE)
    assert search.verdicts() == [Status.ACCEPTED] * 4
    assert not search.lost
    assert search.settlements[-1].kidnapped_to == BROKEN_AT
    assert len(search.settlements[-1].accepted) == 4


def test_the_chain_is_hung_where_the_sightings_have_it():
    search = Search().drive(range(40, 44), THERE)
    reattached = next(p for p in search.proposals.values() if p.kind is EdgeKind.REGISTRATION)
    assert (reattached.source, reattached.target, reattached.status) == (39, 40, Status.ACCEPTED)
    assert reattached.contradicts_odometry
    assert compose(BELIEF.poses_map_node[39], reattached.relative.delta) == pytest.approx([X[THERE], 0.0, 0.0])
    assert reattached.kidnapped_m == pytest.approx(X[BROKEN_AT] - X[THERE])


def test_registrations_across_the_break_are_taken_back():
    believed = [step(38, 39), step(39, 40), step(38, 40), step(40, 41)]
    search = Search(steps=believed).drive(range(40, 44), THERE)
    taken_back = [p for p in search.proposals.values() if p.kind is EdgeKind.REGISTRATION and p.status is Status.REJECTED]
    assert [(p.source, p.target) for p in taken_back] == [(39, 40), (38, 40)]
    assert all(p.lack is Lack.KIDNAPPED and not p.contradicts_odometry for p in taken_back)


def test_a_robot_found_where_the_chain_has_it_was_not_carried():
    search = Search(steps=[step(39, 40)])
    for node in range(40, 44):
        search.see(node, (node, None))
    assert search.verdicts() == [Status.ACCEPTED] * 4
    assert search.verdicts(EdgeKind.REGISTRATION) == []
    assert search.settlements[-1].kidnapped_to is None
    assert not search.lost


@pytest.mark.parametrize(("sigma_m", "carried"), [(0.1, True), (2.0, False)])
def test_a_robot_found_within_the_drift_of_a_long_way_was_not_carried(sigma_m, carried):
    drift = np.diag([sigma_m**2, sigma_m**2, 1e-6])
    search = Search()
    for node in range(BROKEN_AT, BROKEN_AT + 4):
        belief = seen_until(node)
        relative = RelativePose(np.zeros(3), np.eye(3) * 1e-4)
        edge = Edge(node, THERE + node - BROKEN_AT, EdgeKind.LOOP, Status.PENDING, relative, key=next(search.keys))
        far = replace(belief, covariance_from=lambda _: np.broadcast_to(drift, (200, 3, 3)))
        settled = search.relocaliser.settle([GlobalMatch(edge)], far)
    assert len(settled.accepted) == 4
    assert (settled.kidnapped_to == BROKEN_AT) is carried


def test_sightings_that_enter_have_passed_what_they_are_held_against():
    accepted = Search().drive(range(40, 44), THERE).settlements[-1].accepted
    assert {tuple(check.figure for check in edge.checks) for edge in accepted} == {("agreeing", "span_m", "rival")}


def test_rivals_that_count_for_half_as_much_keep_it_waiting():
    search = Search(span_m=0.0)
    for node in range(40, 44):
        search.see(node, (THERE + node - 40, None), *([(ELSEWHERE + node - 40, None)] if node < 42 else []))
    assert search.lost
    search.see(44, (THERE + 4, None))
    assert not search.lost


def test_agreement_needs_travel_and_not_only_views():
    search = Search(span_m=1.1).drive(range(40, 44), THERE)
    assert search.lost
    assert not search.drive([44], THERE).lost


def test_several_sightings_of_one_node_are_one_support():
    search = Search(span_m=0.0)
    search.see(40, *((THERE, None),) * 8)
    assert search.lost


def test_a_rival_place_keeps_it_waiting():
    search = Search()
    for node in range(40, 46):
        search.see(node, (THERE + node - 40, None), (ELSEWHERE + node - 40, None))
    assert search.lost
    for node in range(46, 60):
        search.see(node, (THERE + node - 40, None))
    assert not search.lost
    refused = [p for p in search.proposals.values() if p.status is Status.REJECTED]
    assert {p.target for p in refused} == set(range(ELSEWHERE, ELSEWHERE + 6))
    assert all(p.lack is Lack.CONTRADICTED for p in refused)


def test_of_one_nodes_sightings_the_better_fit_counts_for_more():
    search = Search()
    for node in range(40, 44):
        search.see(node, (THERE + node - 40, 0.01), (ELSEWHERE + node - 40, 0.12))
    assert not search.lost
    assert search.settlements[-1].kidnapped_to == BROKEN_AT
    assert all(p.target < ELSEWHERE for p in search.settlements[-1].accepted)


@pytest.mark.parametrize(("mismatch", "nodes"), [(0.0, 4), (0.075, 6), (0.12, 14), (0.16, None)])
def test_the_worse_they_fit_the_more_travel_is_needed(mismatch, nodes):
    """0.75 m where they fit, 1.5 m at half of what is too much, 3.75 m at four fifths."""
    search = Search()
    needed = next((n for n in range(1, 60) if not search.drive([39 + n], THERE, mismatch).lost), None)
    assert needed == nodes


def test_old_sightings_are_given_up(monkeypatch):
    monkeypatch.setattr(relocalising, "WAIT_M", 6.0)
    search = Search().drive(range(40, 43), THERE)
    search.see(65)
    assert search.verdicts() == [Status.REJECTED] * 3
    assert all(p.lack is Lack.UNSUPPORTED for p in search.proposals.values())
    assert search.relocaliser.dismiss() == []


def test_what_waits_can_be_dismissed():
    search = Search().drive(range(40, 43), THERE)
    dismissed = search.relocaliser.dismiss(Lack.NOT_LOST)
    assert [(p.status, p.lack) for p in dismissed] == [(Status.REJECTED, Lack.NOT_LOST)] * 3
    assert search.relocaliser.dismiss() == []


def test_sightings_of_a_chain_that_holds_hang_nothing_anew():
    relocaliser = Relocaliser(Whereabouts(1), iter(range(99)).__next__, 0.75)
    relocaliser.whereabouts.unrecognised()
    found = []
    for node in range(40, 44):
        delta = between(BELIEF.poses_map_node[node], BELIEF.poses_map_node[node] + [0.0, 3.0, 0.0])
        relative = RelativePose(delta, np.eye(3) * 1e-4)
        found.append(GlobalMatch(Edge(node, THERE + node - 40, EdgeKind.LOOP, Status.PENDING, relative, key=node)))
    settlement = relocaliser.settle(found, seen_until(43))
    assert len(settlement.accepted) == 4
    assert settlement.kidnapped_to is None
    assert {p.kind for p in settlement.proposals} == {EdgeKind.LOOP}
