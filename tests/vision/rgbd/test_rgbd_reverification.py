"""Loops that a back-end holds for false, measured again from the map; and nodes tried again that a closure has moved."""

from __future__ import annotations

import numpy as np
import pytest

from hybridmap.config import Config
from hybridmap.config.vision import RgbdClosingConfig, RgbdConfig, VisionConfig
from hybridmap.geometry import RelativePose, between, compose
from hybridmap.graph.edges import Edge, EdgeKind, Lack, Method, Search, Status
from hybridmap.mapper import Mapper
from hybridmap.streams.base import Rig
from hybridmap.vision.base import VerifyingFrontEnd
from hybridmap.vision.rgbd import checks, closing
from hybridmap.vision.rgbd.front_end import RgbdFrontEnd
from hybridmap.vision.rgbd.pnp import Verification, Verifier
from hybridmap.vision.rgbd.revisits import Revisits
from tests.narrowing import as_a, known
from tests.vision.rgbd.rgbd_room import camera, render
from tests.vision.rgbd.test_rgbd_front_end import NOT_CARRIED, PER_LAP, VIEW, belief_of, drive, errors, lap_poses

SURE, UNSURE = 0.02, 1.0


@pytest.fixture(scope="module")
def poses():
    return lap_poses()


@pytest.fixture(scope="module")
def frames(poses):
    rng = np.random.default_rng(8)
    return [render(VIEW, pose, stamp_ns=i * 10**9, noise=0.002, rng=rng) for i, pose in enumerate(poses)]


@pytest.fixture(scope="module")
def driven(poses, frames):
    front_end, proposals, _ = drive(VisionConfig(), poses, np.deg2rad(0.5), frames)
    loops = [p for p in proposals.values() if p.kind is EdgeKind.LOOP and p.status is Status.ACCEPTED]
    return front_end, loops


def again(front_end, loop, poses, sigma=SURE):
    [found] = front_end.verify([loop], belief_of(poses, sigma))
    assert (found.key, found.source, found.target, found.kind) == (loop.key, loop.source, loop.target, EdgeKind.LOOP)
    return found


def moved(poses, node, by):
    """A map that has the nodes from one on elsewhere."""
    out = poses.copy()
    out[node:] = compose(compose(out[node], by), between(out[node], out[node:]))
    return out


def test_the_front_end_can_measure_again(driven):
    assert isinstance(driven[0], VerifyingFrontEnd)


@pytest.mark.parametrize("by", [(0.0, 0.0, 0.0), (0.12, -0.1, 0.05)])
def test_a_true_loop_is_found_again_from_where_the_map_has_it(driven, poses, by):
    front_end, loops = driven
    found = again(front_end, loops[0], moved(poses, loops[0].source, np.array(by)))
    assert found.status is Status.ACCEPTED
    assert (found.search, found.proposed_by) == (Search.AGAIN, loops[0].proposed_by)
    assert errors([found], poses)[0] == pytest.approx([0.0, 0.0], abs=0.3)
    assert errors([found], poses)[0, 0] < 0.01


def test_a_loop_between_views_of_different_walls_goes(driven, poses):
    front_end, _ = driven
    back_to_back = next(
        (i, j) for i in range(PER_LAP, len(poses)) for j in range(i) if abs(np.cos(poses[i, 2] - poses[j, 2]) + 1.0) < 0.05
    )
    wrong = Edge(*back_to_back, EdgeKind.LOOP, Status.ACCEPTED, RelativePose(np.zeros(3), 1e-4 * np.eye(3)), key=900)
    found = again(front_end, wrong, poses)
    assert found.status is Status.REJECTED
    assert found.relative is None
    assert found.lack is Lack.NO_DEPTH or found.failed[0].figure in ("depth_inliers", "overlap", "points")
    assert found.failed[-1].figure in ("matches", "feature_inliers")


