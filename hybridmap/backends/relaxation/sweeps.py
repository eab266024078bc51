"""Sweeps of the per-link rule, compiled: each link in turn moves its two ends towards each other.

A link sees what the links before it have done, which leaves numpy little to do at once: this is the one loop that is
compiled. Without fast mathematics and without threads: the same input gives the same bytes.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from hybridmap.backends.relaxation.relaxing import TOLERANCE_M
from hybridmap.compiled import compiled
from hybridmap.config.backends import RelaxationConfig
from hybridmap.geometry import Array, wrap_angle
from hybridmap.graph.pose_graph import PoseGraph

ROBUST_SCALE_M, ROBUST_SCALE_RAD = 0.3, 0.1
"""`relaxation-robust`: errors of position and heading at which a loop's correction is a quarter of the plain one. A
false loop that is off by a metre then pulls with less than a hundredth."""
ROBUST_START = 8.0
"""Factor on both scales at the first sweep of a call, from which they shrink to themselves: loops of 2 m still pull."""

_LINKS = "int64[::1], int64[::1], float64[:, ::1], boolean[::1]"
_RULE = "float64, float64, int64, float64, float64, float64, float64"
_SIGNATURE = f"Tuple((int64, boolean))(float64[:, ::1], float64[:, ::1], {_LINKS}, {_RULE})"

_TURN = 2.0 * np.pi
_PER_RAD = 1.0 / _TURN


@dataclass(frozen=True, slots=True)
class Relaxed:
    """Where a run of sweeps ended.

    Attributes:
        poses: (N, 3), yaw wrapped; not finite where the run grew without bound.
        sweeps: how many were done.
        settled: whether the last one moved nothing by more than the tolerance.
    """

    poses: Array
    sweeps: int
    settled: bool


def relax_links(graph: PoseGraph, start: Array, sweeps: int, config: RelaxationConfig, *, robust: bool = False) -> Relaxed:
    """At most so many sweeps over the links, by source node and of one node by age, as OpenRatSLAM has them.

    Each link moves both of its ends by theta times its error: x and y in the world frame, and yaw wrapped to +-pi.

    Args:
        graph: its edges are the links; their information is not used.
        start: (N, 3) poses before, m and rad.
        sweeps: most sweeps; they end after one that moves no coordinate by more than `TOLERANCE_M`, or one beyond all bounds.
        config: theta and its decay from sweep to sweep.
        robust: multiply theta by the Geman-McClure weight 1 / (1 + r^2)^2 of a loop's error at its visit, r^2 being the sum of
            the squares in units of the scales. These shrink geometrically from `ROBUST_START` times themselves to themselves,
            which they are in the second half of the sweeps; before that the tolerance ends nothing.
    """
    order = np.argsort(graph.sources, kind="stable")
    poses = np.array(start, dtype=np.float64, order="C")
    done, settled = _sweep(
        poses,
        np.empty_like(poses),
        graph.sources[order],
        graph.targets[order],
        np.ascontiguousarray(graph.deltas[order]),
        graph.is_loop[order] & robust,
        config.theta,
        config.theta_decay,
        sweeps,
        TOLERANCE_M,
        ROBUST_SCALE_M,
        ROBUST_SCALE_RAD,
        ROBUST_START if robust else 1.0,
    )
    poses[:, 2] = wrap_angle(poses[:, 2])
    return Relaxed(poses, done, settled)


@compiled(_SIGNATURE)
def _sweep(
    poses: Array,
    before: Array,
    sources: NDArray[np.int64],
    targets: NDArray[np.int64],
    deltas: Array,
    weighed: NDArray[np.bool_],
    theta: float,
    theta_decay: float,
    sweeps: int,
    tolerance: float,
    scale_m: float,
    scale_rad: float,
    start: float,
) -> tuple[int, bool]:
    """Sweep over `poses` in place, with room for a copy of them; the sweeps done, and whether they settled.

    Element by element, since an operation on a whole array takes seconds to compile.
    """
    for done in range(1, sweeps + 1):
        scale = start ** max(0.0, 1.0 - 2.0 * done / sweeps)
        per_m, per_rad = 1.0 / (scale * scale_m), 1.0 / (scale * scale_rad)
        for node in range(len(poses)):
            for k in range(3):
                before[node, k] = poses[node, k]
        for link in range(len(sources)):
            source, target = sources[link], targets[link]
            yaw = poses[source, 2]
            cos, sin = np.cos(yaw), np.sin(yaw)
            dx = poses[target, 0] - poses[source, 0] - (cos * deltas[link, 0] - sin * deltas[link, 1])
            dy = poses[target, 1] - poses[source, 1] - (sin * deltas[link, 0] + cos * deltas[link, 1])
            turn = poses[target, 2] - yaw - deltas[link, 2]
            turn -= _TURN * np.rint(turn * _PER_RAD)
            rate = theta
            if weighed[link]:
                x, y, angle = dx * per_m, dy * per_m, turn * per_rad
                falloff = 1.0 + x * x + y * y + angle * angle
                rate /= falloff * falloff
            poses[source, 0] += rate * dx
            poses[source, 1] += rate * dy
            poses[source, 2] += rate * turn
            poses[target, 0] -= rate * dx
            poses[target, 1] -= rate * dy
            poses[target, 2] -= rate * turn
        settled, finite = scale == 1.0, True
        for node in range(len(poses)):
            for k in range(3):
                moved = abs(poses[node, k] - before[node, k])
                settled = settled and moved <= tolerance
                finite = finite and moved < np.inf
        if settled or not finite:
            return done, settled
        theta *= theta_decay
    return sweeps, False
