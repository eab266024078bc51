"""All errors of a session against a reference trajectory and verified relations."""

from __future__ import annotations

import logging
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from hybridmap.backends.base import ODOMETRY
from hybridmap.errors import EvaluationError, counted
from hybridmap.evaluate.association import associate
from hybridmap.evaluate.edge_errors import ClosureErrors, EdgeErrors, closure_errors, edge_errors
from hybridmap.evaluate.loops import evaluate_loops
from hybridmap.evaluate.relations import Relations, relation_errors, relations_of
from hybridmap.evaluate.trajectory_errors import absolute_error, absolute_error_of, drift_percent, relative_error_of
from hybridmap.geometry import Array, compose, inverse
from hybridmap.graph.gaps import grounded, pieces
from hybridmap.metrics import ONLINE, Metric, figure
from hybridmap.store import MapStore, SessionFolder, trajectory_of
from hybridmap.store.session_folder import ON_MAP
from hybridmap.trajectory import Trajectory, read_tum

log = logging.getLogger(__name__)


def evaluate_session(
    folder: Path, reference: Path | None = None, relations: Path | None = None, *, loops: bool = False
) -> list[Metric]:
    """Evaluate the trajectories of a session (odometry, and each back-end's final and online one) and store the metrics in its
    `metrics.json`, where they replace those of the same name. The files that were given are named there. If that file cannot
    be written, a warning is logged.

    With a reference, its loops and its edges by kind are evaluated as well.

    Args:
        folder: the session folder.
        reference: ground truth in the TUM format; default: the session's own, if any.
        relations: file of verified relative poses, lines `t1 t2 dx dy dyaw` (s, m, rad).
        loops: also evaluate how well the views tell places apart, see `evaluate_loops`.

    Returns:
        The metrics, named `<measure>/<back-end>`, `<measure>/graph` for all accepted loops, `<measure>/<kind>` for edges of
        one kind; NaN where the data do not allow a value.

    Raises:
        StoreError: the folder holds no session.
        StreamError: the reference is missing or damaged.
        EvaluationError: there is neither a reference nor a relations file, they share no stamps with the session, the
            relations file is missing, empty or damaged, or `loops` is set and there is no ground truth or the session stores no
            views.
    """
    session = SessionFolder(folder)
    session.require()
    truth_file = reference or (session.groundtruth if session.groundtruth.is_file() else None)
    if truth_file is None and relations is None:
        raise EvaluationError(f"{folder}: nothing to compare with; give --reference GT.tum or --relations FILE")
    truth = None if truth_file is None else read_tum(truth_file)
    candidates = evaluate_loops(folder, reference) if loops else []
    with MapStore.open(folder) as store:
        estimates = session_trajectories(session, store)
        verified = None if relations is None else relations_of(relations, estimates[ODOMETRY])
        closures = {} if truth is None else _judge_closures(store, truth)
        edges = [] if truth is None else _judge_edges(store, truth)
    metrics: list[Metric] = []
    for name, trajectory in estimates.items():
        if truth is not None:
            metrics += against_truth(name, trajectory, truth)
        if verified is not None:
            metrics += against_relations(name, trajectory, verified)
    for name, errors in closures.items():
        metrics += _closure_metrics(name, errors)
    metrics += [*edges, *candidates]
    judged_by = {} if truth is None else {"reference": "" if reference is None else str(reference)}
    session.merge_metrics(metrics, judged_by if relations is None else judged_by | {"relations": str(relations)})
    return metrics


def session_trajectories(session: SessionFolder, store: MapStore) -> dict[str, Trajectory]:
    """The estimated trajectories of a session: `odometry`, `<back-end>` (final) and `<back-end>_online` -> trajectory.

    Beside them `on_map`, in the frame of the map that the drive was localised on, if it was.
    They are read from `trajectory/`, or from the map file if the run was killed. Poses while the robot was kidnapped are left
    out where the map records the kidnapping.
    """
    written = session.trajectories()
    estimates = {ODOMETRY: written[ODOMETRY] if ODOMETRY in written else store.track().odometry}
    solutions = store.solutions()
    followed = store.online_backends()
    for name in (*solutions, *(name for name in followed if name not in solutions)):
        if name == ODOMETRY:
            continue
        if name in written:
            estimates[name] = written[name]
        elif name in solutions:
            estimates[name] = trajectory_of(store.track(), solutions[name].poses)
        if name + ONLINE in written:
            estimates[name + ONLINE] = written[name + ONLINE]
        elif name in followed:
            estimates[name + ONLINE] = store.online(name)
    if ON_MAP in written:
        estimates[ON_MAP] = written[ON_MAP]
    experiences = store.map()
    return {name: grounded(estimate, experiences) for name, estimate in estimates.items()}


