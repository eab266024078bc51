"""A robot that was carried to a place that looks alike is found by how well its loops fit, and by the better place."""

from itertools import count

import numpy as np
import pytest

from hybridmap.geometry import RelativePose
from hybridmap.graph.edges import Edge, EdgeKind, Lack, Status
from hybridmap.vision import second_opinion
from hybridmap.vision.base import Belief
from hybridmap.vision.relocalising import GlobalMatch
from hybridmap.vision.second_opinion import SecondOpinion, is_about, worse_since

NODES, STEP_M = 80, 0.5
X = STEP_M * np.arange(NODES, dtype=np.float64)
BELIEF = Belief(np.column_stack([X, 0 * X, 0 * X]), np.arange(float(NODES)), X, lambda _: np.zeros((NODES, 3, 3)))
"""A straight drive on the map; in truth nodes from 60 on are where 10.. are, though their loops put them at 40.."""
CARRIED_TO, TRUE_PLACE, ALIKE = 60, 10, 40
GOOD, BAD = 0.02, 0.12


def edge(source, target, kind=EdgeKind.LOOP, misfit=GOOD, delta=None, key=None):
    delta = np.array([X[target] - X[source], 0.0, 0.0]) if delta is None else np.asarray(delta)
    relative = RelativePose(delta, np.eye(3) * 1e-4)
    return Edge(
        source, target, kind, Status.ACCEPTED, relative, figures={"misfit": misfit}, key=next(KEYS) if key is None else key
    )


KEYS = count()


def loops(misfit):
    before = [edge(node, node - 30) for node in range(32, 50, 3)]
    return before + [edge(node, node - CARRIED_TO + ALIKE, misfit=misfit) for node in range(62, 80, 3)]


def steps():
    return [edge(node - 1, node, EdgeKind.REGISTRATION) for node in range(1, NODES)]


class FakeWitness:
    worse, span_m, reach_m = 0.06, 1.5, 2.0

    def __init__(self, mismatch=GOOD, places=range(CARRIED_TO - 2, CARRIED_TO + 3)):
        self.mismatch, self.places = mismatch, places
        self.asked, self.told = [], []

    def new_key(self):
        return next(KEYS)

    def misfit(self, seen):
        return seen.figures["misfit"]

    def matches(self, node, since):
        self.asked.append((node, since))
        target = node - CARRIED_TO + TRUE_PLACE
        relative = RelativePose(np.zeros(3), np.eye(3) * 1e-4)
        found = Edge(node, target, EdgeKind.LOOP, Status.PENDING, relative, key=self.new_key(), lack=Lack.WAITING)
        return [GlobalMatch(found, self.mismatch)]

    def carried_to(self, matches, since, belief):
        return self.places

    def corrected(self, edges):
        self.told += edges


def test_the_node_is_found_across_which_loops_fit_worse():
    assert worse_since(loops(BAD), steps(), FakeWitness()) in range(49, 63)


@pytest.mark.parametrize("seen", [loops(GOOD), [edge(node, node - 30, misfit=BAD) for node in range(32, 79, 3)][:3], []])
def test_no_node_where_loops_fit_alike_or_are_few(seen):
    assert worse_since(seen, steps(), FakeWitness()) is None


def test_loops_without_others_are_compared_with_registrations():
    across = [edge(node, node - 50, misfit=BAD) for node in range(62, 78, 3)]
    assert worse_since(across, steps(), FakeWitness()) is not None
    assert worse_since(across, [edge(1, 2, EdgeKind.REGISTRATION, misfit=BAD)], FakeWitness()) is None


