from __future__ import annotations

import numpy as np
import pytest
import yaml

from hybridmap.errors import ExportError, OutputError, StoreError
from hybridmap.export import FORMATS
from hybridmap.export.formats import ExportOptions, export_session
from hybridmap.geometry import between, compose, log
from hybridmap.graph.io import read_graph
from hybridmap.streams.base import Rig
from hybridmap.trajectory import read_tum
from tests.store.sessions import CAMERA, LASER, ring_map, truth_at, write_session

OPTIONS = ExportOptions(resolution_m=0.1, voxel_m=0.05)


@pytest.fixture(scope="module")
def experiences():
    return ring_map()


@pytest.fixture(scope="module")
def folder(tmp_path_factory, experiences):
    path = tmp_path_factory.mktemp("exported") / "laser"
    write_session(path, experiences, rig=Rig(laser=LASER))
    return path


@pytest.fixture(scope="module")
def depth_folder(tmp_path_factory, experiences):
    path = tmp_path_factory.mktemp("exported") / "depth"
    write_session(path, experiences, rig=Rig(camera=CAMERA))
    return path


@pytest.fixture
def truth(experiences):
    return truth_at(np.array([node.stamp_ns for node in experiences.nodes]))


@pytest.mark.parametrize("name", FORMATS)
def test_every_format_is_written_whole_and_with_the_same_bytes_each_time(folder, tmp_path, name):
    out = f"out{FORMATS[name].suffix}"
    first = export_session(folder, name, tmp_path / "a" / out, options=OPTIONS)
    second = export_session(folder, name, tmp_path / "b" / out, options=OPTIONS)
    assert first.metrics == second.metrics
    assert first.backend == "gtsam-lm"
    for one, other in zip(first.files, second.files, strict=True):
        assert one.read_bytes() == other.read_bytes()
        assert one.stat().st_size > 100
    assert sorted(path.name for path in (tmp_path / "a").iterdir()) == sorted(path.name for path in first.files)


def test_tum_is_the_session_s_trajectory(folder, tmp_path):
    export_session(folder, "tum", tmp_path / "x.tum")
    assert (tmp_path / "x.tum").read_bytes() == (folder / "trajectory" / "gtsam-lm.tum").read_bytes()
    export_session(folder, "tum", tmp_path / "o.tum", backend="odometry")
    assert (tmp_path / "o.tum").read_bytes() == (folder / "trajectory" / "odometry.tum").read_bytes()


def test_kitti_is_read_by_evo(folder, tmp_path):
    file_interface = pytest.importorskip("evo.tools.file_interface")
    export_session(folder, "kitti", tmp_path / "x.txt")
    read = file_interface.read_kitti_poses_file(str(tmp_path / "x.txt"))
    ours = read_tum(folder / "trajectory" / "gtsam-lm.tum").poses
    np.testing.assert_allclose(read.positions_xyz[:, :2], ours[:, :2], atol=1e-12)
    matrices = np.array(read.poses_se3)
    np.testing.assert_allclose(np.arctan2(matrices[:, 1, 0], matrices[:, 0, 0]), ours[:, 2], atol=1e-12)


def test_g2o_holds_the_graph_at_the_back_end_s_poses(folder, tmp_path, experiences, truth):
    export_session(folder, "g2o", tmp_path / "x.g2o")
    read, graph = read_graph(tmp_path / "x.g2o"), experiences.pose_graph()
    np.testing.assert_array_equal(read.initial, truth)
    np.testing.assert_array_equal(read.deltas, graph.deltas)
    np.testing.assert_array_equal(read.information, graph.information)
    assert read.n_edges == graph.n_edges


def test_posegraph_is_read_back_and_consistent_by_open3d_s_own_rule(folder, tmp_path, experiences, truth):
    o3d = pytest.importorskip("open3d")
    export_session(folder, "posegraph", tmp_path / "x.json")
    read = o3d.io.read_pose_graph(str(tmp_path / "x.json"))
    graph = experiences.pose_graph()
    assert (len(read.nodes), len(read.edges)) == (graph.n_nodes, graph.n_edges)
    poses = np.array([node.pose for node in read.nodes])
    np.testing.assert_allclose(poses[:, :2, 3], truth[:, :2], atol=1e-9)
    loops = [edge for edge in read.edges if edge.uncertain]
    assert len(loops) == np.count_nonzero(graph.is_loop)
    for edge in loops:
        # points of the source node, brought into the target's frame (Open3D's edge.transformation)
        expected = np.linalg.inv(poses[edge.target_node_id]) @ poses[edge.source_node_id]
        assert np.abs(edge.transformation - expected).max() < 0.02
    registration = o3d.pipelines.registration
    for node in read.nodes[1:]:
        moved = np.array(node.pose)
        moved[:2, 3] += 0.1
        node.pose = moved
    registration.global_optimization(
        read,
        registration.GlobalOptimizationLevenbergMarquardt(),
        registration.GlobalOptimizationConvergenceCriteria(),
        registration.GlobalOptimizationOption(max_correspondence_distance=0.05, edge_prune_threshold=0.25, reference_node=0),
    )
    solved = np.array([node.pose for node in read.nodes])
    assert np.abs(solved[:, 2, 3]).max() < 1e-6
    error = np.hypot(*(solved[:, :2, 3] - truth[:, :2]).T)
    odometry_error = np.hypot(*(graph.initial[:, :2] - truth[:, :2]).T)
    assert error.max() < 0.5 * odometry_error.max()


