"""The layout of a map file, how one is opened, and how arrays and sensor mountings are packed without loss."""

from __future__ import annotations

import json
import math
import sqlite3
import zlib
from contextlib import closing
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from hybridmap.errors import StoreError
from hybridmap.store import migrations
from hybridmap.streams.cameras import decode_picture
from hybridmap.trajectory import FARTHEST_M

VERSION = migrations.NEWEST
"""Raised whenever the tables change, with a step in `migrations.STEPS` that leads there."""

WHOLE = -1
"""Session number of what is said of the map as a whole: its solutions, and its facts (`info`). Under the number of a session
stand those that it had before it was joined to others."""

APPLICATION_ID = 0x68796D70
"""Marks the SQLite file as a map (`hymp`)."""

MAP_NAME = "map.db"

AGAIN = "map the source again, into the same folder with --overwrite"
"""What to do about a damaged map."""

RATSLAM_ACTIONS = "ratslam_actions"
"""Key of the TopologicalActions that an imported map was made of: [sample of the track, stamp ns, action, src, dest, rad]."""
DURATION_S = "duration_s"
"""Figure of an edge: the duration that was recorded of an imported link."""

TABLES = """
CREATE TABLE sessions (
    number INTEGER PRIMARY KEY, first_node INTEGER NOT NULL, name TEXT NOT NULL, source TEXT NOT NULL,
    x_m REAL NOT NULL, y_m REAL NOT NULL, yaw_rad REAL NOT NULL);
CREATE TABLE info (
    session INTEGER NOT NULL, key TEXT NOT NULL, value TEXT NOT NULL, PRIMARY KEY (session, key)) WITHOUT ROWID;
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
    session INTEGER NOT NULL, stamp_ns INTEGER NOT NULL, node INTEGER NOT NULL,
    x_m REAL NOT NULL, y_m REAL NOT NULL, yaw_rad REAL NOT NULL,
    odom_x_m REAL NOT NULL, odom_y_m REAL NOT NULL, odom_yaw_rad REAL NOT NULL,
    PRIMARY KEY (session, stamp_ns)) WITHOUT ROWID;
CREATE TABLE anchors (
    session INTEGER NOT NULL, stamp_ns INTEGER NOT NULL, node INTEGER NOT NULL, next_node INTEGER NOT NULL,
    x_m REAL NOT NULL, y_m REAL NOT NULL, yaw_rad REAL NOT NULL,
    next_x_m REAL NOT NULL, next_y_m REAL NOT NULL, next_yaw_rad REAL NOT NULL,
    PRIMARY KEY (session, stamp_ns)) WITHOUT ROWID;
CREATE TABLE online (
    session INTEGER NOT NULL, backend TEXT NOT NULL, stamp_ns INTEGER NOT NULL,
    x_m REAL NOT NULL, y_m REAL NOT NULL, yaw_rad REAL NOT NULL,
    PRIMARY KEY (session, backend, stamp_ns)) WITHOUT ROWID;
CREATE TABLE solutions (
    session INTEGER NOT NULL, backend TEXT NOT NULL, position INTEGER NOT NULL, poses BLOB NOT NULL, report TEXT NOT NULL,
    PRIMARY KEY (session, backend));
"""


