"""The formats by name, and the one function that writes any of them whole or not at all."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from importlib import import_module
from pathlib import Path

from hybridmap.errors import ExportError
from hybridmap.export.view import ExportOptions, SessionView, open_view
from hybridmap.metrics import Metric
from hybridmap.output import staged

Writer = Callable[[SessionView, Path], list[Metric]]


@dataclass(frozen=True, slots=True)
class Format:
    """An export format.

    Attributes:
        writer: `module:function` below this package; it writes one file and returns figures about it.
        suffix: what its file is usually called.
        description: one line for people.
        companion: suffix of a second file that lies beside the first, if there is one.
        by_suffix: Open3D reads the file back only under its suffix.
    """

    writer: str
    suffix: str
    description: str
    companion: str | None = None
    by_suffix: bool = False


FORMATS: dict[str, Format] = {
    "tum": Format("graphs:write_tum_trajectory", ".tum", "trajectory: stamp, position, quaternion a line"),
    "kitti": Format("graphs:write_kitti_trajectory", ".txt", "trajectory: the 12 numbers of a 3x4 pose a line"),
    "g2o": Format("graphs:write_g2o_graph", ".g2o", "pose graph: VERTEX_SE2, EDGE_SE2"),
    "lineset": Format("graphs:write_lineset", ".ply", "graph as an Open3D LineSet, edges coloured by kind", by_suffix=True),
    "posegraph": Format("graphs:write_posegraph", ".json", "graph as an Open3D PoseGraph", by_suffix=True),
    "ply": Format("keyframes:write_cloud", ".ply", "merged point cloud, PLY", by_suffix=True),
    "pcd": Format("keyframes:write_cloud", ".pcd", "merged point cloud, PCD", by_suffix=True),
    "grid": Format("keyframes:write_grid", ".yaml", "occupancy grid for map_server: yaml and pgm", ".pgm"),
}


@dataclass(frozen=True, slots=True)
class Exported:
    """What was written: the files, whose poses they carry, and figures about them."""

    files: tuple[Path, ...]
    backend: str
    metrics: list[Metric]


def export_session(
    folder: Path,
    format_name: str,
    out: Path,
    *,
    backend: str | None = None,
    overwrite: bool = False,
    options: ExportOptions | None = None,
) -> Exported:
    """Write a session in another format. The same session gives the same bytes.

    Args:
        folder: the session folder.
        format_name: one of `FORMATS`.
        out: the file to write; `grid` writes a `.yaml` and a `.pgm` of that name.
        backend: whose poses; the primary's by default.
        overwrite: replace files that are there.
        options: how fine.

    Raises:
        StoreError: no session there.
        ExportError: unknown format or back-end, or nothing of the kind in the session.
        OutputError: a file in the way, or one that cannot be written.
    """
    if format_name not in FORMATS:
        raise ExportError(f"unknown format {format_name!r}; expected one of: {', '.join(FORMATS)}")
    chosen = FORMATS[format_name]
    targets = _targets(out, chosen)
    for target in targets:
        if chosen.by_suffix and target.suffix != chosen.suffix:
            raise ExportError(f"{target}: Open3D reads a {format_name} by its suffix; name a file that ends in {chosen.suffix}")
    module, function = chosen.writer.split(":")
    writer: Writer = getattr(import_module(f"hybridmap.export.{module}"), function)
    with staged(*targets, overwrite=overwrite) as work:
        view = open_view(folder, backend, options or ExportOptions())
        try:
            metrics = writer(view, work / targets[0].name)
        finally:
            view.store.close()
    return Exported(targets, view.backend, metrics)


def _targets(out: Path, chosen: Format) -> tuple[Path, ...]:
    if chosen.companion is None:
        return (out,)
    main = out.with_suffix(chosen.suffix) if out.suffix in (chosen.suffix, chosen.companion) else Path(f"{out}{chosen.suffix}")
    return (main, main.with_suffix(chosen.companion))
