"""The layout of a map file, and how one is opened."""

from __future__ import annotations

import sqlite3
from contextlib import closing
from pathlib import Path

from hybridmap.errors import StoreError

VERSION = 3
"""Raised whenever the tables change."""

READABLE = (1, 2, 3)
"""Versions that can be read; a file of another one is refused. Version 1 has no anchors; before version 3 an edge had figures
and a reason in words, but no record of its checks."""

APPLICATION_ID = 0x68796D70
"""Marks the SQLite file as a map (`hymp`)."""

MAP_NAME = "map.db"

TABLES = """
CREATE TABLE info (key TEXT PRIMARY KEY, value TEXT NOT NULL) WITHOUT ROWID;
CREATE TABLE nodes (
    number INTEGER PRIMARY KEY, stamp_ns INTEGER NOT NULL,
    odom_x_m REAL NOT NULL, odom_y_m REAL NOT NULL, odom_yaw_rad REAL NOT NULL,
    initial_x_m REAL NOT NULL, initial_y_m REAL NOT NULL, initial_yaw_rad REAL NOT NULL,
    template INTEGER NOT NULL, travel_m REAL NOT NULL);
CREATE TABLE arrays (
    node INTEGER NOT NULL, part TEXT NOT NULL, name TEXT NOT NULL,
    dtype TEXT NOT NULL, shape TEXT NOT NULL, codec TEXT NOT NULL, data BLOB NOT NULL,
    PRIMARY KEY (node, part, name));
CREATE TABLE edges (
    number INTEGER PRIMARY KEY, source INTEGER NOT NULL, target INTEGER NOT NULL,
    kind TEXT NOT NULL, status TEXT NOT NULL, reason TEXT NOT NULL,
    x_m REAL, y_m REAL, yaw_rad REAL, covariance BLOB, record TEXT NOT NULL,
    since_node INTEGER NOT NULL);
CREATE TABLE track (
    stamp_ns INTEGER PRIMARY KEY, node INTEGER NOT NULL,
    x_m REAL NOT NULL, y_m REAL NOT NULL, yaw_rad REAL NOT NULL,
    odom_x_m REAL NOT NULL, odom_y_m REAL NOT NULL, odom_yaw_rad REAL NOT NULL);
CREATE TABLE anchors (
    stamp_ns INTEGER PRIMARY KEY, node INTEGER NOT NULL, next_node INTEGER NOT NULL,
    x_m REAL NOT NULL, y_m REAL NOT NULL, yaw_rad REAL NOT NULL,
    next_x_m REAL NOT NULL, next_y_m REAL NOT NULL, next_yaw_rad REAL NOT NULL);
CREATE TABLE online (
    backend TEXT NOT NULL, stamp_ns INTEGER NOT NULL,
    x_m REAL NOT NULL, y_m REAL NOT NULL, yaw_rad REAL NOT NULL,
    PRIMARY KEY (backend, stamp_ns)) WITHOUT ROWID;
CREATE TABLE solutions (backend TEXT PRIMARY KEY, position INTEGER NOT NULL, poses BLOB NOT NULL, report TEXT NOT NULL);
"""


def create(path: Path) -> sqlite3.Connection:
    """Make an empty map file and open it for writing.

    A write-ahead log keeps every committed node readable should the process be killed, without a disk sync for each,
    and lets others read along.

    Raises:
        StoreError: there is a file already, or it cannot be written.
    """
    if path.exists():
        raise StoreError(f"{path}: a map is here already; choose another folder or overwrite it")
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
        connection = sqlite3.connect(path)
        connection.execute("PRAGMA journal_mode = WAL")
        connection.execute("PRAGMA synchronous = NORMAL")
        connection.executescript(TABLES)
        connection.execute(f"PRAGMA application_id = {APPLICATION_ID}")
        connection.execute(f"PRAGMA user_version = {VERSION}")
        connection.commit()
    except (sqlite3.Error, OSError) as error:
        raise StoreError(f"{path}: cannot write a map here: {error}") from None
    return connection


def open_read_only(path: Path) -> sqlite3.Connection:
    """Open a map file without changing it.

    Raises:
        StoreError: missing, not a map, or of another version.
    """
    if not path.is_file():
        raise StoreError(f"{path}: no such map file; expected a session folder, as `hybridmap map SOURCE --out DIR` writes it")
    try:
        connection = sqlite3.connect(f"{path.resolve().as_uri()}?mode=ro", uri=True)
        application = connection.execute("PRAGMA application_id").fetchone()[0]
        version = connection.execute("PRAGMA user_version").fetchone()[0]
    except sqlite3.Error as error:
        raise StoreError(f"{path}: not a map file: {error}") from None
    if application != APPLICATION_ID:
        connection.close()
        raise StoreError(f"{path}: an SQLite file, but not a map of hybridmap")
    if version not in READABLE:
        connection.close()
        raise StoreError(f"{path}: map of version {version}, expected {VERSION}; map the source again with this hybridmap")
    return connection


def finish(connection: sqlite3.Connection) -> None:
    """Commit, fold the write-ahead log into the file and close: one file is left, unless somebody reads it just now."""
    with closing(connection):
        connection.commit()
        connection.execute("PRAGMA wal_checkpoint(TRUNCATE)")
        try:
            connection.execute("PRAGMA journal_mode = DELETE")
        except sqlite3.OperationalError as error:
            if error.sqlite_errorcode != sqlite3.SQLITE_BUSY:
                raise
            # somebody has the log open: with it the file is whole, and the session must not fail for a reader
