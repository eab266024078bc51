"""Sequences of views and the exact search, as the front-end uses them."""

from __future__ import annotations

import numpy as np
import pytest

from hybridmap.config.vision import MatchingConfig, VisionConfig
from hybridmap.graph.edges import EdgeKind, Status
from hybridmap.vision.gating import Gate
from tests.vision.rgbd.rgbd_room import render
from tests.vision.rgbd.test_rgbd_front_end import VIEW, drive, errors, lap_poses


@pytest.fixture(scope="module")
def lap():
    poses = lap_poses()
    rng = np.random.default_rng(8)
    return poses, [render(VIEW, pose, stamp_ns=i * 10**9, noise=0.002, rng=rng) for i, pose in enumerate(poses)]


def scores_of(proposals):
    return {(p.source, p.target): p.figures["profile_G"] for p in proposals.values() if "profile_G" in p.figures}


def test_views_in_a_row_decide_where_the_configuration_says_so(lap):
    poses, frames = lap
    found = {}
    for views in (1, 4):
        config = VisionConfig(matching=MatchingConfig(sequence=views))
        _, proposals, _ = drive(config, poses, np.deg2rad(0.5), frames)
        accepted = [p for p in proposals.values() if p.kind is EdgeKind.LOOP and p.status is Status.ACCEPTED]
        assert len(accepted) > 5
        assert errors(accepted, poses)[:, 0].max() < 0.05
        found[views] = scores_of(proposals)
    both = found[1].keys() & found[4].keys()
    assert both
    assert any(found[1][pair] != pytest.approx(found[4][pair]) for pair in both)


def test_what_the_search_for_loops_saw_is_kept_with_the_node(lap):
    poses, frames = lap
    front_end, _, _ = drive(VisionConfig(), poses, np.deg2rad(0.5), frames)
    last = front_end.keyframe(len(poses) - 1)
    gate = Gate.of_array(last["gate"])
    assert gate.inside <= gate.older
    assert (np.diff(last["ranked"][:, 1]) >= 0).all()
    assert set(last["ranked"][:, 0].astype(int)) <= set(range(len(poses) - 10))
    assert "gate" not in front_end.keyframe(len(poses) - 2)
