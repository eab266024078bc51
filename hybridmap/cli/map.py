"""`hybridmap map`: map a recording or a simulated world into a session folder."""

from __future__ import annotations

import logging
from pathlib import Path
from typing import Annotated, Any

import typer

from hybridmap.cli.options import OUT, SEED, AsJson, OdometryFile, SensorSetting, Source, Topic, sensor_settings
from hybridmap.cli.show import emit, progress
from hybridmap.errors import ConfigError, EvaluationError

log = logging.getLogger(__name__)

LOST = 3
"""Exit code of a recording that lost messages, where that matters."""

_Configuration = Annotated[
    str | None,
    typer.Option(
        help="Configuration: a name (an unknown one gives the list) or a YAML file. Default: that of the simulated world, or"
        " the one for the sensors found."
    ),
]
_Backends = Annotated[
    list[str] | None,
    typer.Option(
        help="Back-end; may be given several times, the first sets the robot's pose (map -> odom)."
        " An unknown name gives the list. Default: those of the configuration."
    ),
]
_SkipDamaged = Annotated[
    bool,
    typer.Option(
        "--skip-damaged",
        help="Skip damaged scans and pictures, and count them as lost. Without it the first one is an error, which breaks the"
        " session off.",
    ),
]
_Resume = Annotated[
    bool,
    typer.Option(
        "--resume",
        help="Go on with the session of a run that was killed or broken off, from its last checkpoint, to the same map as an"
        " unbroken run. Give the same source and options as before.",
    ),
]
_Onto = Annotated[
    Path | None,
    typer.Option(
        help="Session folder of a map that the drive continues: the new map holds both. Nothing is assumed of where the drive"
        " begins; if it is not found on that map, both stay apart and the verdict says `not joined`. The drive alone lies in"
        " DIR-drive until the end; if the run dies it stays there, and --onto with --resume goes on with it."
    ),
]
_Strict = Annotated[
    bool,
    typer.Option(
        "--strict",
        help="Exit code 3 if messages of the recording were lost or skipped as damaged. The session is written all the same.",
    ),
]


def map_source(
    source: Source,
    out: Annotated[Path, typer.Option(help=OUT)],
    config: _Configuration = None,
    backend: _Backends = None,
    start: Annotated[float | None, typer.Option(help="Start this many seconds after the first stamp.")] = None,
    end: Annotated[float | None, typer.Option(help="End this many seconds after the first stamp.")] = None,
    odometry_topic: Topic = None,
    scan_topic: Topic = None,
    color_topic: Topic = None,
    depth_topic: Topic = None,
    camera_info_topic: Topic = None,
    odometry_file: OdometryFile = None,
    seed: Annotated[int | None, typer.Option(help=f"{SEED} Default: that of the configuration.", min=0)] = None,
    setting: SensorSetting = None,
    skip_damaged: _SkipDamaged = False,
    strict: _Strict = False,
    onto: _Onto = None,
    overwrite: Annotated[bool, typer.Option("--overwrite", help="Replace an existing session.")] = False,
    resume: _Resume = False,
    as_json: AsJson = False,
) -> None:
    """Map a recording or a simulated world into a session folder.

    The folder holds the map (map.db), the trajectories, the resolved configuration, metrics.json with the verdict on the map,
    and the page report.html. Messages that the recording states to hold but that cannot be read are left out, warned of, and
    counted in metrics.json (`lost`). On an error what was mapped is kept, and a session that was to be replaced lies in
    DIR/.previous; an error before the first node changes nothing. Ctrl-C keeps the map in a new folder, and restores a
    session that was to be replaced.
    """
    from hybridmap.cli.choose import choose, parse_settings

    topics = sensor_settings(
        source,
        odometry_topic=odometry_topic,
        scan_topic=scan_topic,
        color_topic=color_topic,
        depth_topic=depth_topic,
        camera_info_topic=camera_info_topic,
        odometry_file=odometry_file,
    )
    named: dict[str, Any] = {"backends.names": backend or None, "seed": seed}
    chosen_here = {key: value for key, value in named.items() if value is not None}
    overrides = {**topics, **chosen_here, **parse_settings(setting)}
    chosen = choose(source, config, overrides, start_s=start, end_s=end, skip_damaged=skip_damaged)
    head, metrics = _mapped(chosen, out, onto, overwrite=overwrite, resume=resume)
    emit(head, metrics, as_json=as_json, title=f"{out}: {chosen.stream.name}")
    if not as_json:
        typer.echo(f"page: {out / 'report.html'}")
    if strict and chosen.stream.report.lost:
        raise typer.Exit(LOST)


def _mapped(chosen: Any, out: Path, onto: Path | None, *, overwrite: bool, resume: bool) -> tuple[dict[str, Any], list[Any]]:
    if resume and overwrite:
        raise ConfigError("--resume goes on with a session as it is; give it without --overwrite")
    if onto is None:
        return map_and_report(chosen.stream, chosen.config, out, overwrite=overwrite, resume=resume)
    from hybridmap.sessions.joining import map_onto

    with progress(f"mapping {chosen.stream.name}") as advance:
        joined = map_onto(chosen.stream, chosen.config, onto, out, overwrite=overwrite, resume=resume, progress=advance)
    return judged(joined.folder)


def map_and_report(
    stream: Any, config: Any, out: Path, *, overwrite: bool, resume: bool = False
) -> tuple[dict[str, Any], list[Any]]:
    """Map a stream into the session folder `out`, evaluate the map if ground truth is known, and write the page.

    With `overwrite` a session that exists is replaced, with `resume` one that did not end is gone on with. What `session.run`
    raises is passed on; that the map could not be evaluated is only logged.

    Returns:
        The two parts of `metrics.json`: the facts about the run, and the list of metrics.
    """
    from hybridmap import session

    with progress(f"mapping {stream.name}") as advance:
        finished = session.run(stream, config, out, overwrite=overwrite, resume=resume, progress=advance)
    return judged(finished.folder)


def judged(folder: Any, *, errors: bool = True) -> tuple[dict[str, Any], list[Any]]:
    """Evaluate a session that was written, if its ground truth is known and `errors` is set, and write its page.

    Returns:
        As `map_and_report`.
    """
    from hybridmap.evaluate import evaluate_session
    from hybridmap.report import write_report

    if errors and folder.groundtruth.is_file():
        try:
            evaluate_session(folder.path)
        except EvaluationError as error:
            log.warning("mapped, but not evaluated: %s", error)
    write_report(folder)
    written = folder.read_metrics()
    return written.head, written.metrics
