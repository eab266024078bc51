"""The map file: everything a session knows, in one SQLite file, written as the run proceeds."""

from __future__ import annotations

import json
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from functools import update_wrapper
from pathlib import Path
from typing import Any, Concatenate, ParamSpec, Self, TypeVar

import numpy as np
from numpy.typing import NDArray

from hybridmap.backends.base import ODOMETRY, Solution, SolveReport
from hybridmap.config.section import mapping_of
from hybridmap.errors import GeometryError, GraphError, StoreError, quoted
from hybridmap.geometry import Array, RelativePose, compose
from hybridmap.graph.edges import Edge, EdgeKind, Status
from hybridmap.graph.experience_map import ExperienceMap, Node
from hybridmap.store import records, schema
from hybridmap.store.tables import BROKEN_OFF, Tables, floats, marks
from hybridmap.store.track import Track
from hybridmap.streams.base import Rig
from hybridmap.trajectory import Anchors, Trajectory

_KEYFRAME, _SNAPSHOT, _CODE, _STATE = "keyframe", "snapshot", "code", "state"
_DAMAGE = (ArithmeticError, AttributeError, LookupError, RecursionError, TypeError, ValueError, GeometryError, GraphError)
"""What making something of the values of a damaged file raises."""
NOTHING: Mapping[str, NDArray[Any]] = {}
_Given = ParamSpec("_Given")
_Found = TypeVar("_Found")


NEWEST = -1
"""Stands for the session that was added last."""


@dataclass(frozen=True, slots=True)
class StoredSession:
    """A session of a map file.

    Attributes:
        number: from 0.
        first_node: its first node; it ends before the first node of the next session.
        name, source: what it is called, and what was mapped, for people.
        pose_map_session: (3,) its frame, in which its poses by odometry are kept, on the map, m and rad. The frame of a session
            that is not joined to the first one is a frame of its own.
    """

    number: int
    first_node: int
    name: str
    source: str
    pose_map_session: Array


def _reading(
    method: Callable[Concatenate[MapStore, _Given], _Found],
) -> Callable[Concatenate[MapStore, _Given], _Found]:
    """A method that reads the file as it is at one moment, also while it is written by another.

    Values in the file that are not what `create` wrote become a StoreError.
    """

    def guarded(self: MapStore, /, *args: _Given.args, **named: _Given.kwargs) -> _Found:
        try:
            with self.at_one_moment():
                return method(self, *args, **named)
        except _DAMAGE as error:
            raise StoreError(
                f"{self.path}: damaged: {quoted(f'{error or type(error).__name__}')[1:-1]}; {schema.AGAIN}"
            ) from None

    return update_wrapper(guarded, method)


