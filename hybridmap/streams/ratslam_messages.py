"""The messages of OpenRatSLAM (package `ratslam_ros`), for bags that do not carry their definitions, and to write them.

Another package's messages of the same names are read alike, if the bag defines them.
"""

from __future__ import annotations

from typing import Any

ACTION, MAP = "ratslam_ros/msg/TopologicalAction", "ratslam_ros/msg/TopologicalMap"
CREATE_NODE, CREATE_EDGE, SET_NODE = 1, 2, 3
"""Values of `TopologicalAction.action`: a new experience, a new link to a known one, or back to a known one by a known link."""

_DEFINITIONS = {
    "ratslam_ros/msg/TopologicalNode": "uint32 id\ngeometry_msgs/Pose pose",
    "ratslam_ros/msg/TopologicalEdge": (
        "uint32 id\nuint32 source_id\nuint32 destination_id\nduration duration\ngeometry_msgs/Transform transform"
    ),
    MAP: (
        "std_msgs/Header header\nuint32 node_count\nratslam_ros/TopologicalNode[] node\n"
        "uint32 edge_count\nratslam_ros/TopologicalEdge[] edge"
    ),
    ACTION: (
        f"uint32 CREATE_NODE={CREATE_NODE}\nuint32 CREATE_EDGE={CREATE_EDGE}\nuint32 SET_NODE={SET_NODE}\n"
        "std_msgs/Header header\nuint32 action\nuint32 src_id\nuint32 dest_id\nfloat64 relative_rad"
    ),
}


def register(store: Any) -> None:
    """Add the message types to a type store of `rosbags` that holds the standard ones."""
    from rosbags.typesys import get_types_from_msg

    for name, text in _DEFINITIONS.items():
        store.register(get_types_from_msg(text, name))


def is_a(msgtype: str, ours: str) -> bool:
    """Whether a message type, of whatever package, has the name of one of ours."""
    return msgtype.rpartition("/")[2] == ours.rpartition("/")[2]
