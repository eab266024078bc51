"""A copy of a map's files, taken at any moment, opens and holds a beginning of the map: so does what a power loss leaves."""

from __future__ import annotations

import shutil
import sqlite3
from pathlib import Path

import numpy as np
import pytest

from hybridmap.errors import StoreError
from hybridmap.graph.experience_map import Node
from hybridmap.store import MapStore, SessionFolder
from hybridmap.store.schema import MAP_NAME, VERSION
from hybridmap.streams.base import Rig


def write_node(store: MapStore, number: int) -> None:
    """Write a node whose number can be told from all of its parts; it is not committed."""
    rng = np.random.default_rng(number)
    node = Node(number * 10, np.array([number, 0.0, 0.0]), np.zeros(4, dtype=np.float32), 0, float(number))
    store.add_node(number, node, np.zeros(3), {"ranges_m": rng.normal(size=300)}, {})
    store.add_track(number * 10, number, np.zeros(3), np.zeros(3))


def copied(folder: Path, to: Path, wal_bytes: int | None = None) -> None:
    """Copy the map and its log, of the log only so many bytes."""
    to.mkdir()
    for name in (MAP_NAME, f"{MAP_NAME}-wal"):
        if (folder / name).is_file():
            shutil.copy(folder / name, to / name)
    if wal_bytes is not None and (to / f"{MAP_NAME}-wal").is_file():
        with (to / f"{MAP_NAME}-wal").open("r+b") as log:
            log.truncate(wal_bytes)


def check_beginning(folder: Path, least: int) -> int:
    """Check that a map is whole and holds the first nodes; returns how many."""
    with MapStore.open(folder) as store:
        store.check()
        nodes = store.nodes
        assert [int(row[0]) for row in store.rows("SELECT number FROM nodes ORDER BY number")] == list(range(nodes))
        for number in range(nodes):
            rng = np.random.default_rng(number)
            np.testing.assert_array_equal(store.keyframe(number)["ranges_m"], rng.normal(size=300))
    assert nodes >= least
    return nodes


def test_a_copy_taken_at_any_moment_has_every_committed_node(tmp_path):
    with MapStore.create(tmp_path / "s", "{}", Rig(), "drive") as store:
        for number in range(60):
            write_node(store, number)
            copied(tmp_path / "s", tmp_path / f"within{number}")  # in the middle of the node
            check_beginning(tmp_path / f"within{number}", number)
            store.commit()
            if number % 20 == 7:
                store.sync()
            copied(tmp_path / "s", tmp_path / f"after{number}")
            assert check_beginning(tmp_path / f"after{number}", number + 1) == number + 1


def test_a_log_that_was_not_all_written_costs_the_newest_nodes_only(tmp_path):
    rng, synced = np.random.default_rng(0), 20
    with MapStore.create(tmp_path / "s", "{}", Rig(), "drive") as store:
        for number in range(40):
            write_node(store, number)
            store.commit()
            if number == synced - 1:
                store.sync()
        size = (tmp_path / "s" / f"{MAP_NAME}-wal").stat().st_size
        for trial, left in enumerate([0, size, *rng.integers(0, size, 30).tolist()]):
            copied(tmp_path / "s", tmp_path / f"cut{trial}", left)
            check_beginning(tmp_path / f"cut{trial}", synced)


def test_a_damaged_map_of_a_run_that_did_not_end_is_found_when_it_is_opened(tmp_path):
    store = MapStore.create(tmp_path / "s", "{}", Rig(), "drive")
    for number in range(60):
        write_node(store, number)
    store.close()
    SessionFolder(tmp_path / "s").require()
    path = tmp_path / "s" / MAP_NAME
    content = bytearray(path.read_bytes())
    content[len(content) // 2 : len(content) // 2 + 6000] = bytes(6000)
    path.write_bytes(content)
    with pytest.raises(StoreError, match=r"map\.db: damaged"):
        SessionFolder(tmp_path / "s").require()
    with pytest.raises(StoreError, match=r"map\.db: damaged"):
        MapStore.resume(tmp_path / "s")


def test_a_map_of_a_newer_version_says_what_to_do(tmp_path):
    MapStore.create(tmp_path / "s", "{}", Rig(), "drive").close()
    with sqlite3.connect(tmp_path / "s" / MAP_NAME) as connection:
        connection.execute(f"PRAGMA user_version = {VERSION + 1}")
    with pytest.raises(StoreError, match=rf"version {VERSION + 1}, expected {VERSION}; a newer hybridmap wrote it"):
        MapStore.open(tmp_path / "s")
