"""A bag file: its topics, its messages in recorded order, and a clear error for any damage.

ROS 1 `.bag`, ROS 2 folders with `metadata.yaml`, single `.mcap` and `.db3` files, read by `rosbags` without ROS.
"""

from __future__ import annotations

import struct
from collections.abc import Collection, Iterator
from contextlib import closing
from dataclasses import dataclass
from functools import cache
from pathlib import Path
from typing import Any

from hybridmap.errors import StreamError, quoted
from hybridmap.trajectory import NS_PER_S

_TF_DEFINITION = "geometry_msgs/TransformStamped[] transforms"
TRANSFORM = ("tf2_msgs/msg/TFMessage", "tf/msg/tfMessage")

_ADVICE = {
    "not indexed": "the bag has no index; run `rosbag reindex` on it",
    "index looks damaged": "the bag is cut off or was not closed; run `rosbag reindex` on it or record again",
    "file magic is invalid": "not a bag of a format that can be read, or damaged; convert it or record again",
    "end magic": "the file is cut off or was not closed; recover it with `mcap recover`",
    "footer": "the file is cut off or was not closed; recover it with `mcap recover`",
    "malformed": "the database is cut off or damaged",
    "files are missing": "the folder is incomplete",
    "yaml": "metadata.yaml is damaged; run `ros2 bag reindex` on the folder",
    "metadata": "metadata.yaml is damaged; run `ros2 bag reindex` on the folder",
    "profile": "an mcap file of another kind than a ROS 2 recording",
    "not supported": "convert the bag",
    "permission denied": "the file may not be read by this user",
}


@dataclass(frozen=True, slots=True)
class Topic:
    """One topic of a bag.

    Attributes:
        name: name of the topic, with its leading slash.
        msgtype: message type, written like `sensor_msgs/msg/LaserScan`, for ROS 1 too.
        count: number of messages according to the bag.
    """

    name: str
    msgtype: str
    count: int


@dataclass(frozen=True, slots=True)
class RawMessage:
    """One serialised message.

    Attributes:
        topic: name of its topic.
        number: index within the topic, from 0.
        data: serialised bytes.
    """

    topic: str
    number: int
    data: bytes


class BagFile:
    """A bag that can be read. The file is closed between readings, so several readings can run at once.

    Attributes:
        path: of the bag.
        is_ros1: whether it is a ROS 1 bag.
        topics: its topics, sorted by name; one with messages of two types is there twice.
    """

    def __init__(self, path: Path) -> None:
        """Open the bag once and read its topics.

        Raises:
            StreamError: missing, empty, truncated, not indexed, or not a bag.
        """
        self.path = path
        self.is_ros1 = path.suffix == ".bag"
        if not path.exists():
            raise StreamError(f"{path}: no such file or folder")
        if path.is_file() and path.stat().st_size == 0:
            raise StreamError(f"{path}: the file is empty")
        _check_databases(path)
        self._stores: dict[str, Any] = {}
        self._definitions: dict[str, Any] = {}
        with self._reader() as reader:
            counts: dict[tuple[str, str], int] = {}
            for connection in reader.connections:
                key = (connection.topic, connection.msgtype)
                counts[key] = counts.get(key, 0) + connection.msgcount
                self._definitions.setdefault(connection.msgtype, connection.msgdef)
        self.topics = tuple(Topic(name, msgtype, count) for (name, msgtype), count in sorted(counts.items()))
        self._types = {topic.name: topic.msgtype for topic in self.topics}

    def raw(self, names: Collection[str]) -> Iterator[RawMessage]:
        """Messages of the named topics in recorded order; a name that the bag lacks gives none.

        Raises:
            StreamError: the file is damaged.
        """
        wanted = frozenset(names)
        numbers = dict.fromkeys(wanted, 0)
        if not wanted:
            return
        with self._reader() as reader:
            connections = [c for c in reader.connections if c.topic in wanted]
            messages = reader.messages(connections=connections) if connections else iter(())
            while True:
                try:
                    connection, _, data = next(messages)
                except StopIteration:
                    return
                except Exception as error:  # noqa: BLE001  a damaged file makes the parser raise anything
                    raise self._damaged(error) from None
                number = numbers[connection.topic]
                numbers[connection.topic] = number + 1
                yield RawMessage(connection.topic, number, bytes(data))

    def stamp_ns(self, message: RawMessage) -> int:
        """Header stamp of a message whose first field is a header, without decoding the rest, ns.

        Raises:
            StreamError: the message is too short.
        """
        data = message.data
        try:
            if self.is_ros1:
                _, seconds, nanoseconds = struct.unpack_from("<III", data)
            else:
                seconds, nanoseconds = struct.unpack_from("<iI" if data[1] & 1 else ">iI", data, 4)
        except (struct.error, IndexError):
            raise self._undecodable(message) from None
        return int(seconds) * NS_PER_S + int(nanoseconds)

    def decode(self, message: RawMessage) -> Any:
        """Decode a message into an object with the fields of its type.

        Raises:
            StreamError: the bytes are not of that type.
        """
        msgtype = self._types[message.topic]
        try:
            store = self._store(msgtype)
            if self.is_ros1:
                return store.deserialize_ros1(message.data, msgtype)
            return store.deserialize_cdr(message.data, msgtype)
        except Exception as error:
            raise self._undecodable(message) from error

    def _reader(self) -> Any:
        try:
            if self.is_ros1:
                from rosbags.rosbag1 import Reader as Reader1

                reader = Reader1(self.path)
            else:
                from rosbags.rosbag2 import Reader as Reader2

                reader = Reader2(self.path)
            reader.open()
        except Exception as error:  # noqa: BLE001  a damaged file makes the parser raise anything
            raise self._damaged(error) from None
        return closing(reader)

    def _store(self, msgtype: str) -> Any:
        if msgtype not in self._stores:
            embedded = _embedded_store(self._definitions[msgtype], msgtype, self.is_ros1)
            self._stores[msgtype] = embedded if embedded is not None else _standard_store(self.is_ros1)
        return self._stores[msgtype]

    def _damaged(self, error: Exception) -> StreamError:
        found = " ".join(_plain(part) for part in error.args) or type(error).__name__
        advice = next((text for sign, text in _ADVICE.items() if sign in found.lower()), "the file is cut off or damaged")
        return StreamError(f"{self.path}: cannot be read as a bag ({quoted(found.rstrip('.'))[1:-1]}): {advice}")

    def _undecodable(self, message: RawMessage) -> StreamError:
        return StreamError(
            f"{self.path}: {message.topic}: message {message.number + 1} ({len(message.data)} bytes) "
            f"is no valid {self._types[message.topic]}; the bag is damaged"
        )