def create(path: Path) -> sqlite3.Connection:
    """Make an empty map file and open it for writing.

    A write-ahead log keeps every committed node readable if the process is killed, without a disk sync for each, and lets
    other processes read at the same time.

    Raises:
        StoreError: the file exists, or it cannot be written.
    """
    if path.exists():
        raise StoreError(f"{path}: a map is here already; choose another folder or overwrite it")
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
        connection = sqlite3.connect(path)
        _set_up(connection)
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
        StoreError: the file is missing, is not a map, or is of another version.
    """
    connection, version = _opened(path, "ro", (*migrations.STEPS, VERSION))
    migrations.see_as_newest(connection, version)
    return connection


def open_to_write(path: Path) -> sqlite3.Connection:
    """Open a map file of this version to write on, and check that it is whole.

    Raises:
        StoreError: the file is missing, is not a map, is damaged, or is of another version.
    """
    connection, _ = _opened(path, "rw", (VERSION,))
    try:
        check(connection, path)
        _set_up(connection)
    except BaseException:
        connection.close()
        raise
    return connection


def check(connection: sqlite3.Connection, path: Path) -> None:
    """Check that a map file is whole; this reads all of it.

    Raises:
        StoreError: it is damaged.
    """
    try:
        found = str(connection.execute("PRAGMA quick_check(1)").fetchone()[0])
    except sqlite3.Error as error:
        found = str(error)
    if found != "ok":
        raise StoreError(f"{path}: damaged: {' '.join(found.split())}; {AGAIN}")


def _opened(path: Path, mode: str, versions: tuple[int, ...]) -> tuple[sqlite3.Connection, int]:
    """Open a map file of one of these versions in a mode of SQLite; returns its version, too."""
    if not path.is_file():
        raise StoreError(f"{path}: no such map file; expected a session folder, as `hybridmap map SOURCE --out DIR` writes it")
    if path.stat().st_size == 0:
        raise StoreError(f"{path}: is empty; {AGAIN}")
    try:
        connection = sqlite3.connect(f"{path.resolve().as_uri()}?mode={mode}", uri=True)
        application = connection.execute("PRAGMA application_id").fetchone()[0]
        version = connection.execute("PRAGMA user_version").fetchone()[0]
    except sqlite3.Error as error:
        if error.sqlite_errorcode & 0xFF == sqlite3.SQLITE_CANTOPEN and path.with_name(f"{path.name}-wal").exists():
            raise StoreError(
                f"{path}: its run did not end, and its log cannot be looked through here ({error}); copy the whole session"
                " folder to where it can be written to"
            ) from None
        raise StoreError(
            f"{path}: not a map file ({error}); expected one that `hybridmap map` wrote; if it is damaged, {AGAIN}"
        ) from None
    if application != APPLICATION_ID:
        connection.close()
        raise StoreError(f"{path}: an SQLite file, but not a map of hybridmap; expected the one in a session folder")
    if version not in versions:
        connection.close()
        newer = "a newer hybridmap wrote it: use that one" if version > VERSION else "map the source again with this hybridmap"
        raise StoreError(f"{path}: map of version {version}, expected {VERSION}; {newer}")
    return connection, version


def _set_up(connection: sqlite3.Connection) -> None:
    """Set how a map is written: see `create`."""
    connection.execute("PRAGMA journal_mode = WAL")
    connection.execute("PRAGMA synchronous = NORMAL")


def finish(connection: sqlite3.Connection) -> None:
    """Commit, merge the write-ahead log into the file and close. One file is left, unless another process is reading it.

    Raises:
        sqlite3.Error: the file cannot be written.
    """
    with closing(connection):
        connection.commit()
        connection.execute("PRAGMA wal_checkpoint(TRUNCATE)")
        try:
            connection.execute("PRAGMA journal_mode = DELETE")
        except sqlite3.OperationalError as error:
            if error.sqlite_errorcode != sqlite3.SQLITE_BUSY:
                raise
            # somebody has the log open: with it the file is whole, and the session must not fail for a reader


_PNG_LEVEL = 1
_ZLIB_LEVEL = 1


@dataclass(frozen=True, slots=True)
class Packed:
    """An array as the map file keeps it: little-endian bytes (`zlib`) or an image (`png`).

    Attributes:
        dtype: numpy's name of the type, such as `<f4`.
        shape: JSON list.
        codec: `zlib` or `png`.
        data: compressed bytes.
    """

    dtype: str
    shape: str
    codec: str
    data: bytes


def pack(array: NDArray[Any]) -> Packed:
    """Compress an array without loss; images of 8 or 16 bits become PNG, the rest zlib. Same array, same bytes."""
    little = np.ascontiguousarray(array.astype(array.dtype.newbyteorder("<"), copy=False))
    shape = json.dumps(list(array.shape))
    if _is_image(little):
        import cv2

        pixels = little[..., ::-1] if little.ndim == 3 else little
        _, data = cv2.imencode(".png", pixels, [cv2.IMWRITE_PNG_COMPRESSION, _PNG_LEVEL])
        return Packed(little.dtype.str, shape, "png", data.tobytes())
    return Packed(little.dtype.str, shape, "zlib", zlib.compress(little.tobytes(), _ZLIB_LEVEL))


def unpack(packed: Packed) -> NDArray[Any]:
    """Return the array that `pack` packed.

    Raises:
        ValueError: the bytes are damaged.
    """
    try:
        return _unpack(packed)
    except (zlib.error, ArithmeticError, LookupError, TypeError, ValueError) as error:
        raise ValueError(f"an array cannot be unpacked: {error}") from None


_MOST_BYTES = 1 << 28
"""Size of an unpacked array; a few bytes of a damaged file may unpack to gigabytes."""


def _unpack(packed: Packed) -> NDArray[Any]:
    dtype, shape = np.dtype(packed.dtype), tuple(json.loads(packed.shape))
    size = dtype.itemsize * math.prod(shape)
    if dtype.kind not in "biuf" or not 0 <= size <= _MOST_BYTES or min(shape, default=0) < 0:
        raise ValueError(f"found {packed.dtype} of shape {packed.shape}, expected numbers, at most {_MOST_BYTES} bytes")
    if packed.codec == "png":
        import cv2

        pixels = decode_picture(packed.data, cv2.IMREAD_UNCHANGED)
        return np.ascontiguousarray(pixels[..., ::-1] if pixels.ndim == 3 else pixels).astype(dtype, copy=False).reshape(shape)
    return np.frombuffer(zlib.decompressobj().decompress(packed.data, size + 1), dtype).reshape(shape).copy()


def _is_image(array: NDArray[Any]) -> bool:
    grey_or_rgb = array.ndim == 2 or (array.ndim == 3 and array.shape[2] == 3)
    return array.dtype.str in ("|u1", "<u2") and grey_or_rgb and min(array.shape) > 0


def pack_floats(values: NDArray[np.float64]) -> bytes:
    """Return the values as little-endian float64 bytes, row by row; the shape is not kept."""
    return np.ascontiguousarray(values, dtype="<f8").tobytes()


def unpack_floats(data: bytes, columns: int) -> NDArray[np.float64]:
    """Return the array that `pack_floats` packed, as float64 of shape (-1, columns).

    Raises:
        ValueError: the bytes are no whole rows.
    """
    return np.frombuffer(data, "<f8").astype(np.float64).reshape(-1, columns)


def near(values: NDArray[np.float64]) -> NDArray[np.float64]:
    """The numbers of any shape, if they are poses.

    Raises:
        ValueError: one is not finite, or too large for a pose in metres.
    """
    if not (np.abs(values) <= FARTHEST_M).all():
        raise ValueError(f"a pose with NaN, Inf or a number beyond {FARTHEST_M:g}")
    return values


def covariance_from_bytes(data: bytes) -> NDArray[np.float64]:
    """The covariance (3, 3) that `pack_floats` packed.

    Raises:
        ValueError: it is none.
    """
    covariance = unpack_floats(data, 3)
    if covariance.shape != (3, 3) or not np.isfinite(covariance).all() or not (np.diagonal(covariance) > 0.0).all():
        raise ValueError("a covariance that is none")
    return covariance
