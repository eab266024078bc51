"""Every row with a bar: break that figure, and exactly that row misses."""

import dataclasses

import numpy as np
import pytest

from hybridmap.config.mapping import NeuralConfig
from hybridmap.neural import PathIntegrator
from hybridmap.neural.place import PlaceAttractor
from hybridmap.verification import path_error, rate_maps, rows_of, shadow
from hybridmap.verification.shadow import overwrite
from tests.verification.cells_for_tests import TINY

SEED = np.random.SeedSequence(11)


def missed(result):
    return {row.name.removeprefix("verify/") for row in rows_of(result) if row.passed is False}


def with_part(result, part, **changes):
    return dataclasses.replace(result, **{part: dataclasses.replace(getattr(result, part), **changes)})


def with_path(result, key, **changes):
    *others, last = result.room[key]
    return dataclasses.replace(result, room=result.room | {key: [*others, dataclasses.replace(last, **changes)]})


def worst(values, worse):
    """The same values but for one, the last."""
    changed = np.array(values, dtype=float)
    changed.flat[-1] = worse
    return changed


BREAKS = {
    "head_direction_float64": lambda r: with_part(
        r, "head_direction", error_rad=r.head_direction.error_rad | {"float64": 1.1e-9}
    ),
    "head_direction_float32": lambda r: with_part(
        r, "head_direction", error_rad=r.head_direction.error_rad | {"float32": 1.1e-3}
    ),
    "head_direction_von_mises": lambda r: with_part(
        r, "head_direction", error_rad=r.head_direction.error_rad | {"von_mises": 1.1e-9}
    ),
    "band_orientation": lambda r: with_part(
        r, "lattice", band_orientation_error_deg=worst(r.lattice.band_orientation_error_deg, 0.6)
    ),
    "band_period": lambda r: with_part(r, "lattice", band_period_error=worst(r.lattice.band_period_error, 0.021)),
    "gridness": lambda r: with_part(r, "lattice", gridness=worst(r.lattice.gridness, 1.09)),
    "phase_error_relu_30hz": lambda r: with_path(r, ("relu", 30.0), module=np.full((3, 8), 0.0061)),
    "phase_error_relu_100hz": lambda r: with_path(r, ("relu", 100.0), module=np.full((3, 8), 0.0061)),
    "phase_error_softplus_30hz": lambda r: with_path(r, ("softplus", 30.0), module=np.full((3, 8), 0.00021)),
    "phase_error_softplus_100hz": lambda r: with_path(r, ("softplus", 100.0), module=np.full((3, 8), 0.00021)),
    "position_room_relu": lambda r: with_path(r, ("relu", 100.0), position_m=np.full(3, 0.51e-3)),
    "position_room_softplus": lambda r: with_path(r, ("softplus", 30.0), position_m=np.full(3, 0.51e-3)),
    "position_corridor_relu": lambda r: dataclasses.replace(r, corridor=r.corridor | {"relu": off_the_corridor(r, "relu")}),
    "position_corridor_softplus": lambda r: dataclasses.replace(
        r, corridor=r.corridor | {"softplus": off_the_corridor(r, "softplus")}
    ),
    "no_shadow_integrator": lambda r: with_overwriting(r, at_once=worst(r.overwritten["softplus"].at_once, 1.1e-6)),
    "no_shadow_driving_on": lambda r: with_overwriting(r, driving_on=1.1e-6),
    "place_single_recruited": lambda r: with_part(
        r, "place", recruited=dataclasses.replace(r.place.recruited, fields=np.array([1] * 94 + [2] * 6))
    ),
    "place_single_room": lambda r: with_part(
        r, "room_fields", sampled=dataclasses.replace(r.room_fields.sampled, fields=np.array([1] * 94 + [2] * 6))
    ),
    "attractor_one_bump_recruited_settled": lambda r: with_bumps(r, "recruited"),
    "attractor_one_bump_printed_settled": lambda r: with_bumps(r, "printed"),
    "standing_still": lambda r: with_part(r, "standstill", pose_change=1e-15),
    "recalibrated_5_percent": lambda r: with_part(r, "recalibrated", error_m=worst(r.recalibrated.error_m, 0.151)),
    "printed_kernel_refused": lambda r: dataclasses.replace(r, printed_kernel=""),
}


def off_the_corridor(result, rectifier):
    return dataclasses.replace(result.corridor[rectifier], position_m=np.array([0.0, 0.11e-3]))


def with_overwriting(result, **changes):
    broken = dataclasses.replace(result.overwritten["softplus"], **changes)
    return dataclasses.replace(result, overwritten=result.overwritten | {"softplus": broken})


def with_bumps(result, learnt):
    return with_part(result, "place", one_bump=result.place.one_bump | {(learnt, "settled"): 0.98})


@pytest.mark.parametrize("row", BREAKS)
def test_a_broken_figure_makes_exactly_its_row_miss(result, row):
    assert missed(BREAKS[row](result)) == {row}


@pytest.mark.parametrize("row", ["band_period", "gridness", "no_shadow_driving_on"])
def test_a_figure_that_is_none_misses_its_bar(result, row):
    none = {
        "band_period": lambda r: with_part(r, "lattice", band_period_error=worst(r.lattice.band_period_error, np.nan)),
        "gridness": lambda r: with_part(r, "lattice", gridness=worst(r.lattice.gridness, np.nan)),
        "no_shadow_driving_on": lambda r: with_overwriting(r, driving_on=float("nan")),
    }
    assert missed(none[row](result)) == {row}


def test_every_row_with_a_bar_is_broken_above(result):
    assert {row.name.removeprefix("verify/") for row in rows_of(result) if row.passed is not None} == set(BREAKS)


