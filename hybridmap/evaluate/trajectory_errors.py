"""Errors of a trajectory against a reference: absolute (ATE), relative (RPE) and drift.

ATE and RPE as defined by Sturm et al., "A benchmark for the evaluation of RGB-D SLAM systems", IROS 2012, in the plane;
drift as the mean translational error over sub-trajectories (Geiger et al., "Are we ready for autonomous driving?", CVPR
2012), with lengths that suit a building.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

import numpy as np
from numpy.typing import NDArray

from hybridmap.evaluate.association import PosePairs, associate, travel
from hybridmap.geometry import Array, align, between, compose
from hybridmap.trajectory import NS_PER_S, Trajectory

_DRIFT_LENGTHS_M = (5.0, 10.0, 20.0, 40.0, 80.0, 160.0)


@dataclass(frozen=True, slots=True)
class AbsoluteError:
    """Distances between an estimate and the reference after the best SE(2) alignment.

    Attributes:
        rmse_m, mean_m, median_m, max_m: statistics of the distances between positions; headings do not count.
        pose_reference_estimate: (3,) the alignment: pose of the estimate's map frame in the reference's, m and rad.
        used, total: number of compared poses of the estimate, and of all.
    """

    rmse_m: float
    mean_m: float
    median_m: float
    max_m: float
    pose_reference_estimate: Array
    used: int
    total: int


@dataclass(frozen=True, slots=True)
class RelativeError:
    """Errors of the relative pose over pieces of fixed length or duration (RPE).

    Attributes:
        trans_rmse_m, trans_mean_m: errors of the translation.
        rot_rmse_deg, rot_mean_deg: errors of the rotation.
        pairs: number of pieces compared; the errors are NaN if it is 0.
    """

    trans_rmse_m: float
    trans_mean_m: float
    rot_rmse_deg: float
    rot_mean_deg: float
    pairs: int


def absolute_error(estimate: Trajectory, reference: Trajectory) -> AbsoluteError:
    """ATE: the distances that remain after the estimate is aligned to the reference by one SE(2) transform.

    Raises:
        EvaluationError: fewer than three stamps in common.
    """
    return absolute_error_of(associate(estimate, reference))


def absolute_error_of(pairs: PosePairs) -> AbsoluteError:
    """ATE of an estimate and a reference at common stamps."""
    pose = align(pairs.reference, pairs.estimate)
    offset = compose(pose, pairs.estimate)[:, :2] - pairs.reference[:, :2]
    distance = np.hypot(offset[:, 0], offset[:, 1])
    return AbsoluteError(
        rmse_m=float(np.sqrt(np.mean(distance**2))),
        mean_m=float(distance.mean()),
        median_m=float(np.median(distance)),
        max_m=float(distance.max()),
        pose_reference_estimate=pose,
        used=len(pairs),
        total=pairs.total,
    )


def relative_error(estimate: Trajectory, reference: Trajectory, delta: float, unit: Literal["m", "s"]) -> RelativeError:
    """RPE: error of the relative pose over every piece of `delta` metres of the reference's path, or of `delta` seconds.

    Raises:
        EvaluationError: fewer than three stamps in common.
    """
    return relative_error_of(associate(estimate, reference), delta, unit)


def relative_error_of(pairs: PosePairs, delta: float, unit: Literal["m", "s"]) -> RelativeError:
    """RPE of an estimate and a reference at common stamps, over pieces of `delta` metres of the reference's path, or seconds.

    A piece begins at every pose at which the reference moved on (of seconds: at every pose), so pieces overlap. It ends at the
    first pose at least `delta` further; those more than half too long, as over a gap, are left out. The errors are NaN if there
    is no piece.
    """
    along = travel(pairs.reference) if unit == "m" else (pairs.stamps_ns - pairs.stamps_ns[0]) / NS_PER_S
    first, last = _pieces(along, delta)
    if len(first) == 0:
        return RelativeError(np.nan, np.nan, np.nan, np.nan, 0)
    translation, rotation = motion_errors(pairs, first, last)
    return RelativeError(
        trans_rmse_m=float(np.sqrt(np.mean(translation**2))),
        trans_mean_m=float(translation.mean()),
        rot_rmse_deg=float(np.sqrt(np.mean(rotation**2))),
        rot_mean_deg=float(rotation.mean()),
        pairs=len(first),
    )


def drift_percent(pairs: PosePairs) -> float:
    """Mean translational error in % of the distance travelled by the reference, over pieces of 5, 10, 20, ... 160 m.

    Lengths beyond the path are left out; a path shorter than 5 m is one piece. Returns NaN if the reference does not move.
    """
    along = travel(pairs.reference)
    lengths = [length for length in _DRIFT_LENGTHS_M if length <= along[-1]] or [float(along[-1])]
    if lengths[0] <= 0.0:
        return float("nan")
    shares = []
    for length in lengths:
        first, last = _pieces(along, length)
        grown = along[last] - along[first]
        translation, _ = motion_errors(pairs, first, last)
        shares.append(translation[grown > 0.0] / grown[grown > 0.0])  # beside a jump of 1e9 m a step of millimetres is none
    found = np.concatenate(shares)
    return 100.0 * float(found.mean()) if len(found) else float("nan")


def motion_errors(pairs: PosePairs, first: NDArray[np.int64], last: NDArray[np.int64]) -> tuple[Array, Array]:
    """Errors of the estimate's motion between pairs of poses.

    Args:
        pairs: estimate and reference at common stamps.
        first, last: (K,) indices of the poses at which each motion begins and ends.

    Returns:
        Translation errors (K,), m, and rotation errors (K,), degrees.
    """
    moved = between(pairs.estimate[first], pairs.estimate[last])
    truly = between(pairs.reference[first], pairs.reference[last])
    error = between(truly, moved)
    return np.hypot(error[:, 0], error[:, 1]), np.degrees(np.abs(error[:, 2]))


def _pieces(along: Array, delta: float) -> tuple[NDArray[np.int64], NDArray[np.int64]]:
    """For each pose at which `along` grew: itself and the first pose at least `delta` further, no more than half too far."""
    starts = np.flatnonzero(np.diff(along, prepend=-1.0) > 0)
    ends = np.searchsorted(along, along[starts] + delta - 1e-9)
    reached = ends < len(along)
    starts, ends = starts[reached], ends[reached]
    near = along[ends] - along[starts] <= 1.5 * delta
    return starts[near], ends[near]
