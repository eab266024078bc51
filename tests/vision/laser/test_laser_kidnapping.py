"""A laser robot that is carried away in a ring of corridors, unseen, is found on the whole map."""

import numpy as np
import pytest

from hybridmap.config.vision import VisionConfig
from hybridmap.geometry import between, compose
from hybridmap.graph.edges import EdgeKind, Lack, Method, Search, Status
from hybridmap.vision import relocalising
from hybridmap.vision.laser import kidnapping
from hybridmap.vision.laser.hypotheses import WINDOW_M, Prober
from hybridmap.vision.laser.panorama import Panoramas
from tests.vision.laser.laser_worlds import LASER, Run, drifting, ring, ring_drive

EVERY = 5
UP, DOWN, STOP = 700, 1000, 1100
"""On the second lap the robot is picked up after so many steps of 0.1 m; it drives on, and stops, so far along the drive."""


def carried(up=UP, down=DOWN, stop=STOP):
    """The run, and the node at which the robot is on the floor again."""
    way = ring_drive(2.1)
    truth = np.concatenate([way[:up], way[down:stop]])
    felt = np.concatenate([way[:up], compose(way[up - 1], between(way[down], way[down:stop]))])
    return Run(ring(), truth, drifting(felt, np.random.default_rng(2)), EVERY), up // EVERY


@pytest.fixture(scope="module")
def found():
    return carried()


def last_words(run):
    """What became of each edge that was proposed."""
    return {p.key: p for p in run.proposals}.values()


def across(run, down):
    """Accepted loops from after the carry to before it."""
    return [p for p in run.loops(Status.ACCEPTED) if p.source >= down > p.target]


def test_the_break_is_noticed_and_the_chain_is_joined_anew(found):
    run, down = found
    into = [p for p in last_words(run) if p.kind is EdgeKind.REGISTRATION and p.target == down]
    seen = next(p for p in run.proposals if p.target == down and p.kind is EdgeKind.REGISTRATION)
    assert seen.broken_by
    assert not any(check.passed for check in seen.broken_by)
    rejected = next(p for p in into if p.key == seen.key)
    assert rejected.status is Status.REJECTED
    assert rejected.lack is Lack.KIDNAPPED
    reattached = next(p for p in into if p.status is Status.ACCEPTED)
    assert (reattached.source, reattached.target, reattached.contradicts_odometry) == (down - 1, down, True)
    error = run.error(reattached)
    assert np.hypot(error[0], error[1]) < 0.2
    assert abs(error[2]) < np.deg2rad(2.0)


def test_it_is_found_within_five_metres_by_loops_that_are_right(found):
    run, down = found
    way = np.hypot(*np.diff(run.truth[run.node_at[down] :, :2], axis=0).T).cumsum()
    loops = [p for p in across(run, down) if p.search is Search.WHOLE_MAP]
    assert len({p.source for p in loops}) >= relocalising.SUPPORT
    newest = max(p.source for p in loops)
    assert way[run.node_at[newest] - run.node_at[down] - 1] < 5.0
    errors = np.array([run.error(p) for p in across(run, down)])
    assert np.hypot(errors[:, 0], errors[:, 1]).max() < 0.15
    assert np.abs(errors[:, 2]).max() < np.deg2rad(2.0)


def test_what_was_sought_on_the_whole_map_stays_with_its_figures(found):
    run, down = found
    sought = [p for p in last_words(run) if p.search is Search.WHOLE_MAP and p.kind is EdgeKind.LOOP]
    assert all(p.source >= down > p.target and p.status is not Status.PENDING for p in sought)
    assert all({"near", "fit"} < {check.figure for check in p.checks} for p in sought)
    assert all("off_m" not in {check.figure for check in p.checks} and "gate_sigma_m" not in p.figures for p in sought)


