"""What a setting changes: paired with the first setting by seed and source, in ratios that are the same for every source."""

import csv
import io
import math

import numpy as np
import pytest

from hybridmap.errors import ConfigError
from hybridmap.study import tables
from hybridmap.study.cell import MAPPED, CellResult
from hybridmap.study.cells import lay_out
from hybridmap.study.effects import effects_of
from hybridmap.study.statistics import signed_rank
from tests.study.studies import small

MAPS = {
    "sources": ["lab", "office"],
    "backends": [{"backend": "odometry", "way": "mapped"}, {"backend": "primary", "way": "mapped"}],
}
PARTS = [
    {"name": "as it is"},
    {"name": "without wheels", "overrides": {"edges.drop_contradicted": False}},
    {"name": "office alone", "overrides": {"nodes.distance_m": 0.3}, "sources": ["office"]},
]


def study_of(**changes):
    return small(**({"seeds": 6, "false_loops": {}, "settings": PARTS} | MAPS | changes))


def effects(error, cpu_s=lambda cell: 1.0, **changes):
    grid = lay_out(study_of(**changes))
    results = {}
    for cell in grid.cells:
        figures, status = error(cell), MAPPED
        figures = figures if isinstance(figures, dict) else {"ate_m": figures}
        results[cell.key] = CellResult(cell.key, status, "", figures, {"cpu_s": cpu_s(cell)}, "")
    return effects_of(grid, results)


def by_place(found):
    return {(one.cell.setting, one.where): one for one in found}


def doubled(cell):
    """An error that grows with the seed, ten times as large in the office, and doubled without the wheels."""
    return (0.01 + 0.001 * cell.seed) * (10.0 if cell.source == "office" else 1.0) * (2.0 if "wheels" in cell.setting else 1.0)


def test_a_setting_is_for_the_sources_that_it_names():
    places = {(cell.source, cell.setting) for cell in lay_out(study_of()).cells}
    assert ("lab", "office alone") not in places
    assert ("office", "office alone") in places
    assert len(places) == 5


def test_differences_are_paired_by_seed_and_ratios_pool_sources_of_any_scale():
    found = by_place(effects(doubled, lambda cell: 3.0 if cell.setting == "as it is" else 2.0))
    assert list(found) == [
        ("without wheels", "lab"),
        ("without wheels", "office"),
        ("without wheels", "all 2"),
        ("office alone", "office"),
    ]
    lab, both = found["without wheels", "lab"], found["without wheels", "all 2"]
    assert lab.difference.value == pytest.approx(0.0125)
    assert (lab.ratio.value, lab.ratio.low, lab.ratio.high) == pytest.approx((2.0, 2.0, 2.0))
    assert (both.ratio.count, both.ratio.value) == (12, pytest.approx(2.0))
    assert both.cpu_ratio == pytest.approx(2.0 / 3.0)
    assert both.verdict == "higher"
    assert found["office alone", "office"].ratio.value == 1.0
    assert found["office alone", "office"].verdict == ""


def test_holm_counts_the_settings_on_the_same_drives():
    one = by_place(effects(doubled))
    assert one["without wheels", "lab"].p == pytest.approx(2.0 / 2**6)  # alone in the lab
    assert one["without wheels", "office"].p == pytest.approx(2 * 2.0 / 2**6)
    assert one["without wheels", "all 2"].p == pytest.approx(2.0 / 2**12)
    assert one["office alone", "office"].p == 1.0


def test_holm_counts_pooled_settings_only_on_the_same_set_of_sources():
    wheels = {"edges.drop_contradicted": False}
    worse = [{"name": f"without wheels {number}", "overrides": wheels} for number in (1, 2)]
    two = {"name": "two without wheels", "overrides": wheels, "sources": ["office", "lab"]}
    changes = {"sources": ["lab", "office", "corridor"], "settings": [PARTS[0], *worse, two]}
    one = by_place(effects(doubled, **changes))
    assert one["without wheels 1", "all 3"].p == pytest.approx(2 * signed_rank(np.full(18, math.log(2.0))))
    assert one["without wheels 2", "all 3"].p == pytest.approx(2 * signed_rank(np.full(18, math.log(2.0))))
    assert one["two without wheels", "all 2"].p == pytest.approx(2.0 / 2**12)
    assert one["two without wheels", "lab"].p == pytest.approx(3 * 2.0 / 2**6)


def test_few_pairs_have_a_difference_and_no_verdict():
    found = by_place(effects(doubled, seeds=2))["without wheels", "lab"]
    assert found.difference.value == pytest.approx(0.0105)
    assert math.isnan(found.p)
    assert not found.ratio.known
    assert found.verdict == ""


def test_each_source_is_compared_by_the_error_that_it_has():
    def error(cell):
        name = "relation_m" if cell.source == "office" else "ate_m"
        return {name: doubled(cell)}

    found = by_place(effects(error))
    assert found["without wheels", "office"].measures == ("relation_m",)
    assert found["without wheels", "all 2"].measures == ("ate_m", "relation_m")
    assert found["without wheels", "all 2"].ratio.value == pytest.approx(2.0)


def test_a_disturbance_that_is_random_is_paired_with_the_one_drive_that_is_not(tmp_path):
    recording = tmp_path / "drive.tum"
    recording.write_text("")
    changes = {
        "sources": [{"recording": str(recording)}],
        "settings": [{"name": "as it is"}, {"name": "noisy", "disturb": {"scan_noise_m": 0.1}}],
    }
    found = effects(lambda cell: 0.1 if cell.seed is None else 0.2 + 0.01 * cell.seed, **changes)
    assert [one.difference.count for one in found] == [6]
    assert found[0].difference.value == pytest.approx(0.125)


def test_the_table_has_a_line_each_and_no_number_that_is_not_known():
    text = tables.effects_csv(effects(doubled, seeds=2))
    rows = list(csv.DictReader(io.StringIO(text)))
    assert [row["source"] for row in rows] == ["lab", "office", "all 2", "office"]
    assert rows[0]["ratio_median"] == "2.0" or float(rows[0]["ratio_median"]) == pytest.approx(2.0)
    assert (rows[0]["p_holm"], rows[0]["ratio_low"], rows[0]["pairs"]) == ("", "", "2")


def test_back_ends_on_frozen_graphs_are_compared_without_a_clock():
    changes = {"sources": [{"synthetic": {"nodes": 30, "per_lap": 10}}], "backends": ["gtsam-lm"]}
    settings = [{"name": "as it is"}, {"name": "noisy", "drift": {"noise": 1.0}}]
    grid = lay_out(study_of(settings=settings, **changes))
    results = {cell.key: CellResult(cell.key, "converged", "", {"ate_m": 0.1}, {"cpu_s": 1.0}, "") for cell in grid.cells}
    assert all(math.isnan(one.cpu_ratio) for one in effects_of(grid, results))


@pytest.mark.parametrize(
    ("settings", "said"),
    [
        ([{"name": "a", "sources": ["lab"]}, {"name": "b"}], "a: is the first and must be for all sources"),
        ([{"name": "a"}, {"name": "b", "sources": ["elsewhere"]}], "b: sources has no 'elsewhere'; there are lab, office"),
    ],
)
def test_settings_for_no_source_are_refused(settings, said):
    with pytest.raises(ConfigError, match=said):
        study_of(settings=settings)
