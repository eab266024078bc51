"""A robot that is carried across the room: found again by its views, and its chain joined again where it broke."""

from __future__ import annotations

from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

from hybridmap.backends import create
from hybridmap.config import Config
from hybridmap.geometry import RelativePose, align, between, compose
from hybridmap.graph.edges import Edge, EdgeKind, Lack, Method, Search, Status
from hybridmap.mapper import Mapper
from hybridmap.streams.base import Rig
from hybridmap.vision.relocalising import ChainState
from hybridmap.vision.rgbd import checks, global_search
from hybridmap.vision.rgbd.global_search import GlobalSearch, chain_state
from hybridmap.vision.rgbd.pnp import Verification, Verifier
from hybridmap.vision.templates import Matcher
from tests.narrowing import known
from tests.vision.rgbd.rgbd_room import camera, render

VIEW = camera(width=240)
PER_LAP, UP, DOWN = 16, 19, 28
"""On the second lap the robot is picked up at pose 19 and put down at 28, where it looks the other way."""


@pytest.fixture(scope="module")
def carried():
    """True poses, what the wheels felt, frames: two laps and a half of an ellipse in a room, without the piece between."""
    t = 2.0 * np.pi * np.arange(int(2.6 * PER_LAP)) / PER_LAP
    way = np.stack([-0.7 + 0.9 * np.sin(t), -0.5 + 0.6 * np.cos(t), np.arctan2(-0.6 * np.sin(t), 0.9 * np.cos(t))], axis=1)
    way[PER_LAP:] += np.random.default_rng(3).normal(scale=[0.03, 0.03, 0.02], size=(len(way) - PER_LAP, 3))
    truth = np.concatenate([way[: UP + 1], way[DOWN:]])
    after = compose(way[UP], between(way[DOWN - 1], way[DOWN:]))
    felt = np.concatenate([way[: UP + 1], after])
    steps = between(felt[:-1], felt[1:]) * [1.01, 1.0, 1.0] + [0.0, 0.0, np.deg2rad(0.3)]
    wheels = [felt[0]]
    for step in steps:
        wheels.append(compose(wheels[-1], step))
    rng = np.random.default_rng(8)
    frames = [render(VIEW, pose, stamp_ns=i * 10**9, noise=0.002, rng=rng) for i, pose in enumerate(truth)]
    return truth, np.array(wheels), frames


def mapped(carried, **overrides):
    truth, wheels, frames = carried
    overrides = {"backends.names": ["gtsam-gnc"], "nodes.distance_m": 0.05, **overrides}
    mapper = Mapper(Config.load("rgbd", overrides), Rig(camera=VIEW))
    found_at = None
    for i, (pose, frame) in enumerate(zip(wheels, frames, strict=True)):
        mapper.add_odometry(float(i), pose)
        update = mapper.add_rgbd(float(i), frame.color, frame.depth_m)
        off = between(compose(truth[0], known(update).pose_map_robot), truth[i])
        if i > UP and found_at is None and np.hypot(off[0], off[1]) < 0.15:
            found_at = i
    mapper.finish()
    return mapper, found_at


@pytest.fixture(scope="module")
def found(carried):
    """The mapper at the end of the drive, and the node at which its pose was right again."""
    return mapped(carried)


def off_m(poses, truth):
    return np.hypot(*(compose(align(truth, poses), poses) - truth)[:, :2].T)


def test_it_is_found_again_and_the_chain_is_joined_where_it_broke(carried, found):
    truth = carried[0]
    mapper, found_at = found
    travel = np.hypot(*np.diff(truth[UP + 1 :, :2], axis=0).T).cumsum()
    assert found_at is not None
    assert travel[found_at - UP - 2] < 2.5
    into = [mapper.map.edge(n) for n in mapper.map.edges_into(UP + 1) if mapper.map.edge(n).source == UP]
    wheels = next(edge for edge in into if edge.kind is EdgeKind.ODOMETRY)
    assert (wheels.status, wheels.lack) == (Status.RETRACTED, Lack.OVERRULED)
    joined = next(edge for edge in into if edge.kind is EdgeKind.REGISTRATION and edge.status is Status.ACCEPTED)
    gap = between(joined.relative.delta, between(truth[UP], truth[UP + 1]))
    assert np.hypot(gap[0], gap[1]) < 0.1
    assert sum(edge.search is Search.WHOLE_MAP for edge in mapper.map.edges if edge.status is Status.ACCEPTED) >= 5
    assert off_m(mapper.poses(), truth).max() < 0.05
    assert mapper.lost_since is None


