"""Serialised messages of ROS 1 and ROS 2: their stamps, and decoding them by the definitions that came with them.

Bags and robots are read by the same code, so a drive gives the same numbers from either.
"""

from __future__ import annotations

import struct
from copy import deepcopy
from dataclasses import dataclass
from functools import cache
from typing import Any

from hybridmap.errors import StreamError
from hybridmap.streams import ratslam_messages
from hybridmap.trajectory import NS_PER_S

_TF_DEFINITION = "geometry_msgs/TransformStamped[] transforms"
TRANSFORM = ("tf2_msgs/msg/TFMessage", "tf/msg/tfMessage")


@dataclass(frozen=True, slots=True)
class Topic:
    """One topic of a bag or a robot.

    Attributes:
        name: name of the topic, with its leading slash.
        msgtype: message type, written like `sensor_msgs/msg/LaserScan`, for ROS 1 too.
        count: number of messages according to the bag; 1 on a robot.
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


def full_type(msgtype: str) -> str:
    """A message type as it is written here: `sensor_msgs/msg/LaserScan` for `sensor_msgs/LaserScan`, too."""
    package, _, name = msgtype.rpartition("/")
    return msgtype if package.endswith("/msg") else f"{package}/msg/{name}"


class Messages:
    """Reads the messages of one source, each type by the definition that came with it, else by the standard one.

    Attributes:
        source: name of the source, for errors.
        is_ros1: whether messages are serialised as ROS 1 does it, else as CDR.
        types: topic -> its message type.
    """

    def __init__(self, source: str, is_ros1: bool, blame: str) -> None:
        """Start without any topic; `blame` says what it means if a message cannot be read, for errors."""
        self.source, self.is_ros1, self._blame = source, is_ros1, blame
        self.types: dict[str, str] = {}
        self._definitions: dict[str, Any] = {}
        self._stores: dict[str, Any] = {}

    def define(self, topic: str, msgtype: str, definition: Any = None) -> None:
        """Take in the type of a topic.

        Args:
            topic: its name.
            msgtype: the type, as in `Topic`.
            definition: of `rosbags`, or the text that a ROS 1 publisher sends; the first of a type counts. None: not known.
        """
        if isinstance(definition, str):
            from rosbags.interfaces import MessageDefinition, MessageDefinitionFormat

            definition = MessageDefinition(MessageDefinitionFormat.MSG, definition)
        self.types[topic] = msgtype
        if definition is not None:
            self._definitions.setdefault(msgtype, definition)

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
        msgtype = self.types[message.topic]
        try:
            store = self._store(msgtype)
            if self.is_ros1:
                return store.deserialize_ros1(message.data, msgtype)
            return store.deserialize_cdr(message.data, msgtype)
        except Exception as error:
            raise self._undecodable(message) from error

    def _store(self, msgtype: str) -> Any:
        if msgtype not in self._stores:
            definition = self._definitions.get(msgtype)
            embedded = None if definition is None else _embedded_store(definition, msgtype, self.is_ros1)
            self._stores[msgtype] = embedded if embedded is not None else _fallback_store(self.is_ros1)
        return self._stores[msgtype]

    def _undecodable(self, message: RawMessage) -> StreamError:
        return StreamError(
            f"{self.source}: {message.topic}: message {message.number + 1} ({len(message.data)} bytes) "
            f"is no valid {self.types[message.topic]}; {self._blame}"
        )


@cache
def standard_store(is_ros1: bool) -> Any:
    """Type store of the standard messages."""
    from rosbags.typesys import Stores, get_types_from_msg, get_typestore

    store = get_typestore(Stores.ROS1_NOETIC if is_ros1 else Stores.ROS2_HUMBLE)
    for name in TRANSFORM:
        if name not in store.fielddefs:
            store.register(get_types_from_msg(_TF_DEFINITION, name))
    return store


@cache
def _fallback_store(is_ros1: bool) -> Any:
    """Type store for messages without definitions: the standard ones and those of OpenRatSLAM."""
    store = deepcopy(standard_store(is_ros1))
    ratslam_messages.register(store)
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
        standard = standard_store(is_ros1).fielddefs
        whole = all(_names(standard[name]) <= _names(types[name]) for name in types.keys() & standard.keys())
    except Exception:  # noqa: BLE001  an incomplete definition: the standard one will do
        return None
    return store if whole else None


def _names(definition: Any) -> set[str]:
    """Names of the fields of a message type."""
    _, fields = definition
    return {name for name, _ in fields}
