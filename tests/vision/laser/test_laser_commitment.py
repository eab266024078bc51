"""Late commitment: a cluster waits for enough probes, over enough travel, and for its rivals."""

import numpy as np
import pytest

from hybridmap.geometry import RelativePose, between, compose
from hybridmap.graph.edges import Lack, Search, Status
from hybridmap.vision.base import Belief
from hybridmap.vision.laser import checks
from hybridmap.vision.laser.commitment import Commitment
from hybridmap.vision.laser.hypotheses import Hypothesis

N = 400
STEP_M = 0.5
CHAIN = np.column_stack([np.arange(N) * STEP_M, np.zeros(N), np.zeros(N)])
TRAVEL = (np.arange(N) * STEP_M).astype(np.float64)


def covariance_from(node):
    """Steps of 1 mm and 0.05 degrees."""
    return np.abs(np.arange(N) - node)[:, None, None] * np.diag([1e-3, 1e-3, np.deg2rad(0.05)]) ** 2


BELIEF = Belief(CHAIN, np.arange(N, dtype=float), TRAVEL, covariance_from)


THINGS = 60
"""Things in sight in the open: the standard error of a share near one half is 0.065."""


def hypothesis(probe, anchor, where=(2.0, 5.0, 0.3), quality=0.7, sigma_m=5.0, near=None):
    """A probe that lies at `CHAIN[anchor] * where + way since node 200` in the old map: all with one `where` agree."""
    at = compose(compose(CHAIN[20], np.array(where)), between(CHAIN[200], CHAIN[probe]))
    relative = RelativePose(between(at, CHAIN[anchor]), np.diag([0.03, 0.03, 0.01]) ** 2)
    asked = () if near is None else checks.of_fit(near, 0.9, 0.7)
    return Hypothesis(probe, anchor, relative, quality, sigma_m, Search.GATE, asked, {}, True, 0.0, THINGS)


@pytest.fixture
def commitment():
    return Commitment(TRAVEL.__getitem__)


def test_waits_until_enough_probes_over_enough_travel_agree(commitment):
    for key, probe in enumerate((200, 203)):
        commitment.add(key, hypothesis(probe, 20 + key))
        assert commitment.settle(TRAVEL[probe], BELIEF) == []
    commitment.add(2, hypothesis(206, 22))
    assert commitment.settle(TRAVEL[206], BELIEF) == []
    commitment.add(3, hypothesis(210, 24))
    settled = commitment.settle(TRAVEL[210], BELIEF)
    assert [s.key for s in settled] == [0, 1, 2, 3]
    assert all(s.accepted for s in settled)
    assert [(check.figure, check.value) for check in settled[0].checks] == [("probes", 4), ("span_m", 5.0), ("rival", 0.0)]


def test_a_wider_gate_asks_for_more_travel():
    def travel_needed(sigma_m):
        commitment = Commitment(TRAVEL.__getitem__)
        for key, probe in enumerate(range(200, 240, 2)):
            commitment.add(key, hypothesis(probe, 20, sigma_m=sigma_m))
            if commitment.settle(TRAVEL[probe], BELIEF):
                return TRAVEL[probe] - TRAVEL[200]
        return np.inf

    needed = [travel_needed(s) for s in (0.3, 5.0, 50.0)]
    assert needed == [3.0, 5.0, 8.0]


def test_at_the_end_the_rule_of_a_narrow_gate_holds_for_all(commitment):
    for key, probe in enumerate((200, 203, 206)):
        commitment.add(key, hypothesis(probe, 20, sigma_m=50.0))
    assert commitment.settle(TRAVEL[206], BELIEF) == []
    assert [s.accepted for s in commitment.flush(BELIEF)] == [True, True, True]


def test_fewer_are_enough_where_the_gate_is_narrow(commitment):
    commitment.add(0, hypothesis(200, 20, sigma_m=0.3))
    assert commitment.settle(TRAVEL[200], BELIEF) == []
    commitment.add(1, hypothesis(207, 22, sigma_m=0.3))
    assert [s.accepted for s in commitment.settle(TRAVEL[207], BELIEF)] == [True, True]


def test_an_equal_rival_blocks_and_a_weak_one_is_refused(commitment):
    for key, probe in enumerate((200, 206, 212, 220)):
        commitment.add(2 * key, hypothesis(probe, 20))
        commitment.add(2 * key + 1, hypothesis(probe, 20, where=(6.0, 5.0, 0.3), quality=0.65))
    assert commitment.settle(TRAVEL[220], BELIEF) == []
    for key, probe in enumerate((224, 228), start=10):
        commitment.add(key, hypothesis(probe, 24))
    settled = commitment.settle(TRAVEL[228], BELIEF)
    assert {s.key for s in settled if s.accepted} == {0, 2, 4, 6, 10, 11}
    assert {s.key for s in settled if not s.accepted} == {1, 3, 5, 7}
    assert all(s.lack is Lack.CONTRADICTED for s in settled if not s.accepted)


