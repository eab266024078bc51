"""The robust estimate recovers what was put in, and knows how sure it is."""

import numpy as np
import pytest

from hybridmap.calibration import NEUTRAL, Gains, regress
from hybridmap.calibration.regression import DELAY_LIMIT_S, Sighting
from hybridmap.config import Config
from hybridmap.errors import EvaluationError
from tests.calibration.drives import GAINS, along, circle, drive, sighting


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
    with pytest.raises(EvaluationError, match="give a drive that turns"):
        regress([straight])


@pytest.mark.parametrize("noise", [0.0, 0.1, 1.0])
@pytest.mark.parametrize(("step_m", "turn_rad"), [(0.002, 0.05), (0.02, 0.05), (0.05, 0.01)])
def test_a_circle_tells_turn_gain_and_bias_not_apart(step_m, turn_rad, noise):
    """Whatever noise makes of the fit: with none it is singular, with some it explains the noise."""
    rng = np.random.default_rng(0)
    one = circle(rng, step_m, turn_rad, steps=round(16.0 / step_m) if step_m < 0.01 else 2000, noise=noise)
    with pytest.raises(EvaluationError, match=r"does not tell turn gain and heading bias apart: found a condition number"):
        regress([sighting(one, rng)])


def test_turns_that_are_noise_tell_no_turn_gain():
    """A straight line whose odometry errs by a degree or two: regressing on that gave a turn gain of -0.02 +- 0.11."""
    rng = np.random.default_rng(0)
    with pytest.raises(EvaluationError, match=r"found turns of 0\.\d standard deviations.*give a drive that turns"):
        regress([sighting(along(rng, [(0.05, 0.0, 0.0)] * 2000), rng)])


def test_a_circle_and_a_way_back_the_other_way_round_tell_them():
    rng = np.random.default_rng(0)
    one = along(rng, [(0.05, 0.0, 0.05)] * 1000 + [(0.05, 0.0, -0.05)] * 1000)
    estimate = regress([sighting(one, rng)])
    assert estimate.measured.all()
    assert np.all(np.abs(estimate.off()) < 4.0)


def test_a_gain_that_no_straight_leg_tells_is_not_measured():
    rng = np.random.default_rng(0)
    one = along(rng, [(0.0005, 0.0, 0.05 * (1 if (k // 200) % 2 else -1)) for k in range(20000)])
    estimate = regress([sighting(one, rng)])
    assert estimate.measured.tolist() == [False, True, True, True]
    assert estimate.off(Gains(1.05, 1.0, 0.0))[0] == 0.0
    assert estimate.kept(Gains(1.05, 1.2, 0.3)).gain == 1.05
    assert estimate.kept(Gains(1.05, 1.2, 0.3)).turn_gain == estimate.gains.turn_gain


def test_a_delay_that_no_change_of_turning_tells_is_left_out_of_the_fit():
    """Turning at one rate while getting faster, seen by poses with little to compare."""
    rng = np.random.default_rng(1)
    one = along(rng, [(0.02 + 0.03 * k / 800, 0.0, 0.05) for k in range(800)], noise=0.3)
    estimate = regress([sighting(one, rng)])
    assert estimate.measured.tolist() == [True, True, True, False]
    assert estimate.delay_s == 0.0
    assert not estimate.delay_differs
    assert np.all(np.abs(estimate.off()) < 4.0)


def test_a_delay_beyond_what_can_be_set_is_refused():
    rng = np.random.default_rng(9)
    with pytest.raises(EvaluationError, match=r"found a delay of 1\.50 s .*expected at most 1 s; are both on one clock"):
        regress([sighting(drive(rng), rng, 30, 1.5)])
    assert Config.from_tree({"sensors": {"odometry_delay_s": DELAY_LIMIT_S}}, "test").sensors.odometry_delay_s == DELAY_LIMIT_S


@pytest.mark.parametrize("leg_m", [0.0, -1.0, 0.01, float("nan"), float("inf")])
def test_a_leg_that_is_none_is_refused(leg_m):
    with pytest.raises(EvaluationError, match=rf"--leg: found {leg_m:g} m, expected 0\.1 m or more"):
        regress([sighting(drive(np.random.default_rng(0), laps=1))], leg_m)


def test_gains_that_no_robot_has_are_refused():
    with pytest.raises(EvaluationError, match=r"test: found turn_gain -0\.19, which no robot has"):
        Gains(1.0, -0.19, 0.0).checked("test")