def _plain(part: object) -> str:
    """The text of an error on one line, without nested quotes."""
    return " ".join(str(part).replace("('", "").replace("',)", "").split())


def _check_databases(path: Path) -> None:
    """Refuse a `.db3` file that is shorter than its header says; SQLite itself may not notice."""
    for file in sorted(path.glob("*.db3")) if path.is_dir() else [path] if path.suffix == ".db3" else []:
        with file.open("rb") as opened:
            header = opened.read(100)
        if len(header) < 100 or not header.startswith(b"SQLite format 3\0"):
            raise StreamError(f"{file}: no SQLite database, or damaged; expected a ROS 2 recording")
        page_bytes, pages = int.from_bytes(header[16:18], "big"), int.from_bytes(header[28:32], "big")
        expected = (65536 if page_bytes == 1 else page_bytes) * pages
        if file.stat().st_size < expected:
            raise StreamError(f"{file}: the database is cut off: found {file.stat().st_size} bytes, expected {expected}")


@cache
def _standard_store(is_ros1: bool) -> Any:
    """Type store of the standard messages, for bags without definitions."""
    from rosbags.typesys import Stores, get_types_from_msg, get_typestore

    store = get_typestore(Stores.ROS1_NOETIC if is_ros1 else Stores.ROS2_HUMBLE)
    for name in TRANSFORM:
        if name not in store.fielddefs:
            store.register(get_types_from_msg(_TF_DEFINITION, name))
    return store


@cache  # parsing a definition takes tens of milliseconds, and every bag of a robot carries the same ones
def _embedded_store(definition: Any, msgtype: str, is_ros1: bool) -> Any | None:
    """Type store of the definitions inside the bag; None if there are none that can be used.

    A standard type that lacks a standard field is damaged: its messages are read as the standard has them.
    """
    from rosbags.interfaces import MessageDefinitionFormat
    from rosbags.typesys import Stores, get_types_from_msg, get_typestore

    if definition.format != MessageDefinitionFormat.MSG:
        return None
    try:
        types = get_types_from_msg(definition.data, msgtype)
        store = get_typestore(Stores.EMPTY)
        store.register(types)
        store.generate_msgdef(msgtype)
        standard = _standard_store(is_ros1).fielddefs
        whole = all(_names(standard[name]) <= _names(types[name]) for name in types.keys() & standard.keys())
    except Exception:  # noqa: BLE001  an incomplete definition: the standard one will do
        return None
    return store if whole else None


def _names(definition: Any) -> set[str]:
    """Names of the fields of a message type."""
    _, fields = definition
    return {name for name, _ in fields}
