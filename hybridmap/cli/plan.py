"""`hybridmap plan`: the way from a pose to a goal on a session's map."""

from __future__ import annotations

import math
from pathlib import Path
from typing import Annotated

import typer

from hybridmap.cli.options import AsJson, FootprintText, footprint_of
from hybridmap.cli.show import emit

_Blocked = Annotated[
    list[str] | None,
    typer.Option(
        "--blocked",
        metavar="X,Y,R",
        help="Something that is not in the map: a disc round X,Y of radius R, m. May be given several times.",
    ),
]


def plan(
    folder: Annotated[Path, typer.Argument(metavar="DIR", help="Session folder, as `hybridmap map` writes it.")],
    start: Annotated[
        str,
        typer.Option("--from", metavar="X,Y[,YAW]|NODE", help="Where the robot is, m and degrees in the map, or a node."),
    ],
    goal: Annotated[
        str, typer.Option("--to", metavar="X,Y[,YAW]|NODE", help="Where it shall go, m and degrees in the map, or a node.")
    ],
    blocked: _Blocked = None,
    by: Annotated[str, typer.Option(metavar="length|time", help="What the way is the least of.")] = "length",
    footprint: FootprintText = None,
    resolution: Annotated[float, typer.Option(min=0.001, max=10.0, help="Cell size of the grid, m.")] = 0.05,
    backend: Annotated[
        str | None, typer.Option(metavar="NAME", help="Back-end whose map to use. Default: the primary one.")
    ] = None,
    as_json: AsJson = False,
) -> None:
    """Plan a way through the free space that a map knows: along the driven graph, shortened where there is room.

    With --json the way is in `path`: x, y, m, and heading, rad, of the ends of its straights, in the map frame of the back-end.
    """
    import time

    from hybridmap.errors import ConfigError
    from hybridmap.export.formats import ExportOptions, open_view, require_one_piece
    from hybridmap.metrics import Metric
    from hybridmap.plan.links import Cost
    from hybridmap.plan.session import discs, place, planner_on

    if by not in list(Cost):
        raise ConfigError(f"--by: found {by!r}, expected one of: {', '.join(Cost)}")
    in_the_way = discs(blocked or [])
    view = open_view(folder, backend, ExportOptions(resolution_m=resolution, footprint=footprint_of(footprint)))
    with view.store:
        require_one_piece(folder, view)
        ends = place(start, view.poses), place(goal, view.poses)
        begun_s = time.process_time()
        planner = planner_on(view, Cost(by))
        prepared_s = time.process_time()
        for point, radius_m in in_the_way:
            planner.block(point, radius_m)
        found = planner.plan(*ends)
        done_s = time.process_time()
    head = {"backend": view.backend, "by": by, "nodes": list(found.nodes), "path": found.poses.tolist()}
    metrics = [
        Metric("length", found.length_m, "m", "length of the way"),
        Metric("backups", found.backups, "1", f"values of nodes set to find it, of {len(view.poses)} nodes"),
        Metric("cpu_s/plan", done_s - prepared_s, "s", "CPU time of planning"),
        Metric("cpu_s/free-space", prepared_s - begun_s, "s", "CPU time of drawing the grid and linking the nodes, once a map"),
    ]
    emit(head, metrics, as_json=as_json, title=f"{folder}: from {start} to {goal} ({view.backend})")
    if not as_json:
        typer.echo("way: x m, y m, heading")
        for x_m, y_m, yaw_rad in found.poses.tolist():
            typer.echo(f"{x_m:9.2f} {y_m:9.2f} {math.degrees(yaw_rad):5.0f}")