def _judge_closures(store: MapStore, truth: Trajectory) -> dict[str, ClosureErrors]:
    experiences, _, numbers = store.map().of_sessions([-1])
    judged = {"graph": closure_errors(experiences, truth)}
    for name, solution in store.solutions().items():
        if name != ODOMETRY:
            rejected = np.flatnonzero(np.isin(numbers, solution.report.rejected_edge_ids))
            judged[name] = closure_errors(experiences, truth, rejected=frozenset(rejected.tolist()))
    return judged


def _judge_edges(store: MapStore, truth: Trajectory) -> list[Metric]:
    solution = store.solutions().get(store.primary)
    experiences, _, numbers = store.map().of_sessions([-1])
    given = {} if solution is None else solution.report.weights
    weights = {place: given[number] for place, number in enumerate(numbers.tolist()) if number in given}
    metrics = []
    for kind, errors in edge_errors(experiences, truth, weights).items():
        metrics += _edge_metrics(kind.name.lower(), errors)
    return metrics


def _names(estimate: str) -> tuple[str, str, str]:
    """Suffix of the measure, back-end, and words for people."""
    if estimate.endswith(ONLINE):
        return ONLINE, estimate.removesuffix(ONLINE), "as the robot believed it at the time"
    known = "where its place on the map is known; of its shape alone, as it is aligned"
    return "", estimate, known if estimate == ON_MAP else "over the whole recording"


def against_truth(estimate: str, trajectory: Trajectory, truth: Trajectory) -> list[Metric]:
    """ATE, RPE and drift of one estimated trajectory, as metrics.

    Args:
        estimate: its name: `odometry`, `<back-end>` or `<back-end>_online`.
        trajectory: the estimate.
        truth: true trajectory, in any frame.

    Returns:
        Metrics named `<measure>/<back-end>`, those of an online estimate `<measure>_online/<back-end>`.

    Raises:
        EvaluationError: fewer than three stamps in common.
    """
    suffix, backend, when = _names(estimate)
    try:
        pairs = associate(trajectory, truth)
    except EvaluationError as error:
        raise EvaluationError(f"{estimate}: {error}") from None
    ate = absolute_error_of(pairs)
    metre, second = relative_error_of(pairs, 1.0, "m"), relative_error_of(pairs, 1.0, "s")
    values = {
        "ate_rmse": ate.rmse_m,
        "ate_median": ate.median_m,
        "ate_max": ate.max_m,
        "ate_poses": ate.used,
        "rpe_trans": metre.trans_rmse_m,
        "rpe_rot": metre.rot_rmse_deg,
        "rpe_trans_1s": second.trans_rmse_m,
        "rpe_rot_1s": second.rot_rmse_deg,
        "drift": drift_percent(pairs),
    }
    return [figure(f"{name}{suffix}/{backend}", value, when=when, total=ate.total) for name, value in values.items()]


def against_relations(estimate: str, trajectory: Trajectory, relations: Relations) -> list[Metric]:
    """Relation errors of one estimated trajectory, as metrics: over all relations and over those that span more than 60 s.

    Args:
        estimate: its name: `odometry`, `<back-end>` or `<back-end>_online`.
        trajectory: the estimate.
        relations: verified relative poses.

    Returns:
        Metrics named as by `against_truth`; NaN where the trajectory covers no relation.
    """
    suffix, backend, when = _names(estimate)
    errors = relation_errors(trajectory, relations)
    if not suffix and backend == ODOMETRY and errors.all.used < 0.5 * errors.all.total:
        log.warning(
            "of %s only %d within the session; are they of this recording?",
            counted(errors.all.total, "relation"),
            errors.all.used,
        )
    metrics = []
    judged = (("relation", errors.all, "all relations"), ("relation_loop", errors.loops, "relations over more than 60 s"))
    for prefix, found, which in judged:
        values = {
            "trans_mean": found.trans_mean_m,
            "trans_std": found.trans_std_m,
            "rot_mean": found.rot_mean_deg,
            "rot_std": found.rot_std_deg,
            "used": found.used,
        }
        facts = {"when": when, "which": which, "total": found.total}
        metrics += [figure(f"{prefix}_{name}{suffix}/{backend}", value, **facts) for name, value in values.items()]
    return metrics


