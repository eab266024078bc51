from dataclasses import replace

import numpy as np
import pytest
from pydantic import ValidationError

from hybridmap.config.vision import (
    ClosingConfig,
    RelocalisingConfig,
    RgbdClosingConfig,
    RgbdConfig,
    TrackingConfig,
    VisionConfig,
)
from hybridmap.errors import ConfigError, StreamError
from hybridmap.geometry import RelativePose, between, compose
from hybridmap.graph.edges import Edge, EdgeKind, Method, Proposer, Search, Status
from hybridmap.streams.base import Rig
from hybridmap.streams.laser import LaserScan
from hybridmap.streams.rgbd import RgbdFrame
from hybridmap.vision import create_front_end
from hybridmap.vision.base import Belief
from hybridmap.vision.rgbd import closing
from hybridmap.vision.rgbd.front_end import RgbdFrontEnd
from tests.narrowing import known
from tests.vision.rgbd.rgbd_room import camera, render, textures

VIEW = camera(width=240)
LAPS, PER_LAP = 2, 14
NOT_CARRIED = RelocalisingConfig(enabled=False)  # one view is of a bare wall, after which the robot might be anywhere


def lap_poses():
    """Two laps on an ellipse in the room, nearly the same poses in both."""
    rng = np.random.default_rng(3)
    t = np.linspace(0.0, 2.0 * np.pi * LAPS, LAPS * PER_LAP, endpoint=False)
    x, y = -0.7 + 0.9 * np.sin(t), -0.5 + 0.6 * np.cos(t)
    poses = np.stack([x, y, np.arctan2(-0.6 * np.sin(t), 0.9 * np.cos(t))], axis=1)
    poses[PER_LAP:] += rng.normal(scale=[0.03, 0.03, 0.02], size=(PER_LAP, 3))
    return poses


def drive(config, poses, bias=0.0, frames=None, sigma=1.0):
    """Run the front-end over poses with biased odometry; returns it, every proposal by key, and odometry poses."""
    rng = np.random.default_rng(8)
    front_end = RgbdFrontEnd(config, VIEW, seed=0)
    odometry = [np.zeros(3)]
    proposals: dict[int, Edge] = {}
    frames = frames or [render(VIEW, p, stamp_ns=i * 10**9, noise=0.002, rng=rng) for i, p in enumerate(poses)]
    for node, frame in enumerate(frames):
        relative = None
        if node:
            step = between(poses[node - 1], poses[node]) * [1.02, 1.0, 1.0] + [0.0, 0.0, bias]
            relative = RelativePose(step, np.diag([0.02, 0.02, np.deg2rad(1.5)]) ** 2)
            odometry.append(compose(odometry[-1], step))
        front_end.add_node(node, front_end.observe(frame, np.zeros(3)))
        found = front_end.track(node, relative) + front_end.close(node, belief_of(odometry, sigma))
        proposals |= {p.key: p for p in found}
    return front_end, proposals, np.array(odometry)


def belief_of(poses, sigma=1.0):
    """A map that says it may be off by `sigma`, m and rad."""
    poses = np.array(poses)
    steps = np.hypot(*np.diff(poses[:, :2], axis=0, prepend=poses[:1, :2]).T)
    return Belief(
        poses, np.arange(float(len(poses))), np.cumsum(steps), lambda _: np.tile(np.eye(3) * sigma**2, (len(poses), 1, 1))
    )


@pytest.fixture(scope="module")
def poses():
    return lap_poses()


@pytest.fixture(scope="module")
def frames(poses):
    rng = np.random.default_rng(8)
    return [render(VIEW, p, stamp_ns=i * 10**9, noise=0.002, rng=rng) for i, p in enumerate(poses)]


@pytest.fixture(scope="module")
def driven(poses, frames):
    return drive(VisionConfig(), poses, np.deg2rad(0.5), frames)


