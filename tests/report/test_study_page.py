"""The page of a study: no verdict on few seeds, and what failed said once instead of shown empty."""

import re
from dataclasses import replace
from typing import Any

import pytest

from hybridmap.output import held
from hybridmap.report import study_figures, style
from hybridmap.report.study_page import effect_lines, groups_of, write_study_page
from hybridmap.study.cell import CellResult
from hybridmap.study.cells import Cell, lay_out
from hybridmap.study.folder import STUDY_FOLDER, StudyFolder
from hybridmap.study.pools import ThisProcess
from hybridmap.study.statistics import summarise
from hybridmap.study.study import Study, run_study
from tests.study.studies import TREE, small

NO_LOOPS = "graph: found no loops"


@pytest.fixture(autouse=True)
def _unpainted(monkeypatch):
    """Figures are laid out and not written: their text is not looked at."""
    monkeypatch.setattr(style, "svg_uri", lambda _: "data:,")


@pytest.fixture
def made(tmp_path):
    """Make a study whose cells come out as a function of theirs says: ATE (m), or a message."""

    def make(outcome, **changes) -> Study:
        config, folder = small(**changes), StudyFolder(tmp_path)
        with held(tmp_path, STUDY_FOLDER):
            for cell in lay_out(config).cells:
                folder.keep_result(_result(cell, outcome(cell)))
        return run_study(config, tmp_path, ThisProcess())

    return make


def _result(cell: Cell, outcome: float | str) -> CellResult:
    if isinstance(outcome, str):
        return CellResult(cell.key, "failed", outcome, {}, {}, "")
    figures: dict[str, float | None] = {
        "ate_m": outcome,
        "chi2": 1.0,
        "false_kept": 2.0,
        "false_loops": 2.0 * (cell.rate > 0.0),
        "own_lost": 0.0,
        "own_loops": 3.0,
    }
    return CellResult(cell.key, "converged", "", figures, {}, "")


def error_of(result: CellResult) -> float | None:
    return result.figures.get("ate_m")


def _page_of(study: Study) -> str:
    return write_study_page(study).read_text()


def text_of(study: Study) -> str:
    """The page without its pictures and tags."""
    return " ".join(re.sub(r"<style>.*?</style>|<[^>]+>", " ", _page_of(study), flags=re.DOTALL).split())


def better_by_the_seed(cell: Cell) -> float:
    return 1.0 if cell.backend == "gtsam-lm" else 0.5 - 0.01 * (cell.seed or 0)


@pytest.mark.parametrize(("seeds", "interval", "judged"), [(2, False, 0), (5, True, 0), (8, True, 2)])
def test_few_seeds_have_no_verdict_and_the_page_says_so(made, seeds, interval, judged):
    study = made(better_by_the_seed, seeds=seeds, false_loops={})
    page = write_study_page(study).read_text()
    assert page.count('class="n lower"') == judged
    assert (f"({seeds} values: no interval)" in page) is not interval
    told = next(metric.description for metric in study.metrics if metric.name.startswith("ate_difference/"))
    assert ("95 % interval" in told) is interval
    assert ("Wilcoxon's p, by Holm" in told) is interval
    assert "mix of false loops" not in page
    assert "mixes of false loops" not in page


def test_a_back_end_that_diverged_has_the_error_of_odometry_and_a_cross(made, monkeypatch):
    study = made(lambda cell: 1.0, seeds=8, false_loops={})
    for cell in study.grid.cells:
        if cell.backend == "relaxed" and cell.seed == 3:
            study.results[cell.key] = replace(study.results[cell.key], status="diverged")
    study = replace(study, summaries=summarise(study.grid, study.results))
    (group,) = groups_of(study)
    assert [(line.backend, line.start, line.solved) for line in group.lines] == [
        ("gtsam-lm", "own", "8 of 8"),
        ("odometry", "odometry", "8 of 8"),
        ("relaxed", "own", "7 of 8"),
    ]
    drawn: list[Any] = []
    monkeypatch.setattr(style, "svg_uri", drawn.append)
    study_figures.merit_figure(study, study_figures.layout(study), "ATE (m)", error_of, logarithmic=True)
    crosses = [len(line.get_xdata()) for axes in drawn[0].axes for line in axes.lines if line.get_marker() == "x"]
    assert crosses == [0, 0, 1]
    assert [text.get_text() for axes in drawn[0].axes for text in axes.texts] == ["1 of 8 diverged"]


def test_what_failed_is_said_once_and_not_shown_empty(made):
    def outcome(cell: Cell) -> float | str:
        if cell.kind:
            return NO_LOOPS
        return "theta 0.3 diverged" if cell.backend == "relaxed" and cell.seed == 3 else better_by_the_seed(cell)

    study = made(outcome, sources=[*TREE["sources"], {"name": "again", "synthetic": {"nodes": 44}}])
    text = text_of(study)
    assert text.count(NO_LOOPS) == 1
    assert f"every one 24 {NO_LOOPS}" in text
    assert "4 groups have no map by any back-end" in text
    assert [group.label for group in groups_of(study) if group.lines] == ["laps/default", "again/default"]


