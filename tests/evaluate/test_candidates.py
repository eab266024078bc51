"""Which readings tell places apart: by hand on scores, and on views of the simulated office."""

from __future__ import annotations

import numpy as np
import pytest

from hybridmap.config.inputs import CameraConfig, SimulationConfig
from hybridmap.evaluate.loops import (
    CandidateErrors,
    CandidateLimits,
    Reading,
    Truth,
    candidate_errors,
    judge_pairs,
    score_matrix,
)
from hybridmap.geometry import compose
from hybridmap.simulation import SimulatedStream
from hybridmap.simulation.scene import Scene
from hybridmap.simulation.sensor_models import CameraModel
from hybridmap.simulation.worlds import build_world
from hybridmap.trajectory import Trajectory
from hybridmap.vision.profile import image_profile

SECOND = 1_000_000_000

READINGS = {
    **{mode: (1, Reading(mode)) for mode in ("literal", "ratio", "signed", "plain")},
    "plain, depth": (1, Reading("plain", 0.0, 1.0)),
    "four-band": (4, Reading("four-band")),
    "four-band, depth": (4, Reading("four-band", 0.0, 1.0)),
    "four-band, 5 in a row": (4, Reading("four-band", sequence=5)),
}
"""Name -> row bands of the profiles, and how they are scored."""


def truth_table(same, different):
    return Truth(np.arange(len(same)), np.array(same, dtype=bool), np.array(different, dtype=bool))


def test_figures_by_hand():
    """Three views; the first two come back to a place, the second is taken for another one."""
    scores = np.array([[0.1, 0.5, 0.9], [0.6, 0.3, 0.4], [0.8, 0.7, 0.95]])
    truth = truth_table([[1, 0, 0], [0, 0, 1], [0, 0, 0]], [[0, 1, 1], [1, 1, 0], [1, 1, 0]])
    errors = candidate_errors(scores, truth)
    # same: 0.1 0.4; different: 0.5 0.9 0.6 0.3 0.8 0.7: 0.1 beats six, 0.4 beats five
    assert errors.pair_auc == pytest.approx(11 / 12)
    assert (errors.queries, errors.revisits, errors.pairs) == (3, 2, 8)
    assert errors.top1 == 0.5
    # best matches: 0.1 right, 0.3 wrong, 0.7 wrong
    assert errors.recall_full_precision == 0.5
    assert errors.average_precision == pytest.approx(0.5)


def test_equal_scores_are_accepted_together():
    truth = truth_table([[1, 0], [0, 0]], [[0, 1], [1, 1]])
    errors = candidate_errors(np.array([[0.2, 0.9], [0.2, 0.9]]), truth)
    assert errors.recall_full_precision == 0.0
    assert errors.pair_auc == pytest.approx((1 + 0.5 + 1) / 3)


def test_nothing_to_judge_gives_no_figure():
    errors = candidate_errors(np.full((1, 2), np.inf), truth_table([[0, 0]], [[0, 0]]))
    assert np.isnan([errors.pair_auc, errors.top1, errors.average_precision, errors.recall_full_precision]).all()


def test_pairs_are_judged_by_distance_heading_and_age():
    poses = np.array([[0, 0, 0], [5, 0, 0], [0.5, 0, 0.1], [1.5, 0, 0], [0, 0, np.pi], [9, 9, 0]], dtype=float)
    stamps = np.array([0, 4, 20, 24, 28, 100]) * SECOND
    truth = judge_pairs(stamps, Trajectory(stamps[:5], poses[:5]), CandidateLimits(), max_gap_s=30)
    assert truth.queries.tolist() == [2, 3, 4]  # 1 has nothing older than 10 s, the truth of 5 is not known
    assert np.argwhere(truth.same).tolist() == [[0, 0]]
    # 3 is 1.5 m from 0: neither; 2 and 3 are too young for each other
    assert np.argwhere(truth.different).tolist() == [[0, 1], [1, 1], [2, 0], [2, 1]]


@pytest.fixture(scope="module")
def office():
    """Twenty-four places of the office, each seen again from 40 cm farther on and 40 cm to the side; profiles by bands."""
    config = SimulationConfig(world="office", camera=CameraConfig(width_px=96, height_px=72))
    stream = SimulatedStream(config, 3)
    camera = CameraModel(Scene(build_world(config.world)), config.camera, np.random.default_rng(1))
    first = np.linspace(4.0, 120.0, 24)
    start = stream.groundtruth.stamps_ns[0]
    poses = stream.groundtruth.at((start + first * SECOND).astype(np.int64))
    side = np.tile([1.0, -1.0], 12)
    again = compose(poses, np.column_stack([np.full(24, 0.4), 0.4 * side, -0.15 * side]))
    stamps = (start + np.concatenate([first, first + 140.0]) * SECOND).astype(np.int64)
    every = np.concatenate([poses, again])
    noise = np.random.default_rng(2).spawn(len(every))
    frames = [camera.frame(int(s), (s - start) / SECOND, p, n) for s, p, n in zip(stamps, every, noise, strict=True)]
    grey = [frame.color.mean(axis=-1).astype(np.uint8) for frame in frames]
    profiles = {bands: [image_profile(g, f.depth_m, 64, bands) for g, f in zip(grey, frames, strict=True)] for bands in (1, 4)}
    return profiles, judge_pairs(stamps, Trajectory(stamps, every), CandidateLimits(gap_s=100), max_gap_s=20)


def test_the_literal_rule_is_inverted_and_four_bands_beat_one(office):
    profiles, truth = office
    found: dict[str, CandidateErrors] = {}
    for name, (bands, reading) in READINGS.items():
        found[name] = candidate_errors(score_matrix(profiles[bands], truth.queries, reading), truth)
    assert found["literal"].revisits == 24
    assert found["literal"].pair_auc < 0.3
    assert found["literal"].top1 < 0.1
    for name in ("ratio", "signed", "plain"):
        assert 0.9 < found[name].pair_auc < found["four-band"].pair_auc
        assert found[name].top1 < found["four-band"].top1 - 0.1
        assert found[name].recall_full_precision < found["four-band"].recall_full_precision
    assert found["four-band"].pair_auc > 0.97
    assert found["four-band, 5 in a row"].recall_full_precision > found["four-band"].recall_full_precision
    for one, both in (("plain, depth", "plain"), ("four-band, depth", "four-band")):
        assert 0.5 < found[one].pair_auc < found[both].pair_auc


def test_a_sequence_is_the_mean_over_its_views():
    rng = np.random.default_rng(4)
    profiles = list(rng.normal(size=(9, 2, 16)).astype(np.float32))
    readings = Reading("plain", max_shift=2), Reading("plain", max_shift=2, sequence=2)
    single, double = (score_matrix(profiles, np.array([7, 8]), reading) for reading in readings)
    before = min(single[0, 3], single[0, 4], single[0, 5])
    assert double[1, 5] == pytest.approx(0.5 * (single[1, 5] + before))
    assert np.isinf(double[0, 7:]).all()
