"""What the page's parts compute: alignment, errors over time, fates of loops, what a keyframe shows from above."""

import math
from dataclasses import replace
from typing import Any

import numpy as np
import pytest
from matplotlib.text import Text

from hybridmap.geometry import compose, transform_points
from hybridmap.graph.edges import Edge, EdgeKind, at_least, at_most
from hybridmap.graph.experience_map import ExperienceMap
from hybridmap.metrics import Metric
from hybridmap.report import loop_examples, page_tables, session_figures, style
from hybridmap.report.loop_examples import examples, in_words, spread
from hybridmap.report.outline import outline, outlines, raster
from hybridmap.report.session_figures import (
    ErrorSeries,
    draw_errors,
    error_series,
    gaps,
    loops_by_fate,
    mark_loops,
    over_intervals,
    with_gaps,
)
from hybridmap.report.session_scene import SessionScene, load_scene
from hybridmap.store import MapStore, SessionFolder
from hybridmap.study.statistics import Interval
from hybridmap.trajectory import Trajectory
from tests.store.sessions import RIG, keyframe_of, ring_map, truth_at, write_session

MOVED = np.array([3.0, -2.0, 0.7])


@pytest.fixture(scope="module")
def session(tmp_path_factory: pytest.TempPathFactory) -> SessionFolder:
    """A session whose ground truth is told in another frame."""
    folder = write_session(tmp_path_factory.mktemp("parts") / "session", ring_map(1.5))
    stamps = np.arange(0, 60 * 10**9, 10**8)
    folder.write_groundtruth(Trajectory(stamps, compose(MOVED, truth_at(stamps))))
    return folder


@pytest.fixture
def scene(session: SessionFolder) -> SessionScene:
    with MapStore.open(session.path) as store:
        return load_scene(session, store)


def test_everything_is_brought_to_the_frame_of_the_truth(scene: SessionScene) -> None:
    stamps = np.array([node.stamp_ns for node in scene.experiences.nodes])
    np.testing.assert_allclose(scene.nodes[:, :2], compose(MOVED, truth_at(stamps))[:, :2], atol=2e-3)
    assert scene.backends == ("odometry", "gtsam-lm")
    assert scene.primary == "gtsam-lm"


def test_errors_are_those_of_the_aligned_trajectories(scene: SessionScene) -> None:
    series = error_series(scene)
    assert series["gtsam-lm"].position_m.max() < 0.01
    rmse = float(np.sqrt(np.mean(series["odometry"].position_m ** 2)))
    offset = scene.pairs["odometry"].estimate - scene.pairs["odometry"].reference
    assert rmse == pytest.approx(np.sqrt(np.mean(np.sum(offset[:, :2] ** 2, axis=1))))
    assert rmse > 0.1
    assert series["odometry"].time_s[0] == 0.0


def test_intervals_keep_the_root_mean_square() -> None:
    time = np.linspace(0.0, 10.0, 4000)
    series = ErrorSeries(time, np.where(time < 5, 3.0, 4.0), np.ones(4000))
    drawn = over_intervals(series, 10)
    assert len(drawn.time_s) == 10
    np.testing.assert_allclose(drawn.position_m, [3.0] * 5 + [4.0] * 5, rtol=1e-2)
    assert over_intervals(drawn, 10) is drawn


def test_a_gap_lies_where_no_error_is_taken() -> None:
    time = np.concatenate([np.arange(0.0, 20.0, 0.1), np.arange(40.0, 60.0, 0.1)])
    assert gaps(time) == pytest.approx([29.95])
    assert not len(gaps(np.arange(0.0, 100.0, 10.0)))  # a truth that is known seldom
    assert not len(gaps(time[:1]))
    series = ErrorSeries(time, np.ones(400), np.ones(400))
    drawn = with_gaps(over_intervals(series, 60), gaps(time))
    (nan,) = np.flatnonzero(np.isnan(drawn.position_m))
    assert drawn.time_s[nan - 1] < 20.0 < drawn.time_s[nan] < 40.0 <= drawn.time_s[nan + 1]
    assert np.isnan(drawn.heading_deg[nan])


def test_no_error_is_ruled_across_a_time_without_a_truth(scene: SessionScene) -> None:
    pairs = scene.pairs["odometry"]
    kept = (pairs.stamps_ns < 20 * 10**9) | (pairs.stamps_ns > 40 * 10**9)
    left = replace(pairs, stamps_ns=pairs.stamps_ns[kept], estimate=pairs.estimate[kept], reference=pairs.reference[kept])
    with style.figure(4.0, 3.0) as picture:
        axes = picture.add_subplot()
        draw_errors(axes, replace(scene, pairs={"odometry": left}), heading=False)
        (line,) = axes.get_lines()
    assert np.isnan(line.get_ydata()).sum() == 1


