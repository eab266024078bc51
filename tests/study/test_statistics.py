"""Sums over the seeds: scipy is the oracle of the t interval, paired differences see what means do not."""

import math

import numpy as np
import pytest
from scipy import stats

from hybridmap.study.cell import CellResult
from hybridmap.study.cells import lay_out
from hybridmap.study.model import StatisticsConfig
from hybridmap.study.statistics import mean_of, summarise
from tests.narrowing import known
from tests.study.studies import small


def test_student_s_interval_is_scipy_s():
    values = np.random.default_rng(0).normal(3.0, 2.0, 12)
    found = mean_of(values, StatisticsConfig(confidence=0.9))
    expected = stats.ttest_1samp(values, 0.0).confidence_interval(0.9)
    assert (found.low, found.high) == pytest.approx((expected.low, expected.high))
    assert found.value == pytest.approx(values.mean())


def test_t_intervals_hold_the_truth_as_often_as_they_say():
    rng = np.random.default_rng(1)
    config = StatisticsConfig(confidence=0.8)
    hits = [abs(found.value) <= found.high - found.value for found in (mean_of(rng.normal(size=6), config) for _ in range(800))]
    assert np.mean(hits) == pytest.approx(0.8, abs=0.05)


def test_the_bootstrap_is_no_matter_of_chance_and_near_student_on_normal_values():
    values = np.random.default_rng(2).normal(3.0, 2.0, 40)
    config = StatisticsConfig(method="bootstrap", resamples=999)
    first, again = mean_of(values, config), mean_of(values, config)
    assert first == again
    other = mean_of(values, StatisticsConfig())
    assert (first.low, first.high) == pytest.approx((other.low, other.high), abs=0.15)
    assert first != other


@pytest.mark.parametrize("method", ["t", "bootstrap"])
def test_degenerate_samples_have_honest_intervals(method):
    config = StatisticsConfig(method=method)
    assert math.isnan(mean_of(np.array([]), config).value)
    one = mean_of(np.array([2.0]), config)
    assert one.value == 2.0
    assert math.isnan(one.low)
    assert not one.excludes_zero
    alike = mean_of(np.full(5, 2.0), config)
    assert (alike.low, alike.high) == (2.0, 2.0)
    assert alike.excludes_zero


@pytest.mark.parametrize(("method", "least"), [("t", 3), ("bootstrap", 5)])
def test_a_few_values_have_no_interval_and_no_verdict(method, least):
    config = StatisticsConfig(method=method)
    for values in (np.linspace(1.0, 1.1, least - 1), np.ones(least - 1)):
        few = mean_of(values, config)
        assert not few.known
        assert not few.excludes_zero
        assert few.value == pytest.approx(values.mean())
        assert str(few) == f"{least - 1} values: no interval"
    enough = mean_of(np.linspace(1.0, 1.1, least), config)
    assert enough.low < enough.value < enough.high
    assert str(mean_of(np.ones(1), config)) == "1 value: no interval"


def results_of(grid, ate):
    """Results with `ate(backend, seed)`; None: no map."""
    made = {}
    for cell in grid.cells:
        value = ate(cell.backend, cell.seed)
        made[cell.key] = CellResult(cell.key, "converged", "", {} if value is None else {"ate_m": value}, {}, "")
    return made


def test_differences_are_paired_by_seed_and_cells_without_a_map_left_out():
    grid = lay_out(small(seeds=6, backends=["gtsam-lm", "odometry"], false_loops={}))

    def ate(backend, seed):
        if (backend, seed) == ("odometry", 5):
            return None
        return 10.0 * seed + (0.5 + 0.01 * seed if backend == "odometry" else 0.0)

    base, other = (one for one in summarise(grid, results_of(grid, ate)) if one.measure == "ate_m")
    assert base.difference is None
    assert (base.cells, base.solved, base.median) == (6, 6, 25.0)
    apart = known(other.difference)
    assert (other.cells, other.solved, apart.count, other.better) == (6, 5, 5, 0.0)
    assert apart.value == pytest.approx(0.52)
    assert apart.excludes_zero  # though the means' intervals overlap widely
    assert other.mean.low < base.mean.value < other.mean.high


def test_a_back_end_that_never_has_a_map_has_no_figures():
    grid = lay_out(small(backends=["gtsam-lm", "odometry"], false_loops={}))
    rows = summarise(grid, results_of(grid, lambda backend, seed: None if backend == "odometry" else 1.0))
    lost = next(one for one in rows if (one.cell.backend, one.measure) == ("odometry", "ate_m"))
    assert (lost.solved, known(lost.difference).count) == (0, 0)
    assert math.isnan(lost.median)
    assert math.isnan(known(lost.difference).value)
    assert math.isnan(lost.better)
