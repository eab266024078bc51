"""Match the poses of an estimate with a reference, and measure travel."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from hybridmap.errors import EvaluationError, counted
from hybridmap.geometry import Array
from hybridmap.trajectory import MAX_GAP_S, Trajectory, known_at

_DEAD_BAND_M = 0.05


@dataclass(frozen=True, slots=True)
class PosePairs:
    """Poses of an estimated trajectory and of the reference at the same stamps.

    Attributes:
        stamps_ns: (P,) int64.
        estimate: (P, 3) m and rad, in the estimate's map frame.
        reference: (P, 3) m and rad, in the reference's frame.
        total: number of all poses of the estimate, those without a reference included.
    """

    stamps_ns: NDArray[np.int64]
    estimate: Array
    reference: Array
    total: int

    def __len__(self) -> int:
        return len(self.stamps_ns)


def associate(estimate: Trajectory, reference: Trajectory, max_gap_s: float = MAX_GAP_S) -> PosePairs:
    """Interpolate the reference trajectory at the stamps of the estimate. Nothing is aligned.

    Args:
        estimate: trajectory to evaluate.
        reference: true trajectory.
        max_gap_s: longest gap of the reference over which it is interpolated, s. Stamps in longer gaps and outside of the
            reference are left out.

    Raises:
        EvaluationError: fewer than three stamps in common.
    """
    known = known_at(reference, estimate.stamps_ns, max_gap_s)
    if np.count_nonzero(known) < 3:
        raise EvaluationError(
            f"estimate ({_span(estimate)}) and reference ({_span(reference)}) have "
            f"{counted(int(np.count_nonzero(known)), 'stamp')} in common, expected at least 3; are both of the same "
            f"recording and on the same clock?"
        )
    stamps = estimate.stamps_ns[known]
    return PosePairs(stamps, estimate.poses[known], reference.at(stamps), len(estimate))


def travel(poses: Array) -> Array:
    """Path length (P,) up to each pose (P, 3), m. Motion counts only once it adds up to 5 cm, so that jitter does not."""
    total, length = [], 0.0
    positions = poses[:, :2].tolist()
    anchor = positions[0]
    for position in positions:
        step = math.dist(anchor, position)
        if step >= _DEAD_BAND_M:
            anchor, length = position, length + step
        total.append(length)
    return np.array(total)


def _span(trajectory: Trajectory) -> str:
    if len(trajectory) == 0:
        return "empty"
    return f"{trajectory.stamps_s[0]:.3f} to {trajectory.stamps_s[-1]:.3f} s"
