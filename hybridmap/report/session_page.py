"""The page of a session."""

from __future__ import annotations

from contextlib import suppress
from dataclasses import dataclass
from importlib.metadata import version
from pathlib import Path
from typing import Any

import numpy as np

from hybridmap.backends.base import ODOMETRY
from hybridmap.errors import StoreError
from hybridmap.graph.gaps import kidnappings
from hybridmap.metrics import Metric
from hybridmap.output import write_text
from hybridmap.report import page_tables as tables
from hybridmap.report.loop_examples import examples
from hybridmap.report.outline import outlines, raster
from hybridmap.report.page_tables import rendered
from hybridmap.report.session_figures import (
    correction_figure,
    error_figure,
    graph_figure,
    known_map_figure,
    trajectories_figure,
)
from hybridmap.report.session_scene import SessionScene, load_scene
from hybridmap.store import MapStore, SessionFolder
from hybridmap.store.session_folder import ON_MAP
from hybridmap.trajectory import NS_PER_S

_TEMPLATE = "report.html.j2"


@dataclass(frozen=True, slots=True)
class Tile:
    """One of the main values at the top of the page, with its unit and label."""

    value: str
    unit: str
    label: str


def write_report(folder: SessionFolder) -> Path:
    """Write `report.html` of a session, replacing an earlier one: one self-contained page without network access or scripts.

    Returns:
        The path of the page.

    Raises:
        StoreError: there is no session, or its map or metrics are damaged.
        StreamError: one of its trajectories is damaged.
        OutputError: the page cannot be written.
    """
    folder.require_map()
    with MapStore.open(folder.path) as store:
        scene = load_scene(folder, store)
        text = rendered(_TEMPLATE, **_content(scene, store), **_on_map(folder, scene.head.get("localized")))
    write_text(folder.report, text)
    return folder.report


def _content(scene: SessionScene, store: MapStore) -> dict[str, Any]:
    points_of = outlines(store, len(scene.nodes))
    building = raster(points_of, scene.nodes)
    correction = scene.correction
    start_ns = scene.estimates[ODOMETRY].stamps_ns[0]
    return {
        "source": scene.source,
        "primary": scene.primary,
        "backends": scene.backends,
        "titles": scene.head.get("titles", {}),
        "reports": [scene.reports[name] for name in scene.backends if name in scene.reports],
        "known_truth": scene.truth is not None,
        "judged_by": {"reference": "", "relations": ""} | scene.head.get("judged_by", {}),
        "saw_something": building is not None,
        "tiles": tiles(scene),
        "sessions": len(scene.experiences.sessions),
        "joined": scene.head.get("joined", True),
        "verdict": scene.head.get("verdict"),
        "reasons": [reason["words"] for reason in scene.head.get("reasons", ())],
        "remarks": _remarks(scene),
        "trajectories": trajectories_figure(scene, building),
        "graph": graph_figure(scene, building),
        "errors": error_figure(scene),
        "correction": None if correction is None else correction_figure(correction, points_of, kidnappings(scene.experiences)),
        "correction_shift": None if correction is None else " ".join(tables.length(correction.shift_m)),
        "correction_time": None if correction is None else tables.number(round((correction.stamp_ns - start_ns) / NS_PER_S, 1)),
        "examples": examples(scene, store, points_of),
        "by_backend": tables.by_backend(scene.metrics, scene.backends),
        "of_session": tables.of_session(scene.metrics, scene.backends),
        "config_yaml": scene.config_yaml,
        "graph_hash": scene.head.get("graph_hash", ""),
        "version": version("hybridmap"),
    }


def _on_map(folder: SessionFolder, localized: dict[str, Any] | None) -> dict[str, Any]:
    """Where a drive was on the map that it was localised on: what the page shows of it; nothing of another drive."""
    way = folder.trajectories().get(ON_MAP)
    if localized is None or way is None:
        return {"localized": localized, "known_map": None}
    known = np.zeros((0, 3))
    with suppress(StoreError), MapStore.open(Path(localized["map"])) as store:
        known = store.solutions()[store.primary].poses
    return {"localized": localized, "known_map": known_map_figure(known, way)}


def tiles(scene: SessionScene) -> list[Tile]:
    """The main values of a session: accuracy, travel, loops and computing time; those without a metric are left out."""
    named = {metric.name: metric for metric in scene.metrics}
    odometry = scene.head.get("titles", {}).get(ODOMETRY, ODOMETRY)
    wanted = [
        (f"ate_rmse/{ODOMETRY}", f"ATE of {odometry}"),
        (f"ate_rmse/{scene.primary}", f"ATE of {scene.primary}"),
        (f"relation_trans_mean/{ODOMETRY}", f"relation error of {odometry}"),
        (f"relation_trans_mean/{scene.primary}", f"relation error of {scene.primary}"),
        ("travel", "driven"),
        ("duration", "recorded"),
        ("nodes", "node(s)"),
        ("loops_accepted", "loop(s) accepted"),
        ("loops_rejected", "loop(s) rejected"),
        ("cpu_s_per_min", "CPU a minute of recording"),
    ]
    return [_tile(named[name], label) for name, label in dict(reversed(wanted)).items() if name in named][::-1]


def _tile(metric: Metric, label: str) -> Tile:
    label = label.replace("(s)", "" if metric.value == 1 else "s")
    if metric.unit == "m":
        return Tile(*tables.length(metric.value), label)
    if metric.unit == "s/min":
        return Tile(f"{metric.value:.3g}", "s", label)
    if metric.unit == "s":
        return Tile(*tables.duration(metric.value), label)
    return Tile(tables.number(metric.value), tables.unit(metric), label)


def _remarks(scene: SessionScene) -> list[str]:
    """Warnings and omissions of the run."""
    failed = [f"{name} failed: {why}" for name, why in dict(scene.head.get("failed_backends", {})).items()]
    return failed + [str(remark) for remark in scene.head.get("remarks", [])]
