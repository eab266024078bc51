import dataclasses

import numpy as np
import pytest

from hybridmap import geometry
from hybridmap.verification import rows_of, verify_cells
from hybridmap.verification.drives import corridor, pixel_order, raster, wander
from hybridmap.verification.rows import recurrence_verdict, verb_of_change
from tests.verification.cells_for_tests import TINY


def broken(**settings):
    return {row.name: row for row in rows_of(verify_cells(3, TINY, settings))}


@pytest.fixture(scope="module")
def rows(result):
    return {row.name.removeprefix("verify/"): row for row in rows_of(result)}


def test_every_row_of_the_table_is_there(rows):
    judged = {name for name, row in rows.items() if row.passed is not None}
    assert judged == {
        "head_direction_float64", "head_direction_float32", "head_direction_von_mises", "band_orientation", "band_period",
        "gridness", "phase_error_relu_30hz", "phase_error_relu_100hz", "phase_error_softplus_30hz",
        "phase_error_softplus_100hz",
        "position_room_relu", "position_room_softplus", "position_corridor_relu", "position_corridor_softplus",
        "no_shadow_integrator", "no_shadow_driving_on", "place_single_recruited", "place_single_room",
        "attractor_one_bump_recruited_settled", "attractor_one_bump_printed_settled", "standing_still",
        "printed_kernel_refused", "recalibrated_5_percent",
    }  # fmt: skip
    assert {"gridness_ideal", "gridness_square", "place_single_printed", "noise_1_percent", "turn_rate_modulation"} <= set(rows)


def test_the_bars_are_kept_on_short_drives(rows):
    assert [name for name, row in rows.items() if row.passed is False] == []


def test_a_square_metric_scores_below_the_hexagonal_one(rows):
    assert rows["gridness_square"].value < -0.5 < 1.0 < rows["gridness_median"].value


def test_more_noise_is_more_error(rows):
    assert 0.0 < rows["noise_1_percent"].value < rows["noise_10_percent"].value


def test_closures_bound_what_noise_costs(rows):
    assert rows["recalibrated_5_percent"].value < 0.1
    assert rows["not_recalibrated_5_percent"].value > 10.0 * rows["recalibrated_5_percent"].value


def test_recurrence_is_stated_whichever_way_it_comes_out(result):
    text = recurrence_verdict(result.place)
    assert "recruited place cells" in text
    assert "printed rule" in text
    settled = dataclasses.replace(result.place, sheet=dict.fromkeys(result.place.sheet, result.place.recruited))
    assert recurrence_verdict(settled).count("does not change") == 2
    assert [verb_of_change(percent) for percent in (0.4, 1.0, -4.9, 6.0, -6.0)] == [
        "does not change", "hardly changes", "hardly changes", "raises", "lowers",
    ]  # fmt: skip


@pytest.mark.slow
def test_the_same_seed_gives_the_same_figures(rows):
    again = {row.name.removeprefix("verify/"): row for row in rows_of(verify_cells(3, TINY, {}))}
    assert again == rows


@pytest.mark.slow
def test_a_wrong_gain_is_seen():
    rows = broken(gain=1.01)
    missed = {name.removeprefix("verify/") for name, row in rows.items() if row.passed is False}
    assert {"phase_error_relu_30hz", "phase_error_softplus_100hz", "position_corridor_relu"} <= missed


@pytest.mark.parametrize("hz", [30.0, 100.0])
def test_the_exact_path_is_what_the_increments_make(hz):
    for drive in (wander(np.random.default_rng(4), 20.0, hz), corridor(np.random.default_rng(4), hz), raster(0.4, 0.1, 0.3)):
        pose = np.zeros(3)
        for delta, exact in zip(drive.deltas, drive.poses, strict=True):
            pose = geometry.compose(pose, delta)
            assert geometry.between(exact, pose) == pytest.approx(np.zeros(3), abs=1e-9)


def test_a_wander_stays_in_the_room_and_a_corridor_has_its_length():
    drive = wander(np.random.default_rng(5), 60.0, 30.0)
    assert np.abs(drive.poses[:, 0]).max() < 5.0
    assert np.abs(drive.poses[:, 1]).max() < 1.5
    assert drive.distance_m[-1] == pytest.approx(60.0, abs=0.05)
    assert corridor(np.random.default_rng(5), 30.0).distance_m[-1] == pytest.approx(16.8)


@pytest.mark.parametrize("upright", [False, True])
def test_a_raster_comes_to_every_pixel_once_by_steps_of_one(upright):
    order = pixel_order(7, upright=upright)
    assert len({tuple(pixel) for pixel in order}) == 49
    assert np.abs(np.diff(order, axis=0)).sum(axis=1).max() == 1
    steps = np.linalg.norm(raster(0.7, 0.1, 1.0, upright=upright).deltas[1:, :2], axis=1)
    assert steps == pytest.approx(np.full(48, 0.1))
