"""Solutions of a session's graph against the truth and against verified relations, without touching the session."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path

from hybridmap.backends.base import ODOMETRY
from hybridmap.evaluate.relations import relations_of
from hybridmap.evaluate.session import against_relations, against_truth
from hybridmap.evaluate.trajectory import absolute_error
from hybridmap.geometry import Array, compose, inverse
from hybridmap.graph.gaps import grounded, pieces
from hybridmap.metrics import Metric
from hybridmap.store import MapStore, SessionFolder, trajectory_of
from hybridmap.trajectory import read_tum


@dataclass(frozen=True, slots=True)
class Judged:
    """What is known of some solutions.

    Attributes:
        metrics: `<measure>/<title>`, as `evaluate` names them; empty where there is nothing to compare with.
        truth: the true way, m and rad, moved onto the solution of the lowest ATE: a piece (P, 3) before, between and after
            the carries that the map knows of; none where it is not known.
    """

    metrics: tuple[Metric, ...]
    truth: tuple[Array, ...] = ()


def judge_solutions(
    folder: Path, solutions: Mapping[str, Array], reference: Path | None = None, relations: Path | None = None
) -> Judged:
    """Judge poses of a session's nodes, over the whole recording.

    Args:
        folder: the session.
        solutions: title -> poses (N, 3), m and rad; `odometry` stands for dead reckoning at every stamp.
        reference: true trajectory in the TUM format; without it the session's own, if there is one.
        relations: verified relative poses, `t1 t2 dx dy dyaw` a line.

    Raises:
        StoreError: no session there.
        StreamError, EvaluationError: the reference or the relations are damaged or have nothing in common with it.
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
