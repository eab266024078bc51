"""The content of a session's page, read from the session folder and transformed into one frame."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

from hybridmap.backends.base import ODOMETRY, SolveReport
from hybridmap.backends.pieces import pieces_of
from hybridmap.errors import EvaluationError, HybridMapError
from hybridmap.evaluate.association import PosePairs, associate
from hybridmap.evaluate.session_errors import session_trajectories
from hybridmap.evaluate.trajectory_errors import absolute_error_of
from hybridmap.geometry import IDENTITY, Array, compose
from hybridmap.graph.experience_map import ExperienceMap
from hybridmap.metrics import Metric
from hybridmap.store import MapStore, SessionFolder
from hybridmap.trajectory import NS_PER_S, Trajectory, read_tum


@dataclass(frozen=True, slots=True)
class Correction:
    """The map of the primary back-end just before and after its largest change during the drive.

    Attributes:
        stamp_ns: stamp at which the map changed.
        shift_m: largest shift of a node, m.
        before, after: (K, 3) poses of the nodes at that time, m and rad, in the page's frame.
    """

    stamp_ns: int
    shift_m: float
    before: Array
    after: Array


BESIDE_M = 10.0
"""Distance at which pieces of a map that are not joined are drawn beside each other, m."""


@dataclass(frozen=True, slots=True)
class SessionScene:
    """Everything drawn on a session's page, in one frame: that of the ground truth if known, else `map`.

    Attributes:
        source: name of the recording or world that was mapped.
        primary: name of the primary back-end.
        backends: `odometry`, then every back-end with a trajectory or a solution, the primary first.
        truth: true trajectory, None if unknown.
        estimates: name -> trajectory, each aligned to the truth by itself; online ones are called `<backend>_online`. Empty
            ones are left out.
        pairs: name -> estimate and truth at common stamps, both in the page's frame; empty without a truth.
        nodes: (N, 3) poses of the nodes by the primary back-end, m and rad.
        experiences: the nodes and edges of the map.
        reports: back-end -> report on its solution.
        correction: the largest change of the map, None if it never changed.
        head, metrics: the content of `metrics.json`.
        config_yaml: the whole configuration as YAML.
    """

    source: str
    primary: str
    backends: tuple[str, ...]
    truth: Trajectory | None
    estimates: dict[str, Trajectory]
    pairs: dict[str, PosePairs]
    nodes: Array
    experiences: ExperienceMap
    reports: dict[str, SolveReport]
    correction: Correction | None
    head: dict[str, Any]
    metrics: list[Metric]
    config_yaml: str


def load_scene(folder: SessionFolder, store: MapStore) -> SessionScene:
    """Read the content of a session's page from its folder and its map file.

    Raises:
        StoreError: the map or the metrics are damaged.
        StreamError: a trajectory is damaged.
    """
    estimates = session_trajectories(folder, store)
    truth = _truth(folder, estimates[ODOMETRY])
    alignments = {} if truth is None else _alignments(estimates, truth)
    estimates = {
        name: Trajectory(estimate.stamps_ns, compose(alignments.get(name, IDENTITY), estimate.poses))
        for name, estimate in estimates.items()
        if len(estimate)
    }
    solutions = store.solutions()
    primary = store.primary
    followed = [name for name in (*solutions, *store.online_backends()) if name != ODOMETRY]
    backends = tuple(dict.fromkeys((ODOMETRY, *(name for name in followed if name == primary), *followed)))
    experiences = store.map()
    poses = solutions[primary].poses if primary in solutions else experiences.initial
    place = alignments.get(primary, alignments.get(ODOMETRY, IDENTITY))
    figures = folder.read_metrics()
    return SessionScene(
        source=store.source,
        primary=primary,
        backends=backends,
        truth=truth,
        estimates=estimates,
        pairs={} if truth is None else _pairs(estimates, truth),
        nodes=compose(place, _side_by_side(poses, experiences)),
        experiences=experiences,
        reports={name: solution.report for name, solution in solutions.items()},
        correction=_correction(store.info("largest_correction"), place),
        head=figures.head,
        metrics=figures.metrics,
        config_yaml=store.config_yaml,
    )


def _side_by_side(poses: Array, experiences: ExperienceMap) -> Array:
    """Poses (N, 3) of a map in pieces that are not joined: that of the newest session stays, the others are put beside it.

    What they show of where the pieces lie relative to each other is nothing, and looks like it.
    """
    pieces, out = pieces_of(experiences.pose_graph()), poses.copy()
    shown = next(nodes for nodes in pieces if nodes[-1] == len(poses) - 1)
    right_m = poses[shown, 0].max()
    for nodes in pieces:
        if nodes is not shown:
            out[nodes, 0] += right_m + BESIDE_M - poses[nodes, 0].min()
            right_m = out[nodes, 0].max()
    return out


def _truth(folder: SessionFolder, odometry: Trajectory) -> Trajectory | None:
    """The part of the known truth that the recording covers."""
    if not folder.groundtruth.is_file():
        return None
    truth = read_tum(folder.groundtruth)
    covered = odometry.covers(truth.stamps_ns, slack_ns=NS_PER_S)
    return Trajectory(truth.stamps_ns[covered], truth.poses[covered]) if covered.any() else None


def _alignments(estimates: dict[str, Trajectory], truth: Trajectory) -> dict[str, Array]:
    found = {}
    for name, estimate in estimates.items():
        try:
            found[name] = absolute_error_of(associate(estimate, truth)).pose_reference_estimate
        except HybridMapError:
            continue  # too few stamps in common: drawn where its own frame has it
    return found


def _pairs(estimates: dict[str, Trajectory], truth: Trajectory) -> dict[str, PosePairs]:
    found = {}
    for name, estimate in estimates.items():
        try:
            found[name] = associate(estimate, truth)
        except EvaluationError:
            continue
    return found


def _correction(info: Any, place: Array) -> Correction | None:
    if not info or not info.get("before"):
        return None
    before, after = compose(place, info["before"]), compose(place, info["after"])
    shift = float(info["shift_m"]) if "shift_m" in info else float(abs(after - before)[:, :2].max())
    return Correction(int(info["stamp_ns"]), shift, before, after)