def test_every_loop_has_one_fate(scene: SessionScene) -> None:
    counts = {fate: len(edges) for fate, edges in loops_by_fate(scene).items()}
    assert counts["loops accepted"] == 20
    assert counts["loops rejected"] == 20
    assert sum(counts.values()) == 40


def test_examples_are_spread_and_end_with_a_refused_one(session: SessionFolder, scene: SessionScene) -> None:
    with MapStore.open(session.path) as store:
        found = examples(scene, store, outlines(store, len(scene.nodes)))
    assert [example.accepted for example in found] == [True, True, True, False]
    assert len({example.title for example in found}) == 4
    assert all(example.overlay and example.profiles and len(example.photos) == 2 for example in found)
    assert ("time apart", "40.0 s") in found[0].facts


def test_of_two_drives_only_the_newest_has_times_and_no_odometry_joins_them(
    session: SessionFolder, scene: SessionScene
) -> None:
    drives, one = ExperienceMap(), scene.experiences
    for number, node in enumerate(one.nodes):
        if number == 50:
            drives.begin_session()
        drives.add_node(node, one.initial[number])
    for edge in one.edges:
        drives.add_edge(edge)
    scene = replace(scene, experiences=drives)
    with style.figure(4.0, 3.0) as picture:
        axes = picture.add_subplot()
        mark_loops(scene, axes)
        (marks,) = axes.get_lines()
    assert marks.get_xdata() == pytest.approx(np.arange(50.0, 60.0))
    with MapStore.open(session.path) as store:
        facts = dict(examples(scene, store, outlines(store, len(scene.nodes)))[1].facts)
    assert "two drives" in facts["nodes of"]
    assert not {"time apart", "odometry disagrees by"} & set(facts)


def test_the_figures_of_a_closure_are_in_words_with_units(scene: SessionScene) -> None:
    checks = (at_most("off_m", 0.25, 1.0), at_least("feature_inliers", 12, 12))
    edge = Edge.decided(9, 2, EdgeKind.LOOP, None, checks, figures={"inliers": 0.7, "new_one": 1.0}, shift=3)
    assert in_words(edge) == [
        ("off the expected position by", "0.25 m"),
        ("features that agree on the pose", "12"),
        ("share of all points that lie close", "0.7"),
        ("new one", "1"),
        ("scanlines shifted by", "3 columns"),
    ]


def test_bounds_that_are_proved_stay_bounds_when_they_are_rounded() -> None:
    texts = [
        page_tables.shown(Metric(f"{name}/gtsam-lm", value, "1", ""))
        for name, value in (
            ("chi2_gap", 0.123412),
            ("certificate_gap", 1.00001e-9),
            ("chi2_bound", 20160.96),
            ("chi2", 1.23456),
        )
    ]
    assert texts == ["0.1235", "1.001e-09", "20160", "1.235"]


@pytest.mark.parametrize("measured", [True, False])
def test_titles_of_overlays_are_as_wide_as_their_axes(scene: SessionScene, measured: bool) -> None:
    from matplotlib.font_manager import FontProperties
    from matplotlib.textpath import TextPath

    edge = next(edge for edge in scene.experiences.edges if edge.relative is not None)
    title = loop_examples.overlay_title(edge if measured else replace(edge, relative=None))
    bold = FontProperties(family="sans-serif", weight="bold", size=loop_examples.TITLE_PT)
    assert TextPath((0, 0), title, prop=bold).get_extents().width < 72 * 0.8 * loop_examples.WIDTH_IN


def test_accepted_loops_lie_over_the_rejected_ones_and_the_legend_can_be_read(
    scene: SessionScene, monkeypatch: pytest.MonkeyPatch
) -> None:
    drawn: list[Any] = []
    monkeypatch.setattr(style, "svg_uri", drawn.append)
    session_figures.graph_figure(scene, None)
    loops = {lines.get_label(): lines for lines in drawn[0].axes[0].collections}
    accepted, rejected = loops["loops accepted (20)"], loops["loops rejected (20)"]
    assert accepted.get_zorder() > rejected.get_zorder()
    assert rejected.get_linewidth()[0] < 0.5 * accepted.get_linewidth()[0]
    (legend,) = drawn[0].legends
    shown = {text.get_text(): line for text, line in zip(legend.get_texts(), legend.get_lines(), strict=True)}
    line = shown["loops rejected (20)"]
    assert (line.get_linewidth() >= 1.5, line.get_alpha()) == (True, 1.0)


def test_spread_takes_the_middles() -> None:
    edges = ring_map(0.25).edges
    assert spread(edges, 3) == [edges[1], edges[4], edges[7]]
    assert spread(edges[:2], 3) == list(edges[:2])


