"""When a robot counts as lost, and where its chain broke."""

from hybridmap.vision.relocalising import ChainState, Whereabouts


def test_places_that_are_known_and_not_recognised_make_it_lost():
    whereabouts = Whereabouts(unrecognised=3)
    for _ in range(2):
        whereabouts.unrecognised()
    assert not whereabouts.lost
    whereabouts.recognised()
    for _ in range(3):
        whereabouts.unrecognised()
    assert whereabouts.lost
    assert whereabouts.first_break is None
    whereabouts.recognised()
    whereabouts.tracked(7, ChainState.HOLDS)
    assert not whereabouts.lost


def test_a_robot_that_need_recognise_nothing_is_not_lost():
    whereabouts = Whereabouts(unrecognised=0)
    whereabouts.unrecognised()
    assert not whereabouts.lost


def test_a_break_counts_for_more_than_a_doubt():
    whereabouts = Whereabouts(0, uncertain_nodes=40)
    for node, chain in ((8, ChainState.UNCERTAIN), (9, ChainState.BROKEN), (10, ChainState.HOLDS), (12, ChainState.UNCERTAIN)):
        whereabouts.tracked(node, chain)
    assert whereabouts.lost
    assert whereabouts.first_break == 8
    assert whereabouts.lost_since == 9
    assert [whereabouts.break_before(node) for node in (7, 8, 9, 11, 20)] == [None, 8, 9, 9, 9]
    whereabouts.recognised()
    assert whereabouts.break_before(20) is None
    assert whereabouts.lost_since is None


def test_a_doubt_is_forgotten_and_a_break_is_not():
    whereabouts = Whereabouts(0, uncertain_nodes=5)
    whereabouts.tracked(3, ChainState.UNCERTAIN)
    for node in range(4, 9):
        whereabouts.tracked(node, ChainState.HOLDS)
        assert whereabouts.lost
    whereabouts.tracked(9, ChainState.HOLDS)
    assert not whereabouts.lost
    whereabouts.tracked(10, ChainState.BROKEN)
    whereabouts.tracked(100, ChainState.HOLDS)
    assert whereabouts.break_before(100) == 10