def test_mismatch_is_held_against_how_well_the_scans_of_the_drive_fit(found):
    run, down = found
    steps = {p.target: 1.0 - p.figures["fit"] for p in run.proposals if p.method is Method.SCANS and p.search is Search.CHAIN}
    usual = kidnapping.MISFIT
    sightings = [p for p in last_words(run) if "mismatch" in p.figures]
    assert len(sightings) >= 4
    for p in sightings:
        before = [misfit for node, misfit in steps.items() if node <= p.source and node != down]
        mean = (sum(before) + 10 * usual) / (len(before) + 10)
        assert mean < usual
        value = {check.figure: check.value for check in p.checks}
        badly = 1.0 - value["fit"] + value["violation"]
        assert p.figures["mismatch"] == pytest.approx(badly * usual / mean)


def test_submaps_of_either_side_are_not_mixed(found):
    run, down = found
    atlas = run.front_end.atlas
    assert atlas.around(down + 2, 4.0).nodes[0] == down
    assert atlas.around(down - 2, 4.0).nodes[-1] == down - 1


def test_scans_are_traced_on_either_side_of_the_carry(found):
    run, down = found
    final = between(run.truth[0], run.truth[run.node_at])
    retraced = run.front_end.dense_trajectory(run.belief(final))
    index = (retraced.stamps_ns - 1_000_000_000) // 100_000_000
    assert not np.any((index > run.node_at[down - 1]) & (index < run.node_at[down]))
    assert {*range(EVERY * (down - 8), run.node_at[down - 1] + 1), *range(UP, UP + 40)} <= set(index.tolist())
    off = between(between(run.truth[0], run.truth[index]), compose(final[retraced.nodes], retraced.deltas))
    assert np.percentile(np.hypot(off[:, 0], off[:, 1]), 95) < 0.03


def test_of_many_submaps_those_with_the_likeliest_views_are_searched(found, monkeypatch):
    run, down = found
    searched = run.front_end.localisation
    atlas = run.front_end.atlas
    anchors = Prober(VisionConfig(), atlas, LASER, Panoramas(atlas, 64)).anchors_before(down)
    assert searched.most_similar(down + 2, anchors) == anchors
    monkeypatch.setattr(kidnapping, "SUBMAPS", 3)
    places = run.truth[run.node_at]
    near = []
    for node in range(down + 2, down + 8):
        chosen = searched.most_similar(node, anchors)
        assert chosen == sorted(chosen)
        assert len(chosen) == 3 < len(anchors)
        near.append(np.hypot(*(places[chosen, :2] - places[node, :2]).T).min() < WINDOW_M)
    assert np.mean(near) > 0.6


def test_in_a_place_that_it_does_not_know_it_is_not_found():
    run, down = carried(up=200, down=420, stop=600)
    assert [p.target for p in run.proposals if p.broken_by] == [down]
    assert across(run, down) == []
    on_top = np.array(run.poses)
    on_top[down:] = compose(on_top[0], between(on_top[down], on_top[down:]))
    at_the_end = run.front_end.finish(run.belief(on_top))
    assert run.front_end.lost_since == down
    assert len(at_the_end) > 0
    assert [p for p in at_the_end if p.source >= down > p.target and p.status is not Status.REJECTED] == []
    assert [p for p in at_the_end if p.source >= down > p.target and p.search is not Search.WHOLE_MAP] == []


def test_a_glimpse_of_something_else_is_no_carry():
    """For the time of one node the robot is shown another place: its chain breaks, and the next scans mend it."""
    way = ring_drive(2.1)[:840]
    truth = way.copy()
    truth[658:663] = ring_drive(2.1)[1000:1005]
    run = Run(ring(), truth, drifting(way, np.random.default_rng(2)), EVERY)
    assert [p.target for p in run.proposals if p.broken_by] == [660 // EVERY]
    assert not [p for p in run.proposals if p.kidnapped_m is not None]
    assert not any(p.broken_by for p in last_words(run))
    assert not [p for p in run.proposals if p.search is Search.WHOLE_MAP]
    assert len(run.front_end.atlas.pieces) == 1
    assert run.front_end.lost_since is None
    assert run.front_end.localisation.since == 0
