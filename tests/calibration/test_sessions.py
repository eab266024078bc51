"""Whole sessions: the gains in use are taken out, maps and references give the same answer."""

import sqlite3

import numpy as np
import pytest

from hybridmap.calibration.estimate import Estimate
from hybridmap.calibration.legs import corrected
from hybridmap.calibration.sessions import common_tree, estimate_of, read_drive
from hybridmap.errors import EvaluationError, StoreError
from hybridmap.geometry import between
from hybridmap.odometry_model import NEUTRAL, Gains
from hybridmap.trajectory import Trajectory
from tests.calibration.drives import GAINS, drive, experience_map, write_session
from tests.store.sessions import RIG


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
    own = estimate_of([read])
    known = estimate_of([read], [Trajectory(one.motion.stamps_ns, one.truth)])
    for estimate in (own, known):
        assert np.all(np.abs(estimate.off(GAINS)) < 4.0)
        assert estimate.differs(NEUTRAL)
        assert estimate.gains.heading_bias_rad_m == pytest.approx(GAINS.heading_bias_rad_m, abs=0.005)


def test_alternating_optimises_the_map_that_it_regresses_on(one, tmp_path):
    """Begun on poses that are odometry's own, only the map's optimisation can tell that it is wrong."""
    rng = np.random.default_rng(0)
    raw = experience_map(one, rng)[0].initial
    read = read_drive(write_session(tmp_path / "s", one, rng, poses=raw))
    assert estimate_of([read]).gains.heading_bias_rad_m == pytest.approx(GAINS.heading_bias_rad_m, abs=0.005)


def test_corrected_edges_are_what_calibrated_odometry_measures(one, tmp_path):
    read = read_drive(write_session(tmp_path / "s", drive(np.random.default_rng(5), noise=0.0), np.random.default_rng(0)))
    graph = corrected(read.graph, read.motion, read.stamps_ns, GAINS)
    own = graph.kinds == 0
    truth = read.poses
    np.testing.assert_allclose(graph.deltas[own], between(truth[graph.sources[own]], truth[graph.targets[own]]), atol=1e-6)
    np.testing.assert_array_equal(graph.deltas[~own], read.graph.deltas[~own])


def test_a_map_of_odometry_alone_is_refused(tmp_path):
    one = drive(np.random.default_rng(0), laps=1)
    one = type(one)(one.truth[:200], type(one.motion)(one.motion.stamps_ns[:200], one.motion.steps[:199]))
    read = read_drive(write_session(tmp_path / "s", one, np.random.default_rng(0), registered=False))
    with pytest.raises(EvaluationError, match="holds odometry edges only"):
        estimate_of([read], [], "alternating")


@pytest.mark.parametrize("methods", [["sequence"], ["profile"], ["profile", "sequence"]])
@pytest.mark.parametrize("estimator", ["alternating", "joint"])
def test_loops_by_profile_alone_are_refused_however_they_were_found(one, tmp_path, methods, estimator):
    """Those of `ratslam`, and those of `paper`, which nobody verified, join two views at no distance from each other."""
    read = read_drive(write_session(tmp_path / "s", one, np.random.default_rng(0), registered=False, methods=methods))
    with pytest.raises(EvaluationError, match=r"by profile alone and tell no scale.*give --reference"):
        estimate_of([read], [], estimator)


def test_a_profile_beside_a_measured_loop_is_no_reason_to_refuse(one, tmp_path):
    folder = write_session(tmp_path / "s", one, np.random.default_rng(0), registered=False, methods=["profile", "scans"])
    assert not read_drive(folder).by_profile


@pytest.mark.parametrize("value", ['{"a": 1}', '"late"', "NaN"])
def test_a_clock_offset_that_is_no_number_is_refused(one, tmp_path, value):
    folder = write_session(tmp_path / "s", one, np.random.default_rng(0))
    with sqlite3.connect(folder / "map.db") as written:
        written.execute("INSERT OR REPLACE INTO info VALUES (-1, 'clock_offset', ?)", (value,))
    written.close()
    with pytest.raises(StoreError, match="clock_offset: expected a number of seconds, found"):
        read_drive(folder)