@pytest.mark.parametrize(("sigma", "verdict"), [(SURE, Status.REJECTED), (UNSURE, Status.ACCEPTED)])
def test_where_views_and_map_contradict_each_other_it_depends_on_how_sure_the_map_is(driven, poses, sigma, verdict):
    """The same view twice, and a map that has the second one 1.5 m aside: a twin room, or a map that has drifted."""
    front_end, loops = driven
    loop = loops[0]
    found = again(front_end, loop, moved(poses, loop.source, np.array([0.3, 1.5, 0.6])), sigma)
    assert found.status is verdict
    assert found.checks[-1].figure == "map_sigma"
    assert found.figures["off_m"] > 1.0
    if verdict is Status.ACCEPTED:
        assert errors([found], poses)[0, 0] < 0.01


def test_before_a_wall_features_hold_what_depth_alone_lets_slide():
    view = camera(height_m=1.2, width=240)
    front_end = RgbdFrontEnd(VisionConfig(), view, seed=0)
    poses = np.array([[1.6, -0.9, 0.0], [1.6, -0.7, 0.0]])
    for node, pose in enumerate(poses):
        front_end.add_node(node, front_end.observe(render(view, pose, stamp_ns=node), np.zeros(3)))
    off = np.array([0.02, 0.08, 0.01])
    guess = RelativePose(between(poses[1], poses[0]) + off, np.diag([0.15, 0.15, 0.05]) ** 2)
    keyframes, verifier = front_end.keyframes, front_end.verifier
    refused = verifier.verify_on_map(keyframes[1], keyframes[0], guess)
    assert [check.figure for check in refused.checks if not check.passed] == ["slack_m"]
    found = verifier.verify_near(keyframes[1], keyframes[0], guess)
    assert found.method is Method.FEATURES_AND_DEPTH
    assert known(found.relative).delta == pytest.approx(between(poses[1], poses[0]), abs=0.01)


def test_a_view_that_depth_cannot_confirm_stays_where_features_have_it_near_the_map(driven, poses, monkeypatch):
    """However sure the map says it is: a few centimetres are no contradiction."""
    front_end, loops = driven
    nothing = Verification(None, Method.DEPTH, lack=Lack.NO_DEPTH)
    monkeypatch.setattr(Verifier, "verify_near", lambda *_: nothing)
    found = again(front_end, loops[0], moved(poses, loops[0].source, np.array([0.05, 0.05, 0.01])), sigma=1e-3)
    assert found.status is Status.ACCEPTED
    assert errors([found], poses)[0, 0] < 0.01


def test_without_verification_nothing_is_measured_again(poses, frames):
    config = VisionConfig(rgbd=RgbdConfig(verify="none"))
    front_end, proposals, _ = drive(config, poses, 0.0, frames)
    loop = next(p for p in proposals.values() if p.kind is EdgeKind.LOOP)
    assert front_end.verify([loop], belief_of(poses)) == []


def test_a_retracted_loop_no_longer_supports_others(poses, frames):
    front_end, proposals, _ = drive(VisionConfig(), poses, 0.0, frames)
    loops = [p for p in proposals.values() if p.kind is EdgeKind.LOOP and p.status is Status.ACCEPTED]
    support = front_end.closer.support
    before = support.accepted(loops[0].source)
    away = moved(poses, loops[0].source, np.array([0.3, 1.5, 0.6]))
    assert again(front_end, loops[0], away).status is Status.REJECTED
    assert support.accepted(loops[0].source) == before - 1


