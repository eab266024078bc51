from __future__ import annotations

import signal
import sqlite3
import subprocess
import sys
from dataclasses import replace

import numpy as np
import pytest

from hybridmap.backends.base import SolveReport, SolveStatus
from hybridmap.errors import StoreError
from hybridmap.graph.edges import Edge, EdgeKind, Lack, Status
from hybridmap.graph.experience_map import ExperienceMap, Node
from hybridmap.graph.io import graph_hash
from hybridmap.store import MapStore, SessionFolder
from hybridmap.streams.base import Rig
from hybridmap.trajectory import anchors_on
from tests.store.sessions import CAMERA, LASER, keyframe_of, ring_map, truth_at, write_session


def test_map_comes_back_with_every_edge_and_the_same_hash(tmp_path):
    before = ring_map()
    write_session(tmp_path / "s", before)
    with MapStore.open(tmp_path / "s") as store:
        after = store.map()
    assert graph_hash(after) == graph_hash(before)
    assert len(after.edges) == len(before.edges)
    for old, new in zip(before.edges, after.edges, strict=True):
        assert replace(old, relative=None) == replace(new, relative=None)
        assert (old.relative is None) == (new.relative is None)
    for node, back in zip(before.nodes, after.nodes, strict=True):
        assert (node.stamp_ns, node.template, node.travel_m) == (back.stamp_ns, back.template, back.travel_m)
        np.testing.assert_array_equal(node.pose_odom, back.pose_odom)
        np.testing.assert_array_equal(node.place_code, back.place_code)
        assert back.place_code.dtype == np.float32


def test_keyframes_snapshots_rig_and_solutions_come_back_exactly(tmp_path):
    experiences = ring_map()
    write_session(tmp_path / "s", experiences)
    truth = truth_at(np.array([node.stamp_ns for node in experiences.nodes]))
    with MapStore.open(tmp_path / "s") as store:
        for name, array in keyframe_of(11, truth).items():
            back = store.keyframe(11)[name]
            assert back.dtype == array.dtype
            np.testing.assert_array_equal(back, array)
        np.testing.assert_array_equal(store.snapshot(3)["phases"], np.arange(4.0))
        assert store.keyframe(10_000) == {}
        np.testing.assert_array_equal(store.rig.sensors["camera"].T_base_camera, CAMERA.T_base_camera)
        np.testing.assert_array_equal(store.rig.sensors["laser"].bearings_rad, LASER.bearings_rad)
        assert store.rig.sensors["camera"].fx_px == CAMERA.fx_px
        assert store.primary == "gtsam-lm"
        assert store.source == "circle"
        solution = store.solutions()["gtsam-lm"]
        np.testing.assert_array_equal(solution.poses, truth)
        assert solution.report.status is SolveStatus.CONVERGED


def test_grid_phases_of_all_nodes_come_back_in_order(tmp_path):
    phases = np.random.default_rng(0).uniform(size=(12, 3, 2))
    code = np.zeros(1, np.float32)
    with MapStore.create(tmp_path / "whole", "{}", Rig(), "x") as store:
        for k in range(12):
            store.add_node(k, Node(k, np.zeros(3), code, -1, 0.0), np.zeros(3), {}, {"grid_phases": phases[k]})
        phases[4:6] += 0.25
        for k in (4, 5):
            store.put_snapshot(k, {"grid_phases": phases[k]})
    with MapStore.open(tmp_path / "whole") as store:
        np.testing.assert_array_equal(store.grid_phases(), phases)
    with MapStore.create(tmp_path / "empty", "{}", Rig(), "x") as store:
        assert store.grid_phases().shape == (0, 0, 2)
    with MapStore.create(tmp_path / "other", "{}", Rig(), "x") as store:
        store.add_node(0, Node(0, np.zeros(3), code, -1, 0.0), np.zeros(3), {}, {"phases": phases[0]})
        with pytest.raises(StoreError, match="grid phases"):
            store.grid_phases()


