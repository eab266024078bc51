"""Where a drive was on a map that exists and stays as it is: `hybridmap localize`."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from hybridmap.backends.registry import create
from hybridmap.config import Config
from hybridmap.geometry import IDENTITY, Array, RelativePose, compose, invert_relative
from hybridmap.graph.edges import Edge, Status
from hybridmap.graph.io import graph_hash
from hybridmap.graph.paths import covariances_from
from hybridmap.graph.pose_graph import PoseGraph
from hybridmap.metrics import Metric, figure
from hybridmap.session import Progress, run
from hybridmap.sessions.joining import config_of, require_sensors
from hybridmap.sessions.joint_map import JointMap
from hybridmap.sessions.part import Part, finished
from hybridmap.store import MapStore
from hybridmap.store.session_folder import ON_MAP, SessionFolder
from hybridmap.store.track import Track, trajectory_of
from hybridmap.streams.base import Stream
from hybridmap.trajectory import NS_PER_S, Trajectory

KNOWN_M = 0.5
"""Largest standard deviation of a pose on the map at which it counts as known, m."""


@dataclass(frozen=True, slots=True)
class Localized:
    """A drive that was localised on a map.

    Attributes:
        folder: its session folder.
        found: whether its place on the map was found.
        head, metrics: what `metrics.json` holds.
    """

    folder: SessionFolder
    found: bool
    head: dict[str, Any]
    metrics: list[Metric]


def localize(
    stream: Stream, config: Config, base: Path, out: Path, *, overwrite: bool = False, progress: Progress | None = None
) -> Localized:
    """Find where a drive was on a map; the map is not changed.

    The drive is mapped as it would be alone, into its own session folder. Then its place on the map is looked for as `merge`
    does. The poses of the map are taken as exact, and the drive is solved against them. What is known of its place goes to
    `trajectory/on_map.tum`: the poses at nodes, and between them, whose standard deviation on the map is at most `KNOWN_M`.

    Args:
        stream, config, progress: as for `session.run`.
        base: session folder of the map.
        out: session folder of the drive.
        overwrite: replace a session that exists there.

    Raises:
        StoreError: the map is missing, damaged or not finished, or of other sensors.
        OutputError: `out` is the folder of the map, or lies in it.
        What `session.run` raises.
    """
    SessionFolder(base).require_apart(out)
    with MapStore.open(base) as known:
        require_sensors(known, stream.rig, stream.name)
        finished(known)
        before = graph_hash(known.map())
        folder = run(stream, config, out, overwrite=overwrite, progress=progress).folder
        joint = JointMap(config_of(known), known.rig)
        joint.take_up(Part.of(known))
        with MapStore.open(folder.path) as drive:
            nodes = joint.take_up(Part.of(drive))
            found_m, track = joint.join(nodes), drive.track()
        after = graph_hash(known.map())
    poses, sure = on_map(joint, nodes, config) if found_m is not None else (np.zeros((0, 3)), np.zeros(len(nodes), dtype=bool))
    rows = sure[track.nodes]
    if rows.any():
        way = trajectory_of(track, poses)
        folder.write_trajectory(ON_MAP, Trajectory(way.stamps_ns[rows], way.poses[rows]))
    return _said(folder, base, (before, after), found_m, track, rows)


def on_map(joint: JointMap, nodes: range, config: Config) -> tuple[Array, NDArray[np.bool_]]:
    """Poses (N, 3) of the nodes of a drive on a map that is taken as exact, and which (N,) of them are known."""
    numbers, links = [], []
    for number, edge in enumerate(joint.map.edges):
        if edge.status is Status.ACCEPTED and (edge.source in nodes or edge.target in nodes):
            numbers.append(number)
            links.append(_link(edge, nodes, joint.poses))
    sources, targets, relatives = zip(*links, strict=True)
    graph = PoseGraph(
        initial=np.concatenate([IDENTITY[None], joint.poses[nodes.start : nodes.stop]]),
        sources=np.array(sources, dtype=np.int64),
        targets=np.array(targets, dtype=np.int64),
        deltas=np.array([relative.delta for relative in relatives]),
        information=np.linalg.inv(np.array([relative.covariance for relative in relatives])),
        kinds=np.array([joint.map.edge(number).kind for number in numbers], dtype=np.int8),
        edge_ids=np.array(numbers, dtype=np.int64),
    )
    solution = create(config.backends.names[0], config.backends).solve(graph)
    kept = graph.with_edges(~np.isin(graph.edge_ids, solution.report.rejected_edge_ids))
    spread = covariances_from(kept)(0)[1:, :2, :2]
    spread = np.where(np.isfinite(spread), spread, 1e12)
    return solution.poses[1:], np.asarray(np.linalg.eigvalsh(spread)[:, 1] <= KNOWN_M**2)


def _link(edge: Edge, nodes: range, poses: Array) -> tuple[int, int, RelativePose]:
    """An edge of a graph in which the map is node 0 and the drive's nodes follow."""
    assert edge.relative is not None
    if edge.source in nodes and edge.target in nodes:
        return edge.source - nodes.start + 1, edge.target - nodes.start + 1, edge.relative
    seen, on_map, node = (edge.relative, edge.source, edge.target)
    if edge.source in nodes:
        seen, on_map, node = invert_relative(edge.relative), edge.target, edge.source
    return 0, node - nodes.start + 1, RelativePose(compose(poses[on_map], seen.delta), seen.covariance)


def _said(
    folder: SessionFolder,
    base: Path,
    hashes: tuple[str, str],
    found_m: float | None,
    track: Track,
    rows: NDArray[np.bool_],
) -> Localized:
    """Write figures and facts of a localisation beside those of the drive."""
    before = folder.read_metrics()
    spans = _spans(track, ~rows)
    lost = [f"where the robot was on the map is not known from {a:.1f} s to {b:.1f} s" for a, b in spans]
    if found_m is None:
        lost = ["not localised: the place of the drive on the map was not found"]
    head = {
        **before.head,
        "remarks": [*before.head.get("remarks", []), *lost],
        "localized": {
            "map": str(base),
            "graph_hash_before": hashes[0],
            "graph_hash_after": hashes[1],
            "found": found_m is not None,
            "unknown_s": [list(span) for span in spans],
        },
    }
    metrics = [
        *before.metrics,
        figure("found_after", float("nan") if found_m is None else found_m),
        figure("known_on_map", float(rows.mean())),
    ]
    folder.write_metrics(head, metrics)
    return Localized(folder, found_m is not None, head, metrics)


def _spans(track: Track, rows: NDArray[np.bool_]) -> list[tuple[float, float]]:
    """The stretches of a track that a mask (T,) marks, s from its start."""
    edges = np.flatnonzero(np.diff(rows.astype(np.int8), prepend=0, append=0))
    times_s = (track.stamps_ns - track.stamps_ns[0]) / NS_PER_S
    return [(float(times_s[a]), float(times_s[b - 1])) for a, b in edges.reshape(-1, 2)]
