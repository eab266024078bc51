from __future__ import annotations

import numpy as np
import pytest

from hybridmap.errors import EvaluationError, StoreError, StreamError
from hybridmap.evaluate import evaluate_session
from hybridmap.evaluate.session_errors import judge_solutions
from hybridmap.geometry import RelativePose, between
from hybridmap.graph.edges import Edge, EdgeKind, Status
from hybridmap.store import SessionFolder
from hybridmap.trajectory import read_tum
from tests.store.sessions import SECOND, ring_map, truth_at, write_session


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    path = tmp_path_factory.mktemp("evaluated") / "s"
    write_session(path, ring_map(laps=2.2, false_loop=True), keyframes=False)
    lines = []
    for first, second in ((1.0, 5.5), (2.0, 80.0)):
        poses = truth_at(np.array([first, second]) * SECOND)
        lines.append(f"{first} {second} " + " ".join(f"{v:.9f}" for v in between(poses[0], poses[1])))
    (path / "relations.txt").write_text("\n".join(lines))
    return path


def test_every_figure_is_there_for_odometry_and_back_end(folder):
    figures = {metric.name: metric for metric in evaluate_session(folder, None, folder / "relations.txt")}
    for backend in ("odometry", "gtsam-lm"):
        for measure in ("ate_rmse", "rpe_trans", "rpe_rot", "drift", "relation_trans_mean", "relation_trans_std"):
            assert np.isfinite(figures[f"{measure}/{backend}"].value), measure
        for measure in ("relation_rot_mean", "relation_loop_trans_mean", "relation_loop_rot_mean"):
            assert np.isfinite(figures[f"{measure}/{backend}"].value), measure
    assert figures["ate_rmse/gtsam-lm"].value < 0.01 < 0.1 < figures["ate_rmse/odometry"].value
    assert figures["ate_rmse_online/gtsam-lm"].value == pytest.approx(figures["ate_rmse/odometry"].value)
    assert "ate_rmse_online/odometry" not in figures
    assert figures["relation_loop_trans_mean/gtsam-lm"].value < 0.01
    assert figures["loop_precision/gtsam-lm"].value == pytest.approx(48 / 49)
    assert figures["loop_precision/graph"].value == pytest.approx(48 / 49)
    assert "49" in figures["loop_precision/graph"].description
    assert "49" not in figures["loop_precision/gtsam-lm"].description  # back-ends that keep fewer share its line on the page
    assert figures["loop_recall/gtsam-lm"].value == 1.0
    assert figures["relation_rot_mean/gtsam-lm"].unit == "deg"
    stored = SessionFolder(folder).read_metrics()
    assert [metric.name for metric in stored.metrics] == list(figures)
    assert stored.head["primary_backend"] == "gtsam-lm"


def test_killed_session_is_evaluated_from_its_map_file(tmp_path):
    session = write_session(tmp_path / "s", ring_map(), solve=False, keyframes=False)
    for path in session.trajectory.glob("*.tum"):
        path.unlink()
    figures = {metric.name: metric.value for metric in evaluate_session(tmp_path / "s")}
    assert figures["ate_rmse/odometry"] > 0.1
    assert "ate_rmse/gtsam-lm" not in figures
    assert figures["ate_rmse_online/gtsam-lm"] > 0.1


def test_the_way_through_the_air_counts_for_nothing(tmp_path):
    experiences = ring_map()
    hung = RelativePose(np.array([3.0, 4.0, 0.0]), np.eye(3))
    experiences.add_edge(Edge(20, 21, EdgeKind.REGISTRATION, Status.ACCEPTED, hung, kidnapped_m=5.0))
    folder = write_session(tmp_path / "s", experiences, keyframes=False).path
    figures = {metric.name: metric.value for metric in evaluate_session(folder)}
    track = len(read_tum(folder / "trajectory" / "odometry.tum"))
    assert {figures[f"ate_poses/{name}"] for name in ("odometry", "gtsam-lm")} == {track - 10}
    judged = judge_solutions(folder, {"x": np.array([node.pose_odom for node in experiences.nodes])})
    assert {metric.name: metric.value for metric in judged.metrics}["ate_poses/x"] == track - 10


def test_a_named_reference_wins_over_the_session_s_own(folder, tmp_path):
    other = folder / "trajectory" / "odometry.tum"
    figures = {metric.name: metric.value for metric in evaluate_session(folder, other)}
    assert figures["ate_rmse/odometry"] == pytest.approx(0, abs=1e-9)
    assert len(read_tum(other)) == figures["ate_poses/odometry"]


def test_nothing_to_compare_with_is_said(tmp_path, folder):
    session = write_session(tmp_path / "s", ring_map(), keyframes=False)
    session.groundtruth.unlink()
    with pytest.raises(EvaluationError, match="give --reference"):
        evaluate_session(tmp_path / "s")
    with pytest.raises(StoreError, match="no such session folder"):
        evaluate_session(tmp_path / "gone")
    with pytest.raises(StreamError, match="no such trajectory file"):
        evaluate_session(folder, tmp_path / "gone.tum")
