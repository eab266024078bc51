"""The referee: one number, independent of the frame, equal to what gtsam calls twice the error."""

from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from hybridmap.backends.gtsam.factors import NoiseModels, factors, values
from hybridmap.backends.objective import chi2, residuals, squared_norms
from hybridmap.geometry import between, compose, exp, inverse, log
from tests.backends.graphs_for_tests import laps


@given(st.floats(-50, 50), st.floats(-50, 50), st.floats(-3, 3), st.integers(0, 1000))
@settings(max_examples=25, deadline=None)
def test_chi2_does_not_depend_on_the_frame(x, y, yaw, seed):
    graph, truth = laps(np.random.default_rng(seed), nodes=30)
    assert chi2(graph, compose([x, y, yaw], truth)) == pytest.approx(chi2(graph, truth), rel=1e-9)


def test_a_residual_is_the_logarithm_of_the_edge_undone():
    rng = np.random.default_rng(4)
    graph, truth = laps(rng)
    poses = compose(truth, exp(rng.normal(size=truth.shape) * [1.0, 1.0, 1.5]))
    off = compose(inverse(graph.deltas), between(poses[graph.sources], poses[graph.targets]))
    assert np.allclose(residuals(graph, poses), log(off), atol=1e-12)


def test_chi2_is_zero_where_the_measurements_are_kept_and_its_expectation_is_their_number():
    rng = np.random.default_rng(0)
    exact, truth = laps(rng, noise=0.0)
    assert chi2(exact, truth) == pytest.approx(0.0, abs=1e-18)
    noisy, truth = laps(rng, nodes=400)
    assert residuals(noisy, truth).shape == (noisy.n_edges, 3)
    mean = squared_norms(noisy, truth).mean()  # the mixing of the information makes it a little more than 3
    assert 2.5 < mean < 3.6


def test_chi2_is_twice_the_error_of_gtsam_also_for_large_angles():
    gtsam = pytest.importorskip("gtsam")
    rng = np.random.default_rng(1)
    graph, truth = laps(rng)
    poses = compose(truth, exp(rng.normal(size=truth.shape) * [1.0, 1.0, 1.5]))
    transposed = replace(graph, information=np.asfortranarray(graph.information))  # as files are read
    for same in (graph, transposed):
        theirs = gtsam.NonlinearFactorGraph()
        for factor in factors(same, NoiseModels()):
            theirs.push_back(factor)
        assert chi2(same, poses) == pytest.approx(2.0 * theirs.error(values(poses)), rel=1e-10)


def test_a_pose_that_is_not_finite_costs_infinitely_much():
    graph, truth = laps(np.random.default_rng(0))
    truth[7, 1] = np.nan
    assert chi2(graph, truth) == np.inf
