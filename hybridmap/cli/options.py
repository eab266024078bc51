"""Options that several commands share."""

from __future__ import annotations

from collections.abc import Iterable
from pathlib import Path
from typing import Annotated

import typer

Source = Annotated[
    str, typer.Argument(help="Recording (.bag, .mcap or .db3 file, ROS 2 bag folder, TUM folder, .csv) or simulated world.")
]
Topic = Annotated[str | None, typer.Option(metavar="TOPIC", help="Topic to use instead of the one found automatically.")]
OdometryFile = Annotated[str | None, typer.Option(help="TUM folders only: odometry file to use.")]


def sensor_settings(source: str, **given: str | None) -> dict[str, str]:
    """The given topics and files as settings of the section `sensors`.

    Raises:
        ConfigError: one that does not fit the source.
        StreamError: one is given, and the source is of no readable kind.
    """
    named = {name: value for name, value in given.items() if value is not None}
    if named:
        _require_fitting(source, named)
    return {f"sensors.{name}": value for name, value in named.items()}


def _require_fitting(source: str, named: Iterable[str]) -> None:
    from hybridmap.errors import ConfigError
    from hybridmap.streams.open import kind_of, world_of

    kind = "simulated world" if world_of(source) is not None else kind_of(Path(source))
    for name in named:
        fitting = "TUM RGB-D folder" if name == "odometry_file" else "bag"
        if fitting not in kind:
            raise ConfigError(f"--{name.replace('_', '-')}: is for a {fitting}; {source} is a {kind}")