def test_report_keeps_weights_and_rejected_edges(tmp_path):
    report = SolveReport("b", SolveStatus.STALLED, "m", 3, 2.0, 1.0, 0.5, (4, 9), {4: 0.25, 9: 0.0})
    with MapStore.create(tmp_path, "{}", Rig(), "x") as store:
        for k in range(3):
            store.add_node(k, Node(k, np.zeros(3), np.zeros(1, np.float32), -1, 0.0), np.zeros(3), {}, {})
        store.put_solution("b", np.zeros((2, 3)), report)
        store.put_solution("a", np.ones((3, 3)), report)
        store.put_solution("b", np.ones((3, 3)), report)
    with MapStore.open(tmp_path) as store:
        assert list(store.solutions()) == ["b", "a"]
        assert store.solutions()["b"].report == report
        assert store.solutions()["b"].poses.shape == (3, 3)


def test_edge_is_replaced_by_its_later_verdict(tmp_path):
    experiences = ring_map(loops=False)
    pending = Edge(5, 1, EdgeKind.LOOP, Status.PENDING, None)
    number = experiences.add_edge(pending)
    with MapStore.create(tmp_path, "{}", Rig(), "x") as store:
        initial = experiences.pose_graph().initial
        for k, node in enumerate(experiences.nodes):
            store.add_node(k, node, initial[k], {}, {})
        for k, edge in enumerate(experiences.edges):
            store.put_edge(k, edge)
        store.commit()
        experiences.update_edge(number, pending.settled(lack=Lack.CONTRADICTED))
        store.put_edge(number, experiences.edge(number))
    with MapStore.open(tmp_path) as store:
        edges = store.map().edges
    assert len(edges) == len(experiences.edges)
    assert edges[number].status is Status.REJECTED
    assert edges[number].lack is Lack.CONTRADICTED


def test_finished_session_is_one_file(tmp_path):
    write_session(tmp_path / "s", ring_map())
    assert sorted(path.name for path in (tmp_path / "s").glob("map.db*")) == ["map.db"]
    MapStore.open(tmp_path / "s").close()
    assert sorted(path.name for path in (tmp_path / "s").glob("map.db*")) == ["map.db"]


KILLED = """
import os, signal, sys
from pathlib import Path
from hybridmap.store import MapStore
from hybridmap.trajectory import anchors_on
from hybridmap.streams.base import Rig
from tests.store.sessions import ring_map
import numpy as np
experiences = ring_map(loops=False)
initial = experiences.pose_graph().initial
store = MapStore.create(Path(sys.argv[1]), "{}", Rig(), "x")
for k, node in enumerate(experiences.nodes):
    store.add_node(k, node, initial[k], {"noise": np.random.default_rng(k).random(20_000)}, {})
    if k:
        store.put_edge(k - 1, experiences.edge(k - 1))
    if k == 30:
        os.kill(os.getpid(), signal.SIGKILL)
    store.commit()
"""


def test_killed_run_leaves_a_map_up_to_the_last_committed_node(tmp_path):
    done = subprocess.run([sys.executable, "-c", KILLED, str(tmp_path)], check=False)
    assert done.returncode == -signal.SIGKILL
    with MapStore.open(tmp_path) as store:
        killed = store.map()
        assert len(store.keyframe(29)["noise"]) == 20_000
        assert store.keyframe(30) == {}
    assert len(killed) == 30
    whole = ring_map(loops=False)
    part = ExperienceMap()
    for k in range(30):
        part.add_node(whole.node(k), whole.pose_graph().initial[k])
    for edge in whole.edges[:29]:
        part.add_edge(edge)
    assert graph_hash(killed) == graph_hash(part)


def test_running_session_can_be_read_along(tmp_path):
    experiences = ring_map(loops=False)
    with MapStore.create(tmp_path, "{}", Rig(), "x") as store:
        store.add_node(0, experiences.node(0), np.zeros(3), {}, {})
        store.commit()
        store.add_node(1, experiences.node(1), np.zeros(3), {}, {})
        with MapStore.open(tmp_path) as reader:
            assert len(reader.map()) == 1


def test_a_map_is_read_as_of_one_moment_while_it_is_written(tmp_path, monkeypatch):
    experiences = ring_map(1.0)

    def write(store: MapStore, number: int) -> None:
        store.add_node(number, experiences.node(number), experiences.initial[number], {}, {})
        store.commit()

    with MapStore.create(tmp_path, "", Rig(), "a drive") as store:
        write(store, 0)
        with MapStore.open(tmp_path) as reader:
            arrays_of_nodes = reader.arrays_of_nodes

            def read_slowly(*args):
                found = arrays_of_nodes(*args)
                write(store, 1)
                return found

            monkeypatch.setattr(reader, "arrays_of_nodes", read_slowly)
            assert len(reader.map()) == 1
            monkeypatch.undo()
            assert len(reader.map()) == 2


