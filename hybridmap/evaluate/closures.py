"""Loop closures against the truth: precision, recall and the errors of the right ones."""

from __future__ import annotations

from collections.abc import Collection
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from hybridmap.evaluate.association import MAX_GAP_S, known_at
from hybridmap.geometry import Array, between, wrap_angle
from hybridmap.graph.edges import Edge, EdgeKind, Status
from hybridmap.graph.experience_map import ExperienceMap
from hybridmap.trajectory import NS_PER_S, Trajectory


@dataclass(frozen=True, slots=True)
class ClosureLimits:
    """When a loop edge is right, and what counts as a revisit.

    Attributes:
        right_m, right_deg: a loop edge whose measurement is this close to the truth is right.
        revisit_m, revisit_deg: a node this close to an older one revisits its place ...
        revisit_gap_s: ... if the older one was made at least this long before.
        window_nodes: a revisit is found if a right loop edge starts within so many nodes of it.
    """

    right_m: float = 1.0
    right_deg: float = 15.0
    revisit_m: float = 1.0
    revisit_deg: float = 30.0
    revisit_gap_s: float = 10.0
    window_nodes: int = 3


@dataclass(frozen=True, slots=True)
class ClosureErrors:
    """How good a set of loop edges is.

    Attributes:
        precision: share of the judged edges that are right; NaN without any.
        recall: share of the revisits that got a right edge; NaN without any revisit.
        judged, right: number of loop edges between nodes whose truth is known, and of the right ones.
        revisits, found: number of nodes that revisit a place, and of those that got a right edge.
        trans_median_m, trans_p95_m, rot_median_deg, rot_p95_deg: errors of the right edges; NaN without any.
    """

    precision: float
    recall: float
    judged: int
    right: int
    revisits: int
    found: int
    trans_median_m: float
    trans_p95_m: float
    rot_median_deg: float
    rot_p95_deg: float


DEFAULT_LIMITS = ClosureLimits()


def closure_errors(
    experiences: ExperienceMap,
    truth: Trajectory,
    rejected: Collection[int] = (),
    limits: ClosureLimits = DEFAULT_LIMITS,
    max_gap_s: float = MAX_GAP_S,
) -> ClosureErrors:
    """Judge the accepted loop edges of a map.

    Args:
        experiences: the map.
        truth: true poses of `base_link`, in any frame.
        rejected: numbers of loop edges that a back-end threw out; they do not count as closures.
        limits: when an edge is right and a node a revisit.
        max_gap_s: longest gap over which the truth is interpolated.
    """
    stamps = np.array([node.stamp_ns for node in experiences.nodes], dtype=np.int64)
    known = known_at(truth, stamps, max_gap_s)
    poses = truth.at(stamps) if known.any() else np.zeros((len(stamps), 3))
    edges = [edge for number, edge in enumerate(experiences.edges) if _counts(edge) and number not in rejected]
    edges = [edge for edge in edges if known[edge.source] and known[edge.target]]
    translation, rotation = _edge_errors(edges, poses)
    right = (translation <= limits.right_m) & (rotation <= limits.right_deg)
    newer = np.array([max(edge.source, edge.target) for edge in edges], dtype=np.int64)[right]
    revisits = _revisits(stamps, poses, known, limits)
    found = _near_any(revisits, newer, limits.window_nodes)
    return ClosureErrors(
        precision=float(right.mean()) if len(edges) else float("nan"),
        recall=float(found.mean()) if len(revisits) else float("nan"),
        judged=len(edges),
        right=int(right.sum()),
        revisits=len(revisits),
        found=int(found.sum()),
        trans_median_m=_quantile(translation[right], 0.5),
        trans_p95_m=_quantile(translation[right], 0.95),
        rot_median_deg=_quantile(rotation[right], 0.5),
        rot_p95_deg=_quantile(rotation[right], 0.95),
    )


def _counts(edge: Edge) -> bool:
    return edge.kind is EdgeKind.LOOP and edge.status is Status.ACCEPTED and edge.relative is not None


def _edge_errors(edges: list[Edge], poses: Array) -> tuple[Array, Array]:
    measured = np.array([e.relative.delta for e in edges if e.relative is not None], dtype=np.float64).reshape(-1, 3)
    ends = np.array([(edge.source, edge.target) for edge in edges], dtype=np.int64).reshape(-1, 2)
    error = between(between(poses[ends[:, 0]], poses[ends[:, 1]]), measured)
    return np.hypot(error[:, 0], error[:, 1]), np.degrees(np.abs(error[:, 2]))


def _revisits(stamps: NDArray[np.int64], poses: Array, known: NDArray[np.bool_], limits: ClosureLimits) -> NDArray[np.int64]:
    """Nodes that come back to a place seen from about the same side."""
    found = []
    for node in np.flatnonzero(known):
        older = known & (stamps < stamps[node] - limits.revisit_gap_s * NS_PER_S)
        offset = poses[older] - poses[node]
        near = np.hypot(offset[:, 0], offset[:, 1]) <= limits.revisit_m
        if np.any(near & (np.degrees(np.abs(wrap_angle(offset[:, 2]))) <= limits.revisit_deg)):
            found.append(node)
    return np.array(found, dtype=np.int64)


def _near_any(nodes: NDArray[np.int64], targets: NDArray[np.int64], window: int) -> NDArray[np.bool_]:
    """Which nodes have a target no more than `window` numbers away."""
    if len(targets) == 0:
        return np.zeros(len(nodes), dtype=np.bool_)
    return np.asarray(np.abs(nodes[:, None] - np.unique(targets)[None, :]).min(axis=1, initial=window + 1) <= window)


def _quantile(values: Array, q: float) -> float:
    return float(np.quantile(values, q)) if len(values) else float("nan")
