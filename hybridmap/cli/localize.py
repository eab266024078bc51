"""`hybridmap localize`: where a drive was on a map."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from hybridmap.cli.options import OUT, SEED, AsJson, SensorSetting, Source
from hybridmap.cli.show import emit, progress


def localize(
    source: Source,
    map_: Annotated[Path, typer.Option("--map", help="Session folder of the map; it is not changed.")],
    out: Annotated[Path, typer.Option(help=OUT)],
    config: Annotated[
        str | None, typer.Option(help="Configuration of the drive: a name or a YAML file. Default: as for `hybridmap map`.")
    ] = None,
    start: Annotated[float | None, typer.Option(help="Start this many seconds after the first stamp.")] = None,
    end: Annotated[float | None, typer.Option(help="End this many seconds after the first stamp.")] = None,
    seed: Annotated[int | None, typer.Option(help=f"{SEED} Default: that of the configuration.", min=0)] = None,
    setting: SensorSetting = None,
    overwrite: Annotated[bool, typer.Option("--overwrite", help="Replace an existing session.")] = False,
    as_json: AsJson = False,
) -> None:
    """Find where a drive was on a map that exists, wherever it began. The map stays as it is.

    The folder holds the session of the drive, and its trajectory in the frame of the map (trajectory/on_map.tum) wherever its
    place there is known. Where it is not known, that is said, and the trajectory has no pose.
    """
    from hybridmap.cli.choose import choose, parse_settings
    from hybridmap.cli.map import judged
    from hybridmap.sessions.localizing import localize as localize_drive
    from hybridmap.store.session_folder import ON_MAP

    overrides = {**({} if seed is None else {"seed": seed}), **parse_settings(setting)}
    chosen = choose(source, config, overrides, start_s=start, end_s=end)
    with progress(f"localising {chosen.stream.name}") as advance:
        done = localize_drive(chosen.stream, chosen.config, map_, out, overwrite=overwrite, progress=advance)
    head, metrics = judged(done.folder)
    if not as_json:
        head = {**head, "backends": [*head["backends"], ON_MAP]}  # a column of its own
    emit(head, metrics, as_json=as_json, title=f"{out}: {chosen.stream.name} on {map_}")
    if not as_json:
        typer.echo(f"page: {out / 'report.html'}")
