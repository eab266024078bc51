"""A bag file: its topics, its messages in recorded order, and a clear error for any damage.

ROS 1 `.bag`, ROS 2 folders with `metadata.yaml`, single `.mcap` and `.db3` files, read by `rosbags` without ROS.
"""

from __future__ import annotations

from collections.abc import Collection, Iterator
from contextlib import closing
from pathlib import Path
from typing import Any

from hybridmap.errors import StreamError, quoted
from hybridmap.streams.messages import Messages, RawMessage, Topic

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


class BagFile(Messages):
    """A bag that can be read. The file is closed between readings, so several readings can run at once.

    Attributes:
        path: of the bag.
        topics: its topics, sorted by name; one with messages of two types is there twice.
    """

    def __init__(self, path: Path) -> None:
        """Open the bag once and read its topics.

        Raises:
            StreamError: missing, empty, truncated, not indexed, or not a bag.
        """
        super().__init__(str(path), path.suffix == ".bag", "the bag is damaged")
        self.path = path
        if not path.exists():
            raise StreamError(f"{path}: no such file or folder")
        if path.is_file() and path.stat().st_size == 0:
            raise StreamError(f"{path}: the file is empty")
        _check_databases(path)
        with self._reader() as reader:
            counts: dict[tuple[str, str], int] = {}
            for connection in reader.connections:
                key = (connection.topic, connection.msgtype)
                counts[key] = counts.get(key, 0) + connection.msgcount
                self.define(connection.topic, connection.msgtype, connection.msgdef)
        self.topics = tuple(Topic(name, msgtype, count) for (name, msgtype), count in sorted(counts.items()))
        self.types = {topic.name: topic.msgtype for topic in self.topics}  # of two types, that of the last name

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

    def _damaged(self, error: Exception) -> StreamError:
        found = " ".join(_plain(part) for part in error.args) or type(error).__name__
        advice = next((text for sign, text in _ADVICE.items() if sign in found.lower()), "the file is cut off or damaged")
        return StreamError(f"{self.path}: cannot be read as a bag ({quoted(found.rstrip('.'))[1:-1]}): {advice}")


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
