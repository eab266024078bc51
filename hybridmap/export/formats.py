"""The formats by name, and the one function that writes any of them whole or not at all."""

from __future__ import annotations

import shutil
import tempfile
from collections.abc import Callable
from dataclasses import dataclass
from importlib import import_module
from pathlib import Path

from hybridmap.errors import ExportError
from hybridmap.export.view import ExportOptions, SessionView, open_view
from hybridmap.metrics import Metric

Writer = Callable[[SessionView, Path], list[Metric]]


@dataclass(frozen=True, slots=True)
class Format:
    """An export format.

    Attributes:
        writer: `module:function` below this package; it writes one file and returns figures about it.
        suffix: what its file is called while it is written; some writers go by it.
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
    "tum": Format("trajectories:write_tum_trajectory", ".tum", "trajectory: stamp, position, quaternion a line"),
    "kitti": Format("trajectories:write_kitti_trajectory", ".txt", "trajectory: the 12 numbers of a 3x4 pose a line"),
    "g2o": Format("graphs:write_g2o_graph", ".g2o", "pose graph: VERTEX_SE2, EDGE_SE2"),
    "lineset": Format("graphs:write_lineset", ".ply", "graph as an Open3D LineSet, edges coloured by kind", by_suffix=True),
    "posegraph": Format("graphs:write_posegraph", ".json", "graph as an Open3D PoseGraph", by_suffix=True),
    "ply": Format("clouds:write_cloud", ".ply", "merged point cloud, PLY", by_suffix=True),
    "pcd": Format("clouds:write_cloud", ".pcd", "merged point cloud, PCD", by_suffix=True),
    "grid": Format("grids:write_grid", ".yaml", "occupancy grid for map_server: yaml and pgm", ".pgm"),
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
        ExportError: unknown format or back-end, a file in the way, or nothing of the kind in the session.
    """
    if format_name not in FORMATS:
        raise ExportError(f"unknown format {format_name!r}; expected one of: {', '.join(FORMATS)}")
    chosen = FORMATS[format_name]
    targets = _targets(out, chosen)
    for target in targets:
        if chosen.by_suffix and target.suffix != chosen.suffix:
            raise ExportError(f"{target}: Open3D reads a {format_name} by its suffix; name a file that ends in {chosen.suffix}")
        if target.is_dir():
            raise ExportError(f"{target}: is a folder; name a file")
        if target.exists() and not overwrite:
            raise ExportError(f"{target}: exists already; choose another name or give --overwrite")
    module, function = chosen.writer.split(":")
    writer: Writer = getattr(import_module(f"hybridmap.export.{module}"), function)
    view = open_view(folder, backend, options or ExportOptions())
    try:
        metrics = _write_whole(writer, view, targets, chosen)
    finally:
        view.store.close()
    return Exported(targets, view.backend, metrics)


def _targets(out: Path, chosen: Format) -> tuple[Path, ...]:
    if chosen.companion is None:
        return (out,)
    main = out.with_suffix(chosen.suffix) if out.suffix in (chosen.suffix, chosen.companion) else Path(f"{out}{chosen.suffix}")
    return (main, main.with_suffix(chosen.companion))


def _write_whole(writer: Writer, view: SessionView, targets: tuple[Path, ...], chosen: Format) -> list[Metric]:
    """Let the writer work in a folder beside the target, then move what it wrote: nothing half-written is ever seen."""
    beside = next(parent for parent in targets[0].absolute().parents if parent.is_dir())
    try:
        work = Path(tempfile.mkdtemp(prefix=".hybridmap-", dir=beside))
        try:
            partial = work / f"{targets[0].stem}{chosen.suffix}"
            metrics = writer(view, partial)
            targets[0].parent.mkdir(parents=True, exist_ok=True)
            for target in targets:
                written = partial if target == targets[0] else partial.with_suffix(target.suffix)
                written.replace(target)
        finally:
            shutil.rmtree(work, ignore_errors=True)
    except OSError as error:
        raise ExportError(f"{targets[0]}: cannot be written: {error.strerror}") from None
    return metrics
