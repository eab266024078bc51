"""`hybridmap export`: write a session in the format of another tool."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from hybridmap.cli.options import AsJson, FootprintText, ReplaceFile, footprint_of
from hybridmap.errors import ExportError
from hybridmap.export import FORMATS

_FORMATS = ", ".join(f"{name} ({entry.description})" for name, entry in FORMATS.items())
_BY_SUFFIX = ", ".join(f"{name} {entry.suffix}" for name, entry in FORMATS.items() if entry.by_suffix)


def export(
    folder: Annotated[Path, typer.Argument(metavar="DIR", help="Session folder, as `hybridmap map` writes it.")],
    format_name: Annotated[
        str,
        typer.Option(
            "--format", metavar="F", help=f"{_FORMATS}. Open3D reads some by the suffix, and --out must have it: {_BY_SUFFIX}."
        ),
    ],
    out: Annotated[
        Path,
        typer.Option(metavar="PATH", help="File to write; `grid` writes a .yaml and a .pgm of this name. See --overwrite."),
    ],
    backend: Annotated[
        str | None,
        typer.Option(
            metavar="NAME",
            help="Back-end whose poses to use; an unknown name gives the list. If the session has no result of it, its graph is"
            " solved now. Default: the primary one.",
        ),
    ] = None,
    resolution: Annotated[float, typer.Option(min=0.001, max=10.0, help="Cell size of the occupancy grid, m.")] = 0.05,
    voxel: Annotated[
        float, typer.Option(min=0.001, max=10.0, help="Voxel size of point clouds, m: one point is kept per voxel.")
    ] = 0.02,
    max_depth: Annotated[
        float,
        typer.Option(min=0.1, help="Point clouds and grid: larger depth of a camera is left out, m; a laser is not limited."),
    ] = 5.0,
    footprint: FootprintText = None,
    inflation: Annotated[
        float | None,
        typer.Option(
            min=0.0,
            help="Occupancy grid: write costs of 0 to 100 instead of occupied and free (map_server's mode raw), which fall up"
            " to this distance from an obstacle, m.",
        ),
    ] = None,
    overwrite: ReplaceFile = False,
    as_json: AsJson = False,
) -> None:
    """Export trajectory, pose graph, point cloud or occupancy grid, in the map frame of one back-end; m and rad.

    The session is not changed, and none of its own files is overwritten.
    """
    from hybridmap.cli.show import emit
    from hybridmap.export.formats import ExportOptions, export_session

    _require_grid(format_name, footprint=footprint, inflation=inflation)
    options = ExportOptions(
        resolution_m=resolution,
        voxel_m=voxel,
        max_depth_m=max_depth,
        footprint=footprint_of(footprint),
        inflation_m=inflation,
    )
    written = export_session(folder, format_name, out, backend=backend, overwrite=overwrite, options=options)
    files = [str(path) for path in written.files]
    head = {"format": format_name, "backend": written.backend, "files": files}
    emit(head, written.metrics, as_json=as_json, title=f"{', '.join(files)} ({written.backend})")


def _require_grid(format_name: str, **options: object) -> None:
    """Refuse options of the grid for another format."""
    for name, value in options.items():
        if value is not None and format_name != "grid":
            raise ExportError(f"--{name} is for the format grid; found --format {format_name}")