@pytest.mark.parametrize("change", [1.06, 0.95])
def test_bands_of_another_period_than_they_should_have_are_measured(monkeypatch, result, change):
    def mistaken(config):
        integrator = PathIntegrator(config)
        integrator.bands.periods_m = change * integrator.bands.periods_m
        return integrator

    monkeypatch.setattr(rate_maps, "PathIntegrator", mistaken)
    maps = rate_maps.lattice_maps(SEED, {}, TINY.arena_m, TINY.lattice_pitch_m, 1)
    assert maps.band_period_error == pytest.approx(np.full((8, 3), abs(1.0 / change - 1.0)), abs=0.02)
    assert "band_period" in missed(dataclasses.replace(result, lattice=maps))
    assert maps.band_orientation_error_deg.max() < 0.5


def test_bands_of_another_orientation_than_they_should_have_are_measured(monkeypatch):
    def mistaken(config):
        integrator = PathIntegrator(config)
        integrator.bands.orientations_rad = integrator.bands.orientations_rad + np.radians(3.0)
        return integrator

    monkeypatch.setattr(rate_maps, "PathIntegrator", mistaken)
    maps = rate_maps.lattice_maps(SEED, {}, TINY.arena_m, TINY.lattice_pitch_m, 1)
    assert maps.band_orientation_error_deg == pytest.approx(np.full((8, 3), 3.0), abs=0.5)
    assert maps.band_period_error.max() < 0.02


def test_competition_that_does_not_settle_misses_its_bar(monkeypatch, result):
    monkeypatch.setattr(PlaceAttractor, "settle", lambda self, iterations=10: None)
    place = rate_maps.place_maps(SEED, {}, TINY.arena_m, TINY.place_pitch_m, TINY.place_cells, TINY.place_epochs)
    assert "attractor_one_bump_printed_settled" in missed(dataclasses.replace(result, place=place))


def test_the_larger_of_two_bumps_is_what_settles():
    integrator = PathIntegrator(NeuralConfig())
    bump = integrator.attractor.activity
    two = bump + 0.7 * np.roll(bump, (9, -12), axis=(0, 1))
    shown = np.stack([two.ravel(), 0.0 * two.ravel()], axis=1).astype(np.float32)
    settled = rate_maps.settled_sheets(integrator, shown)
    assert rate_maps.one_bump_share(shown) == 0.0
    assert rate_maps.one_bump_share(settled) == 1.0
    assert settled[:, 0].reshape(bump.shape) == pytest.approx(bump, abs=1e-3)
    assert not settled[:, 1].any()


def test_bumps_are_counted_across_the_edge_of_the_sheet():
    bump = PlaceAttractor(32, 0.16, 1.4).activity
    one, two = np.roll(bump, (16, 31), axis=(0, 1)), bump + 0.5 * np.roll(bump, (16, 16), axis=(0, 1))
    weak = bump + 0.1 * np.roll(bump, (16, 16), axis=(0, 1))
    share = rate_maps.one_bump_share(np.stack([a.ravel() for a in (one, two, weak, 0.0 * bump)], axis=1).astype(np.float32))
    assert share == pytest.approx(2 / 3)


def test_the_rings_pull_the_sheets_and_without_stripes_they_do_not():
    found = shadow.overwritten(SEED, {"rectifier": "softplus"}, 2, 1)
    at_start = {key: float(share[0]) for key, share in found.shown.items()}
    at_end = {key: float(share[-1]) for key, share in found.shown.items()}
    for stripes in (True, False):
        assert at_start["sheets", stripes] == pytest.approx(1.0)
        assert at_start["rings", stripes] == pytest.approx(0.0)
        assert at_end["both", stripes] == pytest.approx(1.0, abs=1e-6)
    assert at_end["sheets", True] < 0.05
    assert at_end["rings", True] > 0.95
    assert at_end["sheets", False] == pytest.approx(1.0, abs=1e-6)
    assert at_end["rings", False] == pytest.approx(0.0, abs=1e-6)
    assert found.driving_on < 1e-6


class Shadowed(PathIntegrator):
    """Integrates position in a number beside the network, and puts the sheets where that says."""

    def __init__(self, config):
        super().__init__(config)
        self._position, self._heading = np.zeros(2), 0.0

    def step(self, delta_robot, dt_s):
        super().step(delta_robot, dt_s)
        dx, dy, turn = np.asarray(delta_robot, dtype=float)
        c, s = np.cos(self._heading), np.sin(self._heading)
        self._position = self._position + np.array((c * dx - s * dy, s * dx + c * dy))
        self._heading += turn
        overwrite(self, "both", self._position - self.decode().position_m)


def test_a_shadow_integrator_that_puts_the_sheets_back_is_found(monkeypatch, result):
    monkeypatch.setattr(shadow, "PathIntegrator", Shadowed)
    found = shadow.overwritten(SEED, {"rectifier": "softplus"}, 2, 1)
    assert found.at_once.max() < 1e-6  # which is why the drive goes on
    assert found.driving_on > 0.2
    assert missed(dataclasses.replace(result, overwritten=result.overwritten | {"softplus": found})) == {"no_shadow_driving_on"}


@pytest.mark.parametrize("cells", [8, 90])
def test_the_heading_rows_are_of_the_ring_that_is_configured(cells):
    found = path_error.head_direction(SEED, {"head_direction_cells": cells}, 50)
    assert len(found.preferred_rad) == found.rates.shape[1] == cells
    assert set(found.error_rad) == {"float64", "float32", "von_mises"}


def test_all_noises_are_measured_on_the_same_drives(result):
    first, second = (result.noise[share][0].distance_m for share in TINY.noise)
    assert np.array_equal(first, second)