def test_same_session_twice_has_the_same_stored_bytes(tmp_path):
    dumps = []
    for name in ("a", "b"):
        write_session(tmp_path / name, ring_map())
        with sqlite3.connect(tmp_path / name / "map.db") as connection:
            dumps.append("\n".join(connection.iterdump()))
    assert dumps[0] == dumps[1]


def test_track_keeps_the_last_word_on_a_stamp_and_is_sorted(tmp_path):
    with MapStore.create(tmp_path, "{}", Rig(), "x") as store:
        store.add_track(20, 0, np.array([1.0, 2, 3]), np.zeros(3))
        store.add_track(10, 0, np.zeros(3), np.array([0, 0, 0.5]))
        store.add_track(20, 1, np.array([4.0, 5, 3]), np.zeros(3))
    with MapStore.open(tmp_path) as store:
        track = store.track()
    assert track.stamps_ns.tolist() == [10, 20]
    assert track.nodes.tolist() == [0, 1]
    assert track.deltas[1].tolist() == [4, 5, 3]
    assert track.poses_odom[0].tolist() == [0, 0, 0.5]


def test_bad_files_are_refused_with_the_reason(tmp_path):
    with pytest.raises(StoreError, match="no such map file"):
        MapStore.open(tmp_path)
    (tmp_path / "map.db").write_bytes(b"this is a text of more than a hundred bytes, no database at all" * 4)
    with pytest.raises(StoreError, match="not a map file"):
        MapStore.open(tmp_path)
    with pytest.raises(StoreError, match="map is here already"):
        MapStore.create(tmp_path, "{}", Rig(), "x")
    other = tmp_path / "other.db"
    sqlite3.connect(other).execute("CREATE TABLE t (x)")
    with pytest.raises(StoreError, match="not a map of hybridmap"):
        MapStore.open(other)
    MapStore.create(tmp_path / "v", "{}", Rig(), "x").close()
    with sqlite3.connect(tmp_path / "v" / "map.db") as connection:
        connection.execute("PRAGMA user_version = 99")
    connection.close()
    with pytest.raises(StoreError, match="version 99, expected 4"):
        MapStore.open(tmp_path / "v")


def test_text_that_is_none_and_a_table_that_is_gone_are_damage(tmp_path):
    for change in ("UPDATE sessions SET name = CAST(x'ff' AS TEXT)", "DROP TABLE sessions"):
        folder = write_session(tmp_path / change.split()[0], ring_map(1.0))
        with sqlite3.connect(folder.map_db) as connection:
            connection.execute(change)
        with MapStore.open(folder.path) as store, pytest.raises(StoreError, match=r"damaged.*--overwrite"):
            store.sessions()


def test_reading_changes_nothing(tmp_path):
    write_session(tmp_path / "s", ring_map())
    with MapStore.open(tmp_path / "s") as store, pytest.raises(StoreError, match="cannot write"):
        store.put_info("x", 1)


def test_a_map_file_that_is_gone_while_it_is_written_is_named(tmp_path):
    store = MapStore.create(tmp_path, "{}", Rig(), "x")
    store.put_info("x", 1)
    for file in tmp_path.iterdir():
        file.unlink()
    with pytest.raises(StoreError, match=r"map\.db: cannot write: "):
        store.close()


def test_anchors_come_back_exactly_and_a_later_set_replaces_the_earlier(tmp_path):
    poses = np.array([[0.0, 0, 0], [1.0, 0.2, 0.1]])
    stamps, nodes = np.array([10, 20, 30]), np.array([0, 0, 1])
    anchors = anchors_on(poses, stamps, nodes, np.array([[0.1, 0, 0], [0.7, 0.1, 0.05], [0.01, 0, 0]]))
    with MapStore.create(tmp_path, "{}", Rig(), "x") as store:
        store.put_anchors(anchors_on(poses, stamps + 1, nodes, np.zeros((3, 3))))
        store.put_anchors(anchors)
    with MapStore.open(tmp_path) as store:
        back = store.track().anchors
    for name in ("stamps_ns", "nodes", "next_nodes", "deltas", "next_deltas"):
        np.testing.assert_array_equal(getattr(back, name), getattr(anchors, name))


