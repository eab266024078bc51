"""The odometry terms of the joint calibration, and their covariances.

Where registrations join all nodes, the map does not need odometry. There the terms are long, overlapping pieces of the drive
("legs"), compared by heading and length, for the reasons given in `regression.py`. Elsewhere each odometry edge is a term.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from hybridmap.calibration.legs import Legs, Motion
from hybridmap.calibration.regression import leg_length, leg_sigmas
from hybridmap.geometry import Array
from hybridmap.graph.edges import EdgeKind
from hybridmap.graph.paths import own_odometry
from hybridmap.graph.pose_graph import PoseGraph
from hybridmap.odometry_model import Gains

_OVERLAP = 4


@dataclass(frozen=True, slots=True)
class OdometryTerms:
    """E measurements of odometry between pairs of nodes.

    Attributes:
        legs: raw odometry of each of the E terms.
        sources, targets: (E,) nodes at the start and end of each term.
        whiten: (E, 3, 3) matrix that turns the target's pose relative to its prediction into a residual of unit variance.
        components: (E,) number of components of the residual: 2 for a long leg, 3 for an odometry edge.
        overlap: number of long legs that cover each part of the drive; their information is divided by it.
    """

    legs: Legs
    sources: NDArray[np.int64]
    targets: NDArray[np.int64]
    whiten: Array
    components: NDArray[np.int64]
    overlap: float

    def scaled(self, scale: float) -> OdometryTerms:
        """Copy of the terms with the standard deviations of all of them, long legs too, multiplied by `scale`."""
        return replace(self, whiten=self.whiten / scale)


def terms_of(graph: PoseGraph, motion: Motion, stamps_ns: NDArray[np.int64], gains: Gains) -> OdometryTerms:
    """Make the odometry terms of a graph.

    Args:
        graph: nodes and accepted edges.
        motion: raw odometry.
        stamps_ns: (N,) stamps of the nodes.
        gains: calibration that predicts the direction of a long leg's chord.
    """
    own = own_odometry(graph)
    carried = np.zeros(graph.n_nodes, dtype=bool)  # node k: joined to k + 1 by a registration
    near = (graph.kinds == EdgeKind.REGISTRATION) & (np.abs(graph.targets - graph.sources) == 1)
    carried[np.minimum(graph.sources, graph.targets)[near]] = True
    kept = own[~carried[graph.sources[own]]]
    source, target = _long_legs(carried, stamps_ns, motion)
    overlap = float(_OVERLAP) if len(source) else 1.0
    legs = Legs(motion, stamps_ns[source], stamps_ns[target])
    whiten = np.concatenate([_whiten_long(legs, gains) / np.sqrt(overlap), _whiten_edges(graph, kept)])
    ends = np.concatenate([source, graph.sources[kept]]), np.concatenate([target, graph.targets[kept]])
    return OdometryTerms(
        legs=Legs(motion, stamps_ns[ends[0]], stamps_ns[ends[1]]),
        sources=ends[0],
        targets=ends[1],
        whiten=whiten,
        components=np.repeat([2, 3], [len(source), len(kept)]),
        overlap=overlap,
    )


def _long_legs(
    carried: NDArray[np.bool_], stamps_ns: NDArray[np.int64], motion: Motion
) -> tuple[NDArray[np.int64], NDArray[np.int64]]:
    """Ends of legs within stretches that are joined by registrations, four legs over each place."""
    travel = np.interp(stamps_ns, motion.stamps_ns, motion.travel_m)
    leg_m = leg_length(float(travel[-1] - travel[0]))
    starts = np.searchsorted(travel, np.arange(travel[0], travel[-1], leg_m / _OVERLAP))
    first = np.unique(starts)
    last = np.searchsorted(travel, travel[first] + leg_m)
    inside = last < len(travel)
    first, last = first[inside], last[inside]
    broken = np.concatenate([[0], np.cumsum(~carried)])
    whole = (broken[last] == broken[first]) & (travel[last] - travel[first] < 2.0 * leg_m)
    return first[whole], last[whole]


def _whiten_long(legs: Legs, gains: Gains) -> Array:
    """(L, 3, 3): length along the predicted chord, and heading."""
    predicted = legs.predict(gains)
    sigma_m, sigma_rad = leg_sigmas(legs)
    length = np.maximum(np.hypot(predicted[:, 0], predicted[:, 1]), 1e-9)
    straight = length > 0.3 * legs.travel_m
    direction = (predicted[:, 0] + 1j * predicted[:, 1]) / length * np.exp(-1j * predicted[:, 2])
    out = np.zeros((len(legs), 3, 3))
    out[:, 0, 0], out[:, 0, 1] = direction.real * straight / sigma_m, direction.imag * straight / sigma_m
    out[:, 2, 2] = 1.0 / sigma_rad
    return out


def _whiten_edges(graph: PoseGraph, edges: NDArray[np.int64]) -> Array:
    """(E, 3, 3) upper Cholesky factors of the edges' information."""
    if not len(edges):
        return np.zeros((0, 3, 3))
    return np.asarray(np.linalg.cholesky(graph.information[edges]).transpose(0, 2, 1))
