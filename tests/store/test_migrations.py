"""Map files that earlier versions of hybridmap wrote are read, copied and joined as those of today, and stay as they are."""

from __future__ import annotations

import sqlite3
from contextlib import closing
from pathlib import Path

import numpy as np
import pytest

from hybridmap.errors import StoreError
from hybridmap.graph.io import graph_hash
from hybridmap.store import MapStore, migrations, schema
from hybridmap.store.parts import copy_sessions
from hybridmap.streams.base import Rig
from tests.store.sessions import ring_map, write_session

POSE = "x_m REAL NOT NULL, y_m REAL NOT NULL, yaw_rad REAL NOT NULL"
ODOM = "odom_x_m REAL NOT NULL, odom_y_m REAL NOT NULL, odom_yaw_rad REAL NOT NULL"
NEXT = "next_x_m REAL NOT NULL, next_y_m REAL NOT NULL, next_yaw_rad REAL NOT NULL"
SCORED = """number INTEGER PRIMARY KEY, source INTEGER NOT NULL, target INTEGER NOT NULL,
    kind TEXT NOT NULL, status TEXT NOT NULL, reason TEXT NOT NULL,
    x_m REAL, y_m REAL, yaw_rad REAL, covariance BLOB, scores TEXT NOT NULL, since_node INTEGER NOT NULL"""
TABLES_OF_1 = {
    "info": "key TEXT PRIMARY KEY, value TEXT NOT NULL",
    "nodes": f"""number INTEGER PRIMARY KEY, stamp_ns INTEGER NOT NULL, {ODOM}, initial_x_m REAL NOT NULL,
        initial_y_m REAL NOT NULL, initial_yaw_rad REAL NOT NULL, template INTEGER NOT NULL, travel_m REAL NOT NULL""",
    "arrays": """node INTEGER NOT NULL, part TEXT NOT NULL, name TEXT NOT NULL, dtype TEXT NOT NULL, shape TEXT NOT NULL,
        codec TEXT NOT NULL, data BLOB NOT NULL, PRIMARY KEY (node, part, name)""",
    "edges": SCORED,
    "track": f"stamp_ns INTEGER PRIMARY KEY, node INTEGER NOT NULL, {POSE}, {ODOM}",
    "online": f"backend TEXT NOT NULL, stamp_ns INTEGER NOT NULL, {POSE}, PRIMARY KEY (backend, stamp_ns)",
    "solutions": "backend TEXT PRIMARY KEY, position INTEGER NOT NULL, poses BLOB NOT NULL, report TEXT NOT NULL",
}
TABLES_OF_2 = TABLES_OF_1 | {
    "anchors": f"stamp_ns INTEGER PRIMARY KEY, node INTEGER NOT NULL, next_node INTEGER, {POSE}, {NEXT}"
}
TABLES_OF_3 = TABLES_OF_2 | {"edges": SCORED.replace("scores", "record")}
TABLES = {1: TABLES_OF_1, 2: TABLES_OF_2, 3: TABLES_OF_3}
"""The tables as released versions had them."""
SCORES = '\'{"overlap": 0.25, "carried_m": 3.5}\''


def written_by(version: int, folder: Path) -> Path:
    """Write a map as it is written today, and beside it the same as an earlier version wrote it; returns the folder of that."""
    write_session(folder / "new", ring_map())
    old = folder / f"v{version}"
    old.mkdir()
    with closing(sqlite3.connect(old / schema.MAP_NAME)) as connection:
        connection.execute(f"ATTACH '{folder / 'new' / schema.MAP_NAME}' AS new")
        for table, columns in TABLES[version].items():
            connection.execute(f"CREATE TABLE {table} ({columns})")
            names = [row[1] for row in connection.execute(f"PRAGMA main.table_info({table})")]
            values = [f"{SCORES} AS scores" if name == "scores" else name for name in names]
            connection.execute(f"INSERT INTO main.{table} SELECT {', '.join(values)} FROM new.{table}")
        connection.execute(f"PRAGMA application_id = {schema.APPLICATION_ID}")
        connection.execute(f"PRAGMA user_version = {version}")
        connection.commit()
    return old


def test_every_version_leads_to_the_next():
    assert list(migrations.STEPS) == list(range(1, schema.VERSION))
    assert list(TABLES) == list(migrations.STEPS)


@pytest.mark.parametrize("version", list(TABLES))
def test_a_map_of_an_earlier_version_reads_as_the_newest_and_is_not_changed(tmp_path, version):
    old = written_by(version, tmp_path)
    before = (old / schema.MAP_NAME).read_bytes()
    with MapStore.open(tmp_path / "new") as new, MapStore.open(old) as store:
        store.check()
        assert graph_hash(store.map()) == graph_hash(new.map())
        assert store.sessions() == [] or [one.number for one in store.sessions()] == [0]
        assert store.source == new.source == store.sessions()[0].source
        np.testing.assert_array_equal(store.track().odometry.poses, new.track().odometry.poses)
        assert len(store.track().anchors) == (0 if version == 1 else len(new.track().anchors))
        assert store.solutions().keys() == new.solutions().keys()
        assert store.online_backends() == new.online_backends()
        assert store.info("graph_hash") == new.info("graph_hash")
        assert store.state(0) == {}
        for table in ("nodes", "arrays", "track", "online", "solutions"):
            assert store.rows(f"SELECT * FROM {table} ORDER BY 1, 2, 3") == new.rows(f"SELECT * FROM {table} ORDER BY 1, 2, 3")
    assert [path.name for path in old.iterdir()] == [schema.MAP_NAME]
    assert (old / schema.MAP_NAME).read_bytes() == before


@pytest.mark.parametrize("version", list(TABLES))
def test_what_is_written_from_a_map_of_an_earlier_version_is_of_the_newest(tmp_path, version):
    """As `edit`, `merge` and `map --onto` write it: its edges keep the reasons and figures that were stored."""
    old = written_by(version, tmp_path)
    with MapStore.open(old) as store, MapStore.create(tmp_path / "out", "{}", Rig(), "x") as target:
        copy_sessions(store, target)
        expected = store.map()
    with MapStore.open(tmp_path / "out") as store:
        assert store.one("PRAGMA user_version") == schema.VERSION
        found = store.map()
        assert graph_hash(found) == graph_hash(expected)
        assert [edge.reason for edge in found.edges] == [edge.reason for edge in expected.edges]
        assert [(edge.figures, edge.checks) for edge in found.edges] == [(edge.figures, edge.checks) for edge in expected.edges]
    if version < 3:
        last = found.edges[-1]
        assert (last.figures, last.kidnapped_m, last.checks) == ({"overlap": 0.25}, 3.5, ())
        with MapStore.open(old) as store:
            assert last.reason == store.one("SELECT reason FROM edges ORDER BY number DESC")


def test_a_map_of_an_earlier_version_is_not_written_on(tmp_path):
    with pytest.raises(StoreError, match="map of version 3, expected 4; map the source again with this hybridmap"):
        MapStore.resume(written_by(3, tmp_path))


@pytest.mark.parametrize("version", [0, -1, schema.VERSION + 1, 2**31 - 1])
def test_a_map_of_an_unknown_version_is_refused(tmp_path, version):
    old = written_by(3, tmp_path)
    with closing(sqlite3.connect(old / schema.MAP_NAME)) as connection:
        connection.execute(f"PRAGMA user_version = {version}")
        connection.commit()
    with pytest.raises(StoreError, match=f"map of version {version}, expected {schema.VERSION}"):
        MapStore.open(old)
