"""The map file: everything a session knows, in one SQLite file, written as the run proceeds."""

from __future__ import annotations

import json
import sqlite3
from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager
from functools import update_wrapper
from pathlib import Path
from typing import Any, Concatenate, ParamSpec, Self, TypeVar

import numpy as np
from numpy.typing import NDArray

from hybridmap.backends.base import ODOMETRY, Solution, SolveReport
from hybridmap.config.section import mapping_of
from hybridmap.errors import GeometryError, GraphError, StoreError, quoted
from hybridmap.geometry import Array, RelativePose
from hybridmap.graph.edges import Edge, EdgeKind, Status
from hybridmap.graph.experience_map import ExperienceMap, Node
from hybridmap.store import schema
from hybridmap.store.track import Track
from hybridmap.streams.base import Rig
from hybridmap.trajectory import NO_ANCHORS, Anchors, Trajectory

_KEYFRAME, _SNAPSHOT, _CODE = "keyframe", "snapshot", "code"
_DAMAGE = (ArithmeticError, AttributeError, LookupError, RecursionError, TypeError, ValueError, GeometryError, GraphError)
"""What making something of the values of a damaged file raises."""
_Given = ParamSpec("_Given")
_Found = TypeVar("_Found")


def _reading(
    method: Callable[Concatenate[MapStore, _Given], _Found],
) -> Callable[Concatenate[MapStore, _Given], _Found]:
    """A method that reads; values in the file that are not what `create` wrote become a StoreError."""

    def guarded(self: MapStore, /, *args: _Given.args, **named: _Given.kwargs) -> _Found:
        try:
            return method(self, *args, **named)
        except _DAMAGE as error:
            raise StoreError(
                f"{self.path}: damaged: {quoted(f'{error or type(error).__name__}')[1:-1]}; map the source again"
            ) from None

    return update_wrapper(guarded, method)


