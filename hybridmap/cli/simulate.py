"""`hybridmap simulate`: write a drive through a simulated world as a recording."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, Literal

import typer

from hybridmap.cli.options import AsJson
from hybridmap.cli.show import Advance, emit, progress
from hybridmap.errors import ConfigError

if TYPE_CHECKING:
    from hybridmap.metrics import Metric
    from hybridmap.simulation import SimulatedStream

Format = Literal["rosbag1", "mcap", "db3", "tum"]
CARRIED_M = 20.0
_FORMAT_OF_SUFFIX: dict[str, Format] = {".bag": "rosbag1", ".mcap": "mcap", ".db3": "db3"}

_Out = Annotated[
    Path,
    typer.Option(
        help="File or folder to write. The suffix .bag, .mcap or .db3 chooses the format; otherwise a TUM folder. What is there"
        " already is refused without --overwrite."
    ),
]
_Config = Annotated[
    str | None,
    typer.Option(help="Configuration: a name (an unknown one gives the list) or a YAML file. Default: that of the world."),
]
_Seed = Annotated[
    int | None,
    typer.Option(
        help="Random seed of the errors of the sensors. World and drive are the same for every seed, but for campus, whose"
        " layout is drawn. Default: that of the configuration.",
        min=0,
    ),
]
_Duration = Annotated[float | None, typer.Option(help="Stop the drive after this many seconds. Default: all of it.")]
_Kidnap = Annotated[
    bool,
    typer.Option(
        "--kidnap",
        help="Kidnap the robot: carry it 20 m (simulation.carried_m) to a visited place, or to the farthest one of a smaller"
        " drive, while its sensors are off.",
    ),
]
_ClockOffset = Annotated[
    float | None,
    typer.Option(help="Seconds by which scans and frames are stamped later than odometry (simulation.clock_offset_s)."),
]


def simulate(
    world: Annotated[str, typer.Argument(help="World: lab, office, corridor, corridor-landmarks or campus (outdoors).")],
    out: _Out,
    format_: Annotated[Format | None, typer.Option("--format", help="Format to write, regardless of the suffix.")] = None,
    config: _Config = None,
    seed: _Seed = None,
    duration: _Duration = None,
    kidnap: _Kidnap = False,
    clock_offset: _ClockOffset = None,
    setting: Annotated[
        list[str] | None, typer.Option("--set", help="KEY=VALUE, e.g. simulation.sensors=laser. Keys: docs/configuration.md.")
    ] = None,
    overwrite: Annotated[
        bool, typer.Option("--overwrite", help="Replace an existing file, or a folder with a recording.")
    ] = False,
    as_json: AsJson = False,
) -> None:
    """Simulate a drive with wheel odometry and an RGB-D camera or a laser. Writes a bag or TUM folder with ground truth.

    Shows the length of the drive, the error of its odometry, and how many messages there are. On an error nothing is written.
    """
    from hybridmap.cli.choose import parse_settings
    from hybridmap.config import Config
    from hybridmap.simulation import SimulatedStream

    _check_world(world)
    chosen = format_ or _FORMAT_OF_SUFFIX.get(out.suffix.lower(), "tum")
    overrides: dict[str, Any] = {"simulation.world": world, "simulation.duration_s": duration, "seed": seed}
    overrides["simulation.clock_offset_s"] = clock_offset
    if kidnap:
        overrides["simulation.carried_m"] = CARRIED_M
    overrides = {key: value for key, value in overrides.items() if value is not None} | parse_settings(setting)
    resolved = Config.load(config or world, overrides)
    stream = SimulatedStream(resolved.simulation, resolved.seed)
    with progress(f"simulating {world}") as advance:
        written = _write(stream, out, chosen, overwrite=overwrite, advance=advance)
    head = {"world": world, "path": str(out), "format": chosen, "seed": resolved.seed}
    emit(head, _figures(stream, written), as_json=as_json, title=f"{out}: {world}, {chosen}")


def _check_world(world: str) -> None:
    from hybridmap.simulation import world_names

    if world not in world_names():
        raise ConfigError(f"{world}: no such world; worlds: {', '.join(world_names())}")


def _write(stream: SimulatedStream, out: Path, chosen: Format, *, overwrite: bool, advance: Advance) -> dict[str, int]:
    from hybridmap.simulation.writers import write_rosbag1, write_rosbag2, write_tum

    if chosen == "rosbag1":
        return write_rosbag1(stream, out, overwrite=overwrite, progress=advance)
    if chosen == "tum":
        return write_tum(stream, out, overwrite=overwrite, progress=advance)
    storage: Literal["mcap", "sqlite3"] = "mcap" if chosen == "mcap" else "sqlite3"
    return write_rosbag2(stream, out, storage, overwrite=overwrite, progress=advance)


def _figures(stream: SimulatedStream, written: dict[str, int]) -> list[Metric]:
    from hybridmap.evaluate.association import travel
    from hybridmap.evaluate.trajectory_errors import absolute_error
    from hybridmap.metrics import Metric

    truth, carry = stream.groundtruth, stream.carry
    driven = truth.poses if carry is None else carry.felt[: len(truth)]
    rows = [
        Metric("duration/simulation", float(truth.stamps_s[-1] - truth.stamps_s[0]), "s", "length of the drive"),
        Metric("travel/simulation", float(travel(driven)[-1]), "m", "distance driven, from the ground truth"),
        Metric("ate_rmse/odometry", absolute_error(stream.odometry, truth).rmse_m, "m", "error of the wheels, SE(2)-aligned"),
    ]
    if carry is not None:
        up_s, down_s = (float(truth.stamps_s[step] - truth.stamps_s[0]) for step in (carry.first, carry.last))
        rows += [
            Metric("carried/simulation", carry.distance_m, "m", "straight-line distance by which the robot was kidnapped"),
            Metric("picked_up/simulation", up_s, "s", "time at which it was picked up, from the start of the drive"),
            Metric("put_down/simulation", down_s, "s", "time at which it was put down, from the start of the drive"),
        ]
    return rows + [Metric(f"written/{name.strip('/')}", float(count), "1", "written") for name, count in written.items()]
