"""Candidates of whole sessions: from stored profiles."""

from __future__ import annotations

import numpy as np
import pytest

from hybridmap.errors import EvaluationError
from hybridmap.evaluate.loops import evaluate_loops
from hybridmap.evaluate.session_errors import evaluate_session
from hybridmap.geometry import wrap_angle
from hybridmap.store import SessionFolder
from hybridmap.streams.base import Rig
from hybridmap.trajectory import Trajectory
from tests.store import sessions
from tests.store.sessions import LASER, SECOND, ring_map, write_session


def ring_profile(node: int, _truth: np.ndarray) -> dict[str, np.ndarray]:
    """A window of a panorama that turns by four columns a node, once round in a lap of 40 nodes, with noise."""
    panorama = np.random.default_rng(0).normal(size=(4, 160))
    noise = np.random.default_rng(1000 + node).normal(scale=0.3, size=(4, 64))
    return {"profile": (np.roll(panorama, -4 * node, axis=1)[:, :64] + noise).astype(np.float32)}


def test_stored_profiles_are_judged(tmp_path, monkeypatch):
    monkeypatch.setattr(sessions, "keyframe_of", ring_profile)
    write_session(tmp_path / "s", ring_map(1.9))
    values = {metric.name: metric.value for metric in evaluate_session(tmp_path / "s", loops=True)}
    assert values["pair_auc/four-band"] > 0.8
    assert values["candidate_top1/four-band"] > 0.9
    assert {metric.name for metric in SessionFolder(tmp_path / "s").read_metrics().metrics} == set(values)


def test_a_laser_that_sees_all_around_knows_places_from_any_side(tmp_path, monkeypatch):
    """Three quarters of the ring, then back the same way: the second pass looks the other way."""
    experiences = ring_map(1.5, loops=False)
    turn, nodes = 16, len(experiences)
    panorama = np.random.default_rng(0).normal(size=(1, 64))

    def scan(node: int, _truth: np.ndarray) -> dict[str, np.ndarray]:
        place = node if node < nodes // 2 else nodes - 1 - node
        view = np.random.default_rng(place // 2).normal(size=(1, 64)) + 0.3 * panorama
        noise = np.random.default_rng(1000 + node).normal(scale=0.2, size=(1, 64))
        return {"profile": (np.roll(view, turn * (node >= nodes // 2), axis=1) + noise).astype(np.float32)}

    monkeypatch.setattr(sessions, "keyframe_of", scan)
    session = write_session(tmp_path / "s", experiences, rig=Rig(laser=LASER))
    there = 2.0 * np.pi * np.arange(nodes) / nodes
    back = np.concatenate([there[: nodes // 2], there[: nodes - nodes // 2][::-1]])
    heading = back + np.pi * (np.arange(nodes) >= nodes // 2)
    poses = np.stack([6 * np.cos(back), 6 * np.sin(back), wrap_angle(heading)], axis=-1)
    session.write_groundtruth(Trajectory(np.arange(nodes) * SECOND, poses))
    values = {metric.name: metric.value for metric in evaluate_loops(session.path)}
    assert values["pair_auc/plain"] > 0.8  # half of the neighbours within a metre have a view of their own
    assert values["candidate_top1/plain"] > 0.9


def test_a_session_without_frames_or_truth_is_refused(tmp_path):
    session = write_session(tmp_path / "s", ring_map(), keyframes=False)
    with pytest.raises(EvaluationError, match="no views"):
        evaluate_loops(tmp_path / "s")
    session.groundtruth.unlink()
    with pytest.raises(EvaluationError, match="--reference"):
        evaluate_loops(tmp_path / "s")
