from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from hybridmap.errors import EvaluationError
from hybridmap.evaluate import absolute_error, relative_error
from hybridmap.evaluate.association import associate, travel
from hybridmap.evaluate.trajectory_errors import drift_percent
from hybridmap.geometry import compose, quaternion_from_yaw
from hybridmap.trajectory import NS_PER_S, Trajectory, known_at

STEP_M = 0.1


def wander(count: int = 400, seed: int = 3) -> tuple[Trajectory, Trajectory]:
    """A true way in steps of exactly 0.1 m, 10 Hz, and a drifting, noisy estimate of it in another frame."""
    rng = np.random.default_rng(seed)
    turns = 0.05 * np.sin(np.arange(count) / 30) + rng.normal(0, 0.01, count)
    truth, estimate = [np.zeros(3)], [np.zeros(3)]
    for turn in turns[:-1]:
        motion = np.array([STEP_M, 0.0, turn])
        truth.append(compose(truth[-1], motion))
        estimate.append(compose(estimate[-1], motion + rng.normal([0.001, 0, 0.001], [0.003, 0.001, 0.002])))
    stamps = np.arange(count) * (NS_PER_S // 10) + 1_700_000_000 * NS_PER_S
    return Trajectory(stamps, compose([3.0, -2.0, 0.7], np.array(estimate))), Trajectory(stamps, np.array(truth))


def evo_trajectory(trajectory: Trajectory):
    trajectories = pytest.importorskip("evo.core.trajectory")
    quaternion = np.roll(quaternion_from_yaw(trajectory.poses[:, 2]), 1, axis=1)
    position = np.column_stack([trajectory.poses[:, :2], np.zeros(len(trajectory))])
    return trajectories.PoseTrajectory3D(position, quaternion, trajectory.stamps_s)


def evo_statistics(metric, estimate: Trajectory, reference: Trajectory, *, align: bool) -> dict[str, float]:
    ours, theirs = evo_trajectory(estimate), evo_trajectory(reference)
    if align:
        ours.align(theirs)
    metric.process_data((theirs, ours))
    statistics: dict[str, float] = metric.get_all_statistics()
    return statistics


def test_ate_agrees_with_evo():
    metrics = pytest.importorskip("evo.core.metrics")
    estimate, reference = wander()
    expected = evo_statistics(metrics.APE(metrics.PoseRelation.translation_part), estimate, reference, align=True)
    found = absolute_error(estimate, reference)
    assert found.rmse_m == pytest.approx(expected["rmse"], abs=1e-9)
    assert found.mean_m == pytest.approx(expected["mean"], abs=1e-9)
    assert found.median_m == pytest.approx(expected["median"], abs=1e-9)
    assert found.max_m == pytest.approx(expected["max"], abs=1e-9)
    assert found.rmse_m > 0.05


@pytest.mark.parametrize(("delta", "unit"), [(1.0, "s"), (1.0, "m"), (0.5, "m")])
def test_rpe_agrees_with_evo_on_the_same_pieces(delta, unit):
    metrics = pytest.importorskip("evo.core.metrics")
    estimate, reference = wander()
    frames = round(delta / STEP_M)
    for relation, name in (("translation_part", "trans_rmse_m"), ("rotation_angle_deg", "rot_rmse_deg")):
        rpe = metrics.RPE(metrics.PoseRelation[relation], delta=frames, delta_unit=metrics.Unit.frames, all_pairs=True)
        expected = evo_statistics(rpe, estimate, reference, align=False)
        found = relative_error(estimate, reference, delta, unit)
        assert getattr(found, name) == pytest.approx(expected["rmse"], rel=1e-6)
        assert found.pairs == len(reference) - frames


@settings(max_examples=25, deadline=None)
@given(st.floats(-50, 50), st.floats(-50, 50), st.floats(-3, 3))
def test_errors_do_not_depend_on_the_frame(x, y, yaw):
    estimate, reference = wander(60)
    moved = Trajectory(estimate.stamps_ns, compose([x, y, yaw], estimate.poses))
    assert absolute_error(moved, reference).rmse_m == pytest.approx(absolute_error(estimate, reference).rmse_m, abs=1e-9)
    before, after = relative_error(estimate, reference, 1, "m"), relative_error(moved, reference, 1, "m")
    assert after.trans_rmse_m == pytest.approx(before.trans_rmse_m, abs=1e-9)
    assert after.rot_rmse_deg == pytest.approx(before.rot_rmse_deg, abs=1e-6)


def test_drift_of_a_pure_scale_error_is_that_error():
    _, reference = wander()
    straight = np.column_stack([np.arange(len(reference)) * STEP_M, np.zeros((len(reference), 2))])
    reference = Trajectory(reference.stamps_ns, straight)
    estimate = Trajectory(reference.stamps_ns, straight * [1.03, 1, 1])
    assert drift_percent(associate(estimate, reference)) == pytest.approx(3.0, rel=1e-6)
    assert drift_percent(associate(reference, reference)) == pytest.approx(0.0, abs=1e-9)


def test_drift_without_motion_is_not_a_number():
    _, reference = wander(10)
    still = Trajectory(reference.stamps_ns, np.zeros((10, 3)))
    assert np.isnan(drift_percent(associate(reference, still)))
    assert relative_error(reference, still, 1.0, "m").pairs == 0


def test_reference_is_interpolated_within_its_span_but_not_over_gaps():
    stamps = np.array([0, 1, 2, 10, 11]) * NS_PER_S
    reference = Trajectory(stamps, np.column_stack([np.array([0, 1, 2, 10, 11]), np.zeros((5, 2))]))
    wanted = np.array([-1, 0, 0.5, 2, 5, 10.25, 11, 11.5]) * NS_PER_S
    expected = [False, True, True, True, False, True, True, False]
    assert known_at(reference, wanted.astype(np.int64), 1.0).tolist() == expected
    estimate = Trajectory(wanted.astype(np.int64), np.zeros((8, 3)))
    pairs = associate(estimate, reference, 1.0)
    assert pairs.reference[:, 0].tolist() == [0, 0.5, 2, 10.25, 11]
    assert pairs.total == 8


def test_another_clock_is_an_error_that_says_so():
    estimate, reference = wander(50)
    late = Trajectory(reference.stamps_ns + 10_000 * NS_PER_S, reference.poses)
    with pytest.raises(EvaluationError, match=r"0 stamps in common.*same clock"):
        absolute_error(estimate, late)


def test_jitter_is_no_travel():
    rng = np.random.default_rng(0)
    still = np.column_stack([rng.normal(0, 0.005, (5000, 2)), np.zeros(5000)])
    assert travel(still)[-1] < 0.1
    assert travel(wander()[1].poses)[-1] == pytest.approx(399 * STEP_M)
