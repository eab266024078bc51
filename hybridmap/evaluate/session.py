"""Every figure of a session against a reference trajectory and against verified relations."""

from __future__ import annotations

import logging
from pathlib import Path

from hybridmap.backends.base import ODOMETRY
from hybridmap.errors import EvaluationError
from hybridmap.evaluate.association import associate
from hybridmap.evaluate.closures import ClosureErrors, closure_errors
from hybridmap.evaluate.edges import EdgeErrors, edge_errors
from hybridmap.evaluate.loops import evaluate_loops
from hybridmap.evaluate.relations import ErrorStatistics, Relations, relation_errors, relations_of
from hybridmap.evaluate.trajectory import absolute_error_of, drift_percent, relative_error_of
from hybridmap.graph.carries import grounded
from hybridmap.metrics import Metric
from hybridmap.store import MapStore, SessionFolder, trajectory_of
from hybridmap.trajectory import Trajectory, read_tum

log = logging.getLogger(__name__)

_ONLINE = "_online"


def evaluate_session(
    folder: Path, reference: Path | None = None, relations: Path | None = None, *, loops: bool = False
) -> list[Metric]:
    """Evaluate odometry and every back-end of a session, final and online, and put the figures into its `metrics.json`.

    Where that cannot be written a warning says so.

    Args:
        folder: the session folder.
        reference: true trajectory in the TUM format; without it the session's own, if there is one.
        relations: verified relative poses, `t1 t2 dx dy dyaw` a line.
        loops: judge the candidates as well, see `evaluate_loops`.

    Returns:
        Figures named `<measure>/<back-end>`; NaN where the data do not give one.

    Raises:
        StoreError: no session there.
        StreamError: the reference is damaged.
        EvaluationError: nothing to compare with, nothing in common, or no views to judge candidates by.
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
    session.merge_metrics(metrics)
    return metrics


def session_trajectories(session: SessionFolder, store: MapStore) -> dict[str, Trajectory]:
    """Name -> estimate of a session: `odometry`, then each back-end's final and `_online`.

    Taken from `trajectory/`; what a killed run could not write there comes from the map file. The poses while the robot was
    carried, as far as the map knows, are left out.
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
        if name + _ONLINE in written:
            estimates[name + _ONLINE] = written[name + _ONLINE]
        elif name in followed:
            estimates[name + _ONLINE] = store.online(name)
    experiences = store.map()
    return {name: grounded(estimate, experiences) for name, estimate in estimates.items()}


def _judge_closures(store: MapStore, truth: Trajectory) -> dict[str, ClosureErrors]:
    experiences = store.map()
    judged = {"graph": closure_errors(experiences, truth)}
    for name, solution in store.solutions().items():
        if name != ODOMETRY:
            judged[name] = closure_errors(experiences, truth, rejected=frozenset(solution.report.rejected_edge_ids))
    return judged


def _judge_edges(store: MapStore, truth: Trajectory) -> list[Metric]:
    solution = store.solutions().get(store.primary)
    weights = {} if solution is None else solution.report.weights
    metrics = []
    for kind, errors in edge_errors(store.map(), truth, weights).items():
        metrics += _edge_metrics(kind.name.lower(), errors)
    return metrics


def _names(estimate: str) -> tuple[str, str, str]:
    """Suffix of the measure, back-end, and words for people."""
    if estimate.endswith(_ONLINE):
        return "_online", estimate.removesuffix(_ONLINE), "as the robot believed it at the time"
    return "", estimate, "over the whole recording"


def against_truth(estimate: str, trajectory: Trajectory, truth: Trajectory) -> list[Metric]:
    """ATE, RPE and drift of one estimate, named `<measure>/<estimate>`.

    Raises:
        EvaluationError: too few stamps in common.
    """
    suffix, backend, when = _names(estimate)
    try:
        pairs = associate(trajectory, truth)
    except EvaluationError as error:
        raise EvaluationError(f"{estimate}: {error}") from None
    ate = absolute_error_of(pairs)
    metre, second = relative_error_of(pairs, 1.0, "m"), relative_error_of(pairs, 1.0, "s")
    rows = [
        ("ate_rmse", ate.rmse_m, "m", "absolute trajectory error after SE(2) alignment, RMSE"),
        ("ate_median", ate.median_m, "m", "absolute trajectory error, median"),
        ("ate_max", ate.max_m, "m", "absolute trajectory error, largest"),
        ("ate_poses", float(ate.used), "1", f"poses compared, of {ate.total}"),
        ("rpe_trans", metre.trans_rmse_m, "m", "relative pose error over 1 m, translation, RMSE"),
        ("rpe_rot", metre.rot_rmse_deg, "deg", "relative pose error over 1 m, rotation, RMSE"),
        ("rpe_trans_1s", second.trans_rmse_m, "m", "relative pose error over 1 s, translation, RMSE"),
        ("rpe_rot_1s", second.rot_rmse_deg, "deg", "relative pose error over 1 s, rotation, RMSE"),
        ("drift", drift_percent(pairs), "%", "mean translational error over pieces of 5 to 160 m, of travel"),
    ]
    return [Metric(f"{name}{suffix}/{backend}", value, unit, f"{text}; {when}") for name, value, unit, text in rows]


