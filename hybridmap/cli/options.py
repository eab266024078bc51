"""Options that several commands share."""

from __future__ import annotations

from typing import Annotated

import typer

Source = Annotated[
    str, typer.Argument(help="Recording (.bag, .mcap or .db3 file, ROS 2 bag folder, TUM folder, .csv) or simulated world.")
]
Topic = Annotated[str | None, typer.Option(metavar="TOPIC", help="Topic to use instead of the one found automatically.")]
OdometryFile = Annotated[str | None, typer.Option(help="TUM folders only: odometry file to use.")]


def sensor_settings(**given: str | None) -> dict[str, str]:
    """The given topics and files as settings of the section `sensors`."""
    return {f"sensors.{name}": value for name, value in given.items() if value is not None}
