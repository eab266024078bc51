"""Rows and arrays of a map file: what reading and writing its tables needs, whatever is in them."""

from __future__ import annotations

import json
import sqlite3
from collections.abc import Iterable, Iterator, Mapping
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Self

import numpy as np
from numpy.typing import NDArray

from hybridmap.errors import StoreError
from hybridmap.geometry import Array
from hybridmap.store import schema

BROKEN_OFF = "broken_off"
"""Key of why a run was broken off."""
LIVE = "live"
"""Key that is there if the drive was mapped live, so that nobody can give its samples another time."""

_DAMAGED = (None, sqlite3.SQLITE_ERROR, sqlite3.SQLITE_CORRUPT, sqlite3.SQLITE_NOTADB)
"""Codes of errors in reading that come from what is in the file; text that is none has no code."""


@dataclass(frozen=True, slots=True)
class Mark:
    """How far a map file of one session is written.

    Attributes:
        nodes: number of nodes.
        last_ns: newest stamp of the track, ns; -1 if there is none.
        info: rows of the table `info`.
    """

    nodes: int
    last_ns: int
    info: tuple[tuple[Any, ...], ...]


class Tables:
    """The tables of a map file, through one connection. Errors of SQLite become a StoreError that names the file.

    Usable as a context manager.
    """

    def __init__(self, path: Path, connection: sqlite3.Connection, *, writable: bool) -> None:
        self._path = path
        self._connection = connection
        self._writable = writable

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()

    def close(self) -> None:
        """Commit what was written and close; it may be called twice.

        Raises:
            StoreError: the file cannot be written.
        """
        if self._writable:
            self._writable = False
            with self.named_errors("write"):
                schema.finish(self._connection)
        else:
            self._connection.close()

    @property
    def path(self) -> Path:
        """Path of the map file."""
        return self._path

    @property
    def nodes(self) -> int:
        """Number of nodes."""
        last = self.one("SELECT MAX(number) FROM nodes")
        return 0 if last is None else int(last) + 1

    @contextmanager
    def at_one_moment(self) -> Iterator[None]:
        """Where this only reads, read all that is asked for as of one moment: what another writes meanwhile is not seen."""
        if self._writable or self._connection.in_transaction:
            yield
            return
        with self.named_errors("read"):
            self._connection.execute("BEGIN")
        try:
            yield
        finally:
            self._connection.rollback()

    def commit(self) -> None:
        """Make everything written so far survive a killed process.

        Raises:
            StoreError: the file cannot be written.
        """
        with self.named_errors("write"):
            self._connection.commit()

    def sync(self) -> None:
        """Commit, and make everything written so far survive a power loss, as far as readers leave the log free.

        Raises:
            StoreError: the file cannot be written.
        """
        self.commit()
        self.rows("PRAGMA wal_checkpoint(PASSIVE)")

    def break_off(self, reason: str) -> None:
        """Forget what was written since the last `commit`, and write why the run was broken off.

        Raises:
            StoreError: the file cannot be written.
        """
        with self.named_errors("write"):
            self._connection.rollback()
        self.write("INSERT OR REPLACE INTO info VALUES (?, ?, ?)", (schema.WHOLE, BROKEN_OFF, json.dumps(reason)))
        self.commit()

    def check(self) -> None:
        """Check that the file is whole; this reads all of it.

        Raises:
            StoreError: it is damaged.
        """
        schema.check(self._connection, self._path)

    def mark(self) -> Mark:
        """What there is now, to which `rewind` comes back."""
        last_ns = self.one("SELECT MAX(stamp_ns) FROM track")
        return Mark(self.nodes, -1 if last_ns is None else int(last_ns), tuple(self.rows("SELECT * FROM info ORDER BY 1, 2")))

    def rewind(self, mark: Mark) -> None:
        """Come back to what there was at a mark, but for the edges: they are removed, to be written again.

        Raises:
            StoreError: the file cannot be written.
        """
        for table, column, first in (
            ("nodes", "number", mark.nodes),
            ("arrays", "node", mark.nodes),
            ("track", "stamp_ns", mark.last_ns + 1),
            ("online", "stamp_ns", mark.last_ns + 1),
        ):
            self.write(f"DELETE FROM {table} WHERE {column} >= ?", (first,))
        for table in ("edges", "anchors", "solutions", "info"):
            self.write(f"DELETE FROM {table}", ())
        self.write_rows("info", mark.info)

    def write(self, statement: str, row: tuple[Any, ...]) -> None:
        """Run a statement that writes one row."""
        with self.named_errors("write"):
            self._connection.execute(statement, row)

    def write_rows(self, table: str, rows: Iterable[tuple[Any, ...]]) -> None:
        """Append whole rows to a table."""
        with self.named_errors("write"):
            for row in rows:
                self._connection.execute(f"INSERT INTO {table} VALUES ({marks(len(row))})", row)

    def put_arrays(self, number: int, part: str, arrays: Mapping[str, NDArray[Any]]) -> None:
        """Write arrays of a node, by name, over those of the same part and name."""
        for name, array in arrays.items():
            packed = schema.pack(np.asarray(array))
            fields = (number, part, name, packed.dtype, packed.shape, packed.codec, packed.data)
            self.write(f"INSERT OR REPLACE INTO arrays VALUES ({marks(len(fields))})", fields)

    def rows(self, statement: str, values: tuple[Any, ...] = ()) -> list[tuple[Any, ...]]:
        """All rows that a query gives."""
        with self.named_errors("read"):
            return self._connection.execute(statement, values).fetchall()

    def each_row(self, statement: str, values: tuple[Any, ...] = ()) -> Iterator[tuple[Any, ...]]:
        """The rows that a query gives, one by one: for those that are many and large."""
        with self.named_errors("read"):
            yield from self._connection.execute(statement, values)

    def one(self, statement: str, values: tuple[Any, ...] = ()) -> Any:
        """The first value that a query gives; None if it gives none."""
        rows = self.rows(statement, values)
        return rows[0][0] if rows else None

    def arrays_of_nodes(self, part: str, name: str) -> dict[int, NDArray[Any]]:
        """Node -> its array of a part and name, for the nodes that have it, ascending."""
        statement = "SELECT node, dtype, shape, codec, data FROM arrays WHERE part = ? AND name = ? ORDER BY node"
        return {row[0]: schema.unpack(schema.Packed(*row[1:])) for row in self.rows(statement, (part, name))}

    def arrays_of_node(self, node: int, part: str) -> dict[str, NDArray[Any]]:
        """Name -> array of a part of one node."""
        statement = "SELECT name, dtype, shape, codec, data FROM arrays WHERE node = ? AND part = ? ORDER BY name"
        return {row[0]: schema.unpack(schema.Packed(*row[1:])) for row in self.rows(statement, (int(node), part))}

    @contextmanager
    def named_errors(self, what: str) -> Iterator[None]:
        """Context in which an error of SQLite becomes a StoreError: that the file cannot be read, or written (`what`)."""
        try:
            yield
        except sqlite3.Error as error:
            damaged = what == "read" and getattr(error, "sqlite_errorcode", None) in _DAMAGED
            after = f"; it is damaged: {schema.AGAIN}" if damaged and not isinstance(error, sqlite3.ProgrammingError) else ""
            raise StoreError(f"{self._path}: cannot {what}: {error}{after}") from None


def floats(values: Array) -> tuple[float, ...]:
    """The columns of numbers, such as a pose."""
    return tuple(float(value) for value in values)


def marks(count: int) -> str:
    """So many placeholders of a statement."""
    return ", ".join("?" * count)