def test_back_ends_without_a_map_have_no_line_of_dashes_and_are_not_in_the_legend(made, monkeypatch):
    study = made(lambda cell: "diverged" if cell.backend == "relaxed" else 1.0, seeds=3)
    (first, *_) = groups_of(study)
    assert [line.backend for line in first.lines] == ["gtsam-lm", "odometry"]
    assert first.without == ("relaxed",)
    assert "Without a map: relaxed." in text_of(study)
    drawn: list[Any] = []
    monkeypatch.setattr(style, "svg_uri", drawn.append)
    study_figures.merit_figure(study, study_figures.layout(study), "ATE (m)", error_of, logarithmic=True)
    (legend,) = drawn[0].legends
    assert {text.get_text() for text in legend.get_texts()} == {"gtsam-lm", "odometry"}


def test_panels_without_any_figure_are_left_out_and_counted(made):
    sources = [{"name": name, "synthetic": {"nodes": 40 + 4 * k}} for k, name in enumerate("ab")]
    study = made(lambda cell: NO_LOOPS if cell.source == "a" else 1.0, sources=sources)
    plan = study_figures.having(study_figures.layout(study), error_of)
    assert [panel.title for panel in plan.panels] == ["b, random false loops", "b, aliased false loops"]
    assert "2 panels are left out because no cell has a map there" in text_of(study)
    assert "Every back-end kept all of the false loops" in text_of(study)
    none = made(lambda _: NO_LOOPS)
    assert "No cell has a map with a known error" in text_of(none)


def test_differences_beyond_the_panels_are_counted_and_names_of_several_words_quoted(made):
    settings = [{"name": f"s{k}", "drift": {"scale_bias": 0.01 * k}} for k in range(7)]
    backends = [{"name": "lm, its own start", "backend": "gtsam-lm"}, "odometry"]
    text = text_of(made(lambda _: 1.0, settings=settings, backends=backends, false_loops={"rates": [0.1, 0.2]}))
    assert "error minus that of \u201clm, its own start\u201d on the very same graph" in text
    assert "2 further groups are left out" in text


def test_a_share_of_minus_zero_is_zero(made):
    assert "0 %" in text_of(made(lambda _: 1.0, false_loops={"rates": [-0.0, 0.2], "kinds": ["random"]}))


@pytest.mark.parametrize(("measure", "error"), [("ate_m", "ATE"), ("relation_m", "relation error")])
def test_the_axis_of_the_differences_names_the_error_that_is_compared(made, monkeypatch, measure, error):
    pairs = study_figures.paired_groups(made(better_by_the_seed, seeds=3).summaries, "ate_m")
    drawn: list[Any] = []
    monkeypatch.setattr(style, "svg_uri", drawn.append)
    study_figures.difference_figure(
        {label: [replace(one, measure=measure) for one in ones] for label, ones in pairs.items()}, "gtsam-lm"
    )
    assert {axes.get_xlabel() for axes in drawn[0].axes} - {""} == {f"{error} minus that of gtsam-lm (m)"}


def test_each_group_is_compared_by_the_error_that_its_source_has(made):
    study = made(better_by_the_seed, false_loops={}, sources=[{"name": name, "synthetic": {"nodes": 40}} for name in "ab"])
    other = [
        replace(one, measure="relation_m" if one.measure == "ate_m" and one.cell.source == "b" else one.measure)
        for one in study.summaries
    ]
    groups = groups_of(replace(study, summaries=other))
    assert [(group.label, group.error) for group in groups] == [("a/default", "ATE"), ("b/default", "relation error")]
    assert all(line.solved == "2 of 2" for group in groups for line in group.lines)


def test_what_a_setting_changes_is_a_table_of_its_own(made):
    settings = [{"name": "as it is"}, {"name": "twice", "drift": {"scale_bias": 0.1}}]

    def outcome(cell: Cell) -> float:
        return better_by_the_seed(cell) * (2.0 if cell.setting == "twice" else 1.0)

    study = made(outcome, settings=settings, seeds=6, false_loops={})
    assert "twice laps gtsam-lm ATE 6" in text_of(study)
    lines = effect_lines(study)
    assert [line.backend for line in lines] == ["gtsam-lm", "relaxed"]
    assert [line.verdict for line in lines] == ["higher", "higher"]
    assert "What the settings change" not in text_of(made(better_by_the_seed))


def test_what_a_setting_changes_over_all_drives_is_seen_without_a_click(made):
    settings = [{"name": "as it is"}, {"name": "twice"}]
    sources = [{"name": f"laps {number}", "synthetic": {"nodes": 40}} for number in range(2)]
    page = _page_of(made(better_by_the_seed, settings=settings, sources=sources, seeds=6, false_loops={}))
    pooled = page.index("Over all drives")
    assert page.index("all 2", pooled) < page.index("rows of single sources") < page.index("laps 1", pooled)


def test_a_description_shows_names_as_code_and_no_markup_of_its_own(made):
    page = _page_of(made(better_by_the_seed, description="`bionic` is <b>it</b>"))
    assert "<p><code>bionic</code> is &lt;b&gt;it&lt;/b&gt;</p>" in page
