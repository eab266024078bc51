"""Medians over the seeds: scipy is the oracle of their test, paired differences see what the medians do not."""

import math

import numpy as np
import pytest
from scipy import stats

from hybridmap.study.cell import CellResult
from hybridmap.study.cells import lay_out
from hybridmap.study.model import StatisticsConfig
from hybridmap.study.statistics import LEAST, holm, median_of, signed_rank, summarise
from tests.narrowing import known
from tests.study.studies import small


def test_the_interval_is_that_of_resampled_medians_and_the_same_every_time():
    values = np.random.default_rng(0).normal(3.0, 2.0, 21)
    config = StatisticsConfig(confidence=0.9, resamples=999)
    found = median_of(values, config)
    assert found == median_of(values.copy(), config)
    assert found.value == np.median(values)
    found_by_scipy = stats.bootstrap(
        (values,), np.median, confidence_level=0.9, method="percentile", n_resamples=999, rng=np.random.default_rng(5)
    ).confidence_interval
    assert (found.low, found.high) == pytest.approx((found_by_scipy.low, found_by_scipy.high), abs=0.3)


def test_intervals_hold_the_truth_about_as_often_as_they_say_on_heavy_tails():
    rng = np.random.default_rng(1)
    config = StatisticsConfig(confidence=0.9, resamples=500)
    found = [median_of(rng.standard_cauchy(20), config) for _ in range(400)]
    assert np.mean([one.low <= 0.0 <= one.high for one in found]) == pytest.approx(0.9, abs=0.05)


def test_degenerate_samples_have_honest_intervals():
    config = StatisticsConfig()
    assert math.isnan(median_of(np.array([]), config).value)
    assert str(median_of(np.ones(1), config)) == "1 value: no interval"
    for values in (np.linspace(1.0, 1.1, LEAST - 1), np.ones(LEAST - 1)):
        few = median_of(values, config)
        assert not few.known
        assert few.value == np.median(values)
        assert str(few) == "4 values: no interval"
    alike = median_of(np.full(LEAST, 2.0), config)
    assert (alike.low, alike.high) == (2.0, 2.0)


def test_the_signed_rank_test_is_scipy_s_and_knows_when_it_knows_nothing():
    differences = np.random.default_rng(2).normal(0.4, 1.0, 20)
    assert signed_rank(differences) == stats.wilcoxon(differences).pvalue
    assert signed_rank(-differences) == signed_rank(differences)
    assert math.isnan(signed_rank(differences[: LEAST - 1]))
    assert signed_rank(np.zeros(9)) == 1.0
    assert signed_rank(np.arange(1.0, 7.0)) == pytest.approx(2.0 / 2**6)
    with_ties = np.array([0.0, 0.0, 1.0, 1.0, 2.0, -1.0, 3.0])
    assert 0.0 < signed_rank(with_ties) < 1.0


def test_one_lost_map_of_twenty_does_not_hide_that_the_others_are_better():
    differences = np.append(-0.1 - 0.01 * np.arange(19.0), 50.0)
    assert stats.ttest_1samp(differences, 0.0).pvalue > 0.3
    assert signed_rank(differences) < 0.001


def test_holm_multiplies_the_least_by_all_and_never_lets_a_larger_one_pass_below():
    assert holm([0.01, 0.04, 0.03]) == pytest.approx([0.03, 0.06, 0.06])
    assert holm([0.5, 0.6]) == [1.0, 1.0]
    missing = holm([math.nan, 0.01, 0.02])
    assert math.isnan(missing[0])
    assert missing[1:] == pytest.approx([0.02, 0.02])


def results_of(grid, ate):
    """Results with `ate(backend, seed)`; None: no map."""
    made = {}
    for cell in grid.cells:
        value = ate(cell.backend, cell.seed)
        made[cell.key] = CellResult(cell.key, "converged", "", {} if value is None else {"ate_m": value}, {}, "")
    return made


def test_differences_are_paired_by_seed_and_cells_without_a_figure_left_out():
    grid = lay_out(small(seeds=8, backends=["gtsam-lm", "odometry"], false_loops={}))

    def ate(backend, seed):
        if (backend, seed) == ("odometry", 7):
            return None
        return 10.0 * seed + (0.5 + 0.01 * seed if backend == "odometry" else 0.0)

    base, other = (one for one in summarise(grid, results_of(grid, ate)) if one.measure == "ate_m")
    assert base.difference is None
    assert base.verdict == ""
    assert (base.cells, base.solved, base.median.value) == (8, 8, 35.0)
    apart = known(other.difference)
    assert (other.cells, other.solved, apart.count, other.better) == (8, 7, 7, 0.0)
    assert apart.value == pytest.approx(0.53)
    assert other.p == pytest.approx(2.0 / 2**7)
    assert other.verdict == "higher"  # though the medians' intervals overlap widely
    assert other.median.low < base.median.value < other.median.high


def test_p_is_corrected_for_the_back_ends_of_one_group_and_a_measure():
    grid = lay_out(small(seeds=8, backends=["gtsam-lm", "odometry", "gtsam-gn"], false_loops={"rates": [0.0, 0.2]}))
    ones = summarise(grid, results_of(grid, lambda backend, seed: 1.0 + seed if backend == "gtsam-lm" else 0.5))
    found = [one.p for one in ones if one.measure == "ate_m" and one.cell.backend != "gtsam-lm"]
    assert found == pytest.approx([2 * 2.0 / 2**8] * 4)


def test_optimisers_at_one_optimum_are_not_told_apart_by_rounding():
    grid = lay_out(small(seeds=8, backends=["gtsam-lm", "gtsam-gn"], false_loops={}))
    ones = summarise(grid, results_of(grid, lambda backend, seed: 1.0 + (1e-7 if backend == "gtsam-gn" else 0.0)))
    other = next(one for one in ones if (one.cell.backend, one.measure) == ("gtsam-gn", "ate_m"))
    assert (other.p, other.verdict, other.better) == (1.0, "", 0.0)


def test_a_back_end_that_never_has_a_figure_has_none():
    grid = lay_out(small(backends=["gtsam-lm", "odometry"], false_loops={}))
    rows = summarise(grid, results_of(grid, lambda backend, seed: None if backend == "odometry" else 1.0))
    lost = next(one for one in rows if (one.cell.backend, one.measure) == ("odometry", "ate_m"))
    assert (lost.solved, known(lost.difference).count) == (0, 0)
    for value in (lost.median.value, lost.mean, known(lost.difference).value, lost.better, lost.p):
        assert math.isnan(value)


def test_a_back_end_is_compared_with_the_first_one_from_the_same_start():
    study = small(seeds=6, backends=["gtsam-lm", "odometry", "gtsam-gn"], starts=["odometry", "angular"], false_loops={})
    against = {variant.title: study.baseline_of(variant.title) for variant in study.backends}
    assert against == {
        "gtsam-lm, odometry": "gtsam-lm, odometry",
        "gtsam-lm, angular": "gtsam-lm, angular",
        "odometry": "gtsam-lm, odometry",
        "gtsam-gn, odometry": "gtsam-lm, odometry",
        "gtsam-gn, angular": "gtsam-lm, angular",
    }
    grid = lay_out(study)
    ones = summarise(grid, results_of(grid, lambda backend, seed: 1.0 + ("angular" in backend) + 0.1 * ("gn" in backend)))
    apart = {one.cell.backend: one.difference and one.difference.value for one in ones if one.measure == "ate_m"}
    assert apart["gtsam-lm, angular"] is None
    assert apart["gtsam-gn, angular"] == pytest.approx(0.1)