def test_a_mapper_mends_one_loop_and_retracts_another(poses, frames, monkeypatch):
    """Two laps; at the end one true loop has a wrong measurement and two nodes are joined that see nothing in common."""
    config = Config.load("rgbd", {"backends.names": ["gtsam-gnc"], "nodes.distance_m": 0.05})
    mapper = Mapper(config, Rig(camera=VIEW))
    for i, (pose, frame) in enumerate(zip(poses, frames, strict=True)):
        mapper.add_odometry(float(i), between(poses[0], pose))
        mapper.add_rgbd(float(i), frame.color, frame.depth_m)
    mapper.finish()
    edges = mapper.map.edges
    true = next(e for e in edges if e.kind is EdgeKind.LOOP and e.status is Status.ACCEPTED)
    tight = 1e-5 * np.eye(3)
    spoilt, false = mapper.book.enter(
        [
            Edge(true.source, true.target, EdgeKind.LOOP, Status.ACCEPTED, RelativePose(np.ones(3), tight), key=9000),
            Edge(PER_LAP // 2, 0, EdgeKind.LOOP, Status.ACCEPTED, RelativePose(np.zeros(3), tight), key=9001),
        ]
    )
    held, verify = [mapper.belief().covariance_from(PER_LAP // 2)[0]], as_a(RgbdFrontEnd, mapper.vision).verify

    def looked_at(outliers, belief):
        held.append(belief.covariance_from(PER_LAP // 2)[0])
        return verify(outliers, belief)

    monkeypatch.setattr(mapper.vision, "verify", looked_at)
    mapper.finish()
    assert np.trace(held[1]) > np.trace(held[0])  # a outliers loop is no witness of its own
    edges = mapper.map.edges
    assert {spoilt, false} <= set(mapper.book.tried_again)
    assert edges[spoilt].status is Status.ACCEPTED
    assert edges[spoilt].search is Search.AGAIN
    assert known(edges[spoilt].relative).delta == pytest.approx(between(poses[true.source], poses[true.target]), abs=0.01)
    assert (edges[false].status, edges[false].search) == (Status.RETRACTED, Search.AGAIN)
    assert spoilt not in mapper.backends.solutions["gtsam-gnc"].report.rejected_edge_ids
    relative = between(poses[0], poses)
    assert mapper.poses()[:, :2] == pytest.approx(relative[:, :2], abs=0.02)


def test_nodes_that_a_closure_has_moved_come_up_again_newest_first():
    poses = np.array([[0.5 * i, 0.0, 0.0] for i in range(8)])
    before, after = belief_of(poses), belief_of(moved(poses, 5, np.array([0.0, 0.4, 0.0])))
    revisits = Revisits()
    revisits.closed(7, 1.6, before)
    assert [revisits.next_moved(after) for _ in range(3)] == [6, 5, None]
    revisits.closed(7, 1.6, before)
    assert revisits.next_moved(before) is None


@pytest.mark.parametrize("online", [0, 2])
def test_while_driving_nodes_are_tried_again_once_the_map_has_moved_them(online, poses, frames, monkeypatch):
    """Odometry is so wrong that the second lap begins out of reach; when one view has closed it, the others follow."""
    for name, value in (("GATE_PER_M", 0.0), ("REPROPOSE_ONLINE", online), ("ACCEPT", 1)):
        monkeypatch.setattr(closing, name, value)
    monkeypatch.setattr(checks, "of_support", lambda _: ())
    narrow = RgbdClosingConfig(gate_m=0.6, candidates=1)
    config = VisionConfig(rgbd=RgbdConfig(closing=narrow), relocalising=NOT_CARRIED)
    front_end, _, _ = drive(config, poses[:1], 0.0, frames[:1])
    drifted = moved(poses, PER_LAP - 4, np.array([0.0, 4.0, 0.0]))
    found = {}
    for node in range(1, PER_LAP + 8):
        step = RelativePose(between(poses[node - 1], poses[node]), np.diag([0.02, 0.02, 0.02]) ** 2)
        front_end.add_node(node, front_end.observe(frames[node], np.zeros(3)))
        front_end.track(node, step)
        believed = drifted if node < PER_LAP + 5 else poses
        if node == PER_LAP + 4:
            believed = np.concatenate([drifted[: PER_LAP + 4], poses[[PER_LAP + 4]]])  # seen again at last
        found[node] = front_end.close(node, belief_of(believed[: node + 1], SURE))
    late = {p.source for node in range(PER_LAP + 5, PER_LAP + 8) for p in found[node] if p.status is Status.ACCEPTED}
    behind = {node for node in late if node < PER_LAP + 4}
    assert any(p.status is Status.ACCEPTED for p in found[PER_LAP + 4])
    assert bool(behind) == bool(online)
    assert (
        errors([p for ps in found.values() for p in ps if p.status is Status.ACCEPTED and p.kind is EdgeKind.LOOP], poses)[
            :, 0
        ].max()
        < 0.05
    )