def test_posegraph_information_is_that_of_the_turned_edge(folder, tmp_path, experiences):
    o3d = pytest.importorskip("open3d")
    export_session(folder, "posegraph", tmp_path / "x.json")
    read = o3d.io.read_pose_graph(str(tmp_path / "x.json"))
    graph = experiences.pose_graph()
    rng = np.random.default_rng(1)
    for k in (0, graph.n_edges - 1):
        noise = rng.normal(0, 1e-4, 3)
        moved = compose(graph.deltas[k], noise)
        ours = noise @ graph.information[k] @ noise
        measured = read.edges[k].transformation
        turned = log(between([measured[0, 3], measured[1, 3], np.arctan2(measured[1, 0], measured[0, 0])], _inverse(moved)))
        theirs = np.array([0, 0, turned[2], turned[0], turned[1], 0]) @ read.edges[k].information
        assert theirs @ np.array([0, 0, turned[2], turned[0], turned[1], 0]) == pytest.approx(ours, rel=1e-3)


def _inverse(pose):
    return between(pose, np.zeros(3))


def test_lineset_is_read_back_with_its_lines_and_colours(folder, tmp_path, experiences, truth):
    o3d = pytest.importorskip("open3d")
    export_session(folder, "lineset", tmp_path / "x.ply")
    read, graph = o3d.io.read_line_set(str(tmp_path / "x.ply")), experiences.pose_graph()
    np.testing.assert_allclose(np.asarray(read.points)[:, :2], truth[:, :2], atol=1e-9)
    np.testing.assert_array_equal(np.asarray(read.lines), np.stack([graph.sources, graph.targets], axis=1))
    colors = np.asarray(read.colors)
    assert len(np.unique(colors, axis=0)) == 2
    assert (colors[graph.is_loop, 0] > colors[graph.is_loop, 2]).all()


def test_laser_cloud_lies_on_the_walls(folder, tmp_path):
    o3d = pytest.importorskip("open3d")
    export_session(folder, "pcd", tmp_path / "x.pcd", options=OPTIONS)
    points = np.asarray(o3d.io.read_point_cloud(str(tmp_path / "x.pcd")).points)
    to_wall = np.abs(np.maximum(np.abs(points[:, 0]), np.abs(points[:, 1] - 2.0)) - 5.0)
    assert len(points) > 500
    assert to_wall.max() < 0.01
    assert np.abs(points[:, 2]).max() == 0


def test_depth_cloud_is_where_the_camera_looked_and_coloured(depth_folder, tmp_path, truth):
    o3d = pytest.importorskip("open3d")
    export_session(depth_folder, "ply", tmp_path / "x.ply", options=OPTIONS)
    cloud = o3d.io.read_point_cloud(str(tmp_path / "x.ply"))
    points, colors = np.asarray(cloud.points), np.asarray(cloud.colors)
    centre = compose(truth[10], [2.1, 0.0, 0.0])
    ahead = np.hypot(points[:, 0] - centre[0], points[:, 1] - centre[1]) < 0.1
    assert ahead.any()
    assert points[:, 2].min() > 0.3 - 2.0 * 12 / 30 - 0.05
    assert points[:, 2].max() < 0.3 + 2.0 * 10.5 / 30
    np.testing.assert_allclose(colors[:, 0], 200 / 255, atol=0.01)
    with pytest.raises(ExportError, match="hold no point"):
        export_session(depth_folder, "ply", tmp_path / "y.ply", options=ExportOptions(max_depth_m=1.0))


