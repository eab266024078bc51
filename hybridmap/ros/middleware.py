"""What a node needs of its middleware, and what it publishes and offers there."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from enum import Enum
from typing import Protocol

from hybridmap.ros.contents import Contents
from hybridmap.streams.messages import Topic


@dataclass(frozen=True, slots=True)
class Output:
    """A topic that the node publishes.

    Attributes:
        topic: its name; `~` stands for the name of the node.
        msgtype: its message type.
        latched: whether a late subscriber gets the last message.
    """

    topic: str
    msgtype: str
    latched: bool = False


TF = Output("/tf", "tf2_msgs/msg/TFMessage")
RAW_CORRECTION = Output("~map_to_odom", "geometry_msgs/msg/TransformStamped")
POSE = Output("~pose", "geometry_msgs/msg/PoseWithCovarianceStamped")
LOCALIZATION_POSE = Output("~localization_pose", "geometry_msgs/msg/PoseWithCovarianceStamped")
PATH = Output("~path", "nav_msgs/msg/Path", latched=True)
GRAPH = Output("~graph", "visualization_msgs/msg/MarkerArray", latched=True)
MAP = Output("map", "nav_msgs/msg/OccupancyGrid", latched=True)
MAP_METADATA = Output("map_metadata", "nav_msgs/msg/MapMetaData", latched=True)
DIAGNOSTICS = Output("/diagnostics", "diagnostic_msgs/msg/DiagnosticArray")

OUTPUTS = (TF, RAW_CORRECTION, POSE, LOCALIZATION_POSE, PATH, GRAPH, MAP, MAP_METADATA, DIAGNOSTICS)

INITIAL_POSE = "initialpose"
"""Where rviz tells the robot's pose, geometry_msgs/PoseWithCovarianceStamped."""


class ServiceKind(Enum):
    """The type of a service."""

    TRIGGER = "std_srvs/Trigger"
    EMPTY = "std_srvs/Empty"
    SET_BOOL = "std_srvs/SetBool"
    GET_MAP = "nav_msgs/GetMap"


@dataclass(frozen=True, slots=True)
class Service:
    """A service of the node.

    Attributes:
        name: its name; `~` stands for the name of the node.
        kind: its type.
        does: (value of the request, for SetBool) -> contents of the response. Raises a HybridMapError if it cannot be done.
    """

    name: str
    kind: ServiceKind
    does: Callable[[bool], Contents]


class Middleware(Protocol):
    """ROS 1 or ROS 2, as the node sees it. Callbacks come in threads of the middleware."""

    @property
    def source(self) -> str:
        """Name of the robot, for errors."""

    @property
    def is_ros1(self) -> bool:
        """Whether messages are serialised as ROS 1 does it."""

    def topics(self) -> list[Topic]:
        """The topics that others publish."""

    def subscribe(self, topic: str, msgtype: str, take: Callable[[bytes, str | None], None]) -> None:
        """Have `take` called with each message, serialised, and with the definition of its type, if that is known."""

    def publish(self, output: Output, contents: Contents) -> None:
        """Publish a message."""

    def offer(self, services: Sequence[Service]) -> None:
        """Offer services."""

    def warn(self, text: str) -> None:
        """Tell the operator."""

    def inform(self, text: str) -> None:
        """Tell the operator what is as it should be."""

    def when_stopped(self, call: Callable[[], None]) -> None:
        """Have `call` called when the middleware is told to end this node."""

    def stop(self) -> None:
        """Take leave of the middleware."""
