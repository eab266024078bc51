"""The laser front-end as the mapper drives it."""

import dataclasses

import numpy as np
import pytest

from hybridmap.config.vision import ClosingConfig, VisionConfig
from hybridmap.errors import StreamError
from hybridmap.geometry import IDENTITY, between, compose, log
from hybridmap.graph.edges import Edge, EdgeKind, Lack, Proposer, Search, Status
from hybridmap.streams.laser import LaserScan
from hybridmap.streams.rgbd import RgbdFrame
from hybridmap.vision.base import DenseFrontEnd, VerifyingFrontEnd
from hybridmap.vision.laser import checks, hypotheses
from hybridmap.vision.laser.front_end import LaserFrontEnd
from tests.vision.laser.laser_worlds import LASER, Run, cast, corridor, drifting, ring, ring_drive, room


@pytest.fixture(scope="module")
def two_laps():
    truth = ring_drive(1.6)
    return Run(ring(), truth, drifting(truth, np.random.default_rng(2)))


def test_a_second_lap_is_closed_rightly(two_laps):
    accepted = two_laps.loops(Status.ACCEPTED)
    assert len(accepted) >= 5
    errors = np.array([two_laps.error(p) for p in accepted])
    assert np.hypot(errors[:, 0], errors[:, 1]).max() < 0.25
    assert np.abs(errors[:, 2]).max() < np.deg2rad(3.0)
    assert all(p.source > p.target for p in accepted)
    for p in accepted:
        assert np.linalg.eigvalsh(p.relative.covariance).min() > 0