def test_outline_of_a_scan_is_the_room() -> None:
    pose = truth_at(np.array([7 * 10**9]))[0]
    points = transform_points(pose, outline({"ranges_m": keyframe_of(0, pose[None])["ranges_m"]}, RIG))
    walls = np.minimum(np.abs(np.abs(points[:, 0]) - 5.0), np.abs(np.abs(points[:, 1] - 2.0) - 5.0))
    assert len(points) > 150
    assert walls.max() < 1e-4


def test_outline_of_depth_is_the_wall_ahead() -> None:
    depth = np.full((24, 32), 2000, np.uint16)
    depth[:, :4] = 0
    points = outline({"depth_mm": depth}, RIG)
    np.testing.assert_allclose(points[:, 0], 2.1)
    assert points[:, 1].max() == pytest.approx(2.0 * (16 - 4) / 30)
    assert outline({}, RIG).shape == (0, 2)


def test_raster_is_dark_where_something_was_seen() -> None:
    room = raster({0: np.array([[0.0, 0.0], [2.0, 1.0]])}, np.array([[10.0, 5.0, 0.0]]))
    assert room is not None
    left, right, bottom, top = room.extent
    rows, columns = np.nonzero(room.grey)
    x = left + (columns + 0.5) / room.grey.shape[1] * (right - left)
    y = bottom + (rows + 0.5) / room.grey.shape[0] * (top - bottom)
    np.testing.assert_allclose(sorted(zip(x, y, strict=True)), [(10, 5), (12, 6)], atol=0.03)
    assert raster({}, np.zeros((1, 3))) is None


def test_tables_put_back_ends_side_by_side() -> None:
    metrics = [
        Metric("chi2/gtsam-lm", 146.08, "1", "chi2"),
        Metric("ate_rmse/odometry", 1.5, "m", "error"),
        Metric("ate_rmse/gtsam-lm", float("nan"), "m", "error"),
        Metric("cpu_s/matching", 12.0, "s", "time"),
    ]
    rows = page_tables.by_backend(metrics, ("odometry", "gtsam-lm"))
    assert [(row.measure, row.cells) for row in rows] == [("ate_rmse", ("1.5", "–")), ("chi2", ("", "146.1"))]
    assert [row.measure for row in page_tables.of_session(metrics, ("odometry", "gtsam-lm"))] == ["cpu_s/matching"]


@pytest.mark.parametrize(
    ("value", "said"), [(0.004, ("0.4", "cm")), (0.28, ("28", "cm")), (6.5, ("6.5", "m")), (227.4, ("227", "m"))]
)
def test_lengths_are_said_as_people_say_them(value: float, said: tuple[str, str]) -> None:
    assert page_tables.length(value) == said


@pytest.mark.parametrize(("value", "said"), [(37.5, ("38", "s")), (1060.0, ("17.7", "min")), (float("nan"), ("nan", "s"))])
def test_times_are_said_as_people_say_them(value: float, said: tuple[str, str]) -> None:
    assert page_tables.duration(value) == said


@pytest.mark.parametrize(
    ("figures", "text"),
    [
        ((0.2306, 0.07054, 0.3907), "0.231 [0.071, 0.391]"),
        ((0.001547, 0.001371, 0.001722), "0.001547 [0.001371, 0.001722]"),
        ((5.96, 5.9, 6.02), "5.9600 [5.9000, 6.0200]"),
        ((0.02, 0.0004, 0.039), "0.0200 [0.0004, 0.0390]"),
        ((-7e-8, -1.4e-7, -3e-9), "0 [0, 0]"),
        ((2e-6, -7e-6, 1e-5), "0.000002 [-0.000007, 0.000010]"),
        ((1234.0, 1000.0, 1500.0), "1234 [1000, 1500]"),
        ((0.5, 0.5, 0.5), "0.500000 [0.500000, 0.500000]"),
        ((1.25, math.nan, math.nan), "1.25 (7 values: no interval)"),
        ((-1e-14, math.nan, math.nan), "0 (7 values: no interval)"),
        ((math.nan, math.nan, math.nan), "–"),
    ],
)
def test_an_interval_has_the_decimals_that_it_bears_out(figures, text):
    value, low, high = figures
    assert page_tables.interval(Interval(value, low, high, 0 if math.isnan(value) else 7, 0.95)) == text


def test_dollars_in_a_title_are_no_formula_and_powers_of_ten_are():
    with style.figure(3.0, 2.0) as picture:
        axes = picture.subplots()
        axes.semilogy([1.0, 2.0], [1.0, 1e6], label="$\\frac$ a $")
        axes.set_title("what $\\frac$ does")
        axes.legend()
        assert style.svg_uri(picture).startswith("data:image/svg+xml")
        texts = {text.get_text(): text.get_parse_math() for text in picture.findobj(Text)}
    assert texts["what $\\frac$ does"] is texts["$\\frac$ a $"] is False
    powers = [formula for text, formula in texts.items() if "10^" in text]
    assert powers
    assert all(powers)
