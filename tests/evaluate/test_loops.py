"""Candidates of whole sessions: from stored profiles, and from profiles made again of the frames."""

from __future__ import annotations

import loop_figures
import numpy as np
import pytest

from hybridmap.config import Config
from hybridmap.errors import EvaluationError
from hybridmap.evaluate.loops import evaluate_loops, every_mode, profiles_again, stored_profiles, view_settings
from hybridmap.evaluate.session_errors import evaluate_session
from hybridmap.geometry import wrap_angle
from hybridmap.session import run
from hybridmap.simulation import SimulatedStream
from hybridmap.store import MapStore, SessionFolder
from hybridmap.streams.base import Rig
from hybridmap.trajectory import Trajectory
from tests.store import sessions
from tests.store.sessions import LASER, SECOND, ring_map, write_session

SMALL = {
    "simulation.duration_s": 16.0,
    "simulation.camera.width_px": 96,
    "simulation.camera.height_px": 72,
    "simulation.camera.rate_hz": 2.0,
    "backends.names": ["odometry"],
}


@pytest.fixture(scope="module")
def lab(tmp_path_factory):
    config = Config.load("lab", SMALL)
    return run(SimulatedStream(config.simulation, 1), config, tmp_path_factory.mktemp("lab") / "s").folder


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


def test_profiles_made_again_are_those_that_the_session_stored(lab):
    with MapStore.open(lab.path) as store:
        stored = stored_profiles(store)
        again = profiles_again(store, view_settings(store), 4, len(stored))
    assert len(stored) > 8
    assert np.array_equal(np.stack(stored), np.stack(again))


def test_every_mode_is_judged(lab):
    found = dict(every_mode(lab.path))
    assert {"literal", "ratio", "signed", "plain", "plain, RGB", "plain, depth", "four-band"} < set(found)
    assert {errors.queries for errors in found.values()} == {found["plain"].queries}
    assert found["plain"].pairs > 0


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
    found = dict(every_mode(session.path))
    circle, fan = found["full circle, from any side"], found["fan, from the same side"]
    assert fan.revisits == 0
    assert circle.revisits > 10
    assert circle.pair_auc > 0.8  # half of the neighbours within a metre have a view of their own
    assert circle.top1 > 0.9
    assert found["full circle, from any side, 5 in a row"].top1 > 0.9
    assert {metric.name for metric in evaluate_loops(session.path)} >= {"pair_auc/plain"}


def test_a_session_without_frames_or_truth_is_refused(tmp_path):
    session = write_session(tmp_path / "s", ring_map(), keyframes=False)
    with pytest.raises(EvaluationError, match="no views"):
        dict(every_mode(tmp_path / "s"))
    session.groundtruth.unlink()
    with pytest.raises(EvaluationError, match="--reference"):
        evaluate_loops(tmp_path / "s")


def test_the_tool_prints_a_line_a_mode(lab, monkeypatch, capsys):
    monkeypatch.setattr("sys.argv", ["loop_figures.py", str(lab.path)])
    loop_figures.main()
    said = capsys.readouterr().out.splitlines()
    assert "at least 10 s older" in said[0]
    assert "revisits" in said[1]
    assert [line.split()[0] for line in said[2:4]] == ["literal", "ratio"]