def test_nothing_is_accepted_on_the_first_lap(two_laps):
    first_lap = 4 * 60
    loops = [p for p in two_laps.proposals if p.kind is EdgeKind.LOOP and p.status is Status.ACCEPTED]
    assert [p for p in loops if p.source < first_lap // 5] == []


def loops_of_a_lap_and_a_half(by="geometry"):
    truth = ring_drive(1.6)
    config = VisionConfig(closing=ClosingConfig(by=by))
    run = Run(ring(), truth, drifting(truth, np.random.default_rng(2)), config=config)
    at_the_end = run.front_end.finish(run.belief(between(truth[0], truth[run.node_at])))
    return run.loops(Status.ACCEPTED), [p for p in at_the_end if p.search is Search.NEAR]


def test_every_loop_names_what_proposed_it_and_most_are_profiles(two_laps):
    proposed = [p.proposed_by for p in two_laps.loops(Status.ACCEPTED)]
    assert set(proposed) <= {Proposer.PROFILE, Proposer.PROXIMITY}
    assert proposed.count(Proposer.PROFILE) > 0.5 * len(proposed)


def test_profiles_close_a_lap_where_the_gate_is_not_searched(monkeypatch):
    monkeypatch.setattr(hypotheses, "survivors", lambda *_: [])
    accepted, _ = loops_of_a_lap_and_a_half()
    assert len(accepted) >= 5
    assert {p.proposed_by for p in accepted} == {Proposer.PROFILE}


def test_without_profiles_the_gate_is_searched_and_the_nearest_of_each_pass_are_registered():
    accepted, near = loops_of_a_lap_and_a_half(by="proximity")
    assert len(accepted) >= 5
    assert len(near) >= 10
    assert {p.proposed_by for p in [*accepted, *near]} == {Proposer.PROXIMITY}


def test_the_gate_is_searched_only_where_no_loop_by_profile_passes(two_laps):
    loops = [p for p in two_laps.proposals if p.kind is EdgeKind.LOOP and p.search is Search.GATE]
    by_profile = {p.source for p in loops if p.proposed_by is Proposer.PROFILE and not p.failed}
    others = {p.source for p in loops if p.proposed_by is Proposer.PROXIMITY}
    assert by_profile
    assert others
    assert not by_profile & others


def test_a_closure_waits_before_it_is_accepted(two_laps):
    history: dict[int, list[Status]] = {}
    for p in two_laps.proposals:
        history.setdefault(p.key, []).append(p.status)
    accepted = [v for v in history.values() if Status.ACCEPTED in v and v != [Status.ACCEPTED]]
    assert accepted
    assert all(v == [Status.PENDING, Status.ACCEPTED] for v in accepted)


def test_an_edge_is_explained_by_a_failed_check_or_a_named_lack_unless_it_was_accepted(two_laps):
    assert all((p.status is Status.ACCEPTED) != bool(p.failed or p.lack) for p in two_laps.proposals)


def test_an_accepted_loop_has_passed_every_check(two_laps):
    every = ["near", "fit", "off_m", "off_deg", "loosest_m", "ambiguity", "violation", "probes", "span_m", "rival"]
    driving = [p for p in two_laps.loops(Status.ACCEPTED) if p.search is Search.GATE]
    assert driving
    assert all([check.figure for check in p.checks] == every for p in driving)
    steps = [p for p in two_laps.proposals if p.search is Search.CHAIN and p.status is Status.ACCEPTED]
    assert all(p.checks[0].figure == "inliers" for p in steps)


def test_re_proposal_on_the_right_map_is_right_and_ends(two_laps):
    start = two_laps.truth[0]
    final = between(start, two_laps.truth[two_laps.node_at])
    proposals = two_laps.front_end.finish(two_laps.belief(final))
    near = [p for p in proposals if p.status is Status.ACCEPTED]
    assert len(near) >= 10
    every = ["near", "fit", "off_m", "off_deg", "violation"]
    assert all([check.figure for check in p.checks] == every for p in near if p.search is Search.NEAR)
    assert {p.proposed_by for p in near} == {Proposer.PROFILE, Proposer.PROXIMITY}
    errors = np.array([two_laps.error(p) for p in near])
    assert np.hypot(errors[:, 0], errors[:, 1]).max() < 0.15
    for _ in range(VisionConfig().closing.revisit_rounds):
        proposals = two_laps.front_end.finish(two_laps.belief(final))
    assert proposals == []


def test_covariances_say_how_wrong_edges_are(two_laps):
    start = two_laps.truth[0]
    proposals = [p for p in two_laps.proposals if p.status is Status.ACCEPTED]
    proposals += two_laps.front_end.finish(two_laps.belief(between(start, two_laps.truth[two_laps.node_at])))
    for kind in (EdgeKind.REGISTRATION, EdgeKind.LOOP):
        edges = [p for p in proposals if p.kind is kind and p.status is Status.ACCEPTED]
        errors = [log(two_laps.error(p)) for p in edges]
        chi2 = [e @ np.linalg.solve(p.relative.covariance, e) for e, p in zip(errors, edges, strict=True)]
        assert 0.5 * 2.366 < np.median(chi2) < 2.0 * 2.366, kind


def test_a_doubted_loop_is_measured_again_and_one_of_two_places_is_not_found(two_laps):
    final = between(two_laps.truth[0], two_laps.truth[two_laps.node_at])
    loop = two_laps.loops(Status.ACCEPTED)[0]
    other_side = int(np.argmax(np.hypot(*(final[: loop.source, :2] - final[loop.source, :2]).T)))
    outliers = [loop, dataclasses.replace(loop, target=other_side, key=4711)]
    found, lost = two_laps.front_end.verify(outliers, two_laps.belief(final))
    assert (found.key, found.source, found.target, found.status) == (loop.key, loop.source, loop.target, Status.ACCEPTED)
    assert (found.search, found.proposed_by) == (Search.AGAIN, loop.proposed_by)
    assert np.hypot(*two_laps.error(found)[:2]) < 0.05
    assert (lost.key, lost.status) == (4711, Status.REJECTED)


def test_scans_between_nodes_are_put_right_on_the_final_map(two_laps):
    final = between(two_laps.truth[0], two_laps.truth[two_laps.node_at])
    assert isinstance(two_laps.front_end, DenseFrontEnd)
    assert isinstance(two_laps.front_end, VerifyingFrontEnd)
    retraced = two_laps.front_end.dense_trajectory(two_laps.belief(final))
    assert len(retraced.nodes) > 0.95 * len(two_laps.truth)
    assert (np.diff(retraced.stamps_ns) > 0).all()
    index = (retraced.stamps_ns - 1_000_000_000) // 100_000_000
    off = between(between(two_laps.truth[0], two_laps.truth[index]), compose(final[retraced.nodes], retraced.deltas))
    assert np.percentile(np.hypot(off[:, 0], off[:, 1]), 95) < 0.03
    assert np.percentile(np.abs(off[:, 2]), 95) < np.deg2rad(0.5)


@pytest.mark.parametrize(
    ("asked", "lack", "unexpected"),
    [
        (checks.of_gate(4.0, 1.0, 3.0, 20.0), None, True),
        ((), Lack.UNSUPPORTED, True),
        ((), Lack.CONTRADICTED, True),
        (checks.of_gate(4.0, 1.0, 3.0, 20.0), Lack.NOT_LOST, False),
        ((), Lack.KIDNAPPED, False),
        (checks.of_free_space(0.3), None, False),
        (checks.of_free_space(0.3), Lack.UNSUPPORTED, False),
    ],
)
def test_a_loop_is_unexpected_if_all_that_was_seen_fits(two_laps, asked, lack, unexpected):
    loop = Edge.decided(9, 1, EdgeKind.LOOP, two_laps.loops(Status.ACCEPTED)[0].relative, asked, lack)
    assert two_laps.front_end.unexpected(loop) is unexpected


def test_two_different_rooms_are_not_one():
    shift = np.array([30.0, 0.0, 30.0, 0.0])
    other = np.array(
        [(-4, -3, 4, -3), (4, -3, 4, 3), (4, 3, -4, 3), (-4, 3, -4, -3), (-1, -1, 1, -1), (1, -1, 1, 0.5), (-4, 0, -2, 0)]
    )
    world = np.concatenate([room(), other + shift])
    path = np.column_stack([np.linspace(-1.5, 1.5, 60), np.full(60, -0.3), np.zeros(60)])
    back, far = path[::-1], np.array([30.0, 1.6, 0.0])
    truth = np.concatenate([path, back, path, back, path + far, back + far])
    run = Run(world, truth, np.concatenate([truth[:240], truth[240:] - [30.0, 0.0, 0.0]]))
    first_in_second_room = 240 // 5
    wrong = [p for p in run.loops(Status.ACCEPTED) if p.source >= first_in_second_room + 4 and p.target < first_in_second_room]
    assert wrong == []


def test_a_bare_corridor_closes_nothing():
    x = np.concatenate([np.linspace(-12, 12, 240), np.linspace(12, -12, 240)])
    truth = np.column_stack([x, np.zeros(480), np.repeat([0.0, np.pi], 240)])
    run = Run(corridor(), truth, truth)
    assert run.loops(Status.ACCEPTED) == []


def test_two_runs_give_the_same_bytes():
    truth = ring_drive(1.3)[:420]
    odometry = drifting(truth, np.random.default_rng(2))

    def flat(run):
        return b"".join(
            p.relative.delta.tobytes() + p.relative.covariance.tobytes() for p in run.proposals if p.relative is not None
        )

    a, b = Run(ring(), truth, odometry), Run(ring(), truth, odometry)
    assert flat(a) == flat(b)
    decided = [[(p.key, p.source, p.target, p.kind, p.status) for p in run.proposals] for run in (a, b)]
    assert decided[0] == decided[1]


def test_without_refined_self_motion_the_chain_is_the_odometry():
    truth = ring_drive(0.4)
    odometry = drifting(truth, np.random.default_rng(2))
    run = Run(ring(), truth, odometry, config=VisionConfig.model_validate({"tracking": {"enabled": False}}))
    assert [p for p in run.proposals if p.kind is EdgeKind.REGISTRATION] == []
    last = run.node_at[-1]
    np.testing.assert_allclose(log(between(run.poses[-1], between(odometry[0], odometry[last]))), 0.0, atol=1e-9)


def test_scans_found_view_templates_and_are_recognised():
    truth = ring_drive(2.0)[::5]
    rng = np.random.default_rng(1)
    scans = [LaserScan(i, cast(ring(), pose, rng)) for i, pose in enumerate(truth)]
    views = {}
    for on in (True, False):
        config = VisionConfig.model_validate({"laser": {"scan": {"templates": on}}})
        front_end = LaserFrontEnd(config, LASER)
        views[on] = [front_end.observe(scan, IDENTITY) for scan in scans]
    numbers, lap = np.array([view.template for view in views[True]]), len(truth) // 2
    founded = [i for i, view in enumerate(views[True]) if view.new_template]
    assert founded[0] == 0
    assert 2 <= len(founded) == numbers.max() + 1
    assert founded[-1] < lap
    assert np.mean(numbers[lap : 2 * lap] == numbers[:lap]) > 0.8
    assert {view.template for view in views[False]} == {-1}


def test_frames_of_another_kind_are_refused():
    front_end = LaserFrontEnd(VisionConfig(), LASER)
    with pytest.raises(StreamError, match="expected a LaserScan"):
        front_end.observe(RgbdFrame(0, np.zeros((2, 2, 3), np.uint8), np.zeros((2, 2), np.float32)), IDENTITY)
    with pytest.raises(StreamError, match="271 ranges, found"):
        front_end.observe(LaserScan(0, np.zeros(5, np.float32)), IDENTITY)


def test_a_keyframe_holds_profile_and_ranges():
    front_end = LaserFrontEnd(VisionConfig(), LASER)
    ranges = cast(room(), IDENTITY)
    front_end.add_node(0, front_end.observe(LaserScan(5, ranges), IDENTITY))
    assert front_end.track(0, None) == []
    keyframe = front_end.keyframe(0)
    np.testing.assert_array_equal(keyframe["ranges_m"], ranges)
    assert keyframe["profile"].shape == (1, 64)
