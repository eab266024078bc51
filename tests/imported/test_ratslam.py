"""Experience maps of OpenRatSLAM: actions and odometry, TopologicalMaps and tables become sessions, and bags again."""

from __future__ import annotations

import json
import sqlite3
from contextlib import closing

import numpy as np
import pytest
from rosbags.rosbag1 import Reader as Reader1
from rosbags.rosbag2 import Reader as Reader2

from hybridmap.config import Config
from hybridmap.errors import ExportError, GraphError, StreamError
from hybridmap.export.formats import export_session
from hybridmap.geometry import between, compose, log
from hybridmap.graph.edges import EdgeKind, Status
from hybridmap.graph.io import graph_hash
from hybridmap.imported.ratslam_bag import read_topological_map
from hybridmap.imported.session import RECORDED, import_map
from hybridmap.report import write_report
from hybridmap.store import MapStore
from hybridmap.streams.bagfile import BagFile
from hybridmap.streams.ratslam_messages import ACTION, CREATE_EDGE, CREATE_NODE, SET_NODE, register
from tests.narrowing import known
from tests.store.sessions import ring_map, write_session
from tests.streams.recordings import KINDS, NS, Recording

CONFIG = Config.load(None, {"vision.sensor": "none", "backends.names": ["gtsam-lm"]})
ACTIONS = "/irat_red/PoseCell/TopologicalAction"
DRIFT_RAD = 0.004  # a sample
STRIDE = 5  # samples from experience to experience
ROUND = [(CREATE_NODE, max(k - 1, 0), k) for k in range(16)]
AGAIN = [(CREATE_EDGE, 15, 0), (SET_NODE, 0, 1), (CREATE_EDGE, 1, 2), (CREATE_NODE, 2, 16), (CREATE_EDGE, 16, 4)]
DRIVE = [*ROUND, *AGAIN]
"""A round of a square and a part of a second one: two loops, a link that is there already, and a new experience."""


def true_pose(sample: int) -> np.ndarray:
    side, along = divmod(sample, 20)
    corner = [(0, 0, 0), (2, 0, np.pi / 2), (2, 2, np.pi), (0, 2, -np.pi / 2)][side % 4]
    return compose(corner, (0.1 * along, 0.0, 0.0))


def drifting(samples: int) -> np.ndarray:
    poses = [true_pose(0)]
    for k in range(1, samples):
        poses.append(compose(poses[-1], between(true_pose(k - 1), true_pose(k)) + np.array([0, 0, DRIFT_RAD])))
    return np.array(poses)


