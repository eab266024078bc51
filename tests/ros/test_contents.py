"""What the node publishes, field by field, without ROS."""

from types import SimpleNamespace

import numpy as np
import pytest

from hybridmap.export.keyframes import OccupancyGrid
from hybridmap.geometry import compose, exp
from hybridmap.graph.edges import EdgeKind
from hybridmap.live import LiveReport, Snapshot
from hybridmap.ros import contents

NS = 1_000_000_000
SNAPSHOT = Snapshot(
    stamp_ns=3 * NS + 5,
    stamps_ns=np.array([NS, 2 * NS, 3 * NS]),
    poses=np.array([[0.0, 0.0, 0.0], [1.0, 0.0, np.pi / 2], [1.0, 2.0, np.pi]]),
    edges=np.array([[0, 1], [1, 2], [0, 2]]),
    kinds=np.array([EdgeKind.ODOMETRY, EdgeKind.REGISTRATION, EdgeKind.LOOP], dtype=np.int8),
    pose_map_odom=np.array([1.0, 2.0, 0.5]),
)


def planar(pose) -> np.ndarray:
    """The planar pose of the contents of a Pose."""
    return np.array(
        [pose["position"]["x"], pose["position"]["y"], 2 * np.arctan2(pose["orientation"]["z"], pose["orientation"]["w"])]
    )


def test_a_transform_is_the_correction_from_map_to_odom() -> None:
    made = contents.transform(7 * NS + 9, "map", "odom", np.array([1.0, 2.0, 0.5]))
    assert made["header"]["stamp"].parts == (7, 9)
    assert (made["header"]["frame_id"], made["child_frame_id"]) == ("map", "odom")
    moved = made["transform"]
    yaw = 2 * np.arctan2(moved["rotation"]["z"], moved["rotation"]["w"])
    assert (moved["translation"]["x"], moved["translation"]["y"]) == (1.0, 2.0)
    assert yaw == pytest.approx(0.5)


def test_the_path_has_every_node_with_its_stamp() -> None:
    made = contents.path("map", SNAPSHOT)
    assert [one["header"]["stamp"].ns for one in made["poses"]] == [NS, 2 * NS, 3 * NS]
    assert np.allclose([planar(one["pose"]) for one in made["poses"]], SNAPSHOT.poses)


def test_the_graph_shows_the_edges_of_each_kind() -> None:
    markers = {marker["ns"]: marker for marker in contents.graph("map", SNAPSHOT)["markers"]}
    assert len(markers["nodes"]["points"]) == 3
    ends = [(point["x"], point["y"]) for point in markers["loop edges"]["points"]]
    assert ends == [(0.0, 0.0), (1.0, 2.0)]
    assert len({tuple(marker["color"].values()) for marker in markers.values()}) == 5
    assert markers["manual edges"]["points"] == []


def test_the_covariance_is_turned_from_the_robot_s_frame_into_the_map_s() -> None:
    covariance = np.array([[0.04, 0.001, 0.002], [0.001, 0.01, 0.0], [0.002, 0.0, 0.003]])
    pose, rng = np.array([1.0, 2.0, 1.2]), np.random.default_rng(0)
    drawn = rng.multivariate_normal(np.zeros(3), 1e-4 * covariance, 40_000)
    around = np.array([compose(pose, exp(twist)) for twist in drawn])
    made = np.reshape(contents.pose_with_covariance(0, "map", pose, covariance)["pose"]["covariance"], (6, 6))
    assert np.allclose(made[np.ix_((0, 1, 5), (0, 1, 5))], 1e4 * np.cov((around - pose).T), atol=2e-3)
    assert np.allclose(made[2:5], 0.0)
    assert not np.any(contents.pose_with_covariance(0, "map", pose, None)["pose"]["covariance"])


def test_the_grid_is_row_by_row_from_its_lower_left_corner() -> None:
    grid = OccupancyGrid(np.array([[4.0, -4.0, 0.0], [0.0, 0.5, -0.5]], dtype=np.float32), np.array([-1.0, 2.0]), 0.05)
    made = contents.occupancy(NS, "map", grid)
    assert made["data"].tolist() == [100, 0, -1, -1, -1, -1]
    assert made["data"].dtype == np.int8
    info = made["info"]
    assert (info["width"], info["height"], info["resolution"]) == (3, 2, 0.05)
    assert np.allclose(planar(info["origin"]), [-1.0, 2.0, 0.0])


def test_diagnostics_say_what_is_wrong_and_how_much_was_left_out() -> None:
    report = LiveReport("mapping", {"odometry": 90, "scans": 40}, {"scans": {"too slow": 3}}, 0.25, 1.5, 0.125, 7)
    (status,) = contents.diagnostics(NS, "hybridmap", report, ["scans: late"])["status"]
    assert (status["level"], status["message"]) == (1, "scans: late")
    values = {value["key"]: value["value"] for value in status["values"]}
    assert values["left out of scans: too slow"] == "3"
    assert values["samples of odometry"] == "90"
    assert (values["lag, s"], values["largest lag, s"], values["waiting for odometry, s"]) == ("0.250", "1.500", "0.125")
    (well,) = contents.diagnostics(NS, "hybridmap", report, [])["status"]
    assert well["level"] == 0
    (waiting,) = contents.diagnostics(NS, "hybridmap", None, ["no odometry"])["status"]
    assert (waiting["level"], waiting["message"]) == (1, "no odometry")


def test_an_initial_pose_is_read() -> None:
    q = SimpleNamespace(x=0.0, y=0.0, z=np.sin(0.35), w=np.cos(0.35))
    pose = SimpleNamespace(position=SimpleNamespace(x=3.0, y=-1.0, z=0.0), orientation=q)
    assert np.allclose(contents.pose_in(SimpleNamespace(pose=SimpleNamespace(pose=pose))), [3.0, -1.0, 0.7])