def against_relations(estimate: str, trajectory: Trajectory, relations: Relations) -> list[Metric]:
    """Relation errors of one estimate, over all and over those of more than 60 s, named `<measure>/<estimate>`."""
    suffix, backend, when = _names(estimate)
    errors = relation_errors(trajectory, relations)
    if not suffix and backend == ODOMETRY and errors.all.used < 0.5 * errors.all.total:
        log.warning(
            "only %d of %d relations lie within the session; are they of this recording?", errors.all.used, errors.all.total
        )
    rows = [
        *_relation_rows("relation", errors.all, "all relations"),
        *_relation_rows("relation_loop", errors.loops, "relations over more than 60 s"),
    ]
    return [Metric(f"{name}{suffix}/{backend}", value, unit, f"{text}; {when}") for name, value, unit, text in rows]


def _relation_rows(prefix: str, errors: ErrorStatistics, which: str) -> list[tuple[str, float, str, str]]:
    return [
        (f"{prefix}_trans_mean", errors.trans_mean_m, "m", f"translational relation error, mean, {which}"),
        (f"{prefix}_trans_std", errors.trans_std_m, "m", f"translational relation error, standard deviation, {which}"),
        (f"{prefix}_rot_mean", errors.rot_mean_deg, "deg", f"rotational relation error, mean, {which}"),
        (f"{prefix}_rot_std", errors.rot_std_deg, "deg", f"rotational relation error, standard deviation, {which}"),
        (f"{prefix}_used", float(errors.used), "1", f"relations used of {errors.total}, {which}"),
    ]


def _closure_metrics(name: str, errors: ClosureErrors) -> list[Metric]:
    of_graph = name == "graph"  # back-ends share a line of the page, and its words; how many each kept is its own affair
    kept = "accepted by the front-end" if of_graph else "that the back-end kept"
    judged = f"the {errors.judged} loop edges {kept}" if of_graph else f"the loop edges {kept}"
    rows = [
        (
            "loop_precision",
            errors.precision,
            "1",
            f"share of {judged} within 1 m and 15 deg of truth",
        ),
        ("loop_recall", errors.recall, "1", f"share of the {errors.revisits} revisits with a right loop edge {kept}"),
        ("loops_right", float(errors.right), "1", f"right ones of {judged}"),
    ]
    if of_graph:
        rows += [
            ("loop_trans_median", errors.trans_median_m, "m", "translational error of right loop edges, median"),
            ("loop_trans_p95", errors.trans_p95_m, "m", "translational error of right loop edges, 95 %"),
            ("loop_rot_median", errors.rot_median_deg, "deg", "rotational error of right loop edges, median"),
            ("loop_rot_p95", errors.rot_p95_deg, "deg", "rotational error of right loop edges, 95 %"),
        ]
    return [Metric(f"{measure}/{name}", value, unit, text) for measure, value, unit, text in rows]


def _edge_metrics(kind: str, errors: EdgeErrors) -> list[Metric]:
    which = f"the {errors.count} {kind} edges"
    rows = [
        ("edge_trans_median", errors.trans_median_m, "m", f"translational error of {which}, median"),
        ("edge_trans_p95", errors.trans_p95_m, "m", f"translational error of {which}, 95 %"),
        ("edge_rot_median", errors.rot_median_deg, "deg", f"rotational error of {which}, median"),
        ("edge_rot_p95", errors.rot_p95_deg, "deg", f"rotational error of {which}, 95 %"),
        ("edge_chi2_ratio", errors.chi2_ratio, "1", f"normalised squared error of {which}, median, over the expected median"),
        ("edges_wrong", errors.wrong_share, "1", f"share of {which} that are wrong by more than 1 m"),
        (
            "edges_wrong_kept",
            float(errors.wrong_kept),
            "1",
            "of those, how many the primary back-end gave more than half weight",
        ),
    ]
    return [Metric(f"{measure}/{kind}", value, unit, text) for measure, value, unit, text in rows]
