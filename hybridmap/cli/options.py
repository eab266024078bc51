"""Options that several commands share."""

from __future__ import annotations

from collections.abc import Iterable
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

if TYPE_CHECKING:
    from hybridmap.export.carving import Footprint

OUT = "Session folder to write: new, empty, or with --overwrite one that holds a session. What holds anything else is refused."
SEED = (
    "Random seed of RANSAC and of the errors of simulated sensors. The simulated world and drive are the same for every seed,"
    " but for campus, whose layout is drawn."
)

Source = Annotated[
    str,
    typer.Argument(
        help="Recording (.bag, .mcap or .db3 file, ROS 2 bag folder, TUM folder, .csv) "
        "or simulated world: lab, office, corridor, corridor-landmarks, campus."
    ),
]
Topic = Annotated[
    str | None,
    typer.Option(
        metavar="TOPIC", help="Topic of the recording to use instead of the one found; `hybridmap inspect` lists them."
    ),
]
OdometryFile = Annotated[str | None, typer.Option(help="TUM folders only: file with the odometry, instead of odometry.txt.")]
SensorSetting = Annotated[
    list[str] | None, typer.Option("--set", help="KEY=VALUE, e.g. nodes.distance_m=0.3. Keys: docs/configuration.md.")
]
SolverConfig = Annotated[
    str | None,
    typer.Option(
        help="Configuration with the settings of the back-ends: a name (an unknown one gives the list) or a YAML file."
        " Default: that of the session; for a file the defaults."
    ),
]
SolverSetting = Annotated[
    list[str] | None, typer.Option("--set", help="KEY=VALUE, e.g. backends.gnc.start=batch. Keys: docs/configuration.md.")
]
ReplaceFile = Annotated[bool, typer.Option("--overwrite", help="Replace an existing file, which is otherwise refused.")]
FootprintText = Annotated[
    str | None,
    typer.Option(
        "--footprint",
        metavar="R|CORNERS",
        help="The robot on the floor: its radius, m, or the corners of a convex polygon round base_link, as 'x,y x,y x,y', m."
        " Where it drove, the grid is free. Default: 0.2.",
    ),
]
AsJson = Annotated[bool, typer.Option("--json", help="Print one JSON object instead of text.")]


def footprint_of(text: str | None) -> Footprint:
    """The footprint that the option names, or the usual one.

    Raises:
        ExportError: it names none.
    """
    from hybridmap.export.carving import Footprint
    from hybridmap.export.formats import ROBOT_RADIUS_M

    return Footprint.disc(ROBOT_RADIUS_M) if text is None else Footprint.parse(text)


def sensor_settings(source: str, **given: str | None) -> dict[str, str]:
    """Turn the options for topics and files that were given into settings: `{"sensors.scan_topic": "/scan"}`.

    Args:
        source: path of a recording, or name of a simulated world.
        given: option name -> value; None if the option was not given.

    Raises:
        ConfigError: an option does not fit the source, such as a topic for a TUM folder.
        StreamError: an option was given, and the source is not of a kind that can be read.
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
            raise ConfigError(f"--{name.replace('_', '-')}: is for a {fitting}; {source} is a {kind}: leave the option out")
