"""`hybridmap inspect`: what a recording holds and how it would be mapped."""

from __future__ import annotations

import math
import sys
from typing import TYPE_CHECKING, Annotated, Any

import typer

from hybridmap.cli.map import LOST
from hybridmap.cli.options import AsJson, OdometryFile, SensorSetting, Source, Topic, sensor_settings

if TYPE_CHECKING:
    from collections.abc import Mapping

    from hybridmap.calibration.clock import ClockOffset
    from hybridmap.metrics import Metric
    from hybridmap.streams.inspection import Inspection

_SkipDamaged = Annotated[
    bool,
    typer.Option(
        "--skip-damaged",
        help="Read every scan and picture, and count the damaged ones, which `map --skip-damaged` skips. Without it, damage"
        " inside a scan or picture is seen here in the first 40 m at most, and ends `map`.",
    ),
]
_Strict = Annotated[
    bool,
    typer.Option(
        "--strict",
        help="Exit code 3 if messages that mapping would use cannot be read, or --skip-damaged counted damaged ones.",
    ),
]


def inspect(
    source: Source,
    config: Annotated[
        str | None, typer.Option(help="Configuration to use: a name (an unknown one gives the list) or a YAML file.")
    ] = None,
    odometry_topic: Topic = None,
    scan_topic: Topic = None,
    color_topic: Topic = None,
    depth_topic: Topic = None,
    camera_info_topic: Topic = None,
    odometry_file: OdometryFile = None,
    setting: SensorSetting = None,
    skip_damaged: _SkipDamaged = False,
    strict: _Strict = False,
    as_json: AsJson = False,
) -> None:
    """Show what a recording holds (topics, rates in Hz, spans in s), what mapping would use, and what is missing or damaged.

    It also tells how late scans or frames are stamped, by 40 m of the drive at most. Writes nothing.
    """
    from hybridmap.cli.choose import parse_settings
    from hybridmap.config import Config
    from hybridmap.metrics import to_json
    from hybridmap.streams.inspection import inspect_source
    from hybridmap.streams.open import world_of

    topics = sensor_settings(
        source,
        odometry_topic=odometry_topic,
        scan_topic=scan_topic,
        color_topic=color_topic,
        depth_topic=depth_topic,
        camera_info_topic=camera_info_topic,
        odometry_file=odometry_file,
    )
    overrides = {**topics, **parse_settings(setting)}
    found = inspect_source(source, Config.load(config or world_of(source), overrides), skip_damaged=skip_damaged)
    clock = _clock(found, config, overrides, skip_damaged=skip_damaged)
    if as_json:
        sys.stdout.write(to_json(_head(found, clock), _metrics(found, clock)) + "\n")
    else:
        _show(found, clock)
    if strict and found.lost:
        raise typer.Exit(LOST)


def _clock(found: Inspection, config: str | None, overrides: Mapping[str, Any], *, skip_damaged: bool) -> ClockOffset | None:
    """The offset between views and odometry by the first metres of a recording; None if there is nothing to look at.

    Damage that is met there, and that skipping helps against, is noted in `found`.
    """
    if not found.mappable or not found.parts or not found.rig.sensors:
        return None
    from hybridmap.cli.choose import choose
    from hybridmap.errors import HybridMapError
    from hybridmap.session import first_look

    errors = []
    for skipping in dict.fromkeys((skip_damaged, True)):
        try:
            opened = choose(found.source, config, overrides, skip_damaged=skipping)
            clock = first_look(opened.stream, opened.config)
        except HybridMapError as error:
            errors.append(str(error))
            continue
        found.problems += errors
        found.only_skipping = bool(errors)
        return clock
    found.problems += errors[:1]
    return None


def _head(found: Inspection, clock: ClockOffset | None) -> dict[str, Any]:
    parts = [{"name": part.name, "type": part.kind, "count": part.count, "span_s": part.span_s} for part in found.parts]
    return {
        "source": found.source,
        "kind": found.kind,
        "parts": parts,
        "uses": found.uses,
        "sensor": _sensor(found),
        "remarks": found.remarks,
        "problems": found.problems,
        "lost": found.lost,
        "clock": None if clock is None else {"state": str(clock.state), "words": str(clock)},
        "mappable": found.mappable,
        "only_with_skip_damaged": found.only_skipping,
        "reason": found.reason,
    }


def _metrics(found: Inspection, clock: ClockOffset | None) -> list[Metric]:
    from hybridmap.metrics import Metric, figure

    rows = []
    if clock is not None:
        rows += [figure("clock_offset", clock.offset_s, said=clock), figure("clock_offset_sigma", clock.sigma_s)]
    for part in found.parts:
        name = part.name.lstrip("/")
        rows += [
            Metric(f"count/{name}", part.count, "1", f"messages of {part.kind}"),
            Metric(f"rate/{name}", part.rate_hz, "Hz", "mean rate by header stamps"),
            Metric(f"duration/{name}", part.duration_s, "s", "first to last header stamp"),
            Metric(f"longest_gap/{name}", part.longest_gap_s, "s", "longest time without a message"),
        ]
    return rows


def _sensor(found: Inspection) -> str:
    from hybridmap.streams.sensors import words

    return next(iter(words(found.rig)), "none")


def _show(found: Inspection, clock: ClockOffset | None) -> None:
    lines = [f"{found.source}: {found.kind}", *_table(found)]
    lines += [f"uses {role}: {name}" for role, name in found.uses.items()]
    lines.append(f"maps with: {_sensor(found)}")
    lines += [] if clock is None else [f"clock: {clock}"]
    lines += [f"note: {remark}" for remark in found.remarks]
    lines += [f"problem: {problem}" for problem in found.problems]
    yes = "yes, with --skip-damaged" if found.only_skipping else "yes"
    lines.append(f"mappable: {yes if found.mappable else f'no, because {found.reason}'}")
    sys.stdout.write("\n".join(lines) + "\n")


def _table(found: Inspection) -> list[str]:
    """Aligned columns that are never truncated, so that topic names can be copied."""
    if not found.parts:
        return []
    rows = [("topic or file", "type", "count", "rate Hz", "from s", "for s", "longest gap s")]
    for part in found.parts:
        span = part.span_s
        rate = "" if math.isnan(part.rate_hz) else f"{part.rate_hz:.2f}"
        times = (f"{span[0]:.3f}", f"{part.duration_s:.3f}", f"{part.longest_gap_s:.3f}") if span else ("", "", "")
        rows.append((part.name, part.kind, str(part.count), rate, *times))
    widths = [max(len(row[column]) for row in rows) for column in range(len(rows[0]))]
    aligned = [
        [
            cell.ljust(width) if column < 2 else cell.rjust(width)
            for column, (cell, width) in enumerate(zip(row, widths, strict=True))
        ]
        for row in rows
    ]
    return ["  " + "  ".join(cells).rstrip() for cells in aligned]