def errors(proposals, poses):
    gaps = [between(between(poses[p.source], poses[p.target]), p.relative.delta) for p in proposals]
    return np.array([[np.hypot(g[0], g[1]), abs(np.rad2deg(g[2]))] for g in gaps])


def sigmas_off(proposal, poses):
    gap = between(between(poses[proposal.source], poses[proposal.target]), proposal.relative.delta)
    return np.sqrt(gap @ np.linalg.solve(proposal.relative.covariance, gap))


def test_consecutive_nodes_are_registered_better_than_odometry(driven, poses):
    accepted = [p for p in driven[1].values() if p.kind is EdgeKind.REGISTRATION and p.status is Status.ACCEPTED]
    assert len(accepted) > 1.6 * len(poses)
    assert all(p.source in (p.target - 1, p.target - 2) for p in accepted)
    assert all(p.checks[0].figure == "depth_inliers" for p in accepted)
    found = errors(accepted, poses)
    assert np.median(found[:, 0]) < 0.004
    assert np.median(found[:, 1]) < 0.1


def test_the_second_lap_closes_on_the_first_and_only_rightly(driven, poses):
    loops = [p for p in driven[1].values() if p.kind is EdgeKind.LOOP]
    accepted = [p for p in loops if p.status is Status.ACCEPTED]
    assert len({p.source for p in accepted}) > 0.6 * PER_LAP
    assert all(p.source > p.target for p in accepted)
    found = errors(accepted, poses)
    assert found[:, 0].max() < 0.05
    assert found[:, 1].max() < 1.0
    by_features = ["matches", "feature_inliers", "feature_inliers_reverse", "height_m", "tilt_deg", "reverse_m", "reverse_deg"]
    every = [*by_features, "off_features_m", "off_features_deg", "depth_inliers", "supporting"]
    asked = [[check.figure for check in p.checks] for p in accepted if p.method is Method.FEATURES_AND_DEPTH]
    assert len(asked) > 10
    assert all(figures == every for figures in asked)


def test_features_that_no_depth_confirms_must_be_many(poses, frames, monkeypatch):
    monkeypatch.setattr("hybridmap.vision.rgbd.pnp.register", lambda *_: None)
    _, proposals, _ = drive(VisionConfig(), poses[: PER_LAP + 5], 0.0, frames[: PER_LAP + 5])
    alone = [p for p in proposals.values() if p.method is Method.FEATURES and p.status is Status.ACCEPTED]
    assert alone
    assert all([check.figure for check in p.checks][-2:] == ["feature_inliers_both", "supporting"] for p in alone)


def test_without_profiles_the_nearest_on_the_map_are_tried_first(poses, frames):
    front_end, proposals, odometry = drive(VisionConfig(closing=ClosingConfig(by="proximity")), poses, np.deg2rad(0.5), frames)
    tried = [p for p in proposals.values() if p.kind is EdgeKind.LOOP and p.search is Search.GATE]
    accepted = [p for p in tried if p.status is Status.ACCEPTED]
    assert len({p.source for p in accepted}) > 0.6 * PER_LAP
    assert all("profile_G" not in p.figures for p in tried)
    newest = len(poses) - 1
    first = next(p for p in tried if p.source == newest)
    gap = np.hypot(*(odometry[: newest - 9, :2] - odometry[newest, :2]).T)  # ten seconds old
    assert gap[first.target] == pytest.approx(known(first.figures["map_distance_m"]))
    assert gap[first.target] == gap.min()
    assert len(front_end.closer.note(newest)["ranked"]) == 0


def test_profiles_must_rank_where_the_match_alone_is_the_closure():
    with pytest.raises(ValidationError, match=r"expected vision\.rgbd\.verify pnp where vision\.closing\.by is proximity"):
        VisionConfig(closing=ClosingConfig(by="proximity"), rgbd=RgbdConfig(verify="none"))


