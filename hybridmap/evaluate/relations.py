"""Relation errors: errors of a trajectory against relative poses that were verified by people.

R. Kuemmerle et al., "On measuring the accuracy of SLAM algorithms", Autonomous Robots 27, 2009, its equations 1 and 2:
the mean over relations of the translational and of the rotational part of `delta_estimated (-) delta_true`.
"""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from hybridmap.errors import EvaluationError, counted, quoted
from hybridmap.geometry import Array, between
from hybridmap.trajectory import NS_PER_S, Trajectory, known_at, read_stamp_ns

LOOP_GAP_S = 60.0
"""Relations over more than this time count as loops."""


@dataclass(frozen=True, slots=True)
class Relations:
    """Verified relative poses of a recording.

    Attributes:
        stamps_ns: (R, 2) int64, the two times of each relation.
        deltas: (R, 3) pose of `base_link` at the second time seen from the first, m and rad.
    """

    stamps_ns: NDArray[np.int64]
    deltas: Array

    @property
    def is_loop(self) -> NDArray[np.bool_]:
        """(R,) whether each relation spans more than 60 s, and so measures a loop rather than odometry."""
        return np.asarray(np.abs(np.diff(self.stamps_ns, axis=1)[:, 0]) > LOOP_GAP_S * NS_PER_S)


@dataclass(frozen=True, slots=True)
class ErrorStatistics:
    """Mean and (population) standard deviation of relation errors; NaN if no relation could be used.

    Attributes:
        trans_mean_m, trans_std_m, rot_mean_deg, rot_std_deg: mean and deviation of the errors of the used relations.
        used, total: number of relations whose two times the trajectory covers, and of all.
    """

    trans_mean_m: float
    trans_std_m: float
    rot_mean_deg: float
    rot_std_deg: float
    used: int
    total: int


@dataclass(frozen=True, slots=True)
class RelationErrors:
    """Relation errors over all relations, and over those that span more than 60 s."""

    all: ErrorStatistics
    loops: ErrorStatistics


def read_relations(path: Path) -> Relations:
    """Read verified relative poses from a file with lines `t1 t2 dx dy dyaw` (s, m, rad); `#` starts a comment.

    Raises:
        EvaluationError: the file is missing or empty, or a line is damaged.
    """
    if not path.is_file():
        raise EvaluationError(f"{path}: no such relations file")
    stamps: list[tuple[int, int]] = []
    deltas: list[list[float]] = []
    for number, line in enumerate(path.read_text(encoding="utf-8", errors="replace").splitlines(), start=1):
        fields = line.split("#", 1)[0].split()
        if not fields:
            continue
        try:
            delta = [float(field) for field in fields[2:]]
        except ValueError:
            raise EvaluationError(f"{path}:{number}: expected numbers, found {quoted(line)}") from None
        if len(delta) != 3 or not np.isfinite(delta).all():
            raise EvaluationError(f"{path}:{number}: expected 5 finite numbers `t1 t2 dx dy dyaw`, found {quoted(line)}")
        try:
            stamps.append((read_stamp_ns(fields[0]), read_stamp_ns(fields[1])))
        except ValueError as error:
            raise EvaluationError(f"{path}:{number}: {error}") from None
        deltas.append(delta)
    if not stamps:
        raise EvaluationError(f"{path}: holds no relation; expected lines `t1 t2 dx dy dyaw`")
    return Relations(np.array(stamps, dtype=np.int64), np.array(deltas))


def relations_of(path: Path, trajectory: Trajectory) -> Relations:
    """Read verified relations from a file, for a trajectory of the same recording.

    Raises:
        EvaluationError: the file is missing, empty or damaged, or the trajectory covers none of its relations (by both stamps).
    """
    relations = read_relations(path)
    if relation_errors(trajectory, relations).all.used == 0:
        first_s, last_s = trajectory.stamps_s[[0, -1]]
        raise EvaluationError(
            f"{path}: none of its {counted(len(relations.deltas), 'relation')} lies within the session, "
            f"{first_s:.3f}..{last_s:.3f} s; are they of this recording and on the same clock?"
        )
    return relations


def relation_errors(trajectory: Trajectory, relations: Relations) -> RelationErrors:
    """Errors (m, degrees) of a trajectory's relative poses against verified ones, over all relations and over loops alone.

    A relation counts if the trajectory covers both of its stamps; the errors are NaN if none does.
    """
    first, second = relations.stamps_ns[:, 0], relations.stamps_ns[:, 1]
    known = known_at(trajectory, first) & known_at(trajectory, second)
    loop = relations.is_loop
    error = np.zeros((0, 3))
    if known.any():
        error = between(relations.deltas[known], between(trajectory.at(first[known]), trajectory.at(second[known])))
    return RelationErrors(
        all=_statistics(error, len(known)),
        loops=_statistics(error[loop[known]], int(np.count_nonzero(loop))),
    )


def _statistics(error: Array, total: int) -> ErrorStatistics:
    if len(error) == 0:
        return ErrorStatistics(np.nan, np.nan, np.nan, np.nan, 0, total)
    translation, rotation = np.hypot(error[:, 0], error[:, 1]), np.degrees(np.abs(error[:, 2]))
    return ErrorStatistics(
        trans_mean_m=float(translation.mean()),
        trans_std_m=float(translation.std()),
        rot_mean_deg=float(rotation.mean()),
        rot_std_deg=float(rotation.std()),
        used=len(error),
        total=total,
    )
