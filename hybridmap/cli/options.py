"""Options that more than one command takes."""

from __future__ import annotations

from typing import Annotated

import typer

Source = Annotated[str, typer.Argument(help="A .bag, .mcap or .db3 file, a ROS 2 bag or TUM folder, a .csv, or a world.")]
Topic = Annotated[str | None, typer.Option(metavar="TOPIC", help="Topic to use instead of the one found.")]
OdometryFile = Annotated[str | None, typer.Option(help="TUM folder: the odometry file to use.")]


def sensor_settings(**given: str | None) -> dict[str, str]:
    """Settings of the section `sensors`, by key, of the topics and files that were given."""
    return {f"sensors.{name}": value for name, value in given.items() if value is not None}
