"""Whole sessions: the gains in use are taken out, maps and references give the same answer."""

import numpy as np
import pytest

from hybridmap.calibration.gains import NEUTRAL, Gains
from hybridmap.calibration.sessions import alternating, by_reference, corrected, estimate_of, read_drive
from hybridmap.errors import EvaluationError
from hybridmap.geometry import between
from hybridmap.trajectory import Trajectory
from tests.calibration.drives import GAINS, drive, experience_map, write_session


@pytest.fixture(scope="module")
def one():
    return drive(np.random.default_rng(5))


def test_odometry_is_raw_whatever_gains_were_in_use(one, tmp_path):
    read = read_drive(write_session(tmp_path / "s", one, np.random.default_rng(0), gains=Gains(0.9, 1.1, 0.05)))
    np.testing.assert_allclose(read.motion.steps, one.motion.steps, atol=1e-9)


def test_odometry_is_raw_after_changes_on_the_way(one, tmp_path):
    stamp = int(one.motion.stamps_ns[700])
    changes = [[stamp, 1.02, 0.95, -0.02], [stamp + 10**10, 1.03, 0.97, -0.04]]
    read = read_drive(write_session(tmp_path / "s", one, np.random.default_rng(0), changes=changes))
    np.testing.assert_allclose(read.motion.steps, one.motion.steps, atol=1e-9)


def test_closed_loops_and_a_reference_agree(one, tmp_path):
    read = read_drive(write_session(tmp_path / "s", one, np.random.default_rng(0)))
    own = alternating([read])
    known = by_reference([read], [Trajectory(one.motion.stamps_ns, one.truth)])
    for estimate in (own, known):
        assert np.all(np.abs(estimate.off(GAINS)) < 4.0)
        assert estimate.differs(NEUTRAL)
        assert estimate.gains.heading_bias_rad_m == pytest.approx(GAINS.heading_bias_rad_m, abs=0.005)


def test_alternating_optimises_the_map_that_it_regresses_on(one, tmp_path):
    """Begun on poses that are odometry's own, only the map's optimisation can tell that it is wrong."""
    rng = np.random.default_rng(0)
    raw = experience_map(one, rng)[0].initial
    read = read_drive(write_session(tmp_path / "s", one, rng, poses=raw))
    assert alternating([read]).gains.heading_bias_rad_m == pytest.approx(GAINS.heading_bias_rad_m, abs=0.005)


def test_corrected_edges_are_what_calibrated_odometry_measures(one, tmp_path):
    read = read_drive(write_session(tmp_path / "s", drive(np.random.default_rng(5), noise=0.0), np.random.default_rng(0)))
    graph = corrected(read, GAINS, 0.0)
    own = graph.kinds == 0
    truth = read.poses
    np.testing.assert_allclose(graph.deltas[own], between(truth[graph.sources[own]], truth[graph.targets[own]]), atol=1e-6)
    np.testing.assert_array_equal(graph.deltas[~own], read.graph.deltas[~own])


def test_a_map_of_odometry_alone_is_refused(tmp_path):
    one = drive(np.random.default_rng(0), laps=1)
    one = type(one)(one.truth[:200], type(one.motion)(one.motion.stamps_ns[:200], one.motion.steps[:199]))
    read = read_drive(write_session(tmp_path / "s", one, np.random.default_rng(0), registered=False))
    with pytest.raises(EvaluationError, match="holds odometry alone"):
        estimate_of([read], [], "alternating")


def test_a_reference_of_another_clock_is_refused(one, tmp_path):
    read = read_drive(write_session(tmp_path / "s", one, np.random.default_rng(0)))
    far = Trajectory(one.motion.stamps_ns + 10**15, one.truth)
    with pytest.raises(EvaluationError, match="on the same clock"):
        by_reference([read], [far])
