"""The calibration as a variable of the graph: a chain that bends too much to be optimised is solved with it."""

from dataclasses import replace

import numpy as np
import pytest

from hybridmap import backends
from hybridmap.calibration import joint
from hybridmap.calibration.estimate import Estimate
from hybridmap.calibration.odometry_terms import terms_of
from hybridmap.config.backends import BackendsConfig
from hybridmap.errors import EvaluationError
from hybridmap.geometry import align, transform_points
from hybridmap.graph.paths import own_odometry
from hybridmap.odometry_model import Gains
from tests.calibration.drives import circle, drive, experience_map

CONFIG = BackendsConfig()
BENT = Gains(1.0, 1.0, 0.06)


def ate(poses, truth):
    return float(np.sqrt(np.mean(np.sum((transform_points(align(truth, poses), poses[:, :2]) - truth[:, :2]) ** 2, axis=1))))


@pytest.fixture(scope="module")
def bent():
    """Odometry and true loops alone, with a heading bias of 3.4 deg/m."""
    rng = np.random.default_rng(3)
    one = drive(rng, laps=3, gains=BENT)
    experiences, chosen = experience_map(one, rng, every=20)
    return experiences.pose_graph(), one.motion, one.motion.stamps_ns[chosen], one.truth[chosen]


def test_it_solves_a_chain_that_a_robust_back_end_does_not(bent):
    graph, motion, stamps, truth = bent
    found = joint.solve(graph, motion, stamps, CONFIG)
    assert found.estimate.gains.heading_bias_rad_m == pytest.approx(BENT.heading_bias_rad_m, abs=0.006)
    assert ate(found.poses, truth) < 0.3
    alone = backends.create("gtsam-cauchy", CONFIG).solve(graph).poses
    assert ate(found.poses, truth) < 0.5 * ate(alone, truth)


def test_a_start_of_the_bias_other_than_none_finds_what_none_misses():
    """With 8 deg/m the chain grown without a bias winds once too often, and its optimum is another map."""
    rng, very_bent = np.random.default_rng(3), Gains(1.0, 1.0, 0.14)
    one = drive(rng, laps=3, gains=very_bent)
    experiences, chosen = experience_map(one, rng, every=20)
    found = joint.solve(experiences.pose_graph(), one.motion, one.motion.stamps_ns[chosen], CONFIG)
    assert found.bias_start_rad_m != 0.0
    assert found.estimate.gains.heading_bias_rad_m == pytest.approx(very_bent.heading_bias_rad_m, abs=0.006)
    assert ate(found.poses, one.truth[chosen]) < 0.3


@pytest.mark.parametrize("bias", [0.1, -0.14])
def test_a_drive_that_has_shrunk_to_a_point_is_no_solution(bias):
    """The odometry of a map of no size costs less than that of the true one."""
    rng, gains = np.random.default_rng(3), Gains(1.0, 1.0, bias)
    one = drive(rng, laps=3, gains=gains)
    experiences, chosen = experience_map(one, rng, every=20)
    found = joint.solve(experiences.pose_graph(), one.motion, one.motion.stamps_ns[chosen], CONFIG)
    assert found.estimate.gains.heading_bias_rad_m == pytest.approx(bias, abs=0.006)
    assert ate(found.poses, one.truth[chosen]) < 0.3


def test_a_map_that_drops_its_loops_calibrates_nothing(bent):
    """Of four loops two are false."""
    graph, motion, stamps, _ = bent
    loops = np.flatnonzero(graph.is_loop)[[5, 12, 20, 28]]
    four = graph.with_edges(np.union1d(np.flatnonzero(~graph.is_loop), loops))
    deltas = four.deltas.copy()
    deltas[np.flatnonzero(four.is_loop)[:2]] += [0.0, 2.0, 0.0]
    with pytest.raises(
        EvaluationError, match=r"found [0-2] of 4 registrations and loop closures that agree with the map, expected 3 or more"
    ):
        joint.solve(replace(four, deltas=deltas), motion, stamps, CONFIG)