@pytest.mark.parametrize(("candidates", "proposer"), [(1, Proposer.PROFILE), (1000, Proposer.PROXIMITY)])
def test_profiles_propose_only_where_not_all_of_the_gate_is_verified(candidates, proposer, poses, frames):
    config = VisionConfig(rgbd=RgbdConfig(closing=RgbdClosingConfig(candidates=candidates)), relocalising=NOT_CARRIED)
    _, proposals, _ = drive(config, poses[: PER_LAP + 5], 0.0, frames[: PER_LAP + 5])
    gated = [p.proposed_by for p in proposals.values() if p.search is Search.GATE]
    near = {p.proposed_by for p in proposals.values() if p.search is Search.NEAR}
    assert proposer in gated
    assert set(gated) <= {proposer, Proposer.PROXIMITY}
    assert near <= {Proposer.PROXIMITY}


def test_every_refusal_has_a_reason(driven):
    assert all((p.status is Status.ACCEPTED) != bool(p.failed or p.lack) for p in driven[1].values())


def test_same_input_same_proposals(driven, poses, frames):
    _, again, _ = drive(VisionConfig(), poses, np.deg2rad(0.5), frames)
    assert again.keys() == driven[1].keys()
    for key, proposal in driven[1].items():
        assert again[key].checks == proposal.checks
        if proposal.relative is not None:
            assert np.array_equal(again[key].relative.delta, proposal.relative.delta)
            assert np.array_equal(again[key].relative.covariance, proposal.relative.covariance)


def test_a_lone_closure_waits_and_is_given_up(poses, frames, monkeypatch):
    monkeypatch.setattr(closing, "PENDING_NODES", 2)
    config = VisionConfig(closing=ClosingConfig(revisit_rounds=0))
    there = PER_LAP + 1
    kept = [*range(there), there, 3, 4, 5]  # one revisit, then views too young to close on
    front_end, proposals, odometry = drive(config, poses[kept[: there + 1]], 0.0, [frames[i] for i in kept[: there + 1]])
    loops = [p for p in proposals.values() if p.kind is EdgeKind.LOOP and p.relative is not None]
    lone = [p for p in loops if len({q.source for q in loops}) == 1]
    assert all(p.status is Status.PENDING for p in lone)
    settled = front_end.finish(belief_of(odometry))
    assert all(p.status is Status.REJECTED for p in settled if p.key in {q.key for q in lone})
    assert front_end.finish(belief_of(odometry)) == []


def test_another_place_is_refused(poses, frames):
    """The same poses in a room with other walls: the gate is open, features must say no."""
    other = [
        render(VIEW, p, textures(99), (i + PER_LAP) * 10**9, noise=0.002, rng=np.random.default_rng(i))
        for i, p in enumerate(poses[:6])
    ]
    seen = frames[:PER_LAP] + other
    _, proposals, _ = drive(VisionConfig(), np.concatenate([poses[:PER_LAP], poses[:6]]), 0.0, seen)
    loops = [p for p in proposals.values() if p.kind is EdgeKind.LOOP]
    assert loops
    assert not any(p.status is Status.ACCEPTED for p in loops)


def test_the_end_joins_by_depth_what_features_cannot(poses):
    """The second lap in other wallpaper: features see nothing, walls and the cupboard are the same."""
    papers = textures(1), textures(2)
    config = VisionConfig(relocalising=NOT_CARRIED)
    rng = np.random.default_rng(5)
    repapered = [render(VIEW, p, papers[i >= PER_LAP], i * 10**9, 0.002, rng) for i, p in enumerate(poses)]
    front_end, proposals, odometry = drive(config, poses, np.deg2rad(0.1), repapered)
    assert not any(p.status is Status.ACCEPTED for p in proposals.values() if p.kind is EdgeKind.LOOP)
    found = [p for p in front_end.finish(belief_of(odometry)) if p.status is Status.ACCEPTED and p.target < PER_LAP <= p.source]
    assert len({p.source for p in found}) > 4
    assert all((p.method, p.search) == (Method.DEPTH, Search.NEAR) for p in found)
    every = ["depth_inliers", "overlap", "points", "slack_m", "supporting"]
    assert all([check.figure for check in p.checks] == every for p in found)
    assert np.median(errors(found, poses)[:, 0]) < 0.005
    assert max(sigmas_off(p, poses) for p in found) < 3.0