def driven(drive=DRIVE, *, ros1=False, twist=False, turned=0.0) -> Recording:
    recording = Recording(ros1=ros1)
    register(recording.store)
    action_type = recording.store.types[ACTION]
    poses = drifting(STRIDE * (len(drive) - 1) + 1)
    for sample, pose in enumerate(poses):
        stamp_ns = 100 * NS + sample * NS // 10
        recording.odometry(stamp_ns, *pose)
        if twist:
            message = recording.messages[-1][2]
            message.pose.pose = recording.pose(0.0, 0.0, 0.0)
            message.pose.pose.orientation.w = 0.0
            moved = log(between(poses[max(sample - 1, 0)], pose)) * 10.0
            message.twist.twist.linear = recording.t.Vector3(x=float(moved[0]), y=0.0, z=0.0)
            message.twist.twist.angular = recording.t.Vector3(x=0.0, y=0.0, z=float(moved[2]))
        if sample % STRIDE == 0:
            action, source, target = drive[sample // STRIDE]
            rad = turned if action == CREATE_EDGE else 0.0
            header = recording.header(stamp_ns + 7, "")
            message = action_type(header=header, action=action, src_id=source, dest_id=target, relative_rad=rad)
            recording.messages.append((ACTIONS, ACTION, message))
    return recording


def imported(source, out):
    folder = import_map(source, CONFIG, out)
    with MapStore.open(folder.path) as store:
        return store.map(), store.solutions(), store.track()


@pytest.mark.parametrize("kind", KINDS)
def test_actions_and_odometry_make_a_session(tmp_path, kind):
    bag = driven(ros1=kind == "bag").write(tmp_path / f"drive.{kind}")
    experiences, solutions, track = imported(bag, tmp_path / "s")
    found = [(edge.source, edge.target, edge.kind) for edge in experiences.edges]
    chain = [(k - 1, k, EdgeKind.ODOMETRY) for k in range(1, 16)]
    assert found == [*chain, (15, 0, EdgeKind.LOOP), (2, 16, EdgeKind.ODOMETRY), (16, 4, EdgeKind.LOOP)]
    odometry = drifting(STRIDE * 20 + 1)
    np.testing.assert_allclose(experiences.edge(15).relative.delta, between(odometry[75], odometry[80]), atol=1e-12)
    np.testing.assert_allclose(experiences.initial[16], odometry[95], atol=1e-12)
    assert [node.stamp_ns for node in experiences.nodes[:2]] == [100 * NS, 100 * NS + NS // 2]
    error_m = [np.hypot(*(poses[16] - true_pose(95))[:2]) for poses in (experiences.initial, solutions["gtsam-lm"].poses)]
    assert error_m[1] < 0.05 < 0.25 < error_m[0]
    assert track.nodes[[0, 4, 5, 80, 85, 92]].tolist() == [0, 0, 1, 0, 1, 2]
    loop, link = experiences.edge(15).relative, experiences.edge(3).relative
    assert np.diag(loop.covariance)[0] >= 0.25**2 > np.diag(link.covariance)[0], "half of the way between experiences"


def test_a_robot_that_stays_in_its_experience_keeps_its_way_and_edges_their_time(tmp_path):
    drive = [(CREATE_NODE, 0, 0), (SET_NODE, 0, 0), *ROUND[1:], (CREATE_EDGE, 15, 0), (CREATE_NODE, 0, 16)]
    experiences = imported(driven(drive).write(tmp_path / "drive.mcap"), tmp_path / "s")[0]
    np.testing.assert_allclose(known(experiences.edge(0).relative).delta, drifting(2 * STRIDE + 1)[-1], atol=1e-12)
    assert [edge.since_node for edge in experiences.edges] == [*range(1, 16), 15, 16]


def test_odometry_by_twists_alone_is_integrated(tmp_path):
    poses = imported(driven().write(tmp_path / "a.mcap"), tmp_path / "s")[0].initial
    turning = imported(driven(twist=True).write(tmp_path / "b.mcap"), tmp_path / "t")[0].initial
    np.testing.assert_allclose(turning[:4], poses[:4], atol=1e-2)  # up to the first corner: twists here have no sideways part
    np.testing.assert_allclose(np.exp(1j * turning[:, 2]), np.exp(1j * poses[:, 2]), atol=1e-9)


def test_the_robot_is_turned_against_the_experience_that_it_recognised(tmp_path):
    experiences, _, track = imported(driven(turned=0.3).write(tmp_path / "drive.mcap"), tmp_path / "s")
    odometry = drifting(STRIDE * 20 + 1)
    heading = experiences.edge(15).relative.delta[2]
    assert heading == pytest.approx(between(odometry[75], odometry[80])[2] - 0.3)
    np.testing.assert_allclose(track.deltas[80], (0, 0, 0.3), atol=1e-12)
    moved = compose((0, 0, 0.3), between(odometry[90], odometry[95]))
    np.testing.assert_allclose(experiences.edge(16).relative.delta, moved, atol=1e-12)


def test_a_bag_without_definitions_is_read_by_ours_and_repeated_odometry_counts_once(tmp_path):
    recording = driven()
    recording.messages.insert(1, recording.messages[0])
    bag = recording.write(tmp_path / "drive.db3")
    with closing(sqlite3.connect(bag)) as database:
        assert database.execute("DELETE FROM message_definitions").rowcount > 0
        database.commit()
    experiences, _, track = imported(bag, tmp_path / "s")
    assert (len(experiences), len(track)) == (17, STRIDE * 20 + 1)


@pytest.mark.parametrize("suffix", [".bag", ".mcap", ".db3"])
def test_what_is_written_back_equals_the_session_and_imports_as_the_same_graph(tmp_path, suffix):
    source = driven(turned=0.1).write(tmp_path / "drive.mcap")
    experiences, solutions, _ = imported(source, tmp_path / "s")
    for name in "ab":
        export_session(tmp_path / "s", "ratslam", tmp_path / name / f"map{suffix}")
    bag = tmp_path / "a" / f"map{suffix}"
    assert bag.read_bytes() == (tmp_path / "b" / f"map{suffix}").read_bytes()
    written = read_topological_map(BagFile(bag), "/ExperienceMap/Map")
    np.testing.assert_allclose(known(written.poses), solutions["gtsam-lm"].poses, atol=1e-12)
    assert written.stamps_ns[-1] == experiences.nodes[-1].stamp_ns
    with (Reader1 if suffix == ".bag" else Reader2)(bag) as reader:
        assert (np.diff([stamp_ns for _, stamp_ns, _ in reader.messages()]) > 0)[:-1].all(), (
            "an action comes after its odometry"
        )
    assert len(written.links) == len(experiences.edges)
    for link, edge in zip(written.links, experiences.edges, strict=True):
        assert (link.source, link.target, link.duration_s) == (edge.source, edge.target, edge.figures["duration_s"])
        np.testing.assert_allclose(link.delta, edge.relative.delta, atol=1e-12)
    again, _, track = imported(bag, tmp_path / "t")
    assert [node.stamp_ns for node in again.nodes] == [node.stamp_ns for node in experiences.nodes]
    np.testing.assert_allclose(again.pose_graph().deltas, experiences.pose_graph().deltas, atol=1e-12)
    np.testing.assert_allclose(again.pose_graph().information, experiences.pose_graph().information, rtol=1e-9)
    assert len(track) == STRIDE * 20 + 1


@pytest.mark.parametrize("suffix", [".bag", ".mcap", ".db3"])
def test_a_topological_map_is_imported_and_written_back_the_same(tmp_path, suffix):
    experiences = ring_map()
    write_session(tmp_path / "s", experiences)
    export_session(tmp_path / "s", "ratslam", tmp_path / f"map{suffix}")
    again, _, _ = imported(tmp_path / f"map{suffix}", tmp_path / "t")
    accepted = [edge for edge in experiences.edges if edge.status is Status.ACCEPTED]
    assert [(e.source, e.target, e.kind) for e in again.edges] == [(e.source, e.target, e.kind) for e in accepted]
    assert [node.stamp_ns for node in again.nodes] == [node.stamp_ns for node in experiences.nodes]
    export_session(tmp_path / "t", "ratslam", tmp_path / f"back{suffix}", backend=RECORDED)
    one, other = (read_topological_map(BagFile(tmp_path / f"{name}{suffix}"), "/ExperienceMap/Map") for name in ("map", "back"))
    np.testing.assert_allclose(known(one.poses), known(other.poses), atol=1e-12)
    np.testing.assert_array_equal(one.stamps_ns, other.stamps_ns)
    for a, b in zip(one.links, other.links, strict=True):
        assert (a.source, a.target, a.duration_s) == (b.source, b.target, b.duration_s)
        np.testing.assert_allclose(a.delta, b.delta, atol=1e-12)
    with pytest.raises(ExportError, match="a bag ends in"):
        export_session(tmp_path / "t", "ratslam", tmp_path / "map.txt")


@pytest.mark.parametrize(
    ("drive", "says"),
    [
        ([(CREATE_NODE, 0, 1)], "action 1 .*expected the new experience 0"),
        ([(CREATE_NODE, 0, 0), (CREATE_NODE, 0, 2)], "action 2 .*expected the new experience 1"),
        ([(SET_NODE, 0, 0)], "unknown experience; 0 experiences"),
        ([*ROUND, (CREATE_EDGE, 15, 77)], "unknown experience; 16 experiences"),
        ([*ROUND, (CREATE_EDGE, 15, 15)], "from an experience to itself"),
        ([*ROUND, (SET_NODE, 3, 4)], "the robot is in experience 15"),
        ([*ROUND, (9, 15, 0)], "unknown action 9"),
    ],
)
def test_actions_that_make_no_map_are_one_clear_error(tmp_path, drive, says):
    bag = driven(drive).write(tmp_path / "drive.mcap")
    with pytest.raises(StreamError, match=says):
        import_map(bag, CONFIG, tmp_path / "s")
    assert not (tmp_path / "s").exists()


def test_bags_that_lack_something_are_one_clear_error(tmp_path):
    recording = driven()
    recording.messages.insert(0, recording.messages.pop(1))
    with pytest.raises(StreamError, match="before any odometry"):
        import_map(recording.write(tmp_path / "early.mcap"), CONFIG, tmp_path / "s")
    recording = driven()
    recording.messages[1][2].header.stamp.sec += 50
    with pytest.raises(StreamError, match=r"action 2 .*earlier than that of the action before"):
        import_map(recording.write(tmp_path / "back.mcap"), CONFIG, tmp_path / "s")
    recording = driven(ros1=True)
    recording.messages = [row for row in recording.messages if row[0] == ACTIONS]
    with pytest.raises(StreamError, match="actions need odometry"):
        import_map(recording.write(tmp_path / "alone.bag"), CONFIG, tmp_path / "s")
    whole = driven(ros1=True).write(tmp_path / "whole.bag").read_bytes()
    (tmp_path / "cut.bag").write_bytes(whole[: len(whole) // 2])
    with pytest.raises(StreamError, match="cannot be read as a bag"):
        import_map(tmp_path / "cut.bag", CONFIG, tmp_path / "s")
    recording = driven()
    recording.messages[4][2].header.stamp.sec -= 50
    with pytest.raises(StreamError, match="expected sorted stamps"):
        import_map(recording.write(tmp_path / "unsorted.mcap"), CONFIG, tmp_path / "s")
    recording = Recording()
    recording.odometry(NS)
    with pytest.raises(StreamError, match="no map of OpenRatSLAM"):
        import_map(recording.write(tmp_path / "none.mcap"), CONFIG, tmp_path / "s")
    with pytest.raises(StreamError, match="neither a ROS 2 bag nor"):
        import_map(tmp_path, CONFIG, tmp_path / "s")
    with pytest.raises(StreamError, match=r"no such file or folder; expected a ROS 1 bag .* or a table NAME_nodes.csv"):
        import_map(tmp_path / "no.bag", CONFIG, tmp_path / "s")


NODES = "id,x,y,th,vt_id\n0,0,0,0,0\n1,1,0,0,4\n2,2,0,0,5\n"
LINKS = "from,to,d,heading,facing,dt\n0,1,1,0,0,2.5\n1,2,1,0,0,3.5\n2,0,2,3.14159265,0,9\n"


def tables(folder, nodes=NODES, links=LINKS):
    (folder / "m_nodes.csv").write_text(nodes)
    (folder / "m_links.csv").write_text(links)
    return folder / "m_links.csv"


def test_tables_make_a_session(tmp_path):
    experiences, solutions, track = imported(tables(tmp_path), tmp_path / "s")
    assert [node.template for node in experiences.nodes] == [0, 4, 5]
    assert [edge.kind for edge in experiences.edges] == [EdgeKind.ODOMETRY, EdgeKind.ODOMETRY, EdgeKind.LOOP]
    assert track.stamps_ns.tolist() == [0, 2_500_000_000, 3_500_000_000], "growing durations are times since the start"
    np.testing.assert_array_equal(solutions[RECORDED].poses, [[0, 0, 0], [1, 0, 0], [2, 0, 0]])
    ways = LINKS.replace("3.5", "2.5")
    track = imported(tables(tmp_path, links=ways), tmp_path / "t")[2]
    assert track.stamps_ns.tolist() == [0, 2_500_000_000, 5_000_000_000]
    backward = LINKS.replace("1,2,1,0,0,3.5", "2,1,1,3.14159265,0,3.5")
    experiences = imported(tables(tmp_path, links=backward), tmp_path / "u")[0]
    np.testing.assert_allclose(experiences.initial[2], (2, 0, 0), atol=1e-6)


@pytest.mark.parametrize(
    ("nodes", "links", "error", "says"),
    [
        (NODES, LINKS + "1,1,0,0,0,10\n", GraphError, "link 4 .*to itself"),
        (NODES, LINKS + "1,7,0,0,0,10\n", GraphError, "link 4 .*unknown experience; expected 0 to 2"),
        (NODES, LINKS.replace("9\n", "-9\n"), GraphError, "negative duration"),
        (NODES + "3,3,0,0,0\n", LINKS, GraphError, "no link joins experience 3"),
        (NODES[: NODES.index("0,0")], "from,to,d,heading,facing,dt\n", GraphError, "holds no experience"),
        (NODES.replace("2,2", "5,2"), LINKS, StreamError, "ids 0 to 2 in order"),
        (NODES, LINKS.replace("2.5", "nan"), StreamError, "m_links.csv:2: expected the numbers"),
        (NODES, LINKS[:-4], StreamError, "m_links.csv:4: expected the numbers"),
        ("id,x\n", LINKS, StreamError, "expected the header id,x,y,th,vt_id, found 'id,x'"),
    ],
)
def test_tables_that_are_no_map_are_one_clear_error(tmp_path, nodes, links, error, says):
    with pytest.raises(error, match=says):
        import_map(tables(tmp_path, nodes, links), CONFIG, tmp_path / "s")
    assert not (tmp_path / "s").exists()


def test_a_real_experience_map_is_a_session_that_every_reader_takes(data_dir, tmp_path):
    source = data_dir / "ratslam_maps" / "paper_irat_complete_nodes.csv"
    folder = import_map(source, CONFIG, tmp_path / "s")
    write_report(folder)
    assert folder.report.is_file()
    with MapStore.open(folder.path) as store:
        experiences, solutions = store.map(), store.solutions()
        assert json.loads(folder.metrics_json.read_text())["graph_hash"] == graph_hash(experiences)
    graph = experiences.pose_graph()
    assert (graph.n_nodes, graph.n_edges, int(graph.is_loop.sum())) == (848, 934, 87)
    metrics = json.loads(folder.metrics_json.read_text())
    assert {reason["kind"] for reason in metrics["reasons"]} == {"loops alone"}, "as of a file of loops"
    report = solutions["gtsam-lm"].report
    assert known(report.unit_variance) < 1.0, "the covariances are not smaller than the errors"
    exported = np.loadtxt(source, delimiter=",", skiprows=1)
    np.testing.assert_array_equal(solutions[RECORDED].poses, exported[:, 1:4])
    apart = np.hypot(*(solutions["gtsam-lm"].poses - solutions[RECORDED].poses)[:, :2].T)
    assert np.median(apart) < 0.5
    export_session(folder.path, "ratslam", tmp_path / "map.bag", backend=RECORDED)
    written = read_topological_map(BagFile(tmp_path / "map.bag"), "/ExperienceMap/Map")
    np.testing.assert_allclose(known(written.poses), exported[:, 1:4], atol=1e-12)
