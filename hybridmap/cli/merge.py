"""`hybridmap merge`: maps become one."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from hybridmap.cli.options import OUT, AsJson
from hybridmap.cli.show import emit
from hybridmap.errors import ConfigError


def merge(
    maps: Annotated[
        list[Path], typer.Argument(help="Session folders of two or more maps; the first one gives frame and configuration.")
    ],
    out: Annotated[Path, typer.Option(help=OUT)],
    overwrite: Annotated[bool, typer.Option("--overwrite", help="Replace an existing session.")] = False,
    as_json: AsJson = False,
) -> None:
    """Join maps of one building into one, wherever each drive began. Their order matters for numbers and frame alone.

    No odometry joins them. Views of each session are looked for on the older ones, and loops enter once several of them agree.
    Then all are solved as one map. What is not found is on the new map in a frame of its own, and the verdict says `not
    joined`. The maps stay as they are; nodes and edges of each session are kept bit for bit.
    """
    if len(maps) < 2:
        raise ConfigError("merge: found 1 map, expected two or more")
    from hybridmap.cli.map import judged
    from hybridmap.sessions.joining import merge as merge_maps

    joined = merge_maps(maps, out, overwrite=overwrite)
    head, metrics = judged(joined.folder)
    emit(head, metrics, as_json=as_json, title=f"{out}: {head['source']}")