class MapStore(Tables):
    """A map file, open either for writing (`create`) or for reading (`open`).

    Everything up to the last `commit` survives a killed process; call it once for each node. Usable as a context manager.
    `close` merges SQLite's log into the file, so that one file is left. Reading a damaged file raises a StoreError.
    """

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
        name = source.encode("utf-8", "backslashreplace").decode("utf-8")  # the bytes of a file's name need not be UTF-8
        store.write_rows("sessions", [(0, 0, name, name, 0.0, 0.0, 0.0)])
        for key, value in (("config_yaml", config_yaml), ("rig", records.rig_to_json(rig)), ("source", source)):
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

    @classmethod
    def resume(cls, folder: Path) -> Self:
        """Open the map of a session whose run did not end, to write on.

        Raises:
            StoreError: the file is missing, is not a map, is damaged, or is of another version.
        """
        path = _file_of(folder)
        return cls(path, schema.open_to_write(path), writable=True)

    # ------------------------------------------------------------------ writing

    def add_node(
        self,
        number: int,
        node: Node,
        initial: Array,
        keyframe: Mapping[str, NDArray[Any]],
        snapshot: Mapping[str, NDArray[Any]],
        state: Mapping[str, NDArray[Any]] = NOTHING,
    ) -> None:
        """Write a node.

        Args:
            number: number of the node; nodes are numbered from 0, without gaps, in the order in which they were made.
            node: the node.
            initial: (3,) pose in `map` composed along odometry edges, m and rad.
            keyframe: arrays that the front-end keeps of the node's frame, by name.
            snapshot: arrays of the state of the path integrator, by name, for re-anchoring.
            state: what the front-end needs beside the keyframe to take the node up again, by name.
        """
        row = (
            number,
            int(node.stamp_ns),
            *floats(node.pose_odom),
            *floats(initial),
            int(node.template),
            float(node.travel_m),
        )
        self.write(f"INSERT INTO nodes VALUES ({marks(len(row))})", row)
        for part, arrays in (
            (_CODE, {"place": node.place_code}),
            (_KEYFRAME, keyframe),
            (_SNAPSHOT, snapshot),
            (_STATE, state),
        ):
            self.put_arrays(number, part, arrays)

    def put_snapshot(self, number: int, snapshot: Mapping[str, NDArray[Any]]) -> None:
        """Write the state of the path integrator at a node again, over that which `add_node` wrote."""
        self.put_arrays(number, _SNAPSHOT, snapshot)

    def put_edge(self, number: int, edge: Edge) -> None:
        """Write an edge, whatever its status; replaces what was written under the same number (from 0, without gaps)."""
        measured: tuple[Any, ...] = (None,) * 4
        if edge.relative is not None:
            measured = (*floats(edge.relative.delta), schema.pack_floats(edge.relative.covariance))
        ends, kind = (int(edge.source), int(edge.target)), EdgeKind(edge.kind).name.lower()
        record = records.record_to_json(edge)
        row = (number, *ends, kind, str(edge.status), edge.reason, *measured, record, int(edge.since_node))
        self.write(f"INSERT OR REPLACE INTO edges VALUES ({marks(len(row))})", row)

    def add_track(self, stamp_ns: int, node: int, delta_node_robot: Array, pose_odom: Array) -> None:
        """Write where the robot was at a stamp; replaces what was written for the same stamp.

        Args:
            stamp_ns: the stamp.
            node: the node that the robot was at.
            delta_node_robot: (3,) pose of the robot in the node's frame, m and rad.
            pose_odom: (3,) pose of the robot in `odom`, m and rad.
        """
        row = (int(stamp_ns), int(node), *floats(delta_node_robot), *floats(pose_odom))
        self.write(f"INSERT OR REPLACE INTO track VALUES (0, {marks(len(row))})", row)

    def replace_odometry(self, track: Track, experiences: ExperienceMap) -> None:
        """Write new poses of the whole track, and of all nodes in `odom` and along odometry edges, over the earlier ones.

        Args:
            track: as read from this file, with other poses; its anchors are not written.
            experiences: the map, with the nodes of this file.
        """
        moved = np.column_stack([track.deltas, track.poses_odom]).tolist()
        columns = "x_m = ?, y_m = ?, yaw_rad = ?, odom_x_m = ?, odom_y_m = ?, odom_yaw_rad = ?"
        for stamp_ns, row in zip(track.stamps_ns.tolist(), moved, strict=True):
            self.write(f"UPDATE track SET {columns} WHERE stamp_ns = ?", (*row, stamp_ns))
        columns = "odom_x_m = ?, odom_y_m = ?, odom_yaw_rad = ?, initial_x_m = ?, initial_y_m = ?, initial_yaw_rad = ?"
        for number, (node, initial) in enumerate(zip(experiences.nodes, experiences.initial, strict=True)):
            self.write(f"UPDATE nodes SET {columns} WHERE number = ?", (*floats(node.pose_odom), *floats(initial), number))

    def add_online(self, backend: str, stamp_ns: int, pose_map: Array) -> None:
        """Write the pose (3,) in `map` (m, rad) that a back-end gave at that time; replaces one of the same stamp."""
        self.write("INSERT OR REPLACE INTO online VALUES (0, ?, ?, ?, ?, ?)", (backend, int(stamp_ns), *floats(pose_map)))

    def put_anchors(self, anchors: Anchors) -> None:
        """Write the poses of frames between nodes that were registered to the final map; replaces earlier ones."""
        self.write("DELETE FROM anchors", ())
        ends = zip(anchors.stamps_ns.tolist(), anchors.nodes.tolist(), anchors.next_nodes.tolist(), strict=True)
        for end, delta, next_delta in zip(ends, anchors.deltas, anchors.next_deltas, strict=True):
            self.write(f"INSERT INTO anchors VALUES (0, {marks(9)})", (*end, *floats(delta), *floats(next_delta)))

    def put_solution(self, backend: str, poses: Array, report: SolveReport) -> None:
        """Write a back-end's poses (N, 3) and report; replaces an earlier one of the same name."""
        position = self.one("SELECT position FROM solutions WHERE session = ? AND backend = ?", (schema.WHOLE, backend))
        if position is None:
            position = self.one("SELECT COUNT(*) FROM solutions WHERE session = ?", (schema.WHOLE,))
        row = (schema.WHOLE, backend, position, schema.pack_floats(poses), records.report_to_json(report))
        self.write("INSERT OR REPLACE INTO solutions VALUES (?, ?, ?, ?, ?)", row)

    def put_info(self, key: str, value: Any) -> None:
        """Write a value that JSON can hold under a key; `primary_backend` is the key of the primary back-end's name."""
        self.write("INSERT OR REPLACE INTO info VALUES (?, ?, ?)", (schema.WHOLE, key, json.dumps(value)))

    # ------------------------------------------------------------------ reading

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
        return records.rig_from_json(self.info("rig"))

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

    @property
    def broken_off(self) -> str:
        """Why the run that wrote the file was broken off, in words; empty if it ended, was killed, or is going on."""
        return str(self.info(BROKEN_OFF) or "")

    @_reading
    def info(self, key: str) -> Any:
        """The value that was written under a key; None if the key is not there."""
        text = self.one("SELECT value FROM info WHERE session = ? AND key = ?", (schema.WHOLE, key))
        return None if text is None else json.loads(text)

    @_reading
    def map(self) -> ExperienceMap:
        """A new experience map with the nodes and edges of the file, in the order in which they were made."""
        experiences = ExperienceMap()
        codes, frames = self.arrays_of_nodes(_CODE, "place"), {one.first_node: one.pose_map_session for one in self.sessions()}
        for number, row in enumerate(self.rows("SELECT * FROM nodes ORDER BY number")):
            node = Node(int(row[1]), _pose(row[2:5]), codes[number], int(row[8]), float(row[9]))
            if number in frames:
                experiences.begin_session()
                frame = frames[number]
            if experiences.add_node(node, compose(frame, _pose(row[5:8])) if frame.any() else _pose(row[5:8])) != row[0]:
                raise ValueError(f"node {number} is missing")
        for number, row in enumerate(self.rows("SELECT * FROM edges ORDER BY number")):
            relative = None if row[9] is None else RelativePose(_pose(row[6:9]), schema.covariance_from_bytes(row[9]))
            kind, status, record = EdgeKind[row[3].upper()], Status(row[4]), records.record_from_json(row[10])
            edge = Edge(int(row[1]), int(row[2]), kind, status, relative, since_node=int(row[11]), **record)
            if experiences.add_edge(edge) != row[0]:
                raise ValueError(f"edge {number} is missing")
        return experiences

    @_reading
    def keyframe(self, node: int) -> dict[str, NDArray[Any]]:
        """The arrays that the front-end kept of a node's frame, by name; empty for an unknown node."""
        return self.arrays_of_node(node, _KEYFRAME)

    @_reading
    def state(self, node: int) -> dict[str, NDArray[Any]]:
        """The arrays that the front-end needs beside the keyframe to take a node up again; empty in files of before."""
        return self.arrays_of_node(node, _STATE)

    @_reading
    def snapshot(self, node: int) -> dict[str, NDArray[Any]]:
        """The arrays of the state of the path integrator at a node, by name; empty for an unknown node."""
        return self.arrays_of_node(node, _SNAPSHOT)

    @_reading
    def grid_phases(self) -> NDArray[np.float64]:
        """(N, M, 2) phases of the M grid sheets at each node, cycles: a displacement for `neural.vector.GridVectors`."""
        phases = self.arrays_of_nodes(_SNAPSHOT, "grid_phases")
        if list(phases) != list(range(self.one("SELECT COUNT(*) FROM nodes", ()))):
            raise ValueError("not every node has grid phases")
        return np.array(list(phases.values()), dtype=np.float64).reshape(len(phases), -1 if phases else 0, 2)

    @_reading
    def sessions(self) -> list[StoredSession]:
        """The sessions of the map, in the order in which they were added."""
        return [
            StoredSession(int(row[0]), int(row[1]), str(row[2]), str(row[3]), _pose(row[4:7]))
            for row in self.rows("SELECT * FROM sessions ORDER BY number")
        ]

    @_reading
    def track(self, session: int = NEWEST) -> Track:
        """Where the robot was at each stamp of a session, seen from nodes, and the frames registered to the final map of it.

        It may be empty.
        """
        number = self._number(session)
        rows = self.rows("SELECT * FROM track WHERE session = ? ORDER BY stamp_ns", (number,))
        values = schema.near(np.array([row[3:] for row in rows], dtype=np.float64).reshape(-1, 6))
        ends = np.array([row[1:3] for row in rows], dtype=np.int64).reshape(-1, 2)
        return Track(ends[:, 0].copy(), ends[:, 1].copy(), values[:, :3].copy(), values[:, 3:].copy(), self._anchors(number))

    def _number(self, session: int) -> int:
        return int(self.one("SELECT MAX(number) FROM sessions")) if session == NEWEST else session

    def _anchors(self, session: int) -> Anchors:
        rows = self.rows("SELECT * FROM anchors WHERE session = ? ORDER BY stamp_ns", (session,))
        values = schema.near(np.array([row[4:] for row in rows], dtype=np.float64).reshape(-1, 6))
        ends = np.array([row[1:4] for row in rows], dtype=np.int64).reshape(-1, 3)
        stamps, nodes, after = ends.T.copy()
        return Anchors(stamps, nodes, after, values[:, :3].copy(), values[:, 3:].copy())

    @_reading
    def online(self, backend: str, session: int = NEWEST) -> Trajectory:
        """The poses that a back-end gave while a session was driven, in its own frame; an empty trajectory if it gave none."""
        rows = self.rows(
            "SELECT stamp_ns, x_m, y_m, yaw_rad FROM online WHERE session = ? AND backend = ? ORDER BY stamp_ns",
            (self._number(session), backend),
        )
        stamps = np.array([row[0] for row in rows], dtype=np.int64)
        return Trajectory(stamps, schema.near(np.array([row[1:] for row in rows], dtype=np.float64).reshape(-1, 3)))

    @_reading
    def online_backends(self) -> list[str]:
        """Names of the back-ends that gave poses while driving, sorted."""
        return [str(row[0]) for row in self.rows("SELECT DISTINCT backend FROM online ORDER BY backend")]

    @_reading
    def solutions(self) -> dict[str, Solution]:
        """Poses and report of every back-end, in order of first writing; before the end those of all nodes alone."""
        found, nodes = self.solutions_alone(schema.WHOLE), self.one("SELECT COUNT(*) FROM nodes", ())
        fit = {name: solution for name, solution in found.items() if len(schema.near(solution.poses)) == nodes}
        if self.ended and len(fit) < len(found):
            name = next(name for name in found if name not in fit)
            raise ValueError(f"{name} has {len(found[name].poses)} poses, expected one for each of {nodes} nodes")
        return fit

    @_reading
    def solutions_alone(self, session: int) -> dict[str, Solution]:
        """Poses and report of every back-end as they were before a session was joined to others; empty if that is unknown."""
        rows = self.rows("SELECT backend, poses, report FROM solutions WHERE session = ? ORDER BY position", (session,))
        return {
            str(name): Solution(schema.unpack_floats(poses, 3), records.report_from_json(report))
            for name, poses, report in rows
        }


def _file_of(folder_or_db: Path) -> Path:
    path = Path(folder_or_db)
    return path if path.suffix == ".db" and not path.is_dir() else path / schema.MAP_NAME


def _pose(values: tuple[Any, ...]) -> Array:
    """A pose (3,) from its columns."""
    return schema.near(np.array(values, dtype=np.float64))