def test_single_hypotheses_that_agree_with_nothing_are_given_up(commitment):
    for key, probe in enumerate((200, 206, 212, 220)):
        commitment.add(key, hypothesis(probe, 20, where=(2.0 + 3.0 * key, 5.0, 0.3)))
    assert commitment.settle(TRAVEL[220], BELIEF) == []
    late = commitment.settle(TRAVEL[200] + 33.0, BELIEF)
    assert [(s.key, s.accepted) for s in late] == [(0, False)]
    assert late[0].lack is Lack.UNSUPPORTED
    assert [(s.key, s.accepted) for s in commitment.flush(BELIEF)] == [(1, False), (2, False), (3, False)]
    assert commitment.flush(BELIEF) == []


def test_several_hypotheses_of_one_probe_count_once(commitment):
    for key in range(6):
        commitment.add(key, hypothesis(200 + key // 3, 20 + key))
    assert commitment.settle(TRAVEL[202], BELIEF) == []


def driven(commitment, probes, **given):
    """Settle one hypothesis after the other, and then the rest of the group's wait; returns what was settled."""
    out = []
    for probe in probes:
        commitment.add(probe, hypothesis(probe, 20, **given))
        out += commitment.settle(TRAVEL[probe], BELIEF)
    return out


def test_six_that_miss_a_limit_by_a_hair_close_a_loop_together(commitment):
    assert driven(commitment, range(200, 232, 4), near=0.45) == []
    settled = driven(commitment, [232], near=0.45)
    assert [s.key for s in settled] == list(range(200, 236, 4))
    edges = [s.proposed() for s in settled]
    assert all(edge.status is Status.ACCEPTED for edge in edges)
    near = next(check for check in edges[0].checks if check.figure == "near")
    assert near.limit == pytest.approx(0.5 - np.sqrt(0.25 / THINGS))
    assert near.passed
    assert [check.value for check in edges[0].checks if check.figure == "probes"] == [4.5]


def test_five_are_too_few_and_one_that_kept_the_limits_counts_for_two(commitment):
    five = list(range(200, 240, 8))
    assert driven(commitment, five, near=0.45) == []
    assert commitment.flush(BELIEF) == []
    commitment = Commitment(TRAVEL.__getitem__)
    commitment.add(0, hypothesis(198, 20))
    assert [s.key for s in driven(commitment, five, near=0.45) if s.accepted] == [0, *five]


def test_what_misses_by_more_than_a_hair_counts_nothing(commitment):
    assert driven(commitment, range(200, 260, 4), near=0.43) == []
    assert commitment.flush(BELIEF) == []


def test_a_loop_that_was_closed_needs_no_group(commitment):
    assert driven(commitment, range(200, 216, 4), near=0.45) == []
    full = driven(commitment, (216, 222, 226))
    assert [s.key for s in full if s.accepted] == [216, 222, 226]
    assert driven(commitment, range(228, 250, 8), near=0.45) == []
    assert commitment.flush(BELIEF) == []


def test_an_equal_rival_blocks_a_group(commitment):
    for probe in range(200, 240, 4):
        commitment.add(probe, hypothesis(probe, 20, near=0.45))
        commitment.add(1000 + probe, hypothesis(probe, 20, where=(6.0, 5.0, 0.3), near=0.45))
        assert commitment.settle(TRAVEL[probe], BELIEF) == []
    assert commitment.flush(BELIEF) == []


def test_at_the_end_a_group_waits_no_longer(commitment):
    assert driven(commitment, range(200, 212, 2), near=0.45) == []
    assert [s.key for s in commitment.flush(BELIEF) if s.accepted] == list(range(200, 212, 2))


def test_at_the_end_those_that_kept_the_limits_count_in_a_group(commitment):
    commitment.add(0, hypothesis(198, 20))
    assert driven(commitment, range(200, 216, 4), near=0.45) == []
    assert {s.key for s in commitment.flush(BELIEF) if s.accepted} == {0, 200, 204, 208, 212}
    assert commitment.flush(BELIEF) == []


def test_a_group_refuses_what_waits_and_contradicts_it(commitment):
    commitment.add(0, hypothesis(198, 20, where=(6.0, 5.0, 0.3)))
    settled = driven(commitment, range(200, 236, 4), near=0.45)
    assert [(s.key, s.lack) for s in settled if not s.accepted] == [(0, Lack.CONTRADICTED)]
    assert len(settled) == 10


def test_a_loop_closed_long_before_takes_no_member_from_a_group(commitment):
    full = driven(commitment, (100, 106, 110))
    assert all(s.accepted for s in full)
    assert len(full) == 3
    assert len(driven(commitment, range(200, 236, 4), near=0.45)) == 9


def test_a_probe_gives_a_group_two_members_at_most(commitment):
    for key, probe in enumerate(range(200, 236, 4)):
        for n in range(3):
            commitment.add(3 * key + n, hypothesis(probe, 20 + n, near=0.45))
        settled = commitment.settle(TRAVEL[probe], BELIEF)
    assert len(settled) == 18