def test_until_then_it_is_lost_since_it_was_carried(carried):
    truth, wheels, frames = carried
    mapper, found_at = mapped((truth[: UP + 3], wheels[: UP + 3], frames[: UP + 3]))
    assert found_at is None
    assert mapper.lost_since == UP + 1


@pytest.mark.parametrize("name", ["gtsam-lm", "gtsam-isam2", "gtsam-cauchy", "gtsam-dcs", "relaxation-ratslam"])
def test_every_back_end_survives_it(carried, found, name):
    solved = create(name).solve(found[0].map.pose_graph())
    assert off_m(solved.poses, carried[0]).max() < 0.15


def test_it_stays_lost_where_the_whole_map_is_not_searched(carried):
    mapper, found_at = mapped(carried, **{"vision.relocalising.enabled": False})
    assert found_at is None
    assert off_m(mapper.poses(), carried[0]).max() > 0.5


def test_a_view_of_nothing_is_no_carry(carried):
    """One frame without depth and features breaks the chain; the next closure says that the robot is where it should be."""
    truth, wheels, frames = carried
    blank = render(VIEW, truth[UP], stamp_ns=UP * 10**9)
    blank.color[:] = 128
    blank.depth_m[:] = 0.0
    whole = (truth[: UP + 1], wheels[: UP + 1], [*frames[: UP - 1], blank, frames[UP]])
    mapper, _ = mapped(whole)
    assert not [edge for edge in mapper.map.edges if edge.kind is EdgeKind.ODOMETRY and edge.status is not Status.ACCEPTED]
    assert off_m(mapper.poses(), truth[: UP + 1]).max() < 0.05


class FakeVerifier(Verifier):
    """Says of a pair what it was told."""

    def __init__(self, found):
        self.found = found

    def verify(self, source, target):
        delta = self.found.get((source.number, target.number))
        relative = None if delta is None else RelativePose(np.array(delta, float), np.eye(3) * 1e-4)
        return Verification(relative, Method.FEATURES, checks.of_pose(0 if delta is None else 20, 12))


def test_the_likeliest_views_some_nodes_apart_are_verified(monkeypatch):
    rng = np.random.default_rng(0)
    profiles = rng.normal(size=(31, 2, 16)).astype(np.float32)
    profiles[30] = profiles[12] + 0.1 * profiles[20]
    profiles[13] = profiles[12] + 0.05
    keyframes: list[Any] = [SimpleNamespace(profile=profile, number=i) for i, profile in enumerate(profiles)]
    matcher = Matcher("plain", 0.5, 0.5, max_shift=2)
    for profile in profiles:
        matcher.add(profile)
    verifier = FakeVerifier({(30, 12): (0.1, 0.0, 0.0)})
    monkeypatch.setattr(global_search, "CANDIDATES", 3)
    found = GlobalSearch(keyframes, matcher, verifier, iter(range(99)).__next__).search(30, np.arange(25))
    assert len(found) == 3
    assert (found[0].target, found[0].status) == (12, Status.PENDING)
    assert (found[0].search, found[0].lack) == (Search.WHOLE_MAP, Lack.WAITING)
    assert [p.status for p in found[1:]] == [Status.REJECTED] * 2
    assert all(abs(a.target - b.target) >= 4 for a in found for b in found if a is not b)


def step(status, sigma_m=0.01):
    relative = RelativePose(np.zeros(3), np.diag([sigma_m, 0.5 * sigma_m, 0.01]) ** 2)
    return Edge(39, 40, EdgeKind.REGISTRATION, status, relative)


@pytest.mark.parametrize(
    ("steps", "chain"),
    [
        ([], ChainState.HOLDS),
        ([step(Status.REJECTED), step(Status.REJECTED)], ChainState.BROKEN),
        ([step(Status.REJECTED), step(Status.ACCEPTED)], ChainState.HOLDS),
        ([step(Status.ACCEPTED, 0.3), step(Status.ACCEPTED, 0.4)], ChainState.UNCERTAIN),
        ([step(Status.ACCEPTED, 0.3), step(Status.ACCEPTED, 0.02)], ChainState.HOLDS),
    ],
)
def test_one_wall_fits_any_other(steps, chain):
    assert chain_state(steps) is chain
