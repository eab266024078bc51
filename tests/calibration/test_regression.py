"""The robust estimate recovers what was put in, and knows how sure it is."""

import numpy as np
import pytest

from hybridmap.calibration import NEUTRAL, Gains, regress
from hybridmap.calibration.regression import Sighting
from hybridmap.errors import EvaluationError
from tests.calibration.drives import GAINS, drive, sighting


def test_it_finds_the_gains_exactly_where_there_is_no_noise():
    estimate = regress([sighting(drive(np.random.default_rng(0), noise=0.0))])
    np.testing.assert_allclose(estimate.gains.to_array(), GAINS.to_array(), atol=2e-4)
    assert abs(estimate.delay_s) < 0.01


def test_drop_outs_do_not_move_it():
    rng = np.random.default_rng(1)
    one = drive(rng, laps=6, drop_outs=6)
    estimate = regress([sighting(one, rng)])
    assert np.all(np.abs(estimate.off(GAINS)) < 3.5)
    assert estimate.gains.heading_bias_rad_m == pytest.approx(GAINS.heading_bias_rad_m, abs=0.006)
    assert estimate.gains.gain == pytest.approx(GAINS.gain, abs=0.01)
    assert estimate.downweighted > 0.0


def test_a_late_clock_is_a_delay_and_no_gain():
    rng = np.random.default_rng(2)
    estimate = regress([sighting(drive(rng), rng, delay_s=0.13)])
    assert estimate.delay_s == pytest.approx(0.13, abs=0.03)
    assert estimate.delay_differs
    assert np.all(np.abs(estimate.off(GAINS)) < 3.5)


def test_standard_deviations_are_honest():
    off = []
    for seed in range(12):
        rng = np.random.default_rng(100 + seed)
        off.append(regress([sighting(drive(rng), rng)]).off(GAINS))
    spread = np.sqrt(np.mean(np.square(off), axis=0))
    assert np.all(spread > 0.2)
    assert np.all(spread < 2.0)


def test_right_odometry_is_left_alone():
    told = []
    for seed in range(8):
        rng = np.random.default_rng(seed)
        told.append(regress([sighting(drive(rng, gains=NEUTRAL), rng)]).differs())
    assert sum(told) <= 1


def test_wrong_odometry_is_told():
    rng = np.random.default_rng(3)
    assert regress([sighting(drive(rng), rng)]).differs()


def test_more_drives_are_surer():
    rng = np.random.default_rng(4)
    drives = [sighting(drive(rng), rng) for _ in range(4)]
    alone, together = regress(drives[:1], 4.0), regress(drives, 4.0)
    assert np.all(together.sigmas[:3] < 0.8 * alone.sigmas[:3])
    assert together.legs == pytest.approx(4 * alone.legs, rel=0.05)


def test_too_short_a_drive_is_refused():
    one = sighting(drive(np.random.default_rng(0)))
    short = Sighting(one.motion, one.stamps_ns[:5], one.poses[:5])
    with pytest.raises(EvaluationError, match=r"m of odometry between known poses, expected at least"):
        regress([short])


def test_a_drive_that_never_turns_says_nothing_of_turns():
    one = sighting(drive(np.random.default_rng(0), gains=Gains()))
    still = np.tile([0.05, 0.0, 0.0], (len(one.motion.steps), 1))
    straight = Sighting(type(one.motion)(one.motion.stamps_ns, still), one.stamps_ns, np.zeros_like(one.poses))
    with pytest.raises(EvaluationError, match="expected one that turns"):
        regress([straight])
