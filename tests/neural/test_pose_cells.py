"""RatSLAM's pose cells behave as was published: one packet follows self-motion, and familiar views move it, but not at once."""

from __future__ import annotations

import time
from copy import deepcopy

import numpy as np
import pytest

from hybridmap.geometry import compose
from hybridmap.neural.pose_cells import CELL_M, CELL_RAD, HEADINGS, SIDE, YOUNG_VIEWS, PoseCells, apart_cells

SIZE = np.array([SIDE, SIDE, HEADINGS])
METRIC = np.array([CELL_M, CELL_M, CELL_RAD])


def way(cells, steps):
    """How far the packet moved while each step showed a new view, cells, without wraps."""
    moved, place = np.zeros(3), cells.place
    for step in steps:
        now = cells.step(len(cells), step)
        moved += (now - place + SIZE / 2) % SIZE - SIZE / 2
        place = now
    return moved


def elsewhere(cells, steps=40):
    """Carry the packet to the other side of the network, and let it stay there before an unknown view."""
    cells.activity = np.roll(cells.activity, (9, 12, 12), axis=(0, 1, 2))
    view = len(cells)
    for _ in range(steps):
        cells.step(view, np.zeros(3))


def learnt(views=40):
    """Cells after a straight way, and the place of each view on it."""
    cells = PoseCells()
    return cells, [cells.step(view, [0.1, 0.0, 0.0]) for view in range(views)]


def test_activity_is_one_packet_of_a_few_cells():
    cells, _ = learnt()
    assert cells.activity.sum() == pytest.approx(1.0)
    assert cells.activity.min() == 0.0
    t, x, y = np.nonzero(cells.activity)
    assert apart_cells(np.stack([x, y, t], axis=1), cells.place).max() < 5.0


@pytest.mark.parametrize(("step_m", "lag"), [(0.05, 0.10), (0.1, 0.04), (0.3, 0.03)])
def test_the_packet_follows_a_straight_way_and_wraps(step_m, lag):
    """It lags by some per cent, the more the smaller the steps are against a cell: the cells' grid holds it back."""
    cells = PoseCells()
    heading = cells.place[2] * CELL_RAD
    moved = way(cells, [[step_m, 0.0, 0.0]] * round(12.0 / step_m)) * METRIC
    ahead, aside = moved[:2] @ np.array([[np.cos(heading), -np.sin(heading)], [np.sin(heading), np.cos(heading)]])
    assert ahead == pytest.approx(12.0, rel=lag)
    assert ahead > SIDE * CELL_M
    assert abs(aside) < 0.05
    assert abs(moved[2]) < 0.02


@pytest.mark.parametrize("turn_rad", [0.1, -0.16])
def test_the_packet_follows_a_turn_on_the_spot_without_moving(turn_rad):
    moved = way(PoseCells(), [[0.0, 0.0, turn_rad]] * 20) * METRIC
    assert moved[2] == pytest.approx(20 * turn_rad, rel=0.06)
    assert np.hypot(*moved[:2]) < 0.02


def test_the_packet_follows_a_curve_to_the_left_and_a_step_aside():
    cells = PoseCells()
    start = cells.place[2] * CELL_RAD
    pose = np.array([0.0, 0.0, start - 2.0 * np.pi])
    steps = [[0.1, 0.0, 0.1]] * 15 + [[0.0, 0.1, 0.0]] * 20
    moved = way(cells, steps) * METRIC
    for step in steps:
        pose = compose(pose, step)
    assert moved == pytest.approx(pose - [0.0, 0.0, start - 2.0 * np.pi], abs=0.15)


def test_a_familiar_view_elsewhere_does_not_move_the_packet_at_once_but_several_in_a_row_do():
    after = {}
    for views in (1, 2, 6):
        cells, places = learnt()
        elsewhere(cells)
        away = cells.place
        for view in range(5, 5 + views):
            now = cells.step(view, [0.1, 0.0, 0.0])
        after[views] = apart_cells(now, places[4 + views]), apart_cells(now, away)
    assert after[1][0] > 8.0
    assert after[2][0] > 8.0
    assert after[6][0] < 1.0
    assert after[6][1] > 8.0


def test_a_view_that_is_seen_over_and_over_soon_adds_nothing():
    cells, places = learnt()
    elsewhere(cells)
    away = cells.place
    for _ in range(30):
        cells.step(5, np.zeros(3))
    assert apart_cells(cells.place, places[5]) > 8.0
    assert apart_cells(cells.place, away) < 0.5


@pytest.mark.parametrize(("rest", "adds"), [(1, False), (55, False), (65, True)])
def test_a_view_seen_five_times_adds_again_only_after_a_rest(rest, adds):
    """It has lost 5.8 by then, regains 0.05 in an iteration, and adds something below ln(30) / 1.2 = 2.83: after 60."""
    cells, _ = learnt()
    elsewhere(cells)
    for _ in range(5):
        cells.step(5, np.zeros(3))
    elsewhere(cells, rest)
    with_view, without = deepcopy(cells), deepcopy(cells)
    with_view.step(5, np.zeros(3))
    without.step(len(cells) - 1, np.zeros(3))
    assert (not np.array_equal(with_view.activity, without.activity)) == adds


def test_of_two_packets_the_weaker_one_dies():
    cells, places = learnt()
    elsewhere(cells)
    cells.step(5, np.zeros(3))
    there = cells.activity[tuple(np.rint(places[5][[2, 0, 1]]).astype(int))]
    assert there > 0.0
    for _ in range(60):
        cells.step(len(cells) - 1, np.zeros(3))
    assert cells.activity[tuple(np.rint(places[5][[2, 0, 1]]).astype(int))] == 0.0


def test_a_view_that_is_seen_at_another_heading_pulls_towards_that_heading():
    cells, places = learnt()
    elsewhere(cells)
    for view in range(5, 15):
        now = cells.step(view, [0.1, 0.0, 0.0], 2.0 * CELL_RAD)
    assert (now - places[14])[2] == pytest.approx(2.0, abs=0.3)


def test_the_newest_views_add_nothing():
    cells, _ = learnt()
    before = PoseCells()
    for view in range(40):
        before.step(view, [0.1, 0.0, 0.0])
    newest = len(cells) - YOUNG_VIEWS
    cells.step(newest, [0.1, 0.0, 0.0])
    before.step(len(before), [0.1, 0.0, 0.0])
    assert np.array_equal(cells.activity, before.activity)


def test_places_wrap():
    assert apart_cells([[0.0, 0.0, 0.0], [29.5, 1.0, 35.0]], [0.0, 0.0, 0.0]) == pytest.approx([0.0, np.sqrt(2.25)])


def test_the_same_drive_gives_the_same_activity():
    assert np.array_equal(learnt()[0].activity, learnt()[0].activity)


def test_an_iteration_takes_two_milliseconds_at_most():
    cells, _ = learnt()
    begin = time.process_time()
    for _ in range(200):
        cells.step(len(cells), [0.1, 0.0, 0.05])
    assert (time.process_time() - begin) / 200 < 2e-3