class MapStore:
    """A map file, open either for writing (`create`) or for reading (`open`).

    Everything up to the last `commit` survives a killed process; call it once for each node. Usable as a context manager.
    `close` merges SQLite's log into the file, so that one file is left. Reading a damaged file raises a StoreError.
    """

    def __init__(self, path: Path, connection: sqlite3.Connection, *, writable: bool) -> None:
        self._path = path
        self._connection = connection
        self._writable = writable

    @classmethod
    def create(cls, folder: Path, config_yaml: str, rig: Rig, source: str) -> Self:
        """Make the map file of a session folder and open it for writing.

        Args:
            folder: the session folder, or the path of the file itself if it ends in `.db`.
            config_yaml: the resolved configuration.
            rig: the sensors of the stream.
            source: name of what is mapped (`Stream.name`), for people.

        Raises:
            StoreError: a map exists there, or it cannot be written.
        """
        path = _file_of(folder)
        store = cls(path, schema.create(path), writable=True)
        for key, value in (("config_yaml", config_yaml), ("rig", schema.rig_to_json(rig)), ("source", source)):
            store.put_info(key, value)
        store.commit()
        return store

    @classmethod
    def open(cls, folder_or_db: Path) -> Self:
        """Open a map for reading. The run that writes it may have been killed or may still be going on.

        Raises:
            StoreError: the file is missing, is not a map, or is of another version.
        """
        path = _file_of(folder_or_db)
        return cls(path, schema.open_read_only(path), writable=False)

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
            with self._named_errors("write"):
                schema.finish(self._connection)
        else:
            self._connection.close()

    # ------------------------------------------------------------------ writing

    def add_node(
        self,
        number: int,
        node: Node,
        initial: Array,
        keyframe: Mapping[str, NDArray[Any]],
        snapshot: Mapping[str, NDArray[Any]],
    ) -> None:
        """Write a node.

        Args:
            number: number of the node; nodes are numbered from 0, without gaps, in the order in which they were made.
            node: the node.
            initial: (3,) pose in `map` composed along odometry edges, m and rad.
            keyframe: arrays that the front-end keeps of the node's frame, by name.
            snapshot: arrays of the state of the path integrator, by name, for re-anchoring.
        """
        row = (
            number,
            int(node.stamp_ns),
            *_floats(node.pose_odom),
            *_floats(initial),
            int(node.template),
            float(node.travel_m),
        )
        self._write(f"INSERT INTO nodes VALUES ({_marks(len(row))})", row)
        for part, arrays in ((_CODE, {"place": node.place_code}), (_KEYFRAME, keyframe), (_SNAPSHOT, snapshot)):
            self._put_arrays(number, part, arrays)

    def put_snapshot(self, number: int, snapshot: Mapping[str, NDArray[Any]]) -> None:
        """Write the state of the path integrator at a node again, over that which `add_node` wrote."""
        self._put_arrays(number, _SNAPSHOT, snapshot)

    def put_edge(self, number: int, edge: Edge) -> None:
        """Write an edge, whatever its status; replaces what was written under the same number (from 0, without gaps)."""
        measured: tuple[Any, ...] = (None,) * 4
        if edge.relative is not None:
            measured = (*_floats(edge.relative.delta), schema.pack_floats(edge.relative.covariance))
        ends, kind = (int(edge.source), int(edge.target)), EdgeKind(edge.kind).name.lower()
        record = schema.record_to_json(edge)
        row = (number, *ends, kind, str(edge.status), edge.reason, *measured, record, int(edge.since_node))
        self._write(f"INSERT OR REPLACE INTO edges VALUES ({_marks(len(row))})", row)

    def add_track(self, stamp_ns: int, node: int, delta_node_robot: Array, pose_odom: Array) -> None:
        """Write where the robot was at a stamp; replaces what was written for the same stamp.

        Args:
            stamp_ns: the stamp.
            node: the node that the robot was at.
            delta_node_robot: (3,) pose of the robot in the node's frame, m and rad.
            pose_odom: (3,) pose of the robot in `odom`, m and rad.
        """
        row = (int(stamp_ns), int(node), *_floats(delta_node_robot), *_floats(pose_odom))
        self._write(f"INSERT OR REPLACE INTO track VALUES ({_marks(len(row))})", row)

    def replace_odometry(self, track: Track, experiences: ExperienceMap) -> None:
        """Write new poses of the whole track, and of all nodes in `odom` and along odometry edges, over the earlier ones.

        Args:
            track: as read from this file, with other poses; its anchors are not written.
            experiences: the map, with the nodes of this file.
        """
        moved = np.column_stack([track.deltas, track.poses_odom]).tolist()
        columns = "x_m = ?, y_m = ?, yaw_rad = ?, odom_x_m = ?, odom_y_m = ?, odom_yaw_rad = ?"
        for stamp_ns, row in zip(track.stamps_ns.tolist(), moved, strict=True):
            self._write(f"UPDATE track SET {columns} WHERE stamp_ns = ?", (*row, stamp_ns))
        columns = "odom_x_m = ?, odom_y_m = ?, odom_yaw_rad = ?, initial_x_m = ?, initial_y_m = ?, initial_yaw_rad = ?"
        for number, (node, initial) in enumerate(zip(experiences.nodes, experiences.initial, strict=True)):
            self._write(f"UPDATE nodes SET {columns} WHERE number = ?", (*_floats(node.pose_odom), *_floats(initial), number))

    def add_online(self, backend: str, stamp_ns: int, pose_map: Array) -> None:
        """Write the pose (3,) in `map` (m, rad) that a back-end gave at that time; replaces one of the same stamp."""
        self._write("INSERT OR REPLACE INTO online VALUES (?, ?, ?, ?, ?)", (backend, int(stamp_ns), *_floats(pose_map)))

    def put_anchors(self, anchors: Anchors) -> None:
        """Write the poses of frames between nodes that were registered to the final map; replaces earlier ones."""
        self._write("DELETE FROM anchors", ())
        ends = zip(anchors.stamps_ns.tolist(), anchors.nodes.tolist(), anchors.next_nodes.tolist(), strict=True)
        for end, delta, next_delta in zip(ends, anchors.deltas, anchors.next_deltas, strict=True):
            self._write(f"INSERT INTO anchors VALUES ({_marks(9)})", (*end, *_floats(delta), *_floats(next_delta)))

    def put_solution(self, backend: str, poses: Array, report: SolveReport) -> None:
        """Write a back-end's poses (N, 3) and report; replaces an earlier one of the same name."""
        position = self._one("SELECT position FROM solutions WHERE backend = ?", (backend,))
        if position is None:
            position = self._one("SELECT COUNT(*) FROM solutions", ())
        row = (backend, position, schema.pack_floats(poses), schema.report_to_json(report))
        self._write("INSERT OR REPLACE INTO solutions VALUES (?, ?, ?, ?)", row)

    def put_info(self, key: str, value: Any) -> None:
        """Write a value that JSON can hold under a key; `primary_backend` is the key of the primary back-end's name."""
        self._write("INSERT OR REPLACE INTO info VALUES (?, ?)", (key, json.dumps(value)))

    def commit(self) -> None:
        """Make everything written so far survive a killed process.

        Raises:
            StoreError: the file cannot be written.
        """
        with self._named_errors("write"):
            self._connection.commit()

    # ------------------------------------------------------------------ reading

    @property
    def path(self) -> Path:
        """Path of the map file."""
        return self._path

    @property
    def config_yaml(self) -> str:
        """The resolved configuration of the run, as YAML."""
        return str(self.info("config_yaml"))

    @property
    def config_tree(self) -> dict[str, Any]:
        """The resolved configuration of the run, as a nested mapping.

        Raises:
            StoreError: the configuration in the file is damaged.
        """
        return mapping_of(self.config_yaml, f"{self._path}: configuration", StoreError)

    @property
    @_reading
    def rig(self) -> Rig:
        """The sensors of the run."""
        return schema.rig_from_json(self.info("rig"))

    @property
    def source(self) -> str:
        """Name of the file or folder mapped, without its path, or of the simulated world; not to open it again."""
        return str(self.info("source"))

    @property
    @_reading
    def primary(self) -> str:
        """Name of the primary back-end: as the run recorded it, else the first of the configuration, else of the solutions."""
        recorded = self.info("primary_backend")
        if recorded is not None:
            return str(recorded)
        names = (self.config_tree.get("backends") or {}).get("names") or list(self.solutions())
        return str(names[0]) if names else ODOMETRY

    @property
    def ended(self) -> bool:
        """Whether the run that wrote the file came to its end."""
        return self.info("graph_hash") is not None

    @_reading
    def info(self, key: str) -> Any:
        """The value that was written under a key; None if the key is not there."""
        text = self._one("SELECT value FROM info WHERE key = ?", (key,))
        return None if text is None else json.loads(text)

    @_reading
    def map(self) -> ExperienceMap:
        """A new experience map with the nodes and edges of the file, in the order in which they were made."""
        experiences, version = ExperienceMap(), int(self._one("PRAGMA user_version", ()))
        codes = self._of_nodes(_CODE, "place")
        for number, row in enumerate(self._rows("SELECT * FROM nodes ORDER BY number")):
            node = Node(int(row[1]), _pose(row[2:5]), codes[number], int(row[8]), float(row[9]))
            if experiences.add_node(node, _pose(row[5:8])) != row[0]:
                raise ValueError(f"node {number} is missing")
        for number, row in enumerate(self._rows("SELECT * FROM edges ORDER BY number")):
            relative = None if row[9] is None else RelativePose(_pose(row[6:9]), schema.covariance_from_bytes(row[9]))
            kind, status, record = EdgeKind[row[3].upper()], Status(row[4]), schema.record_from_json(row[10], row[5], version)
            edge = Edge(int(row[1]), int(row[2]), kind, status, relative, since_node=int(row[11]), **record)
            if experiences.add_edge(edge) != row[0]:
                raise ValueError(f"edge {number} is missing")
        return experiences

    @_reading
    def keyframe(self, node: int) -> dict[str, NDArray[Any]]:
        """The arrays that the front-end kept of a node's frame, by name; empty for an unknown node."""
        return self._named(node, _KEYFRAME)

    @_reading
    def snapshot(self, node: int) -> dict[str, NDArray[Any]]:
        """The arrays of the state of the path integrator at a node, by name; empty for an unknown node."""
        return self._named(node, _SNAPSHOT)

    @_reading
    def grid_phases(self) -> NDArray[np.float64]:
        """(N, M, 2) phases of the M grid sheets at each node, cycles: a displacement for `neural.vector.GridVectors`."""
        phases = self._of_nodes(_SNAPSHOT, "grid_phases")
        if list(phases) != list(range(self._one("SELECT COUNT(*) FROM nodes", ()))):
            raise ValueError("not every node has grid phases")
        return np.array(list(phases.values()), dtype=np.float64).reshape(len(phases), -1 if phases else 0, 2)

    @_reading
    def track(self) -> Track:
        """Where the robot was at each stamp, seen from nodes, and the frames registered to the final map; it may be empty."""
        rows = self._rows("SELECT * FROM track ORDER BY stamp_ns")
        values = schema.near(np.array([row[2:] for row in rows], dtype=np.float64).reshape(-1, 6))
        ends = np.array([row[:2] for row in rows], dtype=np.int64).reshape(-1, 2)
        return Track(ends[:, 0].copy(), ends[:, 1].copy(), values[:, :3].copy(), values[:, 3:].copy(), self._anchors())

    def _anchors(self) -> Anchors:
        if not self._rows("SELECT name FROM sqlite_master WHERE name = 'anchors'"):
            return NO_ANCHORS
        rows = self._rows("SELECT * FROM anchors ORDER BY stamp_ns")
        values = schema.near(np.array([row[3:] for row in rows], dtype=np.float64).reshape(-1, 6))
        ends = np.array([row[:3] for row in rows], dtype=np.int64).reshape(-1, 3)
        stamps, nodes, after = ends.T.copy()
        return Anchors(stamps, nodes, after, values[:, :3].copy(), values[:, 3:].copy())

    @_reading
    def online(self, backend: str) -> Trajectory:
        """The poses that a back-end gave while driving; an empty trajectory if it gave none."""
        rows = self._rows("SELECT stamp_ns, x_m, y_m, yaw_rad FROM online WHERE backend = ? ORDER BY stamp_ns", (backend,))
        stamps = np.array([row[0] for row in rows], dtype=np.int64)
        return Trajectory(stamps, schema.near(np.array([row[1:] for row in rows], dtype=np.float64).reshape(-1, 3)))

    @_reading
    def online_backends(self) -> list[str]:
        """Names of the back-ends that gave poses while driving, sorted."""
        return [str(row[0]) for row in self._rows("SELECT DISTINCT backend FROM online ORDER BY backend")]

    @_reading
    def solutions(self) -> dict[str, Solution]:
        """Poses and report of every back-end, by name, in the order in which they were first written."""
        rows = self._rows("SELECT backend, poses, report FROM solutions ORDER BY position")
        nodes = self._one("SELECT COUNT(*) FROM nodes", ())
        found = {
            str(name): Solution(schema.unpack_floats(poses, 3), schema.report_from_json(report)) for name, poses, report in rows
        }
        for name, solution in found.items():
            if len(schema.near(solution.poses)) != nodes:
                raise ValueError(f"{name} has {len(solution.poses)} poses, expected one for each of {nodes} nodes")
        return found

    # ------------------------------------------------------------------ plumbing

    def _write(self, statement: str, row: tuple[Any, ...]) -> None:
        with self._named_errors("write"):
            self._connection.execute(statement, row)

    def _put_arrays(self, number: int, part: str, arrays: Mapping[str, NDArray[Any]]) -> None:
        for name, array in arrays.items():
            packed = schema.pack(np.asarray(array))
            fields = (number, part, name, packed.dtype, packed.shape, packed.codec, packed.data)
            self._write(f"INSERT OR REPLACE INTO arrays VALUES ({_marks(len(fields))})", fields)

    def _rows(self, statement: str, values: tuple[Any, ...] = ()) -> list[tuple[Any, ...]]:
        with self._named_errors("read"):
            return self._connection.execute(statement, values).fetchall()

    @contextmanager
    def _named_errors(self, what: str) -> Iterator[None]:
        try:
            yield
        except sqlite3.Error as error:
            raise StoreError(f"{self._path}: cannot {what}: {error}") from None

    def _one(self, statement: str, values: tuple[Any, ...]) -> Any:
        rows = self._rows(statement, values)
        return rows[0][0] if rows else None

    def _of_nodes(self, part: str, name: str) -> dict[int, NDArray[Any]]:
        statement = "SELECT node, dtype, shape, codec, data FROM arrays WHERE part = ? AND name = ? ORDER BY node"
        return {row[0]: schema.unpack(schema.Packed(*row[1:])) for row in self._rows(statement, (part, name))}

    def _named(self, node: int, part: str) -> dict[str, NDArray[Any]]:
        statement = "SELECT name, dtype, shape, codec, data FROM arrays WHERE node = ? AND part = ? ORDER BY name"
        return {row[0]: schema.unpack(schema.Packed(*row[1:])) for row in self._rows(statement, (int(node), part))}


def _file_of(folder_or_db: Path) -> Path:
    path = Path(folder_or_db)
    return path if path.suffix == ".db" and not path.is_dir() else path / schema.MAP_NAME


def _floats(values: Array) -> tuple[float, ...]:
    return tuple(float(value) for value in values)


def _pose(values: tuple[Any, ...]) -> Array:
    """A pose (3,) from its columns."""
    return schema.near(np.array(values, dtype=np.float64))


def _marks(count: int) -> str:
    return ", ".join("?" * count)