def test_a_circle_is_refused_before_anything_is_solved():
    one = circle(np.random.default_rng(0))
    experiences, chosen = experience_map(one, np.random.default_rng(0), every=20, registered=True)
    with pytest.raises(EvaluationError, match="does not tell turn gain and heading bias apart"):
        joint.solve(experiences.pose_graph(), one.motion, one.motion.stamps_ns[chosen], CONFIG)


def test_what_the_drive_leaves_open_is_the_prior_and_not_reported():
    """The variance that is left of the prior says so."""
    covariance = np.diag(joint.PRIOR**2 * [0.9, 0.01, 0.01, 0.9])
    estimate = joint.told_by_the_drive(Estimate(Gains(1.02, 1.01, 0.01), 0.05, covariance, 4.0, 20.0, 80.0, 1.0, 0.0))
    assert estimate.measured.tolist() == [False, True, True, False]
    assert (estimate.gains, estimate.delay_s) == (Gains(1.0, 1.01, 0.01), 0.0)
    open_ = np.diag(joint.PRIOR**2 * [0.01, 0.01, 0.9, 0.01])
    with pytest.raises(EvaluationError, match="too little about turn gain or heading bias"):
        joint.told_by_the_drive(Estimate(Gains(1.02, 1.01, 0.01), 0.05, open_, 4.0, 20.0, 80.0, 1.0, 0.0))


def test_registrations_leave_no_winding_in_doubt_and_long_legs_enter():
    rng = np.random.default_rng(4)
    one = drive(rng, laps=3, gains=BENT)
    experiences, chosen = experience_map(one, rng, every=20, registered=True)
    graph, stamps = experiences.pose_graph(), one.motion.stamps_ns[chosen]
    terms = terms_of(graph, one.motion, stamps, BENT)
    assert set(terms.components.tolist()) == {2}
    assert np.all(terms.targets - terms.sources > 1)
    found = joint.solve(graph, one.motion, stamps, CONFIG)
    assert np.all(np.abs(found.estimate.off(BENT)) < 4.0)
    assert found.bias_start_rad_m == 0.0


def test_derivatives_agree_with_differences(bent):
    import gtsam

    graph, motion, stamps, truth = bent
    problem = joint.Problem(graph, motion, stamps, CONFIG)
    error = joint.leg_error(problem, problem.terms, 7)
    source, target = int(problem.terms.sources[7]), int(problem.terms.targets[7])
    variable = np.array([1.02, 0.97, 0.03, 0.01])

    def at(pose_i, pose_j, calibration):
        values = gtsam.Values()
        values.insert(source, pose_i)
        values.insert(target, pose_j)
        values.insert(problem.key, calibration)
        return values

    pose_i, pose_j = gtsam.Pose2(*truth[source]), gtsam.Pose2(*truth[target])
    given = [np.zeros((3, 3)), np.zeros((3, 3)), np.zeros((3, 4))]
    error(None, at(pose_i, pose_j, variable), given)
    h = 1e-6
    for k in range(3):
        step = np.eye(3)[k] * h
        more, less = (at(pose_i.retract(s), pose_j, variable) for s in (step, -step))
        np.testing.assert_allclose((error(None, more, None) - error(None, less, None)) / (2 * h), given[0][:, k], atol=1e-3)
        more, less = (at(pose_i, pose_j.retract(s), variable) for s in (step, -step))
        np.testing.assert_allclose((error(None, more, None) - error(None, less, None)) / (2 * h), given[1][:, k], atol=1e-3)
        step = np.eye(4)[k] * h
        more, less = (at(pose_i, pose_j, variable + s) for s in (step, -step))
        np.testing.assert_allclose((error(None, more, None) - error(None, less, None)) / (2 * h), given[2][:, k], atol=1e-3)


def test_every_odometry_edge_enters_where_nothing_else_joins_the_chain(bent):
    graph, motion, stamps, _ = bent
    terms = terms_of(graph, motion, stamps, BENT)
    assert len(terms.legs) == len(own_odometry(graph)) == graph.n_nodes - 1
