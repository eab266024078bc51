"""`hybridmap import`: make a session of a map that another mapper made."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from hybridmap.cli.options import OUT, AsJson, SensorSetting, Topic
from hybridmap.cli.show import emit


def import_session(
    source: Annotated[
        Path,
        typer.Argument(
            metavar="SOURCE",
            help="Bag (.bag, .mcap, .db3, ROS 2 folder) with OpenRatSLAM's TopologicalAction and odometry, or with a"
            " TopologicalMap; or a table NAME_nodes.csv with its NAME_links.csv.",
        ),
    ],
    out: Annotated[Path, typer.Option(help=OUT)],
    config: Annotated[
        str | None, typer.Option(help="Configuration: a name (an unknown one gives the list) or a YAML file.")
    ] = None,
    backend: Annotated[
        list[str] | None,
        typer.Option(
            help="Back-end; may be given several times, the first is the primary. An unknown name gives the list."
            " Default: those of the configuration."
        ),
    ] = None,
    odometry_topic: Topic = None,
    setting: SensorSetting = None,
    overwrite: Annotated[bool, typer.Option("--overwrite", help="Replace an existing session.")] = False,
    as_json: AsJson = False,
) -> None:
    """Import an experience map of OpenRatSLAM as a session, solved by the configured back-ends.

    The session is like one of `map`, without views: it can be shown, evaluated, compared and exported. Poses of a recorded map
    are kept under the name `openratslam`. The maps have no covariances; docs/formats.md says which are taken.
    """
    from hybridmap.cli.choose import parse_settings
    from hybridmap.config import Config
    from hybridmap.imported.session import import_map
    from hybridmap.report import write_report

    named = {"vision.sensor": "none", "backends.names": backend or None, "sensors.odometry_topic": odometry_topic}
    given = {key: value for key, value in named.items() if value is not None}
    folder = import_map(source, Config.load(config, {**given, **parse_settings(setting)}), out, overwrite=overwrite)
    write_report(folder)
    written = folder.read_metrics()
    emit(written.head, written.metrics, as_json=as_json, title=f"{out}: {source.name}")
    if not as_json:
        typer.echo(f"page: {folder.report}")
