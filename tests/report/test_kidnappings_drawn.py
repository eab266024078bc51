"""Pictures of a robot that was kidnapped: no line leads through the air, and no error is drawn there."""

from __future__ import annotations

import sys
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from hybridmap.backends import comparison
from hybridmap.cli import main
from hybridmap.cli.graphs import open_graph
from hybridmap.evaluate.session_errors import judge_solutions
from hybridmap.geometry import RelativePose, between
from hybridmap.graph.edges import Edge, EdgeKind, Lack, Status
from hybridmap.graph.gaps import kidnappings
from hybridmap.report import comparison_page, session_figures, style
from hybridmap.report.session_scene import Correction, SessionScene, load_scene
from hybridmap.store import MapStore, SessionFolder
from tests.store.sessions import SECOND, ring_map, truth_at, write_session

PICKED_UP = 24  # the newest node when it was: the next one lies far from it


@pytest.fixture(scope="module")
def session(tmp_path_factory: pytest.TempPathFactory) -> SessionFolder:
    """A circle of which the robot does not drive the way after node 24: its edge was hung anew."""
    experiences = ring_map()
    (odometry,) = [number for number in experiences.edges_into(PICKED_UP + 1) if experiences.edge(number).source == PICKED_UP]
    experiences.update_edge(odometry, experiences.edge(odometry).settled(lack=Lack.OVERRULED))
    truth = truth_at(np.array([PICKED_UP, PICKED_UP + 1]) * SECOND)
    hung = RelativePose(between(truth[0], truth[1]), np.eye(3))
    edge = Edge(PICKED_UP, PICKED_UP + 1, EdgeKind.REGISTRATION, Status.ACCEPTED, hung, kidnapped_m=5.0)
    experiences.add_edge(edge)
    return write_session(tmp_path_factory.mktemp("kidnapped") / "session", experiences, keyframes=False)


@pytest.fixture
def scene(session: SessionFolder) -> SessionScene:
    with MapStore.open(session.path) as store:
        return load_scene(session, store)


@pytest.fixture
def drawn(monkeypatch: pytest.MonkeyPatch) -> list[Any]:
    """Every picture that a figure is made of."""
    pictures: list[Any] = []
    monkeypatch.setattr(style, "svg_uri", pictures.append)
    return pictures


def is_broken(line: Any) -> bool:
    """Whether a line of nodes breaks at the kidnapping, and nowhere else."""
    return np.flatnonzero(np.isnan(line.get_xdata())).tolist() == [PICKED_UP + 1]


def test_the_truth_ends_where_the_robot_was_picked_up(scene: SessionScene, drawn: list[Any]) -> None:
    session_figures.trajectories_figure(scene, None)
    truth = [line for line in drawn[0].axes[0].get_lines() if line.get_color() == style.TRUTH and line.get_alpha() is not None]
    assert len(truth) == 2
    assert [line.get_label() == "ground truth" for line in truth] == [True, False]


def test_the_chain_is_dashed_where_the_robot_was_carried(scene: SessionScene, drawn: list[Any]) -> None:
    chain, kidnapped = session_figures.chain_and_kidnappings(scene)
    assert [(edge.source, edge.target) for edge in kidnapped] == [(PICKED_UP, PICKED_UP + 1)]
    assert len(chain) == len(scene.nodes) - 2
    session_figures.graph_figure(scene, None)
    (lines,) = [lines for lines in drawn[0].axes[0].collections if lines.get_label() == "kidnapped (1)"]
    assert lines.get_linestyle()[0][1] is not None


def test_the_ways_before_and_after_a_correction_break(scene: SessionScene, drawn: list[Any]) -> None:
    correction = Correction(0, 1.0, scene.nodes[:40], scene.nodes[:40] + 1.0)
    session_figures.correction_figure(correction, {}, kidnappings(scene.experiences))
    assert [is_broken(axes.get_lines()[0]) for axes in drawn[0].axes] == [True, True]


def test_no_map_of_a_comparison_has_a_line_through_the_air(
    session: SessionFolder, drawn: list[Any], monkeypatch: pytest.MonkeyPatch
) -> None:
    source = open_graph(session.path)
    rows = comparison.compare(source.graph, ("odometry", "gtsam-lm"))
    judged = judge_solutions(session.path, comparison_page.solved(rows))
    comparison_page.overlay(rows, judged.truth, source.kidnapped)
    first, second, *maps = drawn[0].axes[0].get_lines()
    assert first.get_label() == "ground truth"
    assert len(first.get_xdata()) + len(second.get_xdata()) < len(source.graph.initial) * 10 - 9
    assert [is_broken(line) for line in maps] == [True, True]
    graphs = []
    monkeypatch.setattr(comparison_page, "draw_map", lambda axes, graph, *_: graphs.append(graph))
    comparison_page.panels(source.graph, rows, source.start, source.kidnapped)
    assert {graph.n_edges for graph in graphs} == {source.graph.n_edges - 1}
    assert all(PICKED_UP + 1 not in graph.targets[graph.is_motion] for graph in graphs)


def test_the_page_of_a_comparison_says_where_lines_end(
    session: SessionFolder, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    words = ["compare", str(session.path), "--batch", "--backends", "odometry", "--out", str(tmp_path / "c")]
    monkeypatch.setattr(sys, "argv", ["hybridmap", *words])
    with pytest.raises(SystemExit):
        main()
    assert "Lines end where the robot was picked up" in (tmp_path / "c" / "comparison.html").read_text()