@pytest.mark.parametrize(("sigma", "joins"), [(0.1, True), (1.0, False)])
def test_while_driving_depth_alone_joins_only_where_the_map_is_sure(sigma, joins, poses):
    papers = textures(1), textures(2)
    repapered = [render(VIEW, p, papers[i >= PER_LAP], i * 10**9) for i, p in enumerate(poses[: PER_LAP + 5])]
    _, proposals, _ = drive(VisionConfig(relocalising=NOT_CARRIED), poses[: PER_LAP + 5], 0.0, repapered, sigma)
    accepted = [p for p in proposals.values() if p.kind is EdgeKind.LOOP and p.status is Status.ACCEPTED]
    assert bool(accepted) == joins


def test_a_bare_wall_leaves_the_way_along_it_to_odometry_and_says_so(poses, frames):
    rng = np.random.default_rng(1)
    bare = np.full((VIEW.height_px, VIEW.width_px, 3), 128, np.uint8)
    walls = [RgbdFrame(k * 10**9, bare, (2.5 + 0.01 * rng.normal(size=bare.shape[:2])).astype(np.float32)) for k in range(3)]
    sideways = np.array([[0.0, 0.1 * k, 0.0] for k in range(3)])
    _, proposals, _ = drive(VisionConfig(), sideways, 0.0, walls)
    free = [p for p in proposals.values() if p.kind is EdgeKind.REGISTRATION]
    assert all(abs(p.figures["free_deg"]) == pytest.approx(90.0, abs=0.5) for p in free)
    _, proposals, _ = drive(VisionConfig(), poses[:3], 0.0, frames[:3])
    assert not any("free_deg" in p.figures for p in proposals.values())


def test_a_wrong_map_is_not_confirmed_by_depth(poses, frames):
    front_end, _, _ = drive(VisionConfig(), poses[:PER_LAP], 0.0, frames[:PER_LAP])
    keyframes = front_end.keyframes
    true = between(poses[5], poses[6])
    there = RelativePose(true, np.diag([0.15, 0.15, 0.05]) ** 2)
    assert front_end.verifier.verify_on_map(keyframes[5], keyframes[6], there).relative is not None
    wrong = RelativePose(true + np.array([0.0, 1.0, 0.6]), np.diag([0.15, 0.15, 0.05]) ** 2)
    refused = front_end.verifier.verify_on_map(keyframes[5], keyframes[6], wrong)
    assert refused.relative is None
    assert refused.lack or not all(check.passed for check in refused.checks)


def test_frames_without_depth_make_nodes_and_no_edges():
    front_end = RgbdFrontEnd(VisionConfig(), VIEW, seed=0)
    blind = RgbdFrame(0, np.full((VIEW.height_px, VIEW.width_px, 3), 90, np.uint8), np.full((180, 240), np.nan, np.float32))
    step = RelativePose(np.array([0.2, 0.0, 0.0]), np.diag([0.02, 0.02, 0.02]) ** 2)
    for node in range(3):
        front_end.add_node(node, front_end.observe(blind, np.zeros(3)))
        found = front_end.track(node, step if node else None)
        assert all(p.status is Status.REJECTED for p in found)
    assert front_end.close(2, belief_of(np.zeros((3, 3)))) == []
    assert front_end.finish(belief_of(np.zeros((3, 3)))) == []


