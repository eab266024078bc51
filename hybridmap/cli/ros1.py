"""`hybridmap ros1`: map on a robot under ROS 1."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from hybridmap.cli.node import (
    Configuration,
    CorrectionSpeed,
    CorrectionTurn,
    KnownMap,
    Lag,
    MapEvery,
    MapFrame,
    Overwrite,
    Rate,
    Resolution,
    RobotTopic,
    overrides_of,
    run_node,
)
from hybridmap.cli.options import OUT, AsJson, SensorSetting


def ros1(
    out: Annotated[Path, typer.Option(help=OUT)],
    remappings: Annotated[
        list[str] | None, typer.Argument(metavar="[NAME:=NAME]...", help="Remappings of ROS, such as map:=/floor_2.")
    ] = None,
    config: Configuration = None,
    odometry_topic: RobotTopic = None,
    scan_topic: RobotTopic = None,
    color_topic: RobotTopic = None,
    depth_topic: RobotTopic = None,
    camera_info_topic: RobotTopic = None,
    setting: SensorSetting = None,
    rate: Rate = 20.0,
    map_every: MapEvery = 5.0,
    resolution: Resolution = 0.05,
    map_frame: MapFrame = "map",
    known_map: KnownMap = None,
    correction_m_s: CorrectionSpeed = 0.1,
    correction_deg_s: CorrectionTurn = 5.0,
    lag_s: Lag = 2.0,
    overwrite: Overwrite = False,
    as_json: AsJson = False,
) -> None:
    """Map on a robot under ROS 1, until Ctrl-C.

    Takes odometry, by topic or by /tf, and laser scans or RGB-D pictures; gives map -> odom on /tf, /map, the path and graph of
    the map, and services to save, pause and reset it: docs/ros.md. Ctrl-C concludes the session, as at the end of a recording.
    Needs rospy and a ROS master.
    """
    from hybridmap.live import LiveLimits
    from hybridmap.ros.robot import NodeOptions, RobotNode
    from hybridmap.ros.ros1 import Ros1, import_rospy

    import_rospy()
    overrides = overrides_of(
        setting, odometry=odometry_topic, scan=scan_topic, color=color_topic, depth=depth_topic, camera_info=camera_info_topic
    )
    options = NodeOptions(
        out,
        config,
        overrides,
        overwrite,
        rate_hz=rate,
        map_every_s=map_every,
        resolution_m=resolution,
        map_frame=map_frame,
        known_map=known_map,
        limits=LiveLimits(lag_s=lag_s, correction_m_s=correction_m_s, correction_deg_s=correction_deg_s),
    )
    middleware = Ros1("hybridmap", remappings or ())
    run_node(middleware, RobotNode(middleware, options), as_json=as_json)