@pytest.mark.parametrize("kind", ["laser", "depth"])
def test_grid_has_walls_free_room_and_the_right_origin(folder, depth_folder, tmp_path, kind):
    export_session(folder if kind == "laser" else depth_folder, "grid", tmp_path / "map.yaml", options=OPTIONS)
    head = yaml.safe_load((tmp_path / "map.yaml").read_text())
    assert head["image"] == "map.pgm"
    assert (head["negate"], head["resolution"], head["origin"][2]) == (0, 0.1, 0.0)
    raw = (tmp_path / "map.pgm").read_bytes()
    magic, size, depth, pixels = raw.split(b"\n", 3)
    width, height = map(int, size.split())
    assert (magic, depth, len(pixels)) == (b"P5", b"255", width * height)
    image = np.frombuffer(pixels, np.uint8).reshape(height, width)
    assert set(np.unique(image)) == {0, 205, 254}

    def at(x: float, y: float) -> int:
        column = int((x - head["origin"][0]) / head["resolution"])
        row = int((y - head["origin"][1]) / head["resolution"])
        return int(image[height - 1 - row, column])

    assert at(0.0, 0.05) == 254
    assert image[0, 0] == 205
    probability = (255 - np.unique(image).astype(float)) / 255
    assert probability[0] > head["occupied_thresh"]
    assert probability[2] < head["free_thresh"] < probability[1]
    if kind == "laser":
        assert at(0.0, 2.0) == 254
        wall = [at(5.0 + dx, y) for dx in (-0.05, 0.05) for y in (-2.0, 0.0, 3.0)]
        assert 0 in wall[:3] or 0 in wall[3:]
        assert at(5.5, 2.0) == 205
        assert (image == 254).sum() * 0.01 == pytest.approx(100, rel=0.06)


def test_files_in_the_way_stay_unless_overwritten(folder, tmp_path):
    (tmp_path / "map.pgm").write_text("mine")
    with pytest.raises(OutputError, match=r"map\.pgm: exists already"):
        export_session(folder, "grid", tmp_path / "map.yaml", options=OPTIONS)
    assert [path.name for path in tmp_path.iterdir()] == ["map.pgm"]
    export_session(folder, "grid", tmp_path / "map.yaml", options=OPTIONS, overwrite=True)
    assert (tmp_path / "map.pgm").read_bytes().startswith(b"P5")
    with pytest.raises(OutputError, match="is a folder"):
        export_session(folder, "tum", tmp_path)


def test_what_the_session_cannot_give_is_said_and_leaves_nothing(tmp_path, folder):
    write_session(tmp_path / "bare", _one_node(), keyframes=False)
    for name, match in (
        ("posegraph", "no edge"),
        ("lineset", "no edge"),
        ("ply", "hold no point"),
        ("grid", "hold no obstacle"),
    ):
        with pytest.raises(ExportError, match=match):
            export_session(tmp_path / "bare", name, tmp_path / "new" / f"x{FORMATS[name].suffix}")
    assert not (tmp_path / "new").exists()
    with pytest.raises(ExportError, match=r"ends in \.json"):
        export_session(folder, "posegraph", tmp_path / "x.pg")
    with pytest.raises(ExportError, match=r"unknown format 'obj'.*tum, kitti"):
        export_session(folder, "obj", tmp_path / "x")
    with pytest.raises(ExportError, match=r"no result of back-end 'ceres'.*odometry.*gtsam-lm"):
        export_session(folder, "tum", tmp_path / "x", backend="ceres")
    with pytest.raises(StoreError, match="no such session folder"):
        export_session(tmp_path / "gone", "tum", tmp_path / "x")
    assert [path.name for path in tmp_path.iterdir()] == ["bare"]


def test_unfinished_run_is_solved_from_what_its_map_file_has(tmp_path, truth):
    write_session(tmp_path / "s", ring_map(), solve=False, keyframes=False)
    exported = export_session(tmp_path / "s", "g2o", tmp_path / "x.g2o")
    assert exported.backend == "gtsam-lm"
    error = read_graph(tmp_path / "x.g2o").initial - truth
    odometry = ring_map().initial - truth
    assert np.abs(error[:, :2]).max() < 0.6 * np.abs(odometry[:, :2]).max()
    assert export_session(tmp_path / "s", "tum", tmp_path / "x.tum", backend="odometry").files[0].is_file()


def _one_node():
    experiences = ring_map(loops=False)
    single = type(experiences)()
    single.add_node(experiences.node(0), np.zeros(3))
    return single


@pytest.mark.parametrize("name", ["map.db", "trajectory/gtsam-lm.tum", "new/../map.db", "trajectory/new.tum"])
def test_no_file_of_the_session_that_is_read_is_replaced(folder, name):
    before = (folder / "map.db").read_bytes()
    with pytest.raises(OutputError, match="a file of the session that is read"):
        export_session(folder, "tum", folder / name, overwrite=True)
    assert (folder / "map.db").read_bytes() == before
    export_session(folder, "tum", folder / "mine.tum")
    (folder / "mine.tum").unlink()