@pytest.mark.parametrize("mode", ["literal", "ratio", "signed", "plain", "four-band"])
def test_seed_modes_close_by_the_shift_alone(mode, poses, frames):
    config = VisionConfig(rgbd=RgbdConfig(matching=mode, verify="none"), tracking=TrackingConfig(enabled=False))
    _, proposals, _ = drive(config, poses, 0.0, frames)
    loops = [p for p in proposals.values() if p.kind is EdgeKind.LOOP]
    assert loops
    assert all((p.method, p.search) == (Method.PROFILE, Search.GATE) for p in loops)
    assert all([check.figure for check in p.checks] == ["profile_G"] for p in loops)
    assert all(known(p.relative).delta[:2] == pytest.approx([0.0, 0.0]) for p in loops)
    assert np.sqrt(np.diag(known(loops[0].relative).covariance)) == pytest.approx([0.7, 0.7, np.deg2rad(6.0)])
    if mode in ("plain", "four-band"):
        assert np.median(errors(loops, poses)[:, 1]) < 4.0


def test_keyframe_is_what_came_in(driven, frames):
    kept = driven[0].keyframe(5)
    assert np.array_equal(kept["color"], frames[5].color)
    assert np.array_equal(kept["depth_mm"], np.rint(frames[5].depth_m * 1000).astype(np.uint16))
    assert kept["T_base_camera"] == pytest.approx(VIEW.T_base_camera)
    assert kept["profile"].shape == (8, 64)


def test_wide_images_are_reduced(poses):
    wide = camera(width=480)
    front_end = RgbdFrontEnd(VisionConfig(), wide, seed=0)
    odometry = between(poses[0], poses[1])
    for node in range(2):
        front_end.add_node(node, front_end.observe(render(wide, poses[node]), np.zeros(3)))
    found = front_end.track(1, RelativePose(odometry + 0.02, np.diag([0.03, 0.03, 0.03]) ** 2))
    assert known(found[0].relative).delta == pytest.approx(odometry, abs=5e-3)
    assert front_end.keyframe(0)["color"].shape == (360, 480, 3)


@pytest.mark.parametrize(("width", "columns"), [(160, 53), (240, 48), (320, 64), (640, 64)])
def test_cells_are_smaller_where_the_picture_is_narrow(width, columns):
    view = camera(width=width)
    front_end = RgbdFrontEnd(VisionConfig(), view, seed=0)
    front_end.add_node(0, front_end.observe(render(view, np.zeros(3)), np.zeros(3)))
    assert front_end.keyframes[0].surface.grid.valid.shape[1] == columns


def test_wrong_frames_are_refused():
    front_end = RgbdFrontEnd(VisionConfig(), VIEW, seed=0)
    with pytest.raises(StreamError, match="found LaserScan"):
        front_end.observe(LaserScan(0, np.zeros(3, np.float32)), np.zeros(3))
    frame = render(VIEW, np.zeros(3))
    with pytest.raises(StreamError, match="depth"):
        front_end.observe(replace(frame, depth_m=frame.depth_m[::2, ::2]), np.zeros(3))


def test_the_sensor_chooses_the_front_end():
    assert isinstance(create_front_end(VisionConfig(), Rig(camera=VIEW), 0), RgbdFrontEnd)
    assert create_front_end(VisionConfig(), Rig(), 0) is None
    assert create_front_end(VisionConfig(sensor="none"), Rig(camera=VIEW), 0) is None
    with pytest.raises((ConfigError, StreamError), match="laser"):
        create_front_end(VisionConfig(sensor="laser"), Rig(camera=VIEW), 0)


def test_no_two_edges_join_the_same_nodes(poses, frames):
    front_end, proposals, odometry = drive(VisionConfig(), poses, 0.0, frames, sigma=0.1)
    for _ in range(2):
        proposals |= {p.key: p for p in front_end.finish(belief_of(odometry))}
    joined = [(p.source, p.target) for p in proposals.values() if p.status is Status.ACCEPTED]
    assert len(joined) == len(set(joined))
