"""ROS 1, by rospy: raw messages in, filled messages out."""

from __future__ import annotations

import logging
import os
from collections.abc import Callable, Mapping, Sequence
from contextlib import suppress
from typing import Any

import numpy as np

from hybridmap.errors import HybridMapError, RosError, StreamError
from hybridmap.ros.contents import Contents, Stamp
from hybridmap.ros.middleware import OUTPUTS, Output, Service
from hybridmap.streams.messages import Topic, full_type

_PICTURES = ("sensor_msgs/msg/Image", "sensor_msgs/msg/CompressedImage")
_PICTURE_BYTES = 1 << 24
"""rospy reads as much at once. With its own 64 kB, pictures come in many pieces, and late."""
_QUEUE = 10

HOW_TO = "source the setup.bash of your ROS 1, or `python tools/ros1.py FOLDER` gets it from Debian without root"


def import_rospy() -> Any:
    """The module rospy.

    Raises:
        RosError: it cannot be imported; the message says how to get it.
    """
    try:
        import rospy
    except ImportError as error:
        raise RosError(f"rospy cannot be imported ({error}): {HOW_TO}") from None
    return rospy


class Ros1:
    """A node of ROS 1; see `middleware.Middleware`."""

    is_ros1 = True

    def __init__(self, name: str, remappings: Sequence[str] = ()) -> None:
        """Register the node with the master.

        Args:
            name: of the node; `__name:=...` replaces it.
            remappings: arguments of roslaunch and rosrun, such as `map:=/floor_2`.

        Raises:
            RosError: there is no rospy, or no master.
        """
        self._rospy = import_rospy()
        import rosgraph

        uri = os.environ.get("ROS_MASTER_URI", "http://localhost:11311")
        if not rosgraph.is_master_online():
            raise RosError(f"no ROS master at {uri}: start `roscore`, or set ROS_MASTER_URI")
        root = logging.getLogger()
        handlers, level = list(root.handlers), root.level
        self._rospy.init_node(name, argv=["hybridmap", *remappings], disable_signals=True)
        root.handlers[:] = handlers  # rospy has its own ideas of what all other modules log
        root.setLevel(level)
        logging.getLogger("rosout").propagate = False  # it writes to the console by itself
        self.source = f"ROS 1 at {uri}"
        self._publishers = {output: self._advertised(output) for output in OUTPUTS}

    def topics(self) -> list[Topic]:
        """The topics that others publish.

        Raises:
            StreamError: the master does not answer.
        """
        master, own = self._rospy.get_master(), self._rospy.get_name()
        try:
            _, _, (publishers, _, _) = master.getSystemState()
            _, _, types = master.getTopicTypes()
        except OSError as error:
            raise StreamError(f"{self.source}: the master does not answer ({error})") from None
        others = {name for name, nodes in publishers if any(node != own for node in nodes)}
        return [Topic(name, full_type(msgtype), 1) for name, msgtype in sorted(types) if name in others and msgtype != "*"]

    def subscribe(self, topic: str, msgtype: str, take: Callable[[bytes, str | None], None]) -> None:
        """Have `take` called with the bytes of each message and the definition that its publisher sent."""

        def received(message: Any) -> None:
            take(bytes(message._buff), message._connection_header.get("message_definition"))

        size = {"buff_size": _PICTURE_BYTES} if msgtype in _PICTURES else {}
        self._rospy.Subscriber(topic, self._rospy.AnyMsg, received, queue_size=None, tcp_nodelay=True, **size)

    def _advertised(self, output: Output) -> Any:
        kind = _message_class(output.msgtype)
        return self._rospy.Publisher(output.topic, kind, queue_size=_QUEUE, latch=output.latched, tcp_nodelay=True)

    def publish(self, output: Output, contents: Contents) -> None:
        """Publish a message."""
        publisher = self._publishers[output]
        if output.latched or publisher.get_num_connections():
            with suppress(self._rospy.ROSException):  # closed: rospy is shutting down
                publisher.publish(filled(publisher.data_class(), contents))

    def offer(self, services: Sequence[Service]) -> None:
        """Offer services. What raises a HybridMapError is an error for the client of rospy, in its words."""
        for service in services:
            self._offer(service)

    def _offer(self, service: Service) -> None:
        import roslib.message

        found = roslib.message.get_service_class(service.kind.value)

        def answer(request: Any) -> Any:
            try:
                return filled(found._response_class(), service.does(bool(getattr(request, "data", False))))
            except HybridMapError as error:
                raise self._rospy.ServiceException(str(error)) from None

        self._rospy.Service(service.name, found, answer)

    def warn(self, text: str) -> None:
        """Tell the operator, on /rosout and the console."""
        self._rospy.logwarn(text)

    def inform(self, text: str) -> None:
        """Tell the operator what is as it should be."""
        self._rospy.loginfo(text)

    def when_stopped(self, call: Callable[[], None]) -> None:
        """Have `call` called when the master or another node ends this one."""
        self._rospy.on_shutdown(call)

    def stop(self) -> None:
        """Unregister from the master."""
        self._rospy.signal_shutdown("finished")


def _message_class(msgtype: str) -> Any:
    import roslib.message

    found = roslib.message.get_message_class(msgtype.replace("/msg/", "/"))
    if found is None:
        raise RosError(f"ROS 1 has no message type {msgtype.replace('/msg/', '/')}: install its package")
    return found


def filled(message: Any, contents: Contents) -> Any:
    """A message of ROS 1 with the fields of `contents`; others keep their zeros."""
    types = dict(zip(message.__slots__, message._slot_types, strict=True))
    for name, value in contents.items():
        setattr(message, name, _field(getattr(message, name), types[name], value))
    return message


def _field(now: Any, kind: str, value: Any) -> Any:
    if isinstance(value, Stamp):
        return type(now)(*value.parts)
    if isinstance(value, Mapping):
        return filled(now, value)
    if isinstance(value, np.ndarray):
        return value.tolist()  # what rospy has for arrays of numpy calls a method that numpy 2.3 has no longer
    if isinstance(value, list) and value and isinstance(value[0], Mapping):
        import roslib.message

        element = roslib.message.get_message_class(kind.partition("[")[0])
        return [filled(element(), part) for part in value]
    return value
