"""The page of a comparison: a row that diverged has no map, and what lines that coincide hide is said."""

from dataclasses import replace
from typing import Any

import numpy as np
import pytest
from matplotlib.colors import to_hex

from hybridmap.backends import comparison
from hybridmap.backends.base import SolveStatus
from hybridmap.config.backends import BackendsConfig
from hybridmap.output import held
from hybridmap.report import comparison_page, style
from hybridmap.report.comparison_page import COMPARISON, Compared, write_comparison
from tests.backends.graphs_for_tests import laps

NAMES = ("gtsam-lm", "odometry", "relaxation-ratslam")


@pytest.fixture(scope="module")
def graph():
    return laps(np.random.default_rng(0), nodes=30, per_lap=12)[0]


@pytest.fixture(scope="module")
def rows(graph):
    return comparison.compare(graph, NAMES)


def ended(row, status):
    report = replace(row.solution.report, status=status, message="theta is too large")
    return replace(row, solution=replace(row.solution, report=report))


def page_of(folder, graph, rows, **more):
    cells = [("back-end",), *((row.title,) for row in rows)]
    head = {"nodes": 30, "edges": graph.n_edges, "loops": 18}
    with held(folder, COMPARISON, overwrite=True) as place:
        compared = Compared("laps", "the start", head, graph, rows, cells, BackendsConfig(), **more)
        return write_comparison(place, compared).read_text()


@pytest.mark.parametrize("status", list(SolveStatus))
def test_a_row_has_a_map_where_its_status_says_so(rows, status):
    row = ended(rows[2], status)
    assert row.has_map is status.has_map
    assert list(comparison_page.solved([row])) == ([row.title] if status.has_map else [])
    assert not replace(row, solution=None).has_map


def test_a_row_that_diverged_is_in_the_table_and_in_no_picture(graph, rows, tmp_path):
    some = [*rows[:2], ended(rows[2], SolveStatus.DIVERGED)]
    assert list(comparison_page.solved(some)) == ["gtsam-lm", "odometry"]
    page = page_of(tmp_path, graph, some)
    assert "Without a map, in the table alone: relaxation-ratslam." in page
    assert '<tr class="bad"><td>relaxation-ratslam</td></tr>' in page
    assert "theta is too large" in page
    assert "Without a map" not in page_of(tmp_path, graph, rows)


def test_the_reasons_against_a_map_stand_beside_what_its_back_end_says(graph, rows, tmp_path):
    page = page_of(tmp_path, graph, rows, reasons={"gtsam-lm": ["nodes 3 to 5: <bent>", "lone"], "odometry": []})
    assert page.count('<ul class="reasons">') == 1
    said = page[page.index("<dt>gtsam-lm</dt>") : page.index("<dt>odometry</dt>")]
    assert "<li>nodes 3 to 5: &lt;bent&gt;</li><li>lone</li>" in said


def test_a_page_without_any_map_shows_the_start_alone(graph, rows, tmp_path):
    page = page_of(tmp_path, graph, [ended(row, SolveStatus.DIVERGED) for row in rows])
    assert page.count("data:image/") == 1
    assert "What the edges cost" not in page


def test_the_page_says_what_its_pictures_hide_and_show(graph, rows, tmp_path):
    page = " ".join(page_of(tmp_path, graph, rows).split())
    assert "can all be seen" not in page
    assert "of maps that coincide the last one is seen" in page
    assert "Gap of chi2: proved of this map" in page
    assert "F, which is chi2 with noise of each edge's position" in page
    assert "<h2>What the edges cost</h2> <p>The share of all edges" in page


def test_later_lines_are_thinner_and_on_top(rows, monkeypatch):
    drawn: list[Any] = []
    monkeypatch.setattr(style, "svg_uri", drawn.append)
    comparison_page.overlay([rows[0], rows[2], replace(rows[0], backend="gtsam-gnc", title="gtsam-gnc")], [], [])
    lines = drawn[0].axes[0].get_lines()
    widths = [line.get_linewidth() for line in lines]
    assert widths == sorted(widths, reverse=True)
    assert len(set(widths)) == 3
    assert len({line.get_zorder() for line in lines}) == 1  # equal: drawn in their order


def test_rejected_loops_lie_under_the_others(graph):
    with style.figure(4.0, 3.0) as picture:
        axes = picture.add_subplot()
        comparison_page.draw_map(axes, graph, graph.initial, (int(graph.edge_ids[graph.is_loop][0]),))
        lowest = min(axes.collections, key=lambda lines: lines.get_zorder())
    assert to_hex(lowest.get_color()[0]) == style.REJECTED
