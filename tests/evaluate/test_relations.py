from __future__ import annotations

import numpy as np
import pytest

from hybridmap.errors import EvaluationError
from hybridmap.evaluate import read_relations, relation_errors
from hybridmap.evaluate.relations import Relations
from hybridmap.geometry import between, compose
from hybridmap.trajectory import NS_PER_S, Trajectory, read_tum
from tests.store.sessions import truth_at


def trajectory(count: int = 200) -> Trajectory:
    stamps = np.arange(count) * NS_PER_S
    return Trajectory(stamps, truth_at(stamps))


def relations_of(truth: Trajectory, ends: list[tuple[float, float]]) -> Relations:
    stamps = (np.array(ends) * NS_PER_S).astype(np.int64)
    return Relations(stamps, between(truth.at(stamps[:, 0]), truth.at(stamps[:, 1])))


def test_truth_has_no_error_in_any_frame():
    truth = trajectory()
    relations = relations_of(truth, [(3, 9), (10.25, 100.5), (100, 20)])
    moved = Trajectory(truth.stamps_ns, compose([4.0, -9.0, 2.0], truth.poses))
    errors = relation_errors(moved, relations)
    assert errors.all.trans_mean_m == pytest.approx(0, abs=1e-9)
    assert errors.all.rot_mean_deg == pytest.approx(0, abs=1e-9)
    assert (errors.all.used, errors.all.total) == (3, 3)
    assert (errors.loops.used, errors.loops.total) == (2, 2)


def test_mean_and_std_are_of_the_relative_pose_error():
    truth = trajectory()
    relations = relations_of(truth, [(3, 9), (10, 100)])
    offsets = np.array([[0.3, 0.4, np.radians(10)], [0, 0, np.radians(-30)]])
    wrong = Relations(relations.stamps_ns, compose(relations.deltas, offsets))
    errors = relation_errors(truth, wrong)
    # the error is delta_true^-1 * delta_estimated, i.e. the inverse of the offset: same length, same angle
    assert errors.all.trans_mean_m == pytest.approx(0.25)
    assert errors.all.trans_std_m == pytest.approx(0.25)
    assert errors.all.rot_mean_deg == pytest.approx(20)
    assert errors.all.rot_std_deg == pytest.approx(10)
    assert errors.loops.trans_mean_m == pytest.approx(0, abs=1e-9)
    assert errors.loops.rot_mean_deg == pytest.approx(30)


def test_relations_beyond_the_trajectory_are_counted_not_used():
    truth = trajectory(50)
    errors = relation_errors(truth, Relations(np.array([[0, 5], [1, 90]]) * NS_PER_S, np.zeros((2, 3))))
    assert (errors.all.used, errors.all.total) == (1, 2)
    assert (errors.loops.used, errors.loops.total) == (0, 1)
    assert np.isnan(errors.loops.trans_mean_m)


def test_file_with_comments_is_read(tmp_path):
    path = tmp_path / "relations.txt"
    path.write_text("# a comment\n\n1216.630413 1217.490267 0.407950 -0.016330 -0.069620 # the first\n1 99 1 2 3\n")
    relations = read_relations(path)
    assert relations.stamps_ns[0].tolist() == [1216630413000, 1217490267000]
    assert relations.deltas[0].tolist() == [0.40795, -0.01633, -0.06962]
    assert relations.is_loop.tolist() == [False, True]


@pytest.mark.parametrize(
    ("text", "match"),
    [
        ("1 2 3 4\n", "txt:1: expected 5"),
        ("# x\n1 2 a 4 5\n", "txt:2: expected numbers"),
        ("1 2 nan 0 0\n", "5 finite"),
        ("#", "no"),
    ],
)
def test_damaged_files_are_refused_with_the_line(tmp_path, text, match):
    path = tmp_path / "relations.txt"
    path.write_text(text)
    with pytest.raises(EvaluationError, match=match):
        read_relations(path)
    with pytest.raises(EvaluationError, match="no such relations file"):
        read_relations(tmp_path / "gone.txt")


@pytest.mark.data
@pytest.mark.parametrize(
    ("name", "trans", "trans_std", "rot", "loop_trans", "loop_rot"),
    [("fr079", 0.0455, 0.0317, 0.711, 0.0573, 0.690), ("aces", 0.0453, 0.0397, 0.925, 0.0816, 1.491)],
)
def test_published_reference_solutions_have_their_published_errors(data_dir, name, trans, trans_std, rot, loop_trans, loop_rot):
    folder = data_dir / "real" / name
    errors = relation_errors(read_tum(folder / "reference_dense.tum"), read_relations(folder / "relations.txt"))
    assert errors.all.trans_mean_m == pytest.approx(trans, rel=0.01)
    assert errors.all.trans_std_m == pytest.approx(trans_std, rel=0.01)
    assert errors.all.rot_mean_deg == pytest.approx(rot, rel=0.01)
    assert errors.loops.trans_mean_m == pytest.approx(loop_trans, rel=0.01)
    assert errors.loops.rot_mean_deg == pytest.approx(loop_rot, rel=0.01)


def _raw_odometry(source) -> Trajectory:
    highlevel, typesys = pytest.importorskip("rosbags.highlevel"), pytest.importorskip("rosbags.typesys")
    poses: dict[int, tuple[float, float, float]] = {}
    with highlevel.AnyReader([source], default_typestore=typesys.get_typestore(typesys.Stores.ROS2_HUMBLE)) as reader:
        odometry = [connection for connection in reader.connections if connection.topic == "/odom"]
        for connection, _, raw in reader.messages(odometry):
            message = reader.deserialize(raw, connection.msgtype)
            pose, stamp = message.pose.pose, message.header.stamp
            yaw = 2 * np.arctan2(pose.orientation.z, pose.orientation.w)
            poses.setdefault(stamp.sec * NS_PER_S + stamp.nanosec, (pose.position.x, pose.position.y, yaw))
    stamps = np.array(sorted(poses))
    return Trajectory(stamps, np.array([poses[stamp] for stamp in stamps.tolist()]))


@pytest.mark.data
@pytest.mark.slow
@pytest.mark.parametrize(
    ("name", "bag", "trans", "trans_std", "loop_trans"),
    [("fr079", "fr079.mcap", 6.504, 13.664, 18.67), ("aces", "aces.bag", 0.549, 2.674, 7.47)],
)
def test_raw_odometry_has_its_known_errors(data_dir, name, bag, trans, trans_std, loop_trans):
    folder = data_dir / "real" / name
    errors = relation_errors(_raw_odometry(folder / bag), read_relations(folder / "relations.txt"))
    assert errors.all.used == errors.all.total
    assert errors.all.trans_mean_m == pytest.approx(trans, rel=0.01)
    assert errors.all.trans_std_m == pytest.approx(trans_std, rel=0.01)
    assert errors.loops.trans_mean_m == pytest.approx(loop_trans, rel=0.01)
