"""`hybridmap merge`: two maps become one."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from hybridmap.cli.options import OUT, AsJson
from hybridmap.cli.show import emit


def merge(
    base: Annotated[Path, typer.Argument(help="Session folder of the first map, which gives frame and configuration.")],
    other: Annotated[Path, typer.Argument(help="Session folder of the map that is looked for on it.")],
    out: Annotated[Path, typer.Option(help=OUT)],
    overwrite: Annotated[bool, typer.Option("--overwrite", help="Replace an existing session.")] = False,
    as_json: AsJson = False,
) -> None:
    """Join two maps of one building into one, wherever each of them began.

    No odometry joins them. Views of the second map are looked for on the first, and loops enter once several of them agree.
    Then both are solved as one map. If the second is not found, the new map holds both, each in a frame of its own, and the
    verdict says `not joined`. Both maps stay as they are; nodes and edges of each are kept bit for bit.
    """
    from hybridmap.report import write_report
    from hybridmap.sessions.joining import merge as merge_maps

    joined = merge_maps(base, other, out, overwrite=overwrite)
    write_report(joined.folder)
    emit(joined.head, joined.metrics, as_json=as_json, title=f"{out}: {joined.head['source']}")