def test_a_reference_of_another_clock_is_refused(one, tmp_path):
    read = read_drive(write_session(tmp_path / "s", one, np.random.default_rng(0)))
    far = Trajectory(one.motion.stamps_ns + 10**15, one.truth)
    with pytest.raises(EvaluationError, match="on the same clock"):
        estimate_of([read], [far])


def test_a_drive_given_twice_is_refused_even_as_a_copy_or_under_other_gains(one, tmp_path):
    """Twice the same would count double: sigmas smaller by sqrt(2) for nothing."""
    read = [read_drive(write_session(tmp_path / name, one, np.random.default_rng(0))) for name in ("a", "copy")]
    part = type(one)(one.truth[:801], type(one.motion)(one.motion.stamps_ns[:801], one.motion.steps[:800]))
    beginning = read_drive(write_session(tmp_path / "part", part, np.random.default_rng(0), gains=Gains(1.1, 1.0, 0.0)))
    for second in (read[0], read[1], beginning):
        with pytest.raises(EvaluationError, match=r"the same drive as .*/a; give each drive once"):
            estimate_of([read[0], second])


def test_drives_under_other_gains_or_delays_are_refused(one, tmp_path):
    other = drive(np.random.default_rng(6))
    first = read_drive(write_session(tmp_path / "a", one, np.random.default_rng(0)))
    regained = read_drive(write_session(tmp_path / "b", other, np.random.default_rng(0), gains=Gains(1.1, 1.0, 0.0)))
    delayed = read_drive(write_session(tmp_path / "c", other, np.random.default_rng(0), sensors="{odometry_delay_s: 0.1}"))
    with pytest.raises(EvaluationError, match=r"/b: was mapped with neural\.gain 1\.1, .*/a with 1; expected one calibration"):
        estimate_of([first, regained])
    with pytest.raises(EvaluationError, match=r"/c: was mapped with sensors\.odometry_delay_s 0\.1, .*/a with 0"):
        estimate_of([first, delayed])


def test_drives_of_other_sensors_are_pooled_with_a_warning(one, tmp_path, caplog):
    other = drive(np.random.default_rng(6))
    first, same = (
        read_drive(write_session(tmp_path / name, it, np.random.default_rng(0))) for name, it in (("a", one), ("b", other))
    )
    estimate_of([first, same])
    assert caplog.text == ""
    unlike = read_drive(write_session(tmp_path / "c", other, np.random.default_rng(0), rig=RIG))
    estimate_of([first, unlike])
    assert "a maps with no sensor but odometry, " in caplog.text
    assert "c maps with laser, 181 beams, 20.00 m and RGB-D, 32x24 pixels: hardly of one kind of robot" in caplog.text


def test_drives_of_two_configurations_have_none_in_common(one, tmp_path):
    first = read_drive(write_session(tmp_path / "a", one, np.random.default_rng(0)))
    second = read_drive(write_session(tmp_path / "b", one, np.random.default_rng(0), sensors="{range_max_m: 9.0}"))
    assert common_tree([first, first]) == first.config_tree
    with pytest.raises(EvaluationError, match=r"/b: its configuration has sensors\.range_max_m 9\.0, that of .*/a None"):
        common_tree([first, second])


def test_a_gain_that_was_not_measured_stays_in_use_on_the_map_too(tmp_path, monkeypatch):
    from hybridmap.calibration import sessions

    estimate = Estimate(Gains(1.0, 0.97, -0.04), 0.0, np.diag([np.inf, 1e-6, 1e-6, 1e-4]), 4.0, 20.0, 80.0, 1.0, 0.0)
    rng = np.random.default_rng(0)
    read = read_drive(write_session(tmp_path / "s", drive(rng, laps=2), rng, gains=Gains(1.05, 1.0, 0.0)))
    used: list[Gains] = []

    def noted(graph, motion, stamps_ns, gains, delay_s):
        used.append(gains)
        return corrected(graph, motion, stamps_ns, gains, delay_s)

    monkeypatch.setattr(sessions, "regress", lambda sightings, leg_m: estimate)
    monkeypatch.setattr(sessions, "corrected", noted)
    assert not estimate_of([read]).measured[0]
    assert used == [Gains(1.05, 0.97, -0.04)]