@pytest.mark.parametrize(
    ("change", "read"),
    [
        ("UPDATE edges SET status = 'x'", "map"),
        ("UPDATE edges SET kind = 'x'", "map"),
        ("UPDATE edges SET target = 1000000", "map"),
        ("UPDATE edges SET target = 'x'", "map"),
        ("UPDATE edges SET covariance = x'00'", "map"),
        ("UPDATE edges SET covariance = zeroblob(72)", "map"),
        ("UPDATE edges SET x_m = 1e300", "map"),
        ("UPDATE edges SET record = '[1]'", "map"),
        ("""UPDATE edges SET record = '{"checks": [["x", "y", "at least", 1]]}'""", "map"),
        ("""UPDATE edges SET record = '{"surprise": 1}'""", "map"),
        ("DELETE FROM edges WHERE number = 3", "map"),
        ("DELETE FROM nodes WHERE number = 3", "map"),
        ("DELETE FROM arrays", "map"),
        ("UPDATE arrays SET shape = '[1000000000000]'", "map"),
        ("UPDATE arrays SET shape = 'x'", "map"),
        ("UPDATE arrays SET dtype = 'O'", "map"),
        ("UPDATE nodes SET odom_x_m = 9e999", "map"),
        ("UPDATE nodes SET travel_m = 'x'", "map"),
        ("UPDATE track SET node = 'x'", "track"),
        ("UPDATE track SET x_m = 9e999", "track"),
        ("UPDATE solutions SET poses = zeroblob(24)", "solutions"),
        ("UPDATE solutions SET poses = zeroblob(7)", "solutions"),
        ("UPDATE solutions SET report = '{}'", "solutions"),
        ("UPDATE solutions SET report = replace(report, 'converged', 'x')", "solutions"),
        ("UPDATE solutions SET report = '[' || report", "solutions"),
        ("DROP TABLE track", "track"),
    ],
)
def test_values_that_no_run_wrote_are_one_error(tmp_path, change, read):
    folder = write_session(tmp_path / "session", ring_map(1.2))
    with sqlite3.connect(folder.path / "map.db") as database:
        database.execute(change)
    with MapStore.open(folder.path) as store, pytest.raises(StoreError, match="map"):
        getattr(store, read)()


def test_a_rig_that_no_run_wrote_is_one_error(tmp_path):
    for k, rig in enumerate(('{"laser": 3}', '{"laser": {"x": 1}}', '{"camera": {"width_px": "x"}}', "[" * 3000)):
        folder = write_session(tmp_path / str(k), ring_map(1.2))
        with sqlite3.connect(folder.path / "map.db") as database:
            database.execute("UPDATE info SET value = ? WHERE key = 'rig'", (rig,))
        with MapStore.open(folder.path) as store, pytest.raises(StoreError, match="damaged"):
            _ = store.rig


def test_an_array_that_is_damaged_is_an_error_that_names_the_file(tmp_path):
    folder = write_session(tmp_path / "session", ring_map(1.2))
    with sqlite3.connect(folder.path / "map.db") as database:
        database.execute("UPDATE arrays SET data = x'00'")
    with MapStore.open(folder.path) as store:
        for read in (store.map, lambda: store.keyframe(0)):
            with pytest.raises(StoreError, match="damaged") as caught:
                read()
            assert str(caught.value).startswith(str(folder.path / "map.db"))


@pytest.mark.parametrize(
    "text",
    [
        "[]",
        "[" * 3000,
        '{"metrics": 3}',
        '{"metrics": [{"name": "a", "value": "x", "unit": "m", "description": "d"}]}',
        '{"metrics": [{"name": 3, "value": 1, "unit": "m", "description": "d"}]}',
        '{"metrics": [], "remarks": 3}',
        '{"metrics": [], "backends": [3]}',
        '{"metrics": [], "reasons": ["x"]}',
        '{"metrics": [], "failed_backends": [3]}',
        '{"metrics": ' + "9" * 6000 + "}",
    ],
)
def test_figures_that_no_run_wrote_are_one_error(tmp_path, text):
    (tmp_path / "metrics.json").write_text(text)
    with pytest.raises(StoreError, match="damaged"):
        SessionFolder(tmp_path).read_metrics()