def test_a_better_place_corrects_the_map():
    witness = FakeWitness()
    wheels = [edge(node - 1, node, EdgeKind.ODOMETRY, key=-1) for node in range(1, NODES)]
    wheels[CARRIED_TO - 1] = edge(CARRIED_TO - 1, CARRIED_TO, EdgeKind.ODOMETRY, delta=[STEP_M, 0.2, 0.1], key=-1)
    changed = SecondOpinion(witness).ask([*wheels, *steps(), *loops(BAD)], [], BELIEF)
    assert changed == witness.told
    retracted = [e for e in changed if e.lack is Lack.KIDNAPPED]
    assert {(e.source, e.target) for e in retracted if e.kind is EdgeKind.REGISTRATION} == {(CARRIED_TO - 1, CARRIED_TO)}
    wrong = {(node, node - CARRIED_TO + ALIKE) for node in range(62, 80, 3)}
    assert {(e.source, e.target) for e in retracted if e.kind is EdgeKind.LOOP} == wrong
    matches = [e for e in changed if e.kind is EdgeKind.LOOP and e.status is Status.ACCEPTED]
    assert {(e.source, e.target) for e in matches} == {(s, s - CARRIED_TO + TRUE_PLACE) for s, _ in wrong}
    (joined,) = (e for e in changed if e.kidnapped_m is not None)
    assert (joined.source, joined.target) == (CARRIED_TO - 1, CARRIED_TO)
    assert joined.kidnapped_m == pytest.approx(X[CARRIED_TO] - X[TRUE_PLACE], abs=0.1)


@pytest.mark.parametrize(
    "witness",
    [FakeWitness(mismatch=BAD), FakeWitness(mismatch=BAD - 0.02), FakeWitness(places=range(0))],
    ids=["fits no better", "fits hardly better", "only drifted"],
)
def test_nothing_changes_unless_another_place_is_clearly_better(witness):
    assert SecondOpinion(witness).ask([*steps(), *loops(BAD)], [], BELIEF) == []
    assert witness.asked
    assert not witness.told


def test_loops_that_nobody_measured_tell_nothing():
    unmeasured = [edge(node, node - 50, misfit=np.nan) for node in range(62, 78, 3)]
    assert worse_since([*loops(GOOD), *unmeasured], steps(), FakeWitness()) is None


def test_loops_among_nodes_after_the_carry_say_nothing_of_the_place():
    among = [edge(node, node - 10) for node in range(71, 80, 3)]
    witness = FakeWitness()
    assert SecondOpinion(witness).ask([*steps(), *loops(BAD), *among], [], BELIEF) == witness.told != []


def test_as_many_nodes_that_fit_where_the_map_has_them_speak_against_a_carry():
    here = [edge(node, node - CARRIED_TO + ALIKE, misfit=0.0) for node in (63, 66, 69, 72, 75, 78)]
    witness = FakeWitness(mismatch=0.05)
    assert SecondOpinion(witness).ask([*steps(), *loops(4 * BAD), *here], [], BELIEF) == []
    assert witness.asked


def test_nothing_is_searched_where_loops_fit():
    witness = FakeWitness()
    assert SecondOpinion(witness).ask([*steps(), *loops(GOOD)], [], BELIEF) == []
    assert witness.asked == []


def test_searches_end_after_a_few():
    witness, opinion = FakeWitness(mismatch=BAD), None
    opinion = SecondOpinion(witness)
    asked = []
    for _ in range(6):
        opinion.ask([*steps(), *loops(BAD)], [], BELIEF)
        asked.append(len(witness.asked))
    assert asked[3] == asked[5] > asked[2]


def test_a_place_is_the_same_within_a_room_and_a_heading():
    placed = np.array([[1.0, 0.0, 0.1], [9.0, 0.0, np.pi]])
    assert is_about(placed, np.zeros(3))
    assert is_about(placed, np.array([9.5, 0.0, -np.pi + 0.1]))
    assert not is_about(placed, np.array([1.0, 0.0, np.pi]))
    assert not is_about(np.zeros((0, 3)), np.zeros(3))


def test_a_short_carry_that_loops_and_chain_dispute_is_for_the_second_look(monkeypatch):
    edges, few = [*steps(), *loops(BAD)], range(len(loops(BAD)) // 10)
    assert SecondOpinion(FakeWitness()).ask(edges, [*few, 1], BELIEF) != []  # the carry is long
    monkeypatch.setattr(second_opinion, "FAR_M", 100.0)
    witness = FakeWitness()
    assert SecondOpinion(witness).ask(edges, [*few, 1], BELIEF) == []
    assert not witness.told
    assert SecondOpinion(FakeWitness()).ask(edges, few, BELIEF) != []