def _closure_metrics(name: str, errors: ClosureErrors) -> list[Metric]:
    of_graph = name == "graph"  # back-ends share a line of the page, and its words; how many each kept is its own affair
    kept = "accepted by the front-end" if of_graph else "that the back-end kept"
    judged = f"the {counted(errors.judged, 'loop edge')} {kept}" if of_graph else f"the loop edges {kept}"
    values = {"loop_precision": errors.precision, "loop_recall": errors.recall, "loops_right": errors.right}
    if of_graph:
        values |= {
            "loop_trans_median": errors.trans_median_m,
            "loop_trans_p95": errors.trans_p95_m,
            "loop_rot_median": errors.rot_median_deg,
            "loop_rot_p95": errors.rot_p95_deg,
        }
    facts = {"judged": judged, "kept": kept, "revisits": counted(errors.revisits, "revisit")}
    return [figure(f"{measure}/{name}", value, **facts) for measure, value in values.items()]


def _edge_metrics(kind: str, errors: EdgeErrors) -> list[Metric]:
    which = f"the {counted(errors.count, f'{kind} edge')}"
    values = {
        "edge_trans_median": errors.trans_median_m,
        "edge_trans_p95": errors.trans_p95_m,
        "edge_rot_median": errors.rot_median_deg,
        "edge_rot_p95": errors.rot_p95_deg,
        "edge_chi2_ratio": errors.chi2_ratio,
        "edges_wrong": errors.wrong_share,
        "edges_wrong_kept": errors.wrong_kept,
    }
    return [figure(f"{measure}/{kind}", value, which=which) for measure, value in values.items()]


@dataclass(frozen=True, slots=True)
class Judged:
    """Errors of several solutions of one graph.

    Attributes:
        metrics: errors named `<measure>/<title of the solution>`; empty without ground truth and relations.
        truth: the true path, m and rad, aligned to the solution with the lowest ATE, cut where the robot was kidnapped into
            pieces (P, 3); empty if unknown.
    """

    metrics: tuple[Metric, ...]
    truth: tuple[Array, ...] = ()


def judge_solutions(
    folder: Path, solutions: Mapping[str, Array], reference: Path | None = None, relations: Path | None = None
) -> Judged:
    """Evaluate several solutions of a session's graph, over the whole recording. Nothing is stored.

    Args:
        folder: the session folder.
        solutions: title -> poses (N, 3) of the nodes, m and rad; the title `odometry` stands for dead reckoning at every stamp.
        reference: ground truth in the TUM format; default: the session's own, if any.
        relations: file of verified relative poses, lines `t1 t2 dx dy dyaw`.

    Raises:
        StoreError: the folder holds no session.
        StreamError: the reference is missing or damaged.
        EvaluationError: the relations are damaged, or reference or relations share no time with the session.
    """
    own = SessionFolder(folder).groundtruth
    truth_file = reference or (own if own.is_file() else None)
    truth = None if truth_file is None else read_tum(truth_file)
    with MapStore.open(folder) as store:
        track, experiences = store.track(), store.map()
    verified = None if relations is None else relations_of(relations, track.odometry)
    ways = {name: track.odometry if name == ODOMETRY else trajectory_of(track, poses) for name, poses in solutions.items()}
    ways = {name: grounded(way, experiences) for name, way in ways.items()}
    metrics: list[Metric] = []
    for name, way in ways.items():
        metrics += [] if truth is None else against_truth(name, way, truth)
        metrics += [] if verified is None else against_relations(name, way, verified)
    if truth is None or not ways:
        return Judged(tuple(metrics))
    best = min((absolute_error(way, truth) for way in ways.values()), key=lambda error: error.rmse_m)
    onto_best = inverse(best.pose_reference_estimate)
    return Judged(tuple(metrics), tuple(compose(onto_best, piece.poses) for piece in pieces(truth, experiences)))
